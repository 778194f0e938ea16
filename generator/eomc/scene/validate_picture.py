"""Checks of [picture]. Independent of SymPy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from eomc.base import names
from eomc.scene.assembly import WORLD, Turn, Vector
from eomc.scene.formulas import Formula, suggest
from eomc.scene.picture import Picture, PicturePlace, Shape
from eomc.scene.schema import Document
from eomc.scene.scope import INPUT, VELOCITY, Checker, Path
from eomc.scene.spelling import Place as Written
from eomc.scene.validate_values import ORIGIN, ZERO

_SIMPLE = (("dots", "dot"), ("lines", "line"), ("springs", "spring"), ("paths", "path"))


def check_picture(check: Checker, doc: Document, known: Mapping[str, float]) -> Picture | None:
    """Check the table [picture] of a scene and return the picture, or None if there is no table.

    known: values of constants and parameters by name. Errors are reported to `check`.
    """
    return _Picture(check, doc, known).checked() if doc.picture else None


class _Picture:
    def __init__(self, check: Checker, doc: Document, known: Mapping[str, float]) -> None:
        assert doc.picture is not None
        self.check, self.known, self.table = check, known, doc.picture
        self.bodies = [e.name for table in (doc.body, doc.point) for e in table.values()]
        dimension = len(doc.gravity) if doc.body and doc.gravity else 0
        self.dimension = (
            dimension if dimension in (2, 3) else 0
        )  # 0: not known before the first vector
        self.points: dict[str, Vector] = {}

    def checked(self) -> Picture:
        """Check the table [picture] and return the picture; errors are reported to `check`."""
        for name, at in self.table.points.items():
            self._declare(name, at)
        shapes = [*self._simple(), *self._solids()]
        if not shapes and not self.check.faults:
            self.check.report(
                ("picture",),
                "draws nothing: add dots, lines, springs, boxes, circles or paths, "
                'such as lines = [["cart", "tip"]]',
            )
        axes = "xyz" if self.dimension == 3 else self.table.axes or "xy"
        if self.table.axes and self.dimension == 3:
            self.check.report(("picture", "axes"), "is for pictures in the plane: remove it")
        return Picture(tuple(shapes), axes)

    def _declare(self, name: str, at: tuple[float | str, ...]) -> None:
        path = ("picture", "points", name)
        if why := names.fault(name):
            self.check.report(path, why)
        elif name == WORLD or name in self.bodies:
            what = "the frame that does not move" if name == WORLD else "a body or point already"
            self.check.report(path, f"'{name}' is {what}: name the point otherwise")
        self.points[name] = self._vector(path, at)

    def _simple(self) -> Iterator[Shape]:
        for key, kind in _SIMPLE:
            for entry in getattr(self.table, key):
                many = entry if key in ("lines", "springs") else (entry,)
                places = tuple(self._place(("picture", key), written) for written in many)
                yield Shape(kind, places)

    def _solids(self) -> Iterator[Shape]:
        for key, kind in (("boxes", "box"), ("circles", "circle")):
            path = ("picture", key)
            for at, size, rotation in getattr(self.table, key):
                place = self._place(path, at)
                if kind == "box" and self.dimension and len(size) != self.dimension:
                    where = "in the plane" if self.dimension == 2 else "in space"
                    words = "two edges" if self.dimension == 2 else "three edges"
                    self.check.report(path, f"a box {where} has {words}, here {len(size)}")
                large = tuple(self._size(path, entry) for entry in size)
                yield Shape(kind, (place,), large, self._rotation(path, rotation))

    def _place(self, path: Path, written: Written) -> PicturePlace:
        if not isinstance(written, str):
            return PicturePlace("", self._vector(path, written))
        if written in self.points:
            return PicturePlace(written, self.points[written])
        if written == WORLD or written in self.bodies:
            return PicturePlace(written, None)
        known = [*self.points, *self.bodies]
        near = suggest(written, known)
        remedy = near or ': add it to [picture.points], such as tip = ["x", "l*cos(theta)"]'
        self.check.report(path, f"'{written}' is no point{remedy}", text=written)
        return PicturePlace(written, ORIGIN)

    def _vector(self, path: Path, entries: tuple[float | str, ...]) -> Vector:
        self.dimension = self.dimension or (len(entries) if len(entries) in (2, 3) else 0)
        if len(entries) != self.dimension:
            words = {2: "two entries, as the others here", 3: "three entries, as the others here"}
            count_text = words.get(self.dimension, "two entries in the plane and three in space")
            self.check.report(path, f"a point has {count_text}, not {len(entries)}")
            return ORIGIN
        checked = [self._formula(path, entry) for entry in entries]
        x, y, z = (*checked, ZERO)[:3]
        return x, y, z

    def _formula(self, path: Path, value: float | str) -> Formula:
        """Return a checked formula, which may use all names except inputs and velocities."""
        check = self.check
        formula = check.formula(path, value)
        if formula is None:
            return ZERO
        kinds = check.kinds_of(formula.tree)
        for kind in (INPUT, VELOCITY):
            if kind in kinds:
                why = f"a picture can't depend on {kind}: it shows where things are"
                check.report(path, why, check.where(formula, kind), formula.text)
        return formula

    def _size(self, path: Path, value: float | str) -> Formula:
        """Return a checked length, a formula of parameters that is not negative."""
        rule = "a size is made of numbers, constants and parameters"
        formula = self.check.formula(path, value, self.known, rule)
        if self.check.number(path, formula, self.known) < 0:
            self.check.report(path, "a size is not negative", text=formula.text if formula else "")
        return formula or ZERO

    def _rotation(self, path: Path, rotation: Any) -> tuple[Turn, ...]:
        if rotation is None:
            return ()
        if not isinstance(rotation, tuple):
            if self.dimension == 3:
                why = 'in space a rotation names its axis: write [["z", "pi/2"]], or more turns'
                self.check.report(path, why)
            return (Turn("z", self._formula(path, rotation)),)
        if self.dimension == 2 and any(axis != "z" for axis, _ in rotation):
            self.check.report(path, "in the plane a rotation is an angle: write it alone")
        return tuple(Turn(axis, self._formula(path, angle)) for axis, angle in rotation)
