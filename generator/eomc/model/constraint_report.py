"""Summary of the constraints: rank, degrees of freedom, redundancy, assembled initial values."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from eomc.base.texts import listed, plural


@dataclass(frozen=True)
class Move:
    """A coordinate or velocity whose initial value was changed to satisfy the constraints.

    guess: the initial value that the user gave. value: the value that satisfies the constraints.
    Both are in `unit`.
    """

    name: str
    guess: float
    value: float
    unit: str = ""

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.name} = {self.value:.6g}{unit} (guess {self.guess:.6g})"


@dataclass(frozen=True)
class ConstraintSummary:
    """Properties of the constraints of a system, computed near its initial configuration.

    D is the mass matrix and A the Jacobian of the constraint equations, with one row A_r for each.

    Attributes
    ----------
    rows
        Names of the constraint equations.
    coordinates
        Number of coordinates.
    rank
        Rank of A almost everywhere on the constraint manifold.
    redundant
        Names of the equations that the others imply; they are not solved for.
    shared
        Names of the equations whose Lagrange multipliers are not unique.
    start_sigma, least_sigma
        Ratio s_rank / s_1 of the singular values s_1 >= s_2 >= ... of the scaled Jacobian.
        start_sigma is the ratio at the start, least_sigma the smallest ratio at the sampled
        configurations. The ratio is 0 at a singular configuration.
    positions
        Number of sampled configurations.
    weights
        If D is singular, weights with which D + sum_r weights[r] A_r^T A_r is regular; else empty.
    slopes
        Largest value of A_r D^-1 A_r^T for each equation among the sampled configurations.
    sums
        Weights of linear combinations of the equations that are solved for in place of `shared`;
        used if no subset of the equations is independent everywhere.
    moves, rate_moves
        Coordinates and velocities whose initial values were changed to satisfy the constraints.
    remarks
        Messages for the user.
    computed_from
        The data of the system from which the summary was computed; other data make it invalid.
    """

    rows: tuple[str, ...]
    coordinates: int
    rank: int
    redundant: tuple[str, ...] = ()
    shared: tuple[str, ...] = ()
    start_sigma: float = 1.0
    least_sigma: float = 1.0
    positions: int = 1
    weights: tuple[float, ...] = ()
    slopes: tuple[float, ...] = ()
    sums: tuple[tuple[float, ...], ...] = ()
    moves: tuple[Move, ...] = ()
    rate_moves: tuple[Move, ...] = ()
    remarks: tuple[str, ...] = ()
    computed_from: tuple[Any, ...] = field(default=(), repr=False, compare=False)

    @property
    def freedoms(self) -> int:
        """The number of degrees of freedom: the number of coordinates minus the rank."""
        return self.coordinates - self.rank

    @property
    def ranks(self) -> str:
        """Text that states the rank, the redundant equations and the non-unique multipliers."""
        text = f"rank {self.rank} of {len(self.rows)}"
        if self.redundant:
            text += (
                f": {plural('row', len(self.redundant))} {listed(self.redundant)} "
                f"{'is' if len(self.redundant) == 1 else 'are'} redundant"
            )
        if self.sums:
            template = "; {} of others" if self.redundant else ": {} of them"
            text += template.format(f"{len(self.sums)} {plural('sum', len(self.sums))}")
            text += " stand for these"
        if self.shared:
            start = "; the" if self.redundant or self.sums else ": the"
            text += f"{start} forces in {listed(self.shared)} are not unique"
        return text

    def table(self) -> str:
        """Return the summary as text of several lines for the terminal."""
        n = len(self.rows)
        lines = [
            f"{n} {plural('row', n)} of constraints on {self.coordinates} "
            f"{plural('coordinate', self.coordinates)}, {self.ranks}",
            f"  {self.freedoms} {plural('freedom', self.freedoms)} left",
            f"  sigma_min/sigma_max {self.start_sigma:.3g} at the start, "
            f"{self.least_sigma:.3g} at the worst of {self.positions} positions",
            *(f"  start: {move}" for move in self.moves),
            *(f"  rate: {move}" for move in self.rate_moves),
            *(f"  - {remark}" for remark in self.remarks),
        ]
        return "\n".join(lines)

    def as_dict(self) -> dict[str, Any]:
        """Return the summary as a dict that can be written as JSON."""
        return {
            "rows": list(self.rows), "rank": self.rank, "freedoms": self.freedoms,
            "redundant": list(self.redundant), "not_unique": list(self.shared),
            "sigma_at_start": self.start_sigma, "sigma_least": self.least_sigma,
            "positions": self.positions, "start": [vars(m) for m in self.moves],
            "rates": [vars(m) for m in self.rate_moves], "remarks": list(self.remarks),
        }  # fmt: skip
