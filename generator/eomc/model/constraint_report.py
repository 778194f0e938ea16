"""What constraints leave: rank, freedoms, rows that others say, and how a start was assembled."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from eomc.base.texts import listed, plural


@dataclass(frozen=True)
class Move:
    """A coordinate, or a rate, that was assembled at another value than its guess."""

    name: str
    guess: float
    value: float
    unit: str = ""

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.name} = {self.value:.6g}{unit} (guess {self.guess:.6g})"


@dataclass(frozen=True)
class ConstraintSummary:
    """The constraints of a system, as found around its assembled start.

    rows: names of all. rank: of their Jacobian, almost everywhere on the positions they leave, so
    that `freedoms` rates are left. redundant: rows left out, which the others imply. shared: rows
    whose multipliers are not unique, since others could bear them. start_sigma, least_sigma: the
    smallest singular value that counts over the largest one, at the start and at the worst of
    `positions` positions; rows in units of their own inverse inertia, coordinates in the metric of
    D: 0 at a singular position. weights: where D alone is singular, of each row r what makes
    D + sum of weights[r] A_r^T A_r regular; else none. slopes: of each row the largest
    A D^-1 A^T of these positions. sums: where rows depend on one another and no set of them does
    everywhere, what is solved for in place of `shared`: the weights of all rows in each. moves,
    rate_moves: what assembling changed. remarks: in words. made_for: what of the system all that
    depends on.
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
    made_for: tuple[Any, ...] = field(default=(), repr=False, compare=False)

    @property
    def freedoms(self) -> int:
        """Rates that the rows leave."""
        return self.coordinates - self.rank

    @property
    def ranks(self) -> str:
        """The rank in words, and which forces are not unique."""
        text = f"rank {self.rank} of {len(self.rows)}"
        if self.redundant:
            text += (
                f": {plural('row', len(self.redundant))} {listed(self.redundant)} "
                f"{'is' if len(self.redundant) == 1 else 'are'} redundant"
            )
        if self.sums:
            of = "; {} of others" if self.redundant else ": {} of them"
            text += of.format(f"{len(self.sums)} {plural('sum', len(self.sums))}")
            text += " stand for these"
        if self.shared:
            start = "; the" if self.redundant or self.sums else ": the"
            text += f"{start} forces in {listed(self.shared)} are not unique"
        return text

    def table(self) -> str:
        """For people."""
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
        """For JSON."""
        return {
            "rows": list(self.rows), "rank": self.rank, "freedoms": self.freedoms,
            "redundant": list(self.redundant), "not_unique": list(self.shared),
            "sigma_at_start": self.start_sigma, "sigma_least": self.least_sigma,
            "positions": self.positions, "start": [vars(m) for m in self.moves],
            "rates": [vars(m) for m in self.rate_moves], "remarks": list(self.remarks),
        }  # fmt: skip
