"""The accelerations of a scene, taken apart for what steps do with them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from sympy import S

from eomc.emit.c_expression import DOUBLE, MIN_SIMD_ANGLES
from eomc.emit.c_names import Target
from eomc.program import outline, trig, two_point
from eomc.program.ir import Function, Operand, rename
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
        first, rest = outline.split_precomputed(self.whole, self.own)
        more = [self._correction_parts[0]] if self._correction_parts else []
        names = [o.name for f in (first, *more) for o in f.outputs]
        others = ("signal", "rate_terms")  # what else steps read parameters for
        read = {n for name in others if (f := self.target.program.functions.get(name))
                for n in f.uses}  # fmt: skip
        kept = [n for n in self.own if n in names or n in read]
        kept += [n for n in names if n not in self.own]
        return replace(
            first,
            early=tuple(a for f in (first, *more) for a in f.early),
            outputs=tuple(Operand(S.One, n) for n in kept),
            checks=tuple(pair for f in (first, *more) for pair in f.checks),
        ), rest

    @cached_property
    def _correction_parts(self) -> tuple[Function, Function] | None:
        """The correction onto the constraints in the same two parts."""
        whole = self.target.program.functions.get("projection")
        if whole is None:
            return None
        first, rest = outline.split_precomputed(whole, self.own)
        own = {a.name: f"rows_{a.name}" for a in first.early}
        return rename(first, own), rename(rest, own)

    @cached_property
    def correction(self) -> tuple[Function, bool]:
        """The correction onto the constraints; whether its sines are those of the accelerations."""
        assert self._correction_parts is not None
        rest = self._correction_parts[1]
        angles, apart = trig.apart(rest, self.target.names)
        known = {(frozenset(a.terms), a.offset): a for a in self.angles}
        pairs = [(a, known.get((frozenset(a.terms), a.offset))) for a in angles]
        names = {
            old: new for a, b in pairs if b for old, new in ((a.sine, b.sine), (a.cosine, b.cosine))
        }
        made = {a.name for a in apart.body}
        if not angles or not all(b for _, b in pairs) or made & {*names.values()}:
            return rest, False
        return rename(apart, names), True

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
        if target.real is not DOUBLE or "rk4" not in target.system.run.methods:
            return None
        early = {a.name for a in self.whole.early}
        return two_point.apart(self.rotated[1], self.angles, target.system, {*self.own, *early})

    @property
    def across(self) -> bool:
        """Whether one trajectory takes the sines of four angles at a time."""
        constrained = bool(self.target.system.constraints)
        return self.parts is not None or (constrained and len(self.angles) >= MIN_SIMD_ANGLES)

    @property
    def long(self) -> bool:
        """Whether they are called rather than inlined: that bounds compile time."""
        return outline.weight(self.rotated[1]) > SHORT
