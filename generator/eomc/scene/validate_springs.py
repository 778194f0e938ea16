"""Checks of [[spring]], [[damper]] and [[force]]."""

from __future__ import annotations

from typing import Any

from eomc.scene.assembly import WORLD, Damper, Force, Spring, Vector
from eomc.scene.formulas import suggest
from eomc.scene.schema import DamperTable, ForceTable, SpringTable
from eomc.scene.scope import Path
from eomc.scene.validate_values import ORIGIN, ZERO, ValueChecker


def check_spring(values: ValueChecker, path: Path, entry: SpringTable) -> Spring:
    """Check a [[spring]] table and return the spring.

    path: keys of the table in the scene. entry: the table. Errors are reported to `values.check`.
    """
    return Spring(
        stiffness=values.formula((*path, "stiffness"), entry.stiffness),
        length=values.formula((*path, "length"), entry.length),
        **_between(values, path, entry),
    )


def check_damper(values: ValueChecker, path: Path, entry: DamperTable) -> Damper:
    """Check a [[damper]] table and return the damper.

    path: keys of the table in the scene. entry: the table. Errors are reported to `values.check`.
    """
    return Damper(
        damping=values.formula((*path, "damping"), entry.damping), **_between(values, path, entry)
    )


def check_force(values: ValueChecker, path: Path, entry: ForceTable) -> Force:
    """Check a [[force]] table and return the force and torque that it applies to a body.

    path: keys of the table in the scene. entry: the table. The formulas of force and torque may use
    all names. Errors are reported to `values.check`.
    """
    check = values.check
    if entry.body not in values.names:
        remedy = suggest(entry.body, values.names) or ": declare it as a [[body]]"
        if entry.body == WORLD:
            remedy = ": what does not move needs no force"
        check.report((*path, "body"), f"there is no body '{entry.body}'{remedy}", text=entry.body)
    if entry.force is None and entry.torque is None:
        example = '[0, "F"]' if values.dimension == 2 else '[0, 0, "F"]'
        check.report(path, f"gives neither a force nor a torque: add force = {example}")
    if entry.point is not None and entry.force is None:
        check.report((*path, "point"), "a torque acts on the whole body: remove it")
    torque = entry.torque
    if values.dimension == 2 and torque is not None:
        if isinstance(torque, tuple):
            check.report((*path, "torque"), 'in a plane scene it is one formula, torque = "M"')
        torque = (0.0, 0.0, torque) if not isinstance(torque, tuple) else None
    elif torque is not None and not isinstance(torque, tuple):
        check.report((*path, "torque"), "has three entries in space, such as [0, 0, 1.5]")
        torque = None
    return Force(
        body=entry.body,
        point=values.vector((*path, "point"), entry.point),
        force=_world_vector(values, (*path, "force"), entry.force),
        torque=_world_vector(values, (*path, "torque"), torque, wide=3),
        in_body=entry.frame == "body",
    )


def _world_vector(
    values: ValueChecker,
    path: Path,
    entries: tuple[float | str, ...] | None,
    wide: int | None = None,
) -> Vector:
    """Return three checked formulas, which may use all names."""
    if entries is None or not (wide == len(entries) or values.fits(path, len(entries))):
        return ORIGIN
    x, y, *third = (values.check.formula(path, entry) or ZERO for entry in entries)
    return x, y, third[0] if third else ZERO


def _between(values: ValueChecker, path: Path, entry: SpringTable | DamperTable) -> dict[str, Any]:
    """Return where a spring or damper acts, as arguments of `assembly.Between`."""
    check, kind = values.check, path[0]
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
        if entry.coordinate not in values.doc.coordinates:
            remedy = suggest(entry.coordinate, values.doc.coordinates)
            remedy = remedy or f": known are {', '.join([*values.doc.coordinates][:9])}"
            check.report(
                (*path, "coordinate"),
                f"'{entry.coordinate}' is not a coordinate{remedy}",
                text=entry.coordinate,
            )
        return {"coordinate": entry.coordinate}
    assert entry.bodies is not None
    first, second = values.two_bodies((*path, "bodies"), entry.bodies, f"a {kind} acts")
    if entry.turning:
        if values.dimension == 3:
            check.report(
                (*path, "turning"),
                f"a {kind} turns in plane scenes only: in space let it act along the "
                "'coordinate' of a joint",
            )
        if entry.points:
            check.report((*path, "points"), f"a turning {kind} has no points: remove them")
        return {"bodies": (first, second), "turning": True}
    points = entry.points or (None, None)
    one, other = (values.vector((*path, "points"), point) for point in points)
    return {"bodies": (first, second), "points": (one, other)}
