"""The independent answer for large systems: Taylor arithmetic along the definitions, in numbers.

Nothing is expanded and nothing is differentiated as a formula. Every quantity carries its value
and those of its derivatives that are needed, as arrays, and the rules for sums, products and
functions pass them on, from the coordinates to K, P, R and Q, along the definitions in their
order (Griewank & Walther, *Evaluating Derivatives*, 2nd ed., ch. 13). It starts from the `System`
and shares nothing else with the compiled way, which sweeps backwards over formulas.

With x = (q, t), v = qd and the direction d = (qd, 1), in which all things go at qdd = 0, these
derivatives do; x is a row of nq + 1 numbers, v one of nq:

    s    e_x . d            of all          x    de/dx              of all
    xs   e_xx d             of positions    v    de/dv              of what hangs on velocities
    vs   e_vx d             (rate of e_v)   vv   d2e/dv2            (nq, nq)
    vvs  rate of e_vv       (nq, nq)        N    e_vq - e_vq^T      (nq, nq)

What a scene writes as dot(y) has the value y_s, and s = y_xs . d, x = y_xs, v = y_q, vs = the rate
of y_q, which is y_xs without its last entry; vv, vvs and N of it are zero, N since y_qq is
symmetric. So no full matrix of second derivatives is ever needed, nor a third derivative.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import sympy
from numpy.typing import ArrayLike
from sympy import Expr

from eomc.base.errors import EomcError
from eomc.model.system import System, dot, t
from eomc.verify.oracle import SCALARS, Answer, Values, Vector

BLOCK = 2**16  # entries of (nq, nq) matrices, of so many states at once: what caches hold

Jet = dict[str, Any]  # value and derivatives, rows by states; what is zero is left out
Fields = frozenset[str]

_PAIRS = ("vv", "vvs", "N")  # the (nq, nq) ones
_OF_VELOCITIES = {"v", "vs", *_PAIRS}

# what of a sum's, a product's or a function's arguments, and of e, makes a derivative of dot(e)
_FEEDS: Mapping[str, Mapping[str, str]] = {
    "product": {
        "value": "value",
        "s": "value s",
        "x": "value x",
        "v": "value v",
        "xs": "value s x xs",
        "vs": "value s v vs",
        "vv": "value v vv",
        "vvs": "value s v vs vv vvs",
        "N": "value x v N",
    },
    "dot": {"value": "s", "s": "xs", "x": "xs", "v": "x", "vs": "xs"},
}

# what each answer takes of K, P, R, of every force Q and of every signal
_WANTED: Mapping[str, Mapping[str, str]] = {
    "D": {"K": "vv"},
    "C": {"K": "vvs N"},
    "g": {"K": "vs x", "P": "x"},
    "bias": {"K": "vs x", "P": "x"},
    "tau": {"Q": "value", "R": "v"},
    "kinetic": {"K": "value"},
    "potential": {"P": "value"},
    "energy": {"K": "value", "P": "value"},
    "jacobi": {"K": "value v", "P": "value"},
    "power": {"K": "x", "P": "x", "Q": "value", "R": "v"},
    "signals": {"u": "value"},
    "motion": {"K": "vs x vv", "P": "x", "Q": "value", "R": "v"},
}


@dataclass(frozen=True)
class _Op:
    """One operation on those before it: what it is, of which, and a number, place or function.

    degree: in the velocities, inf where it is no polynomial in them; moves: 2 where it hangs on
    q, 1 where on t alone; rate: hangs on a dot(...); given: hangs on an input.
    """

    kind: str
    args: tuple[int, ...] = ()
    data: Any = None
    degree: float = 0
    moves: int = 0
    rate: bool = False
    given: bool = False


class Jets(Answer):
    """The equations of `system`, worked out at each state; the fields of `reference.derive`.

    D = K_vv, bias = K_vs - K_q + P_q, and C = (c(qd) + c(0))/2 with c = K_vvs + N: that is
    Christoffel's 1/2 (Ddot + dp2_i/dq_j - dp2_j/dq_i) for p2 = D qd, the gyroscopic part
    da_i/dq_j - da_j/dq_i and the explicit dD/dt, as in `reference.derive`. No differences are
    taken: every value is good to a few roundings of its largest terms.

    Raises EomcError where K is not seen to be a polynomial of degree 2 in the velocities, or
    where a derivative is needed that can't be had.
    """

    def __init__(self, system: System) -> None:
        self.system = system
        self._list = made = _List(system)
        degree = made.ops[made.roots["K"][0]].degree
        if degree > 2:
            raise EomcError(
                "the kinetic energy is not quadratic in the velocities, or can't be seen to be: "
                "write it as a sum of products. Friction belongs in 'dissipation' or [forces]"
            )
        self._plans: dict[str, tuple[tuple[int, _Op, Fields], ...]] = {}

    def _value(
        self, name: str, q: Vector, qd: Vector, t: Any, u: ArrayLike | None, values: Values
    ) -> Any:
        given = None if u is None else np.asarray(u, float)
        if q.ndim == 1:
            row = None if given is None else given[None]
            return self._rows(name, q[None], qd[None], t, row, values)[0][()]
        step = max(1, BLOCK // q.shape[1] ** 2)
        found = []
        for part in (slice(k, k + step) for k in range(0, len(q), step)):
            time, us, *each = (z[part] if np.ndim(z) else z for z in (t, given, *values))
            found.append(self._rows(name, q[part], qd[part], time, us, each))
        return np.concatenate(found)

    def _rows(
        self, name: str, q: Vector, qd: Vector, t: Any, u: Any, values: Sequence[Any]
    ) -> Vector:
        """One row a state: q, qd (b, nq), u (b, nu) or None."""
        if name == "signals" or not self.system.inputs:
            u = np.zeros((1, len(self.system.inputs)))
        elif u is None:
            u = self._rows("signals", q, qd, t, None, values)
        if name == "C":  # in motion and, below, at rest
            q, qd = np.concatenate([q, q]), np.concatenate([qd, 0 * qd])
            t, u, *values = map(_twice, (t, u, *values))
        if name == "g":
            qd = np.zeros_like(qd)
        inputs, parameters = ([_column(z) for z in zs] for zs in (u.T, values))
        with np.errstate(all="ignore"):
            found = self._outputs(name, _State(q, qd, _column(t), inputs, parameters))
        found[~np.isfinite(found.reshape(len(found), -1)).all(axis=1)] = math.nan
        return found

    def _acceleration(
        self, q: Vector, qd: Vector, t: Any, u: ArrayLike | None, values: Values
    ) -> Vector:
        both = self._value("motion", q, qd, t, u, values)  # D and tau - bias beside it
        return np.asarray(np.linalg.solve(both[..., :-1], both[..., -1:])[..., 0])

    def _outputs(self, name: str, state: _State) -> Vector:
        """The values of `name`, a row a state."""
        jets = self._run(name, state)
        roots, (b, nq) = self._list.roots, state.q.shape

        def part(root: str, field: str, *shape: int) -> Vector:
            (index,) = roots[root]
            return np.broadcast_to(jets.get(index, {}).get(field, 0.0), (b, *shape))

        def each(root: str) -> Vector:
            found = [np.broadcast_to(jets[index]["value"], (b, 1)) for index in roots[root]]
            return np.concatenate([np.zeros((b, 0)), *found], axis=1)

        def tau() -> Vector:
            return each("Q") - part("R", "v", nq)

        def bias() -> Vector:
            slope = part("P", "x", nq + 1) - part("K", "x", nq + 1)
            return part("K", "vs", nq) + slope[:, :nq]

        match name:
            case "D":
                found = part("K", "vv", nq, nq)
            case "C":
                c = part("K", "vvs", nq, nq) + part("K", "N", nq, nq)
                found = (c[: b // 2] + c[b // 2 :]) / 2
            case "bias" | "g":
                found = bias()
            case "motion":
                D, b = part("K", "vv", nq, nq), tau() - bias()
                found = np.concatenate([D, b[..., None]], axis=2)
            case "tau":
                found = tau()
            case "kinetic":
                found = part("K", "value", 1)
            case "potential":
                found = part("P", "value", 1)
            case "energy":
                found = part("K", "value", 1) + part("P", "value", 1)
            case "jacobi":
                twice = np.sum(part("K", "v", nq) * state.qd, axis=1, keepdims=True)
                found = twice - part("K", "value", 1) + part("P", "value", 1)
            case "power":
                work = np.sum(tau() * state.qd, axis=1, keepdims=True)
                explicit = part("K", "x", nq + 1) - part("P", "x", nq + 1)
                found = work - explicit[:, nq:]
            case _:
                found = each("u")
        return np.array(found[:, 0] if name in SCALARS else found)

    def _run(self, name: str, state: _State) -> dict[int, Jet]:
        if name not in self._plans:
            self._plans[name] = tuple(self._list.plan(_WANTED[name]))
        jets: dict[int, Jet] = {}
        for index, op, want in self._plans[name]:
            jets[index] = _RULES[op.kind](op, [jets.get(arg, {}) for arg in op.args], want, state)
        return jets


def _twice(z: Any) -> Any:
    """The rows once more behind themselves; one number, or one row, which serves all, as it is."""
    return np.concatenate([z, z]) if np.ndim(z) and len(z) > 1 else z


def _column(z: Any) -> Any:
    """A number as it is, one number a state as a column."""
    return np.asarray(z, float)[:, None] if np.ndim(z) else np.float64(z)


@dataclass(frozen=True)
class _State:
    """Where the operations are carried out: q, qd (b, nq); t, u, values: numbers or columns."""

    q: Vector
    qd: Vector
    t: Any
    u: Any
    values: Any

    @cached_property
    def d(self) -> Vector:
        """The direction (qd, 1) of x = (q, t)."""
        return np.concatenate([self.qd, np.ones((len(self.qd), 1))], axis=1)

    def unit(self, i: int, more: int) -> Vector:
        """The unit row i of nq + more entries."""
        row = np.zeros((1, self.q.shape[1] + more))
        row[0, i] = 1
        return row


# --- from expressions to a flat list of operations ------------------------------------------------


@dataclass
class _List:
    """The operations of all of a system's expressions, each written once, in order."""

    system: System
    ops: list[_Op] = field(default_factory=list)
    known: dict[Expr, int] = field(default_factory=dict)
    roots: dict[str, list[int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        s = self.system
        for i, (q, qd) in enumerate(zip(s.q, s.qd, strict=True)):
            self.known[q] = self.add(_Op("q", data=i, moves=2))
            self.known[qd] = self.add(_Op("qd", data=i, degree=1))
        self.known[t] = self.add(_Op("t", moves=1))
        for i, u in enumerate(s.u):
            self.known[u] = self.add(_Op("u", data=i, given=True))
        for i, p in enumerate(s.parameters):
            self.known[p.symbol] = self.add(_Op("parameter", data=i))
        for name, body in s.definitions:
            self.known[name] = self.node(body)
        forces = s.forces or (sympy.S.Zero,) * len(s.q)
        roots = {"K": [s.kinetic], "P": [s.potential], "R": [s.dissipation], "Q": forces}
        roots["u"] = [i.signal for i in s.inputs]
        self.roots = {name: [self.node(e) for e in exprs] for name, exprs in roots.items()}

    def add(self, op: _Op) -> int:
        self.ops.append(op)
        return len(self.ops) - 1

    def make(self, kind: str, args: Iterable[int], data: Any = None, degree: float = 0) -> int:
        """An operation on others."""
        args = tuple(args)
        of = [self.ops[i] for i in args]
        moves, rate, given = (max(getattr(a, n) for a in of) for n in ("moves", "rate", "given"))
        return self.add(_Op(kind, args, data, degree, moves, rate or kind == "dot", given))

    def node(self, e: Any) -> int:
        """The operation that gives `e`."""
        e = sympy.sympify(e)
        if e not in self.known:
            self.known[e] = self.made(e)
        return self.known[e]

    def made(self, e: Expr) -> int:
        if e.is_number:
            return self.add(_Op("number", data=np.float64(e)))
        if isinstance(e, dot):
            return self.rate(e)
        if e.is_Add:
            terms = [a.as_coeff_Mul() for a in e.args]
            weights = tuple(float(weight) for weight, _ in terms)
            args = [self.node(a) for _, a in terms]
            return self.make("sum", args, weights, max(self.ops[a].degree for a in args))
        if e.is_Mul or (e.is_Pow and e.exp == 2):
            return self.product(e)
        args = [self.node(a) for a in e.args]
        degree = math.inf if any(self.ops[a].degree for a in args) else 0
        if e.is_Pow:
            return self.make("power", args, degree=degree)
        if isinstance(e, sympy.atan2):
            return self.make("atan2", args, degree=degree)
        if isinstance(e, sympy.Min | sympy.Max):
            found = args[0]
            for other in args[1:]:
                found = self.make("extreme", (found, other), e.func is sympy.Max, degree)
            return found
        if isinstance(e, sympy.Heaviside):
            return self.make("function", args[:1], _step_at(float(e.args[1])), degree)
        if e.func in _FUNCTIONS and len(args) == 1:
            return self.make("function", args, _FUNCTIONS[e.func], degree)
        raise EomcError(f"{self.system.name}: the derivatives of {e} are not known")

    def product(self, e: Expr) -> int:
        """Factors in the order of the time they are known, so that few products are large."""
        factors: list[int] = []
        for factor in e.args if e.is_Mul else (e,):
            square = factor.is_Pow and factor.exp == 2
            factors += [self.node(factor.base)] * 2 if square else [self.node(factor)]
        factors.sort(key=lambda i: (self.ops[i].degree > 0, self.ops[i].moves, i))
        found = factors[0]
        for other in factors[1:]:
            degree = self.ops[found].degree + self.ops[other].degree
            found = self.make("product", (found, other), degree=degree)
        return found

    def rate(self, e: Expr) -> int:
        inside = self.node(e.args[0])
        op = self.ops[inside]
        if op.degree or op.given or op.rate:
            what = "velocities" if op.degree else "inputs" if op.given else "a dot(...)"
            raise EomcError(f"{e} hangs on {what}, whose rates are not known")
        return self.make("dot", (inside,), degree=1 if op.moves == 2 else 0)

    def plan(self, wanted: Mapping[str, str]) -> Iterator[tuple[int, _Op, Fields]]:
        """The operations that the wanted derivatives need, in order, and what of each."""
        need: dict[int, set[str]] = {}
        for root, fields in wanted.items():
            for index in self.roots[root]:
                self._demand(need, index, fields.split())
        for index in range(len(self.ops) - 1, -1, -1):
            op = self.ops[index]
            for field_ in sorted(need.get(index, ())):
                if op.kind == "sum":
                    feeds = [field_]
                else:
                    feeds = _FEEDS["dot" if op.kind == "dot" else "product"].get(field_, "").split()
                for arg in op.args:
                    self._demand(need, arg, feeds)
        return ((i, op, frozenset(need[i])) for i, op in enumerate(self.ops) if need.get(i))

    def _demand(self, need: dict[int, set[str]], index: int, fields: Iterable[str]) -> None:
        """Note that `fields` are needed, as far as they aren't zero."""
        op, here = self.ops[index], need.setdefault(index, set())
        for name in fields:
            if name in _OF_VELOCITIES:
                if op.degree > 0:
                    here.add(name)
            elif name == "value" or op.moves or op.degree:
                here.add(name)


# --- rules ----------------------------------------------------------------------------------------


def _weighted(*terms: tuple[Any, Any]) -> Any:
    """sum w z over pairs; what is None is zero."""
    total = None
    for w, z in terms:
        if w is None or z is None:
            continue
        part = (w[..., None] if z.ndim == 3 and isinstance(w, np.ndarray) else w) * z
        total = part if total is None else total + part
    return total


def _plus(total: Any, part: Any) -> Any:
    return part if total is None else total if part is None else total + part


def _outer(a: Any, b: Any) -> Any:
    return None if a is None or b is None else a[:, :, None] * b[:, None, :]


def _with_transpose(a: Any, sign: int = 1) -> Any:
    return None if a is None else a + a.swapaxes(1, 2) if sign > 0 else a - a.swapaxes(1, 2)


def _kept(jet: Jet) -> Jet:
    return {name: part for name, part in jet.items() if part is not None}


def _leaf(op: _Op, args: list[Jet], want: Fields, at: _State) -> Jet:
    match op.kind:
        case "number":
            return {"value": op.data}
        case "parameter":
            return {"value": at.values[op.data]}
        case "u":
            return {"value": at.u[op.data]}
        case "t":
            return {"value": at.t, "s": np.ones((1, 1)), "x": at.unit(-1, 1)}
        case "q":
            i = op.data
            return {"value": at.q[:, i, None], "s": at.qd[:, i, None], "x": at.unit(i, 1)}
    return {"value": at.qd[:, op.data, None], "v": at.unit(op.data, 0)}


def _sum(op: _Op, args: list[Jet], want: Fields, at: _State) -> Jet:
    out: Jet = {}
    for name in want:
        total, mine = None, False
        for weight, a in zip(op.data, args, strict=True):
            if name in a:
                part = a[name] if weight == 1 else weight * a[name]
                if total is None:
                    total = part
                elif name in _PAIRS and mine and total.shape == part.shape:
                    total += part
                else:
                    total, mine = total + part, True
        if total is not None:
            out[name] = total
    return out


def _product(op: _Op, args: list[Jet], want: Fields, at: _State) -> Jet:
    return _times(args[0], args[1], want)


def _times(a: Jet, b: Jet, want: Fields) -> Jet:
    """Leibniz's rule."""
    x, y, g, h = a["value"], b["value"], a.get, b.get
    if len(a) == 1:  # a number, or what hangs on parameters alone
        large = x[..., None] if isinstance(x, np.ndarray) else x
        return {n: (large if n in _PAIRS else x) * z for n, z in b.items() if n in want}
    out: Jet = {}
    for name in want:
        if name == "value":
            out[name] = x * y
            continue
        terms = [(x, h(name)), (y, g(name))]
        if name in ("xs", "vs"):
            terms += [(g("s"), h(name[0])), (h("s"), g(name[0]))]
        elif name == "vvs":
            terms += [(g("s"), h("vv")), (h("s"), g("vv"))]
        found = _weighted(*terms)
        if name == "vv":
            found = _plus(found, _with_transpose(_outer(g("v"), h("v"))))
        elif name == "vvs":
            mixed = _plus(_outer(g("v"), h("vs")), _outer(g("vs"), h("v")))
            found = _plus(found, _with_transpose(mixed))
        elif name == "N":
            mixed = _plus(_outer(g("v"), _of_q(h("x"))), _outer(h("v"), _of_q(g("x"))))
            found = _plus(found, _with_transpose(mixed, -1))
        out[name] = found
    return _kept(out)


def _of_q(x: Any) -> Any:
    """dt left out."""
    return None if x is None else x[:, :-1]


def _chain(f: tuple[Any, Any, Any], a: Jet, want: Fields) -> Jet:
    """A function's value and two derivatives, f, f' and f'', at a."""
    value, slope, bend = f
    g = a.get
    out: Jet = {}
    for name in want:
        if name == "value":
            out[name] = value
        elif name in ("s", "x", "v"):
            out[name] = _weighted((slope, g(name)))
        elif name in ("xs", "vs"):
            turn = None if g("s") is None else bend * g("s")
            out[name] = _weighted((slope, g(name)), (turn, g(name[0])))
        else:  # of K alone, which is a polynomial in the velocities
            raise AssertionError(name)
    return _kept(out)


def _function(op: _Op, args: list[Jet], want: Fields, at: _State) -> Jet:
    return _chain(op.data(args[0]["value"]), args[0], want)


def _power(op: _Op, args: list[Jet], want: Fields, at: _State) -> Jet:
    """a^b; where b changes, exp(b log a)."""
    a, b = args
    x, y = np.asarray(a["value"]), b["value"]
    value = x**y
    if len(b) == 1:
        slope = _falling(y, x, y - 1)
        return _chain((value, slope, _falling(y * (y - 1), x, y - 2)), a, want)
    inside = frozenset(f for name in want for f in _FEEDS["product"][name].split())
    exponent = _times(b, _chain(_log(x), a, inside), inside)
    return _chain((value, value, value), exponent, want)


def _falling(factor: Any, x: Any, y: Any) -> Any:
    """factor x^y, 0 where the factor is."""
    return np.where(np.asarray(factor) == 0, 0.0, factor * x**y)


def _atan2(op: _Op, args: list[Jet], want: Fields, at: _State) -> Jet:
    """The angle of (x, y), as atan in a frame turned so that y is 0 there."""
    inside = frozenset(f for name in want for f in _FEEDS["product"][name].split())
    y, x = args
    r = np.hypot(x["value"], y["value"])
    c, s = x["value"] / r, y["value"] / r
    across, along = (
        _kept({n: _weighted((i, y.get(n)), (j, x.get(n))) for n in inside - {"value"}})
        for i, j in ((c, -s), (s, c))
    )
    slope = _chain((1 / r, -1 / r**2, 2 / r**3), along | {"value": r}, inside)
    angle = _times(across | {"value": 0 * r}, slope, inside)  # atan' = 1 and atan'' = 0 at 0
    return {n: z for n, z in angle.items() if n in want} | {
        "value": np.arctan2(y["value"], x["value"])
    }


def _extreme(op: _Op, args: list[Jet], want: Fields, at: _State) -> Jet:
    """The larger of two, or the smaller; half of each where they are equal."""
    a, b = args
    larger, x, y = op.data, np.asarray(a["value"]), b["value"]
    first = np.heaviside(x - y if larger else y - x, 0.5)
    corner = _corner(x - y)
    out: Jet = {"value": np.maximum(x, y) if larger else np.minimum(x, y)}
    for name in want - {"value"}:
        out[name] = _weighted((first, a.get(name)), (1 - first, b.get(name)))
        if name in ("xs", "vs") and out[name] is not None:
            out[name] = out[name] + corner
    return _kept(out)


def _rate(op: _Op, args: list[Jet], want: Fields, at: _State) -> Jet:
    """d/dt, from the derivatives along d = (qd, 1)."""
    (e,) = args
    xs = e.get("xs")
    out: Jet = {"value": e.get("s", 0.0), "x": xs, "v": _of_q(e.get("x")), "vs": _of_q(xs)}
    if "s" in want and xs is not None:
        out["s"] = np.sum(xs * at.d, axis=1, keepdims=True)
    return {name: part for name, part in out.items() if name in want and part is not None}


_RULES: Mapping[str, Callable[[_Op, list[Jet], Fields, _State], Jet]] = {
    **dict.fromkeys(("number", "parameter", "u", "t", "q", "qd"), _leaf),
    "sum": _sum,
    "product": _product,
    "function": _function,
    "power": _power,
    "atan2": _atan2,
    "extreme": _extreme,
    "dot": _rate,
}


# --- functions: value, first and second derivative ------------------------------------------------

Three = tuple[Any, Any, Any]


def _corner(x: Any) -> Any:
    """nan where a derivative doesn't exist, at 0."""
    return np.where(np.asarray(x) == 0, math.nan, 0.0)


def _sin(x: Any) -> Three:
    s = np.sin(x)
    return s, np.cos(x), -s


def _cos(x: Any) -> Three:
    c = np.cos(x)
    return c, -np.sin(x), -c


def _tan(x: Any) -> Three:
    f = np.tan(x)
    slope = 1 + f**2
    return f, slope, 2 * f * slope


def _asin(x: Any) -> Three:
    slope = 1 / np.sqrt((1 - x) * (1 + x))
    return np.arcsin(x), slope, x * slope**3


def _acos(x: Any) -> Three:
    _, slope, bend = _asin(x)
    return np.arccos(x), -slope, -bend


def _atan(x: Any) -> Three:
    slope = 1 / (1 + x**2)
    return np.arctan(x), slope, -2 * x * slope**2


def _sinh(x: Any) -> Three:
    s = np.sinh(x)
    return s, np.cosh(x), s


def _cosh(x: Any) -> Three:
    c = np.cosh(x)
    return c, np.sinh(x), c


def _tanh(x: Any) -> Three:
    f, slope = np.tanh(x), 1 / np.cosh(x) ** 2
    return f, slope, -2 * f * slope


def _exp(x: Any) -> Three:
    e = np.exp(x)
    return e, e, e


def _log(x: Any) -> Three:
    return np.log(x), 1 / x, -1 / x**2


def _abs(x: Any) -> Three:
    return np.abs(x), np.sign(x), _corner(x)


def _sign(x: Any) -> Three:
    return np.sign(x), _corner(x), _corner(x)


def _step_at(at_zero: float) -> Callable[[Any], Three]:
    return lambda x: (np.heaviside(x, at_zero), _corner(x), _corner(x))


_FUNCTIONS: Mapping[Any, Callable[[Any], Three]] = {
    sympy.sin: _sin,
    sympy.cos: _cos,
    sympy.tan: _tan,
    sympy.asin: _asin,
    sympy.acos: _acos,
    sympy.atan: _atan,
    sympy.sinh: _sinh,
    sympy.cosh: _cosh,
    sympy.tanh: _tanh,
    sympy.exp: _exp,
    sympy.log: _log,
    sympy.Abs: _abs,
    sympy.sign: _sign,
}
