"""Dependencies of derivatives and outputs on coordinates, velocities, inputs and time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from eomc.program.ir import Function
from eomc.program.program import TIME, Program

Names = frozenset[str]


@dataclass(frozen=True)
class Dependencies:
    """Names of the variables that accelerations, outputs and event functions depend on.

    Variables are coordinates, velocities, inputs, parameters and the time.

    Attributes
    ----------
    program
        The program that computes these results.
    signals
        Whether the scene's signals (formulas for its inputs) may replace the inputs. If so, results
        that depend on an input also depend on the variables in its signal.
    """

    program: Program
    signals: bool

    @cached_property
    def known(self) -> Names:
        """The names of all variables that a simulation tool sets in the FMU, including the time.

        These are coordinates, velocities, inputs, parameters and the time.
        """
        s = self.program.system
        return frozenset(x.name for x in (*s.q, *s.qd, *s.u, *s.parameters)) | {TIME}

    @cached_property
    def accelerations(self) -> Sequence[Names]:
        """For each acceleration, the names of the variables that it depends on."""
        return self._results_of("acceleration")

    @cached_property
    def outputs(self) -> Sequence[Names]:
        """For each output, the names of the variables that it depends on."""
        return self._results_of("outputs")

    @cached_property
    def events(self) -> Sequence[Names]:
        """For each event function, the names of the variables that it depends on."""
        return self._results_of("events")

    @cached_property
    def _signals(self) -> Mapping[str, Names]:
        """Dependencies of each input on the variables of the scene's signal for it."""
        names = [x.name for x in self.program.system.u]
        if not self.signals or "signal" not in self.program:
            return {}
        return dict(zip(names, read(self.program["signal"]), strict=True))

    def _results_of(self, name: str) -> Sequence[Names]:
        """Return the dependencies of each result of a function; [] where the program does not have
        it.
        """
        return [self._resolved(x) for x in read(self.program[name])] if name in self.program else []

    def _resolved(self, names: Names) -> Names:
        """Return names with accelerations and signals replaced by their dependencies."""
        qdd = [x.name for x in self.program.system.qdd]
        result = set(names)
        for name, dependencies in zip(
            qdd, self.accelerations if names & {*qdd} else (), strict=False
        ):
            result |= dependencies if name in names else set()
        for name, dependencies in self._signals.items():
            result |= dependencies if name in result else set()
        return frozenset(result) & self.known


def read(function: Function) -> list[Names]:
    """Return the names of the arguments that each result of a function depends on.

    function: a function of the program, a list of elementary operations.
    """
    dependencies: dict[str, Names] = {}
    for a in (*function.early, *function.body):
        dependencies[a.name] = frozenset().union(*(dependencies.get(n, {n}) for n in a.value.names))
    return [dependencies.get(o.name, frozenset({o.name} - {""})) for o in function.outputs]
