"""Springs and dampers of a scene: what each acts on, checked."""

from __future__ import annotations

from typing import Any

from eomc.scene.assembly import WORLD, Damper, Spring
from eomc.scene.formulas import suggest
from eomc.scene.schema import DamperTable, SpringTable
from eomc.scene.scope import Path
from eomc.scene.validate_values import Values


class Springs(Values):
    """Checks the tables [[spring]] and [[damper]]."""

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
        for name in entry.bodies:
            if name != WORLD and name not in self.names:
                remedy = suggest(name, [WORLD, *self.names]) or ": declare it as a [[body]]"
                check.say((*path, "bodies"), f"there is no body '{name}'{remedy}", text=name)
        first, second = entry.bodies
        if first == second:
            check.say(
                (*path, "bodies"), f"a {what} acts between two bodies, here both are '{first}'"
            )
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
