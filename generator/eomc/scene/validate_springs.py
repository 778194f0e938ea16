"""Springs, dampers and forces of a scene: what each acts on, checked."""

from __future__ import annotations

from typing import Any

from eomc.scene.assembly import WORLD, Damper, Force, Spring, Vector
from eomc.scene.formulas import suggest
from eomc.scene.schema import DamperTable, ForceTable, SpringTable
from eomc.scene.scope import Path
from eomc.scene.validate_values import ORIGIN, ZERO, Values


class Springs(Values):
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
        """A force, a torque or both; formulas of all names."""
        check = self.check
        if entry.body not in self.names:
            remedy = suggest(entry.body, self.names) or ": declare it as a [[body]]"
            if entry.body == WORLD:
                remedy = ": what does not move needs no force"
            check.say((*path, "body"), f"there is no body '{entry.body}'{remedy}", text=entry.body)
        if entry.force is None and entry.torque is None:
            example = '[0, "F"]' if self.wide == 2 else '[0, 0, "F"]'
            check.say(path, f"gives neither a force nor a torque: add force = {example}")
        if entry.point is not None and entry.force is None:
            check.say((*path, "point"), "a torque acts on the whole body: remove it")
        torque = entry.torque
        if self.wide == 2 and torque is not None:
            if isinstance(torque, tuple):
                check.say((*path, "torque"), 'in a plane scene it is one formula, torque = "M"')
            torque = (0.0, 0.0, torque) if not isinstance(torque, tuple) else None
        elif torque is not None and not isinstance(torque, tuple):
            check.say((*path, "torque"), "has three entries in space, such as [0, 0, 1.5]")
            torque = None
        return Force(
            body=entry.body,
            point=self._vector((*path, "point"), entry.point),
            force=self._acting((*path, "force"), entry.force),
            torque=self._acting((*path, "torque"), torque, wide=3),
            in_body=entry.frame == "body",
        )

    def _acting(
        self, path: Path, given: tuple[float | str, ...] | None, wide: int | None = None
    ) -> Vector:
        """Three formulas of all names."""
        if given is None or not (wide == len(given) or self._fits(path, len(given))):
            return ORIGIN
        x, y, *third = (self.check.formula(path, entry) or ZERO for entry in given)
        return x, y, third[0] if third else ZERO

    def _two(self, path: Path, bodies: tuple[str, ...], what: str) -> tuple[str, str]:
        """Two bodies, the world among them, that are not the same."""
        for name in bodies:
            if name != WORLD and name not in self.names:
                remedy = suggest(name, [WORLD, *self.names]) or ": declare it as a [[body]]"
                self.check.say(path, f"there is no body '{name}'{remedy}", text=name)
        first, second = bodies
        if first == second:
            self.check.say(path, f"{what} between two bodies, here both are '{first}'")
        return first, second

    def _between(self, path: Path, entry: SpringTable | DamperTable) -> dict[str, Any]:
        """What a spring or damper acts on."""
        check, what = self.check, path[0]
        if (entry.coordinate is None) == (entry.bodies is None):
            if not {(*path, "coordinate"), (*path, "bodies")} & check.mended:
                check.say(
                    path,
                    f"a {what} acts along a 'coordinate' or between two 'bodies': give "
                    + ("one of the two" if entry.coordinate is None else "one of the two only"),
                )
            return {}
        if entry.coordinate is not None:
            for key in ("points", "turning"):
                if getattr(entry, key):
                    check.say((*path, key), f"belongs to a {what} between 'bodies': remove it")
            if entry.coordinate not in self.doc.coordinates:
                remedy = suggest(entry.coordinate, self.doc.coordinates)
                remedy = remedy or f": known are {', '.join([*self.doc.coordinates][:9])}"
                check.say(
                    (*path, "coordinate"),
                    f"'{entry.coordinate}' is not a coordinate{remedy}",
                    text=entry.coordinate,
                )
            return {"coordinate": entry.coordinate}
        assert entry.bodies is not None
        first, second = self._two((*path, "bodies"), entry.bodies, f"a {what} acts")
        if entry.turning:
            if self.wide == 3:
                check.say(
                    (*path, "turning"),
                    f"a {what} turns in plane scenes only: in space let it act along the "
                    "'coordinate' of a joint",
                )
            if entry.points:
                check.say((*path, "points"), f"a turning {what} has no points: remove them")
            return {"bodies": (first, second), "turning": True}
        points = entry.points or (None, None)
        one, other = (self._vector((*path, "points"), point) for point in points)
        return {"bodies": (first, second), "points": (one, other)}
