"""The accelerations of a scene, split as the integration methods of optimised C need them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from sympy import S

from eomc.emit.c_expression import DOUBLE, MIN_SIMD_ANGLES
from eomc.emit.c_names import Target
from eomc.program import outline, two_point
from eomc.program.ir import Function, Operand, rename
from eomc.program.two_point import Angle

MAX_INLINED_OPERATIONS = 300  # of accelerations, up to which every stage inlines them


@dataclass(frozen=True)
class Accelerations:
    """The accelerations q̈ of a scene, split into functions for the methods of optimised C.

    Attributes
    ----------
    target
        The program and its C names.
    constants
        Names of precomputed expressions, which depend on the parameters only.
    angles
        Angles whose sines and cosines are arguments of the remaining function.
    parts
        The remaining function, split into a position-dependent and a velocity-dependent part; None
        where this split is not faster.
    """

    target: Target

    @cached_property
    def function(self) -> Function:
        """The function of the program for the accelerations, before it is split."""
        return self.target.program["acceleration"]

    @cached_property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the scene's parameters."""
        return tuple(p.name for p in self.target.system.parameters)

    @cached_property
    def precomputed_and_remaining(self) -> tuple[Function, Function]:
        """The accelerations as two functions of the program.

        The first computes all expressions that depend on the parameters only, once for a run; the
        second computes the accelerations from these, at every stage.
        """
        precomputed, remaining = outline.split_precomputed(self.function, self.parameter_names)
        projections = [self._split_projection[0]] if self._split_projection else []
        names = [o.name for f in (precomputed, *projections) for o in f.outputs]
        others = ("signal", "rate_terms")  # other functions of steps that read parameters
        read_by_others = {n for name in others if (f := self.target.program.functions.get(name))
                for n in f.uses}  # fmt: skip
        results = [n for n in self.parameter_names if n in names or n in read_by_others]
        results += [n for n in names if n not in self.parameter_names]
        return replace(
            precomputed,
            early=tuple(a for f in (precomputed, *projections) for a in f.early),
            outputs=tuple(Operand(S.One, n) for n in results),
            checks=tuple(pair for f in (precomputed, *projections) for pair in f.checks),
        ), remaining

    @cached_property
    def _split_projection(self) -> tuple[Function, Function] | None:
        """The projection, split in the same way."""
        whole = self.target.program.functions.get("projection")
        if whole is None:
            return None
        precomputed, remaining = outline.split_precomputed(whole, self.parameter_names)
        new_names = {a.name: f"rows_{a.name}" for a in precomputed.early}
        return rename(precomputed, new_names), rename(remaining, new_names)

    @cached_property
    def correction(self) -> tuple[Function, bool]:
        """The function for corrections of a state onto the constraints, and a flag.

        The function reads precomputed expressions of the parameters. If the flag is True, it also
        takes the sines and cosines that the accelerations take; if False, it computes its own.
        """
        assert self._split_projection is not None
        remaining = self._split_projection[1]
        angles, separated = two_point.separate_angles(remaining, self.target.names)
        known = {(frozenset(a.terms), a.offset): a for a in self.angles}
        pairs = [(a, known.get((frozenset(a.terms), a.offset))) for a in angles]
        names = {
            old: new for a, b in pairs if b for old, new in ((a.sine, b.sine), (a.cosine, b.cosine))
        }
        computed = {a.name for a in separated.body}
        if not angles or not all(b for _, b in pairs) or computed & {*names.values()}:
            return remaining, False
        return rename(separated, names), True

    @property
    def constants(self) -> tuple[str, ...]:
        """Names of the precomputed expressions, which depend on the parameters only."""
        return tuple(o.name for o in self.precomputed_and_remaining[0].outputs)

    @cached_property
    def angles_and_function(self) -> tuple[tuple[Angle, ...], Function]:
        """The angles in the accelerations, and the function for the accelerations without sines.

        The function takes the sines and cosines of the angles as arguments, so that a step can
        obtain them by rotating those of another stage. There are no angles if eomc has no sine and
        cosine of its own for the type of numbers.
        """
        if not self.target.real.reach:
            return (), self.precomputed_and_remaining[1]
        return two_point.separate_angles(self.precomputed_and_remaining[1], self.target.names)

    @property
    def angles(self) -> tuple[Angle, ...]:
        """Angles whose sines and cosines are arguments of the function for the accelerations."""
        return self.angles_and_function[0]

    @cached_property
    def parts(self) -> two_point.Parts | None:
        """The accelerations, split into a position-dependent and a velocity-dependent function.

        None if the scene does not use RK4 in double precision, or if the split is not faster.
        """
        target = self.target
        if target.real is not DOUBLE or "rk4" not in target.system.run.methods:
            return None
        early = {a.name for a in self.function.early}
        return two_point.split(
            self.angles_and_function[1], self.angles, target.system, {*self.parameter_names, *early}
        )

    @property
    def simd_angles(self) -> bool:
        """Whether single trajectories compute the sines of four angles in one vector register."""
        constrained = bool(self.target.system.constraints)
        return self.parts is not None or (constrained and len(self.angles) >= MIN_SIMD_ANGLES)

    @property
    def is_long(self) -> bool:
        """Whether the C function for the accelerations is too long to be inlined in every stage.

        Compilation would take too long if it were inlined.
        """
        return outline.weight(self.angles_and_function[1]) > MAX_INLINED_OPERATIONS
