"""Checks of [[spring]], [[damper]] and [[force]]."""

from __future__ import annotations

from typing import Any

from eomc.scene.assembly import WORLD, Damper, Force, Spring, Vector
from eomc.scene.formulas import suggest
from eomc.scene.schema import DamperTable, ForceTable, SpringTable
from eomc.scene.scope import Path
from eomc.scene.validate_values import ORIGIN, ZERO, ValueChecks


class SpringChecks(ValueChecks):
    """Checks the tables [[spring]], [[damper]] and [[force]]."""

    def _spring(self, path: Path, entry: SpringTable) -> Spring:
        return Spring(
            stiffness=self._formula((*path, "stiffness"), entry.stiffness),
            length=self._formula((*path, "length"), entry.length),
            **self._between(path, entry),
        )

    def _damper(self, path: Path, entry: DamperTable) -> Damper:
        return Damper(
            damping=self._formula((*path, "damping"), entry.damping), **self._between(path, entry)
        )

    def _force(self, path: Path, entry: ForceTable) -> Force:
        """Return the checked force, torque or both; their formulas may use all names."""
        check = self.check
        if entry.body not in self.names:
            remedy = suggest(entry.body, self.names) or ": declare it as a [[body]]"
            if entry.body == WORLD:
                remedy = ": what does not move needs no force"
            check.report(
                (*path, "body"), f"there is no body '{entry.body}'{remedy}", text=entry.body
            )
        if entry.force is None and entry.torque is None:
            example = '[0, "F"]' if self.dimension == 2 else '[0, 0, "F"]'
            check.report(path, f"gives neither a force nor a torque: add force = {example}")
        if entry.point is not None and entry.force is None:
            check.report((*path, "point"), "a torque acts on the whole body: remove it")
        torque = entry.torque
        if self.dimension == 2 and torque is not None:
            if isinstance(torque, tuple):
                check.report((*path, "torque"), 'in a plane scene it is one formula, torque = "M"')
            torque = (0.0, 0.0, torque) if not isinstance(torque, tuple) else None
        elif torque is not None and not isinstance(torque, tuple):
            check.report((*path, "torque"), "has three entries in space, such as [0, 0, 1.5]")
            torque = None
        return Force(
            body=entry.body,
            point=self._vector((*path, "point"), entry.point),
            force=self._world_vector((*path, "force"), entry.force),
            torque=self._world_vector((*path, "torque"), torque, wide=3),
            in_body=entry.frame == "body",
        )

    def _world_vector(
        self, path: Path, entries: tuple[float | str, ...] | None, wide: int | None = None
    ) -> Vector:
        """Return three checked formulas, which may use all names."""
        if entries is None or not (wide == len(entries) or self._fits(path, len(entries))):
            return ORIGIN
        x, y, *third = (self.check.formula(path, entry) or ZERO for entry in entries)
        return x, y, third[0] if third else ZERO

    def _two_bodies(self, path: Path, bodies: tuple[str, ...], kind: str) -> tuple[str, str]:
        """Check that two bodies, one of which may be the world, exist and differ."""
        for name in bodies:
            if name != WORLD and name not in self.names:
                remedy = suggest(name, [WORLD, *self.names]) or ": declare it as a [[body]]"
                self.check.report(path, f"there is no body '{name}'{remedy}", text=name)
        first, second = bodies
        if first == second:
            self.check.report(path, f"{kind} between two bodies, here both are '{first}'")
        return first, second

    def _between(self, path: Path, entry: SpringTable | DamperTable) -> dict[str, Any]:
        """Return where a spring or damper acts, as arguments of `assembly.Between`."""
        check, kind = self.check, path[0]
        if (entry.coordinate is None) == (entry.bodies is None):
            if not {(*path, "coordinate"), (*path, "bodies")} & check.repaired:
                check.report(
                    path,
                    f"a {kind} acts along a 'coordinate' or between two 'bodies': give "
                    + ("one of the two" if entry.coordinate is None else "one of the two only"),
                )
            return {}
        if entry.coordinate is not None:
            for key in ("points", "turning"):
                if getattr(entry, key):
                    check.report((*path, key), f"belongs to a {kind} between 'bodies': remove it")
            if entry.coordinate not in self.doc.coordinates:
                remedy = suggest(entry.coordinate, self.doc.coordinates)
                remedy = remedy or f": known are {', '.join([*self.doc.coordinates][:9])}"
                check.report(
                    (*path, "coordinate"),
                    f"'{entry.coordinate}' is not a coordinate{remedy}",
                    text=entry.coordinate,
                )
            return {"coordinate": entry.coordinate}
        assert entry.bodies is not None
        first, second = self._two_bodies((*path, "bodies"), entry.bodies, f"a {kind} acts")
        if entry.turning:
            if self.dimension == 3:
                check.report(
                    (*path, "turning"),
                    f"a {kind} turns in plane scenes only: in space let it act along the "
                    "'coordinate' of a joint",
                )
            if entry.points:
                check.report((*path, "points"), f"a turning {kind} has no points: remove them")
            return {"bodies": (first, second), "turning": True}
        points = entry.points or (None, None)
        one, other = (self._vector((*path, "points"), point) for point in points)
        return {"bodies": (first, second), "points": (one, other)}
