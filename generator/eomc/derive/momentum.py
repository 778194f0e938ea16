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
    """Derive mass, centre of mass, momentum and angular momentum about the centre of mass.

    All along the world's axes, without the rotors of drives; in the plane m, x, y, px, py, L.
    Raises SceneError if no moving body has mass. Returns the tape and the values.
    """
    tape = Tape(leaves(system, *system.qdd))
    sweep = _Masses(tape, system, [f for f in system.frames if f.mass != 0])
    parts = list(sweep.parts())
    mass = sweep.add(*(m for m, *_ in parts))
    if mass is S.Zero:
        raise SceneError([system.problem("run.momentum", "no body that moves has a mass")])
    moment, linear, angular = (sweep.plus(*(part[k] for part in parts)) for k in (1, 2, 3))
    center = sweep.scaled(moment, tape.define(1 / mass))
    about = sweep.plus(angular, sweep.scaled(sweep.cross(center, linear), S.NegativeOne))
    return tape, (mass, *center[: sweep.d], *sweep.flat(linear, about))


class _Masses(Sweep):
    """Masses and momenta of the bodies."""

    def parts(self) -> Iterator[tuple[Expr, Vector, Vector, Vector]]:
        """Yield mass, first moment, momentum and angular momentum about the world's origin of each
        body.
        """
        for k, link in enumerate(self.links):
            yield self.part(
                self.origin[k], self.columns[k], self.velocity[k], self.spin[k],
                self.define(link.mass), self.world(k, self.vector(link.moment)), link.inertia,
            )  # fmt: skip
        for f in self.frames:
            frame_state = self.frame(f)
            columns = list(zip(*frame_state.rotation, strict=True))
            yield self.part(
                frame_state.at, columns, *frame_state.velocity, self.define(f.mass), ZERO, f.inertia
            )

    def part(
        self, at: Vector, columns: Sequence[Vector], v: Vector, omega: Vector, mass: Expr,
        moment: Vector, inertia: Sequence[Expr],
    ) -> tuple[Expr, Vector, Vector, Vector]:  # fmt: skip
        """Return the same quantities for one body. `moment` (along the world's axes) and `inertia`
        refer to the point `at`.
        """
        tensor = [[S.Zero] * 3 for _ in range(3)]
        for (i, j), entry in zip(ENTRIES, inertia, strict=True):
            tensor[i][j] = tensor[j][i] = self.define(entry)
        spin_in_body = self.apply(tensor, self.apply(columns, omega))
        spin = self.plus(*(self.scaled(c, x) for c, x in zip(columns, spin_in_body, strict=True)))
        linear = self.plus(self.scaled(v, mass), self.cross(omega, moment))
        angular = self.plus(spin, self.cross(moment, v), self.cross(at, linear))
        return mass, self.plus(self.scaled(at, mass), moment), linear, angular
