"""States first, then times in turns: the rows of benchmarks/RESULTS.md."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from figure import Mark
from runners import Array, Run, timed
from work import Case, error


@dataclass(frozen=True)
class Peer:
    """Whom we are compared with, and over how many steps if not the case's.

    bars: what our time over theirs may be at most, and behind it what is hoped for.
    x0: its start, if not the case's. agrees: how near its last state must be to ours.
    """

    name: str
    run: Run
    bars: tuple[float, ...] = ()
    steps: int = 0
    x0: Array | None = None
    agrees: float = 1e-9


@dataclass(frozen=True)
class Row:
    """A line of the table: times in ns a step and instance, the ratio's quartiles, errors."""

    work: str
    peer: Peer
    mine: float
    theirs: float
    ratio: Array
    errors: tuple[float, float]
    steps: int

    def __str__(self) -> str:
        low, middle, high = self.ratio
        said = (f"{bar:g} {'met' if middle <= bar else '**missed**'}" for bar in self.peer.bars)
        return (
            f"| {self.work} | {self.peer.name} | {self.mine:.4g} | {self.theirs:.4g} "
            f"| {middle:.3g} | {low:.3g} – {high:.3g} | {', '.join(said)} "
            f"| {self.errors[0]:.1e} | {self.errors[1]:.1e} | {self.steps} |"
        )

    @property
    def missed(self) -> bool:
        return bool(self.peer.bars) and self.ratio[1] > self.peer.bars[0]

    @property
    def mark(self) -> Mark:
        bars = self.peer.bars
        return Mark(self.work, self.peer.name, self.ratio.tolist(), bars[0] if bars else None)


def quartiles(mine: Array, theirs: Array) -> Array:
    """Of the ratios within the rounds."""
    return np.percentile(mine / theirs, [25, 50, 75])


def compare(
    work: str, case: Case, x: Array, mine: Run, peers: list[Peer], rounds: int
) -> list[Row]:
    """Nothing is timed where a state is too far from ours; ratios are taken within each round."""
    many = x.size // len(x)
    errors = []
    for peer in peers:
        steps, begin = peer.steps or case.steps, x if peer.x0 is None else peer.x0
        (_, here), (_, there) = (
            timed(run, at, case.h, steps) for run, at in ((mine, x), (peer.run, begin))
        )
        width = min(here.shape[1], there.shape[1])
        apart = float(np.abs(here[:, :width] - there[:, :width]).max())
        if not apart <= peer.agrees:
            raise SystemExit(f"{work}: {peer.name} ends {apart:.1e} away from us: nothing is timed")
        errors.append((error(case, x, here, steps), error(case, begin, there, steps)))
    times = np.empty((rounds, 1 + len(peers)))
    for k in range(rounds):
        times[k, 0] = timed(mine, x, case.h, case.steps)[0] / case.steps / many
        for i, peer in enumerate(peers, 1):
            steps, begin = peer.steps or case.steps, x if peer.x0 is None else peer.x0
            spent = timed(peer.run, begin, case.h, steps)[0]
            times[k, i] = spent / steps / (begin.size // len(begin))
    rows = []
    middle = np.median(times, axis=0) * 1e9
    for i, peer in enumerate(peers, 1):
        ratio = quartiles(times[:, 0], times[:, i])
        rows.append(
            Row(work, peer, middle[0], middle[i], ratio, errors[i - 1], peer.steps or case.steps)
        )
        print(rows[-1], flush=True)
    return rows
