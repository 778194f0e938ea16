"""Checks of values in the tables of bodies: formulas, vectors, rotations and inertias."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from mpmath import mp

from eomc.base import spatial
from eomc.scene import formulas
from eomc.scene.assembly import WORLD, Turn, Vector
from eomc.scene.formulas import Formula, suggest
from eomc.scene.schema import BodyTable, Document
from eomc.scene.scope import INPUT, VELOCITY, Checker, Path

MOMENT_TOLERANCE = 1e-6  # relative: files give moments of inertia to six digits and more

ZERO = formulas.parse("0")
ORIGIN: Vector = (ZERO, ZERO, ZERO)


class ValueChecker:
    """Checks vectors, rotations, masses and inertias in a scene; errors are reported to `check`.

    doc: the whole scene. known: values of constants and parameters by name. A path is the tuple of
    keys of an entry in the scene, such as ("body", "arm", "mass").
    """

    def __init__(self, check: Checker, doc: Document, known: Mapping[str, float]) -> None:
        self.check = check
        self.doc = doc
        self.known = known
        self.names: dict[str, Path] = {}  # place of each body and point
        # 2 or 3 components of a vector; None if gravity is missing or faulty
        self.dimension: int | None = 2
        self.checked: dict[float | str, tuple[Formula, float]] = {}  # valid formulas by their text
        self.has_inertia: dict[str, bool] = {}

    def value(self, path: Path, value: float | str) -> tuple[Formula, float]:
        """Check an entry that may use constants and parameters; return its formula and its value.

        value: the entry, a number or the text of a formula. The returned value is that for the
        scene's parameters. After an error, report it and return (formula of 0, nan).
        """
        if value not in self.checked:
            rule = f"'{path[-1]}' is made of numbers, constants and parameters"
            formula = self.check.formula(path, value, self.known, rule)
            number = self.check.number(path, formula, self.known)
            if formula is None or math.isnan(number):
                return ZERO, math.nan
            self.checked[value] = formula, number
        return self.checked[value]

    def formula(self, path: Path, value: float | str) -> Formula:
        """Check an entry that may use constants and parameters, and return its formula.

        value: a number or the text of a formula. After an error, report it and return the formula
        of 0.
        """
        return self.value(path, value)[0]

    def position_formula(self, path: Path, value: float | str) -> Formula:
        """Check a formula of a position or angle, and return it.

        It must not depend on inputs or velocities, and not contain dot(...). value: a number or the
        text of the formula. Errors are reported; if the formula can't be parsed, return 0.
        """
        check = self.check
        formula = check.formula(path, value)
        if formula is None:
            return ZERO
        kinds = check.kinds_of(formula.tree)
        if INPUT in kinds:
            check.report(
                path,
                f"'{path[-1]}' can't depend on inputs, whose rates nobody knows: "
                "let them act through an actuator or [forces]",
                check.find_part(formula, INPUT),
                formula.text,
            )
        elif VELOCITY in kinds or any(formula.calls("dot")):
            check.report(
                path,
                f"'{path[-1]}' can't depend on velocities: it is made of coordinates, "
                "t, parameters, constants and definitions of these",
                check.find_part(formula, VELOCITY),
                formula.text,
            )
        check.check_smooth(path, formula)
        return formula

    def vector(
        self,
        path: Path,
        entries: Sequence[float | str] | None,
        formula: Callable[[Path, float | str], Formula] | None = None,
    ) -> Vector:
        """Check a vector and return its three components; in a plane scene, the third is 0.

        entries: two or three numbers or formulas; None for a vector of zeros. formula: the method
        that checks each entry, by default `self.formula`. Errors are reported.
        """
        if entries is None or not self.fits(path, len(entries)):
            return ORIGIN
        checked = [(formula or self.formula)(path, entry) for entry in entries]
        x, y, z = (*checked, ZERO, ZERO, ZERO)[:3]
        return x, y, z

    def fits(self, path: Path, entries: int) -> bool:
        """Return True if a vector with this number of entries fits the dimension of the scene.

        Vectors have two entries in a plane scene and three in space. Otherwise, report the error.
        """
        if self.dimension is None or entries == self.dimension:
            return self.dimension is not None
        scene = "a plane scene" if self.dimension == 2 else "space"
        words = {2: "two", 3: "three"}
        self.check.report(
            path,
            f"vectors have {words[self.dimension]} entries in {scene}, as gravity has, "
            f"here {entries}",
        )
        return False

    def unit(self, path: Path, axis: Sequence[float]) -> tuple[float, float, float] | None:
        """Return an axis as a unit vector of three components.

        axis: two numbers in a plane scene, three in space. After an error, report it and return
        None.
        """
        if not self.fits(path, len(axis)):
            return None
        size = math.hypot(*axis)
        if size < 1e-9:
            self.check.report(path, "the axis has no length, so no direction: give it one")
            return None
        x, y, *third = (entry / size for entry in axis)
        return x, y, third[0] if third else 0.0

    def two_bodies(self, path: Path, bodies: tuple[str, ...], kind: str) -> tuple[str, str]:
        """Check that the two bodies named by an entry exist and differ, and return their names.

        One of them may be "world". kind: the beginning of a message, such as "a spring acts".
        Errors are reported.
        """
        for name in bodies:
            if name != WORLD and name not in self.names:
                remedy = suggest(name, [WORLD, *self.names]) or ": declare it as a [[body]]"
                self.check.report(path, f"there is no body '{name}'{remedy}", text=name)
        first, second = bodies
        if first == second:
            self.check.report(path, f"{kind} between two bodies, here both are '{first}'")
        return first, second

    def rotation(
        self, path: Path, rotation: Any, formula: Callable[[Path, float | str], Formula]
    ) -> tuple[Turn, ...]:
        """Check a rotation and return its successive turns, each about an axis.

        rotation: an angle about z in a plane scene, or a tuple of pairs (axis, angle), or None for
        no rotation. formula: the method that checks an angle. Errors are reported.
        """
        if rotation is None:
            return ()
        if not isinstance(rotation, tuple):
            if self.dimension == 3:
                self.check.report(
                    path, 'in space a rotation names its axis: write [["z", "pi/2"]], or more turns'
                )
            return (Turn("z", formula(path, rotation)),)
        for axis, _ in rotation:
            if axis != "z" and self.dimension == 2:
                self.check.report(path, f"a plane scene turns about z only, here about {axis}")
                break
        return tuple(Turn(axis, formula(path, angle)) for axis, angle in rotation)

    def mass(self, path: Path, entry: BodyTable) -> tuple[Formula, Any]:
        """Check the mass and the inertia of a body, and return their formulas.

        path: keys of the body in the scene. The inertia has the six components Ixx, Iyy, Izz, Ixy,
        Ixz, Iyz in kg m^2; those that are not given are 0. Errors are reported.
        """
        mass, value = self.value((*path, "mass"), entry.mass)
        if value < 0:
            self.check.report(
                (*path, "mass"), f"is {value:g} kg, and no mass is negative", text=mass.text
            )
        inertia, moments = self._inertia((*path, "inertia"), entry.inertia)
        self.has_inertia[entry.name] = value != 0 or any(m != 0 for m in moments)
        return mass, inertia

    def _inertia(self, path: Path, inertia: Any) -> tuple[tuple[Formula, ...], list[float]]:
        nothing = (ZERO,) * 6
        if inertia is None or self.dimension is None:
            return nothing, [math.nan] if self.dimension is None else [0.0]
        single = not isinstance(inertia, tuple)
        entries = (inertia,) if single else inertia
        if self.dimension == 2 and not single:
            self.check.report(path, "a plane scene has one number for it, about z: write it alone")
            return nothing, [math.nan]
        if self.dimension == 3 and (single or len(entries) not in (3, 6)):
            here = "one number" if single else str(len(entries))
            self.check.report(
                path,
                "in space it has three entries, [Ixx, Iyy, Izz], or six, "
                f"[Ixx, Iyy, Izz, Ixy, Ixz, Iyz], here {here}",
            )
            return nothing, [math.nan]
        checked = [self.value(path, entry) for entry in entries]
        moments, numbers = [f for f, _ in checked], [v for _, v in checked]
        if self.dimension == 2:
            if numbers[0] < 0:
                self.check.report(
                    path,
                    f"is {numbers[0]:g} kg m^2, and no inertia is negative",
                    text=moments[0].text,
                )
            return (ZERO, ZERO, moments[0], ZERO, ZERO, ZERO), numbers
        self._moments(path, [*numbers, 0.0, 0.0, 0.0][:6])
        return (*moments, ZERO, ZERO, ZERO)[:6], numbers

    def _moments(self, path: Path, inertia: Sequence[float]) -> None:
        """Report principal moments that no body can have.

        They are impossible if one is negative, or larger than the sum of the two others.
        """
        if not all(abs(x) < 1e150 for x in inertia):
            return
        tensor = mp.matrix(spatial.tensor(inertia))  # NumPy takes 0.1 s to load
        small, middle, large = sorted(map(float, mp.eigsy(tensor, eigvals_only=True)))
        tolerance = MOMENT_TOLERANCE * max(abs(small), abs(large))
        shown = f"{small:.4g}, {middle:.4g} and {large:.4g} kg m^2"
        if small < -tolerance:
            self.check.report(
                path,
                f"its principal moments are {shown}, and none can be negative: "
                "check signs and order, [Ixx, Iyy, Izz, Ixy, Ixz, Iyz]",
            )
        elif large > small + middle + tolerance:
            self.check.report(
                path,
                f"its principal moments are {shown}, and one is larger than the two others "
                "together, which no body has: check it, about the centre of mass",
            )
