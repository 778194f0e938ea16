"""Outlining: long functions are split where few values are live.

The time of compilers grows at least with the square of a function's length, so a long function is
emitted as several functions that pass values on. Independent of C.
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

LARGE = 1000  # weight above which a function is split
PIECE = LARGE // 2  # weight of an outlined function, within a third
# Portable C is to be read: a function stays whole up to some 3,000 lines, of 2.5 operations each.
PORTABLE_LARGE = 7500
PORTABLE_PIECE = 2 * PORTABLE_LARGE // 5


@dataclass(frozen=True)
class Piece:
    """An outlined function: a part of a long function, emitted as a function of its own.

    Attributes
    ----------
    function
        The assignments, with the results and checks that are complete after them.
    outputs
        Indices of these results in the original function.
    reads
        Names of the values that earlier pieces compute and this one reads.
    keeps
        Names of the values of this piece that later pieces read.
    """

    function: Function
    outputs: tuple[int, ...]
    reads: tuple[str, ...]
    keeps: tuple[str, ...]


def weight(function: Function) -> int:
    """Return the number of operations of a function, as a measure of compile time."""
    return sum(map(_weight, (*function.early, *function.body)))


def is_large(function: Function, is_portable: bool = False) -> bool:
    """Return True if a function is long enough to be split into outlined functions.

    is_portable: whether the function belongs to portable C, where longer functions stay whole.
    """
    return weight(function) > (PORTABLE_LARGE if is_portable else LARGE)


def _weight(a: Assignment) -> int:
    """Return the number of operations of an assignment."""
    if isinstance(a.value, Call):
        return 15 if a.value.function in ("sin", "cos") else 2
    return max(1, len(a.value.names) - 1)


def split(function: Function, piece: int) -> tuple[Piece, ...]:
    """Split a function into outlined functions of about `piece` operations.

    The outlined functions are called one after the other. Together they have the same assignments
    as `function`, so that results are identical to the last bit. Values that are passed from one
    outlined function to another are marked as named.
    """
    assignments = _paired((*function.early, *function.body))
    ends = _cuts(assignments, piece)
    starts = [0, *ends[:-1]]
    runs = [assignments[i:j] for i, j in zip(starts, ends, strict=True)]
    piece_of = {a.name: k for k, part in enumerate(runs) for a in part}
    outputs: list[list[int]] = [[] for _ in runs]
    for index, o in enumerate(function.outputs):
        outputs[piece_of.get(o.name, -1)].append(index)
    checks: list[list[tuple[Operand, Operand]]] = [[] for _ in runs]
    for pair in function.checks:
        checks[max(piece_of.get(o.name, 0) for o in pair)].append(pair)
    parts = [
        replace(
            function,
            name=f"{function.name}_{k + 1}",
            early=tuple(a for a in part if a.stage <= Stage.PARAMETER),
            body=tuple(a for a in part if a.stage > Stage.PARAMETER),
            outputs=tuple(function.outputs[index] for index in outputs[k]),
            checks=tuple(checks[k]),
        )
        for k, part in enumerate(runs)
    ]
    reads = [part.uses & piece_of.keys() for part in parts]
    crossing = frozenset().union(*reads)
    return tuple(
        Piece(
            with_names(part, crossing),
            tuple(outputs[k]),
            tuple(a.name for a in assignments if a.name in reads[k]),
            tuple(a.name for a in runs[k] if a.name in crossing),
        )
        for k, part in enumerate(parts)
    )


def _paired(run: tuple[Assignment, ...]) -> list[Assignment]:
    """Put sine and cosine of the same angle next to each other, since they are computed
    together.
    """
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
    """Return where to split: within a third of the target size, where the fewest values are
    live.
    """
    last: dict[str, int] = {}
    for k, a in enumerate(run):
        last |= dict.fromkeys(a.value.names, k)
    last_uses = Counter(last[a.name] for a in run if a.name in last)
    alive = accumulate((a.name in last) - last_uses[k] for k, a in enumerate(run))
    crossing = list(alive)  # number of values computed up to here and read later
    pairs = {
        k for k in range(1, len(run)) if _angle(run[k]) and _angle(run[k]) == _angle(run[k - 1])
    }
    cumulative = list(accumulate(map(_weight, run), initial=0))
    cuts = [0]
    while cumulative[-1] - cumulative[cuts[-1]] > piece * 4 // 3:
        start = cumulative[cuts[-1]]
        first = max(cuts[-1] + 1, bisect_left(cumulative, start + piece * 2 // 3))
        stop = max(first + 1, bisect_right(cumulative, start + piece * 4 // 3))
        candidates = [k for k in range(first, stop) if k not in pairs]
        cuts.append(min(candidates, key=lambda k: crossing[k - 1], default=stop))
    return [*cuts[1:], len(run)]


def _angle(a: Assignment) -> tuple[Operand, ...]:
    """Return the argument of a sine or cosine; () for other assignments."""
    sine = isinstance(a.value, Call) and a.value.function in ("sin", "cos")
    return a.value.args if sine and isinstance(a.value, Call) else ()


def with_names(function: Function, names: frozenset[str]) -> Function:
    """Return the function with the values `names` marked as named: meaningful to a reader."""

    def marked(run: tuple[Assignment, ...]) -> tuple[Assignment, ...]:
        return tuple(replace(a, named=True) if a.name in names else a for a in run)

    return replace(function, early=marked(function.early), body=marked(function.body))


def split_precomputed(function: Function, parameters: Sequence[str]) -> tuple[Function, Function]:
    """Split off the assignments that depend on parameters only, as a function `prepare`.

    The results of `prepare` include the `parameters` (names) that the remaining function reads.
    Returns the pair (prepare, remaining function).
    """
    early = {*parameters, *(a.name for a in function.early)}
    is_early = [not pair[0].name or pair[0].name in early for pair in function.checks]
    checks = list(zip(function.checks, is_early, strict=True))
    remaining = replace(function, early=(), checks=tuple(c for c, e in checks if not e))
    used = remaining.uses
    results = [n for n in (*parameters, *(a.name for a in function.early)) if n in used]
    first = replace(
        function,
        name="prepare",
        body=(),
        outputs=tuple(Operand(S.One, n) for n in results),
        checks=tuple(c for c, e in checks if e),
    )
    return first, remaining
