"""Options NAME=VALUE, where a value may be a formula such as pi/3."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from eomc.base.errors import EomcError


def parse_pairs(
    arguments: Sequence[str], option: str, known: Mapping[str, float]
) -> Iterator[tuple[str, float]]:
    """Yield (name, value) of each NAME=VALUE; formulas may use the names in `known`.

    Raises EomcError.
    """
    import math

    from eomc.scene import formulas

    names: set[str] = set()
    for pair in arguments:
        name, equals, text = pair.partition("=")
        name = name.strip()
        if not equals:
            raise EomcError(f"{option} {pair}: write {option} NAME=VALUE")
        if name in names:
            raise EomcError(f"{option} {pair}: '{name}' has a value already: give it once")
        names.add(name)
        try:
            value = float(
                formulas.evaluate(formulas.parse(text), formulas.NUMERIC, known.__getitem__)
            )
        except KeyError as fault:
            raise EomcError(f"{option} {pair}: {fault} is not a number or parameter") from None
        except (ValueError, ArithmeticError, TypeError) as fault:
            raise EomcError(f"{option} {pair}: {fault}") from None
        if not math.isfinite(value):
            raise EomcError(f"{option} {pair}: not a finite number")
        yield name, value
