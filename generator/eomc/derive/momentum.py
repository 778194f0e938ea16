"""Total mass, centre of mass and momenta of all moving bodies, on a tape."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from sympy import Expr, S

from eomc.base.errors import SceneError
from eomc.base.spatial import ENTRIES
from eomc.derive.energies import leaves
from eomc.derive.frames import Sweep
from eomc.derive.tape import Tape
from eomc.derive.vectors import ZERO, Vector
from eomc.model.system import System


def momentum(system: System) -> tuple[Tape, Sequence[Expr]]:
    """Return the pair (tape, values) with total mass, centre of mass and momenta of all bodies.

    The tape is the list of elementary operations that compute the values. These are, for all moving
    bodies together: the mass (kg), the position of the centre of mass (m), the momentum (kg m/s)
    and the angular momentum about the centre of mass (kg m^2/s). Vectors are along the world's
    axes. In the plane the values are m, x, y, px, py, L. Rotors of drives are not included.

    Raises
    ------
    SceneError
        If no moving body has mass.
    """
    tape = Tape(leaves(system, *system.qdd))
    sweep = Sweep(tape, system, [f for f in system.frames if f.mass != 0])
    parts = list(_parts(sweep))
    mass = sweep.add(*(m for m, *_ in parts))
    if mass is S.Zero:
        raise SceneError([system.problem("run.momentum", "no body that moves has a mass")])
    moment, linear, angular = (sweep.plus(*(part[k] for part in parts)) for k in (1, 2, 3))
    center = sweep.scaled(moment, tape.define(1 / mass))
    about = sweep.plus(angular, sweep.scaled(sweep.cross(center, linear), S.NegativeOne))
    return tape, (mass, *center[: sweep.d], *sweep.flat(linear, about))


# position, axes, velocity and angular velocity of a body, along the world's axes
_Motion = tuple[Vector, Sequence[Vector], Vector, Vector]


def _parts(sweep: Sweep) -> Iterator[tuple[Expr, Vector, Vector, Vector]]:
    """Yield the mass, first moment, momentum and angular momentum of each body.

    The moments are about the world's origin.
    """
    for k, link in enumerate(sweep.links):
        motion = sweep.origin[k], sweep.columns[k], sweep.velocity[k], sweep.spin[k]
        moment = sweep.world(k, sweep.vector(link.moment))
        yield _part(sweep, motion, sweep.define(link.mass), moment, link.inertia)
    for f in sweep.frames:
        frame = sweep.frame(f)
        columns = list(zip(*frame.rotation, strict=True))
        motion = frame.at, columns, *frame.velocity
        yield _part(sweep, motion, sweep.define(f.mass), ZERO, f.inertia)


def _part(
    sweep: Sweep, motion: _Motion, mass: Expr, moment: Vector, inertia: Sequence[Expr]
) -> tuple[Expr, Vector, Vector, Vector]:
    """Return the same quantities for one body.

    `moment` (along the world's axes) and `inertia` refer to the position in `motion`.
    """
    at, columns, v, omega = motion
    tensor = [[S.Zero] * 3 for _ in range(3)]
    for (i, j), entry in zip(ENTRIES, inertia, strict=True):
        tensor[i][j] = tensor[j][i] = sweep.define(entry)
    spin_in_body = sweep.apply(tensor, sweep.apply(columns, omega))
    spin = sweep.plus(*(sweep.scaled(c, x) for c, x in zip(columns, spin_in_body, strict=True)))
    linear = sweep.plus(sweep.scaled(v, mass), sweep.cross(omega, moment))
    angular = sweep.plus(spin, sweep.cross(moment, v), sweep.cross(at, linear))
    return mass, sweep.plus(sweep.scaled(at, mass), moment), linear, angular
