"""Dictionary of quantities of constraints, loops or events, by name."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NoReturn

from .arguments import not_one_of


class ByName(dict[str, Any]):
    """Dict of values by name, whose KeyError for an unknown name lists the known names.

    Parameters
    ----------
    what : str
        What the dict contains, such as "events"; part of the error message.
    names : sequence of str
        The known names.
    values : iterable
        One value for each name.
    """

    def __init__(self, what: str, names: Sequence[str], values: Iterable[Any]) -> None:
        super().__init__(zip(names, values, strict=True))
        self.what = what

    def __missing__(self, name: object) -> NoReturn:
        raise KeyError(not_one_of(self.what, str(name), tuple(self)))

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (dict(self),)
