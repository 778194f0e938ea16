"""What each derivative and output depends on: coordinates, velocities, inputs, the time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from eomc.program.ir import Function
from eomc.program.program import TIME, Program

Names = frozenset[str]


@dataclass(frozen=True)
class Dependencies:
    """Of a program's results, by the names of coordinates, velocities, inputs, parameters, time.

    signals: whether the scene's signals may act in place of inputs, and bring what they read.
    """

    program: Program
    signals: bool

    @cached_property
    def known(self) -> Names:
        """What an importer sets."""
        s = self.program.system
        return frozenset(x.name for x in (*s.q, *s.qd, *s.u, *s.parameters)) | {TIME}

    @cached_property
    def accelerations(self) -> Sequence[Names]:
        """Of each acceleration."""
        return self._of("acceleration")

    @cached_property
    def outputs(self) -> Sequence[Names]:
        """Of each output."""
        return self._of("outputs")

    @cached_property
    def events(self) -> Sequence[Names]:
        """Of each event."""
        return self._of("events")

    @cached_property
    def _signals(self) -> Mapping[str, Names]:
        """What each input reads where it follows the scene's signal."""
        names = [x.name for x in self.program.system.u]
        if not self.signals or "signal" not in self.program:
            return {}
        return dict(zip(names, read(self.program["signal"]), strict=True))

    def _of(self, name: str) -> Sequence[Names]:
        """Of each result of a function, where there is that function."""
        return [self._whole(x) for x in read(self.program[name])] if name in self.program else []

    def _whole(self, names: Names) -> Names:
        qdd = [x.name for x in self.program.system.qdd]
        found = set(names)
        for name, behind in zip(qdd, self.accelerations if names & {*qdd} else (), strict=False):
            found |= behind if name in names else set()
        for name, behind in self._signals.items():
            found |= behind if name in found else set()
        return frozenset(found) & self.known


def read(function: Function) -> list[Names]:
    """The names from outside that each result of a function is computed from."""
    behind: dict[str, Names] = {}
    for a in (*function.early, *function.body):
        behind[a.name] = frozenset().union(*(behind.get(n, {n}) for n in a.value.names))
    return [behind.get(o.name, frozenset({o.name} - {""})) for o in function.outputs]
