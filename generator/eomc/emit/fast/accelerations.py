"""The accelerations of a scene, taken apart for what steps do with them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from sympy import S

from eomc.emit.c_expression import DOUBLE
from eomc.emit.c_names import Target
from eomc.program import outline, trig, two_point
from eomc.program.ir import Function, Operand
from eomc.program.trig import Angle

SHORT = 300  # operations of accelerations that are inlined into every stage


@dataclass(frozen=True)
class Accelerations:
    """The accelerations of a scene, taken apart for steppers.

    constants: what parameters alone decide and the rest reads. angles: those whose sines and
    cosines come from outside. parts: of the two-point form, where it pays.
    """

    target: Target

    @cached_property
    def whole(self) -> Function:
        """As the program has it."""
        return self.target.program["acceleration"]

    @cached_property
    def own(self) -> tuple[str, ...]:
        """The scene's parameters."""
        return tuple(p.name for p in self.target.system.parameters)

    @cached_property
    def staged(self) -> tuple[Function, Function]:
        """What parameters alone decide, as a function of its own; and the rest."""
        first, rest = outline.staged(self.whole, self.own)
        kept = [o.name for o in first.outputs]
        others = ("signal", "projection", "rate_terms")  # what else steps read parameters for
        there = [f for n in others if (f := self.target.program.functions.get(n))]
        if there:
            read = frozenset[str]().union(*(f.uses for f in there))
            kept = [n for n in self.own if n in kept or n in read] + [
                n for n in kept if n not in self.own
            ]
        return replace(first, outputs=tuple(Operand(S.One, n) for n in kept)), rest

    @property
    def constants(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(o.name for o in self.staged[0].outputs)

    @cached_property
    def rotated(self) -> tuple[tuple[Angle, ...], Function]:
        """The angles, and the function that reads their sines and cosines."""
        if not self.target.real.reach:
            return (), self.staged[1]
        return trig.apart(self.staged[1], self.target.names)

    @property
    def angles(self) -> tuple[Angle, ...]:
        """The angles."""
        return self.rotated[0]

    @cached_property
    def parts(self) -> two_point.Parts | None:
        """Of the two-point form, which RK4 takes in double precision."""
        target = self.target
        constrained = bool(target.system.constraints)
        if target.real is not DOUBLE or constrained or "rk4" not in target.system.run.methods:
            return None
        early = {a.name for a in self.whole.early}
        return two_point.apart(self.rotated[1], self.angles, target.system, {*self.own, *early})

    @property
    def long(self) -> bool:
        """Whether they are called rather than inlined: that bounds compile time."""
        return outline.weight(self.rotated[1]) > SHORT
