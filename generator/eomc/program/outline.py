"""Long functions outlined: straight-line code cut where few values cross.

Compilers take time that grows with the square of a function's length and more, so what is long is
emitted as several functions that hand values on. Knows nothing of C.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

from sympy import S

from eomc.derive.tape import Stage
from eomc.program.ir import Assignment, Call, Function, Operand

LARGE = 1000  # weight from which a function is cut
PIECE = 500  # weight of an outlined function, up to a third more or less


@dataclass(frozen=True)
class Piece:
    """An outlined function: a run of another's assignments.

    function: the run, with the results and checks that are ready behind it; outputs: the places of
    these results in the whole. reads: values made by earlier ones; keeps: values that later ones
    read.
    """

    function: Function
    outputs: tuple[int, ...]
    reads: tuple[str, ...]
    keeps: tuple[str, ...]


def weight(function: Function) -> int:
    """What a compiler has to do for a function, in operations."""
    return sum(map(_weight, (*function.early, *function.body)))


def is_large(function: Function) -> bool:
    """Whether a function is long enough to be outlined."""
    return weight(function) > LARGE


def _weight(a: Assignment) -> int:
    if isinstance(a.value, Call):
        return 15 if a.value.function in ("sin", "cos") else 2
    return max(1, len(a.value.names) - 1)


def split(function: Function, piece: int) -> tuple[Piece, ...]:
    """The function as outlined functions of about `piece` operations.

    The assignments stay what they are, and each still stands behind those that it reads: the values
    are the same to the last bit. Values that cross count as named.
    """
    run = _paired((*function.early, *function.body))
    ends = _cuts(run, piece)
    begins = [0, *ends[:-1]]
    runs = [run[i:j] for i, j in zip(begins, ends, strict=True)]
    made_in = {a.name: k for k, part in enumerate(runs) for a in part}
    outputs: list[list[int]] = [[] for _ in runs]
    for place, o in enumerate(function.outputs):
        outputs[made_in.get(o.name, -1)].append(place)
    checks: list[list[tuple[Operand, Operand]]] = [[] for _ in runs]
    for pair in function.checks:
        checks[max(made_in.get(o.name, 0) for o in pair)].append(pair)
    parts = [
        replace(
            function,
            name=f"{function.name}_{k + 1}",
            early=tuple(a for a in part if a.stage <= Stage.PARAMETER),
            body=tuple(a for a in part if a.stage > Stage.PARAMETER),
            outputs=tuple(function.outputs[place] for place in outputs[k]),
            checks=tuple(checks[k]),
        )
        for k, part in enumerate(runs)
    ]
    reads = [part.uses & made_in.keys() for part in parts]
    crossing = frozenset().union(*reads)
    return tuple(
        Piece(
            with_names(part, crossing),
            tuple(outputs[k]),
            tuple(a.name for a in run if a.name in reads[k]),
            tuple(a.name for a in runs[k] if a.name in crossing),
        )
        for k, part in enumerate(parts)
    )


def _paired(run: tuple[Assignment, ...]) -> list[Assignment]:
    """Sine and cosine of one angle side by side, since they are computed together."""
    partners: dict[tuple[Operand, ...], list[Assignment]] = {}
    for a in run:
        if isinstance(a.value, Call) and a.value.function in ("sin", "cos"):
            partners.setdefault(a.value.args, []).append(a)
    out = []
    for a in run:
        if isinstance(a.value, Call) and a.value.function in ("sin", "cos"):
            out += partners.pop(a.value.args, [])
        else:
            out.append(a)
    return out


def _cuts(run: list[Assignment], piece: int) -> list[int]:
    """Where to cut: within a third of the size, where the fewest values cross."""
    last: dict[str, int] = {}
    for k, a in enumerate(run):
        last |= dict.fromkeys(a.value.names, k)
    ended = Counter(last[a.name] for a in run if a.name in last)
    alive = accumulate((a.name in last) - ended[k] for k, a in enumerate(run))
    crossing = list(alive)  # values made up to here and read behind it
    pairs = {
        k for k in range(1, len(run)) if _angle(run[k]) and _angle(run[k]) == _angle(run[k - 1])
    }
    upto = list(accumulate(map(_weight, run), initial=0))
    cuts = [0]
    while upto[-1] - upto[cuts[-1]] > piece * 4 // 3:
        begun = upto[cuts[-1]]
        least = max(cuts[-1] + 1, bisect_left(upto, begun + piece * 2 // 3))
        most = max(least + 1, bisect_right(upto, begun + piece * 4 // 3))
        places = [k for k in range(least, most) if k not in pairs]
        cuts.append(min(places, key=lambda k: crossing[k - 1], default=most))
    return [*cuts[1:], len(run)]


def _angle(a: Assignment) -> tuple[Operand, ...]:
    sine = isinstance(a.value, Call) and a.value.function in ("sin", "cos")
    return a.value.args if sine and isinstance(a.value, Call) else ()


def with_names(function: Function, names: frozenset[str]) -> Function:
    """The function with values that keep their names in print."""

    def marked(run: tuple[Assignment, ...]) -> tuple[Assignment, ...]:
        return tuple(replace(a, named=True) if a.name in names else a for a in run)

    return replace(function, early=marked(function.early), body=marked(function.body))


def staged(function: Function, parameters: Sequence[str]) -> tuple[Function, Function]:
    """What parameters alone decide and the rest reads, as a function of its own; and the rest.

    Parameters that the rest reads are results of the first too.
    """
    early = {*parameters, *(a.name for a in function.early)}
    is_early = [not pair[0].name or pair[0].name in early for pair in function.checks]
    checks = list(zip(function.checks, is_early, strict=True))
    rest = replace(function, early=(), checks=tuple(c for c, e in checks if not e))
    read = rest.uses
    kept = [n for n in (*parameters, *(a.name for a in function.early)) if n in read]
    first = replace(
        function,
        name="prepare",
        body=(),
        outputs=tuple(Operand(S.One, n) for n in kept),
        checks=tuple(c for c, e in checks if e),
    )
    return first, rest
