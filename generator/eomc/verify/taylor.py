"""Independent reference for large systems, by numerical Taylor arithmetic along the definitions.

No formula is expanded or differentiated. The value of each expression and those of its derivatives
that are needed are arrays of numbers. Rules for sums, products and functions compute those of a
result from those of its arguments, from the coordinates to K, P, R and Q, along the definitions in
their order (Griewank & Walther, *Evaluating Derivatives*, 2nd ed., ch. 13). The reference starts
from the `System` and has nothing else in common with the compiler, which differentiates formulas
backwards.

Let e be an expression, x = (q, t), v = qd, and d = (qd, 1) the time derivative of x. At qdd = 0 the
following derivatives are sufficient. Those by x have nq + 1 entries, those by v have nq.

    s    e_x . d        time derivative          x    e_x            gradient by q and t
    xs   e_xx d         rate of e_x              v    e_v            gradient by v
    vs   e_vx d         rate of e_v              vv   e_vv           (nq, nq)
    vvs  rate of e_vv   (nq, nq)                 N    e_vq - e_vq^T  (nq, nq)

xs is needed for expressions of positions only. For e = dot(y), the value is y_s, and s = y_xs . d,
x = y_xs, v = y_q. vs is the rate of y_q, which is y_xs without its last entry. vv, vvs and N are
zero, N since y_qq is symmetric. Therefore neither a full matrix of second derivatives nor a third
derivative is needed.
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
from eomc.verify.reference import SCALARS, ReferenceModel, Values, Vector

BLOCK = 2**16  # entries of the (nq, nq) matrices of all states evaluated at once, for the cache

Jet = dict[str, Any]  # value and derivatives by name, a row for each state; without zeros
Fields = frozenset[str]

PAIRS = ("vv", "vvs", "N")  # derivatives that are (nq, nq) matrices
_VELOCITY_FIELDS = {"v", "vs", *PAIRS}

# for each value of `evaluate`, the derivatives that it requires: of K, of T = K - a.qd (a.qd is the
# linear potential), P, R, the forces Q, and so on
_REQUIRED_FIELDS: Mapping[str, Mapping[str, str]] = {
    "D": {"T": "vv"},
    "C": {"T": "vvs N"},
    "g": {"T": "vs x", "P": "x"},
    "bias": {"T": "vs x", "P": "x"},
    "tau": {"Q": "value", "R": "v", "y": "x", "F": "value"},
    "kinetic": {"K": "value"},
    "potential": {"P": "value"},
    "energy": {"K": "value", "P": "value"},
    "jacobi": {"T": "value v", "P": "value"},
    "power": {"T": "x", "P": "x", "Q": "value", "R": "v", "y": "x", "F": "value"},
    "signals": {"u": "value"},
    "motion": {"T": "vs x vv", "P": "x", "Q": "value", "R": "v", "y": "x", "F": "value"},
    "constraints": {"phi": "value", "psi": "value"},
    "constraint_jacobian": {"phi": "x", "psi": "v"},
    "constraint_rates": {"phi": "s", "psi": "value"},
    "gamma": {"phi": "xs", "psi": "s"},
}


# for each derivative of a product, or of dot(e), the derivatives of its arguments that it requires
FEEDS: Mapping[str, Mapping[str, str]] = {
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


@dataclass(frozen=True)
class Op:
    """One operation: a rule that is applied to the results of earlier operations.

    Attributes
    ----------
    kind : str
        Its rule, a key of RULES.
    args : tuple of int
        Indices of the operations whose results are its arguments.
    data : object
        A number, index or function that the rule needs.
    degree : float
        Degree in the velocities; inf if it is not a polynomial in them.
    moves : int
        2 if it depends on q, 1 if it depends on t only, else 0.
    rate, has_inputs : bool
        Whether it depends on a time derivative dot(...), and on an input.
    """

    kind: str
    args: tuple[int, ...] = ()
    data: Any = None
    degree: float = 0
    moves: int = 0
    rate: bool = False
    has_inputs: bool = False


@dataclass(frozen=True)
class EvaluationPoint:
    """The b states at which operations are evaluated.

    q, qd: coordinates and velocities, (b, nq). t: time, s. u: inputs. values: parameters. The time
    and each input and parameter are one number or a column (b, 1).
    """

    q: Vector
    qd: Vector
    t: Any
    u: Any
    values: Any

    @cached_property
    def d(self) -> Vector:
        """Time derivative (q̇, 1) of x = (q, t), (b, nq + 1)."""
        return np.concatenate([self.qd, np.ones((len(self.qd), 1))], axis=1)

    def unit(self, i: int, more: int) -> Vector:
        """Return the unit vector along entry i, as a matrix with one row, (1, nq + more).

        more: number of entries after the nq coordinates, such as 1 for the time.
        """
        row = np.zeros((1, self.q.shape[1] + more))
        row[0, i] = 1
        return row


class TaylorReference(ReferenceModel):
    """Reference that evaluates equations of motion with arrays of derivatives instead of formulas.

    A reference is the independent evaluation of a system in Python, with which modules are
    compared. The quantities have the same meaning as in `symbolic.derive`.

    With the notation of the module's docstring, D = T_vv, bias = T_vs - T_q + P_q, and C = (c(qd) +
    c(0))/2 with c = T_vvs + N. This is the sum of Christoffel's 1/2 (Ddot + dp2_i/dq_j -
    dp2_j/dq_i) for p2 = D qd, the gyroscopic part da_i/dq_j - da_j/dq_i and the explicit dD/dt.
    There are no difference quotients: each value is exact up to a few roundings of its largest
    terms.

    Raises EomcError if K is not recognised as a polynomial of degree 2 in the velocities, or if a
    required derivative is not known.
    """

    def __init__(self, system: System) -> None:
        self.system = system
        self._list = operations = _List(system)
        degree = operations.ops[operations.roots["T"][0]].degree
        if degree > 2:
            raise EomcError(
                "the kinetic energy is not quadratic in the velocities, or can't be seen to be: "
                "write it as a sum of products. Friction belongs in 'dissipation' or [forces]"
            )
        rates = (c for c in system.constraints if not c.holonomic)
        for c, index in zip(rates, operations.roots["psi"], strict=True):
            if operations.ops[index].degree > 1:
                raise EomcError(
                    f"{system.name}: the constraint {c.name} is not linear in the rates"
                )
        self._plans: dict[str, tuple[tuple[int, Op, Fields], ...]] = {}

    def value(
        self, name: str, q: Vector, qd: Vector, t: Any, u: ArrayLike | None, values: Values
    ) -> Any:
        """Return the value of `name`; see `ReferenceModel.value`."""
        inputs = None if u is None else np.asarray(u, float)
        if q.ndim == 1:
            row = None if inputs is None else inputs[None]
            return self._rows(name, q[None], qd[None], t, row, values)[0][()]
        step = max(1, BLOCK // q.shape[1] ** 2)
        blocks = []
        for part in (slice(k, k + step) for k in range(0, len(q), step)):
            time, us, *each = (z[part] if np.ndim(z) else z for z in (t, inputs, *values))
            blocks.append(self._rows(name, q[part], qd[part], time, us, each))
        return np.concatenate(blocks)

    def _rows(
        self, name: str, q: Vector, qd: Vector, t: Any, u: Any, values: Sequence[Any]
    ) -> Vector:
        """Return the value of `name` at b states: q, qd (b, nq), u (b, nu) or None."""
        if name == "signals" or not self.system.inputs:
            u = np.zeros((1, len(self.system.inputs)))
        elif u is None:
            u = self._rows("signals", q, qd, t, None, values)
        if name == "C":  # with and without velocities
            q, qd = np.concatenate([q, q]), np.concatenate([qd, 0 * qd])
            t, u, *values = map(_twice, (t, u, *values))
        if name == "g":
            qd = np.zeros_like(qd)
        inputs, parameters = ([_column(z) for z in zs] for zs in (u.T, values))
        with np.errstate(all="ignore"):
            result = self._outputs(name, EvaluationPoint(q, qd, _column(t), inputs, parameters))
        result[~np.isfinite(result.reshape(len(result), -1)).all(axis=1)] = math.nan
        return result

    def mass_and_force(
        self, q: Vector, qd: Vector, t: Any, u: ArrayLike | None, values: Values
    ) -> tuple[Vector, Vector]:
        """Return D and τ - bias from one evaluation."""
        both = self.value("motion", q, qd, t, u, values)  # (..., nq, nq + 1)
        return both[..., :-1], both[..., -1]

    def _outputs(self, name: str, state: EvaluationPoint) -> Vector:
        """Return the values of `name`, one row for each state."""
        jets = self._run(name, state)
        roots, (b, nq) = self._list.roots, state.q.shape

        def part(root: str, field: str, *shape: int) -> Vector:
            (index,) = roots[root]
            return np.broadcast_to(jets.get(index, {}).get(field, 0.0), (b, *shape))

        def each(root: str) -> Vector:
            result = [np.broadcast_to(jets[index]["value"], (b, 1)) for index in roots[root]]
            return np.concatenate([np.zeros((b, 0)), *result], axis=1)

        def tau() -> Vector:
            result = each("Q") - part("R", "v", nq)
            for y, force in zip(roots["y"], roots["F"], strict=True):
                result = result + jets[force]["value"] * jets[y]["x"][:, :nq]
            return result

        def bias() -> Vector:
            slope = part("P", "x", nq + 1) - part("T", "x", nq + 1)
            return part("T", "vs", nq) + slope[:, :nq]

        match name:
            case "D":
                result = part("T", "vv", nq, nq)
            case "C":
                c = part("T", "vvs", nq, nq) + part("T", "N", nq, nq)
                result = (c[: b // 2] + c[b // 2 :]) / 2
            case "bias" | "g":
                result = bias()
            case "motion":
                D, b = part("T", "vv", nq, nq), tau() - bias()
                result = np.concatenate([D, b[..., None]], axis=2)
            case "tau":
                result = tau()
            case "kinetic":
                result = part("K", "value", 1)
            case "potential":
                result = part("P", "value", 1)
            case "energy":
                result = part("K", "value", 1) + part("P", "value", 1)
            case "jacobi":
                twice = np.sum(part("T", "v", nq) * state.qd, axis=1, keepdims=True)
                result = twice - part("T", "value", 1) + part("P", "value", 1)
            case "power":
                work = np.sum(tau() * state.qd, axis=1, keepdims=True)
                explicit = part("T", "x", nq + 1) - part("P", "x", nq + 1)
                result = work - explicit[:, nq:]
            case "constraints" | "constraint_jacobian" | "constraint_rates" | "gamma":
                result = self._rows_of(name, jets, state)
            case _:
                result = each("u")
        return np.array(result[:, 0] if name in SCALARS else result)

    def _rows_of(self, name: str, jets: Mapping[int, Jet], state: EvaluationPoint) -> Vector:
        """Return values of the constraints: (b, m), or (b, m, nq) for the Jacobian A."""
        b, nq = state.q.shape

        def part(index: int, field: str, *shape: int) -> Vector:
            return np.broadcast_to(jets.get(index, {}).get(field, 0.0), (b, *shape))

        phi, psi = self._list.roots["phi"], self._list.roots["psi"]
        match name:
            case "constraints":
                result = [part(k, "value", 1) for k in (*phi, *psi)]
            case "constraint_jacobian":
                result = [part(k, "x", nq + 1)[:, None, :nq] for k in phi]
                result += [part(k, "v", nq)[:, None] for k in psi]
            case "constraint_rates":
                result = [part(k, "s", 1) for k in phi] + [part(k, "value", 1) for k in psi]
            case _:
                bends = (np.sum(part(k, "xs", nq + 1) * state.d, axis=1) for k in phi)
                result = [bend[:, None] for bend in bends] + [part(k, "s", 1) for k in psi]
        return np.concatenate(result, axis=1)

    def _run(self, name: str, state: EvaluationPoint) -> dict[int, Jet]:
        if name not in self._plans:
            self._plans[name] = tuple(self._list.plan(_REQUIRED_FIELDS[name]))
        jets: dict[int, Jet] = {}
        for index, op, want in self._plans[name]:
            jets[index] = RULES[op.kind](op, [jets.get(arg, {}) for arg in op.args], want, state)
        return jets


def _twice(z: Any) -> Any:
    """Return the rows repeated once; a number, or a single row, is unchanged."""
    return np.concatenate([z, z]) if np.ndim(z) and len(z) > 1 else z


def _column(z: Any) -> Any:
    """Return a number unchanged, and one number for each state as a column."""
    return np.asarray(z, float)[:, None] if np.ndim(z) else np.float64(z)


# --- from expressions to a flat list of operations ------------------------------------------------


@dataclass
class _List:
    """List of the distinct operations in all expressions of a system, in order of evaluation.

    ops: the operations. known: index of the operation that evaluates an expression. roots: indices
    of the results, such as "K" or "Q", by name.
    """

    system: System
    ops: list[Op] = field(default_factory=list)
    known: dict[Expr, int] = field(default_factory=dict)
    roots: dict[str, list[int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        s = self.system
        for i, (q, qd) in enumerate(zip(s.q, s.qd, strict=True)):
            self.known[q] = self.add(Op("q", data=i, moves=2))
            self.known[qd] = self.add(Op("qd", data=i, degree=1))
        self.known[t] = self.add(Op("t", moves=1))
        for i, u in enumerate(s.u):
            self.known[u] = self.add(Op("u", data=i, has_inputs=True))
        for i, p in enumerate(s.parameters):
            self.known[p.symbol] = self.add(Op("parameter", data=i))
        for name, body in s.definitions:
            self.known[name] = self.node(body)
        forces = s.forces or (sympy.S.Zero,) * len(s.q)
        roots = {"K": [s.kinetic], "T": [s.kinetic - s.linear_potential], "P": [s.potential]}
        roots |= {"R": [s.dissipation], "Q": [*forces]}
        roots |= {"u": [i.signal for i in s.inputs]}
        roots |= {"y": [y for y, _ in s.applied], "F": [force for _, force in s.applied]}
        roots |= {"phi": [c.formula for c in s.constraints if c.holonomic]}
        roots |= {"psi": [c.formula for c in s.constraints if not c.holonomic]}
        self.roots = {name: [self.node(e) for e in exprs] for name, exprs in roots.items()}

    def add(self, op: Op) -> int:
        """Append an operation and return its index."""
        self.ops.append(op)
        return len(self.ops) - 1

    def make(self, kind: str, args: Iterable[int], data: Any = None, degree: float = 0) -> int:
        """Append an operation on the results of earlier ones and return its index.

        kind, data, degree: as in `Op`. args: indices of its arguments. The operation depends on q,
        time, rates and inputs if an argument does.
        """
        args = tuple(args)
        of = [self.ops[i] for i in args]
        moves, rate, constant = (
            max(getattr(a, n) for a in of) for n in ("moves", "rate", "has_inputs")
        )
        return self.add(Op(kind, args, data, degree, moves, rate or kind == "dot", constant))

    def node(self, e: Any) -> int:
        """Return the index of the operation that evaluates the expression `e`.

        The operations are appended if `e` is new.
        """
        e = sympy.sympify(e)
        if e not in self.known:
            self.known[e] = self.build(e)
        return self.known[e]

    def build(self, e: Expr) -> int:
        """Append the operations that evaluate `e`, and return the index of the last one.

        Raises EomcError if the derivatives of `e` are not known.
        """
        if e.is_number:
            return self.add(Op("number", data=np.float64(e)))
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
            index = args[0]
            for other in args[1:]:
                index = self.make("extreme", (index, other), e.func is sympy.Max, degree)
            return index
        if isinstance(e, sympy.Heaviside):
            return self.make("function", args[:1], step_at(float(e.args[1])), degree)
        if e.func in FUNCTIONS and len(args) == 1:
            return self.make("function", args, FUNCTIONS[e.func], degree)
        raise EomcError(f"{self.system.name}: the derivatives of {e} are not known")

    def product(self, e: Expr) -> int:
        """Append the operations for a product or square, and return the index of the last one.

        Factors are sorted by what they depend on, so that few products have large derivatives.
        """
        factors: list[int] = []
        for factor in e.args if e.is_Mul else (e,):
            square = factor.is_Pow and factor.exp == 2
            factors += [self.node(factor.base)] * 2 if square else [self.node(factor)]
        factors.sort(key=lambda i: (self.ops[i].degree > 0, self.ops[i].moves, i))
        index = factors[0]
        for other in factors[1:]:
            degree = self.ops[index].degree + self.ops[other].degree
            index = self.make("product", (index, other), degree=degree)
        return index

    def rate(self, e: Expr) -> int:
        """Append the operation for a dot(...), a derivative by time, and return its index.

        Raises EomcError if the expression in it depends on velocities, inputs or another dot(...).
        """
        inside = self.node(e.args[0])
        op = self.ops[inside]
        if op.degree or op.has_inputs or op.rate:
            what = "velocities" if op.degree else "inputs" if op.has_inputs else "a dot(...)"
            raise EomcError(f"{e} hangs on {what}, whose rates are not known")
        return self.make("dot", (inside,), degree=1 if op.moves == 2 else 0)

    def plan(self, fields_by_root: Mapping[str, str]) -> Iterator[tuple[int, Op, Fields]]:
        """Return the operations that some derivatives require, in the order of their evaluation.

        fields_by_root: for each root, the name of a quantity such as "K", the names of its required
        derivatives, separated by spaces. Each entry of the result is the index of an operation, the
        operation, and the derivatives that must be computed for it.
        """
        need: dict[int, set[str]] = {}
        for root, fields in fields_by_root.items():
            for index in self.roots[root]:
                self._demand(need, index, fields.split())
        for index in range(len(self.ops) - 1, -1, -1):
            op = self.ops[index]
            for field_ in sorted(need.get(index, ())):
                if op.kind == "sum":
                    feeds = [field_]
                else:
                    feeds = FEEDS["dot" if op.kind == "dot" else "product"].get(field_, "").split()
                for arg in op.args:
                    self._demand(need, arg, feeds)
        return ((i, op, frozenset(need[i])) for i, op in enumerate(self.ops) if need.get(i))

    def _demand(self, need: dict[int, set[str]], index: int, fields: Iterable[str]) -> None:
        """Record that `fields` are needed, except those that are zero."""
        op, here = self.ops[index], need.setdefault(index, set())
        for name in fields:
            if name in _VELOCITY_FIELDS:
                if op.degree > 0:
                    here.add(name)
            elif name == "value" or op.moves or op.degree:
                here.add(name)


# --- rules: value and derivatives of an operation from those of its arguments ---------------------


def _weighted(*terms: tuple[Any, Any]) -> Any:
    """Return the sum of w z over pairs (w, z); None counts as zero."""
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


def _without_none(jet: Jet) -> Jet:
    return {name: part for name, part in jet.items() if part is not None}


def _leaf(op: Op, args: list[Jet], fields: Fields, at: EvaluationPoint) -> Jet:
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


def _sum(op: Op, args: list[Jet], fields: Fields, at: EvaluationPoint) -> Jet:
    out: Jet = {}
    for name in fields:
        total, mine = None, False
        for weight, a in zip(op.data, args, strict=True):
            if name in a:
                part = a[name] if weight == 1 else weight * a[name]
                if total is None:
                    total = part
                elif name in PAIRS and mine and total.shape == part.shape:
                    total += part
                else:
                    total, mine = total + part, True
        if total is not None:
            out[name] = total
    return out


def _product(op: Op, args: list[Jet], fields: Fields, at: EvaluationPoint) -> Jet:
    return _times(args[0], args[1], fields)


def _times(a: Jet, b: Jet, fields: Fields) -> Jet:
    """Return the derivatives of a product (Leibniz's rule)."""
    x, y, g, h = a["value"], b["value"], a.get, b.get
    if len(a) == 1:  # a number, or a function of parameters only
        large = x[..., None] if isinstance(x, np.ndarray) else x
        return {n: (large if n in PAIRS else x) * z for n, z in b.items() if n in fields}
    out: Jet = {}
    for name in fields:
        if name == "value":
            out[name] = x * y
            continue
        terms = [(x, h(name)), (y, g(name))]
        if name in ("xs", "vs"):
            terms += [(g("s"), h(name[0])), (h("s"), g(name[0]))]
        elif name == "vvs":
            terms += [(g("s"), h("vv")), (h("s"), g("vv"))]
        total = _weighted(*terms)
        if name == "vv":
            total = _plus(total, _with_transpose(_outer(g("v"), h("v"))))
        elif name == "vvs":
            mixed = _plus(_outer(g("v"), h("vs")), _outer(g("vs"), h("v")))
            total = _plus(total, _with_transpose(mixed))
        elif name == "N":
            mixed = _plus(
                _outer(g("v"), _without_time(h("x"))), _outer(h("v"), _without_time(g("x")))
            )
            total = _plus(total, _with_transpose(mixed, -1))
        out[name] = total
    return _without_none(out)


def _without_time(x: Any) -> Any:
    """Return a row without its entry for t."""
    return None if x is None else x[:, :-1]


def _chain(f: tuple[Any, Any, Any], a: Jet, fields: Fields) -> Jet:
    """Return the value and derivatives of f(a) by the chain rule, from f, f' and f'' at a."""
    value, slope, bend = f
    g = a.get
    out: Jet = {}
    for name in fields:
        if name == "value":
            out[name] = value
        elif name in ("s", "x", "v"):
            out[name] = _weighted((slope, g(name)))
        elif name in ("xs", "vs"):
            turn = None if g("s") is None else bend * g("s")
            out[name] = _weighted((slope, g(name)), (turn, g(name[0])))
        else:  # for K only, which is a polynomial in the velocities
            raise AssertionError(name)
    return _without_none(out)


def _function(op: Op, args: list[Jet], fields: Fields, at: EvaluationPoint) -> Jet:
    return _chain(op.data(args[0]["value"]), args[0], fields)


def _power(op: Op, args: list[Jet], fields: Fields, at: EvaluationPoint) -> Jet:
    """Return a^b, as exp(b log a) if b is not constant."""
    a, b = args
    x, y = np.asarray(a["value"]), b["value"]
    value = x**y
    if len(b) == 1:
        slope = _falling(y, x, y - 1)
        return _chain((value, slope, _falling(y * (y - 1), x, y - 2)), a, fields)
    inside = frozenset(f for name in fields for f in FEEDS["product"][name].split())
    exponent = _times(b, _chain(FUNCTIONS[sympy.log](x), a, inside), inside)
    return _chain((value, value, value), exponent, fields)


def _falling(factor: Any, x: Any, y: Any) -> Any:
    """Return factor x^y, or 0 where the factor is 0."""
    return np.where(np.asarray(factor) == 0, 0.0, factor * x**y)


def _atan2(op: Op, args: list[Jet], fields: Fields, at: EvaluationPoint) -> Jet:
    """Return the angle of (x, y), by atan in a frame rotated so that y is 0 at this point."""
    inside = frozenset(f for name in fields for f in FEEDS["product"][name].split())
    y, x = args
    r = np.hypot(x["value"], y["value"])
    c, s = x["value"] / r, y["value"] / r
    across, along = (
        _without_none({n: _weighted((i, y.get(n)), (j, x.get(n))) for n in inside - {"value"}})
        for i, j in ((c, -s), (s, c))
    )
    slope = _chain((1 / r, -1 / r**2, 2 / r**3), along | {"value": r}, inside)
    angle = _times(across | {"value": 0 * r}, slope, inside)  # atan' = 1 and atan'' = 0 at 0
    return {n: z for n, z in angle.items() if n in fields} | {
        "value": np.arctan2(y["value"], x["value"])
    }


def _extreme(op: Op, args: list[Jet], fields: Fields, at: EvaluationPoint) -> Jet:
    """Return the larger or smaller of two; their mean where they are equal."""
    a, b = args
    larger, x, y = op.data, np.asarray(a["value"]), b["value"]
    first = np.heaviside(x - y if larger else y - x, 0.5)
    corner = _corner(x - y)
    out: Jet = {"value": np.maximum(x, y) if larger else np.minimum(x, y)}
    for name in fields - {"value"}:
        out[name] = _weighted((first, a.get(name)), (1 - first, b.get(name)))
        if name in ("xs", "vs") and out[name] is not None:
            out[name] = out[name] + corner
    return _without_none(out)


def _rate(op: Op, args: list[Jet], fields: Fields, at: EvaluationPoint) -> Jet:
    """Return d/dt, from the derivatives along d = (qd, 1)."""
    (e,) = args
    xs = e.get("xs")
    out: Jet = {
        "value": e.get("s", 0.0),
        "x": xs,
        "v": _without_time(e.get("x")),
        "vs": _without_time(xs),
    }
    if "s" in fields and xs is not None:
        out["s"] = np.sum(xs * at.d, axis=1, keepdims=True)
    return {name: part for name, part in out.items() if name in fields and part is not None}


RULES: Mapping[str, Callable[[Op, list[Jet], Fields, EvaluationPoint], Jet]] = {
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
    """Return nan at 0, where the derivative does not exist."""
    return np.where(np.asarray(x) == 0, math.nan, 0.0)


def _asin(x: Any) -> Three:
    slope = 1 / np.sqrt((1 - x) * (1 + x))
    return np.arcsin(x), slope, x * slope**3


def step_at(at_zero: float) -> Callable[[Any], Three]:
    """Return a function of x that computes the step function and its first two derivatives.

    at_zero: value of the step function at x = 0, where the derivatives are nan.
    """
    return lambda x: (np.heaviside(x, at_zero), _corner(x), _corner(x))


FUNCTIONS: Mapping[Any, Callable[[Any], Three]] = {
    sympy.sin: lambda x: (f := np.sin(x), np.cos(x), -f),
    sympy.cos: lambda x: (f := np.cos(x), -np.sin(x), -f),
    sympy.tan: lambda x: (f := np.tan(x), g := 1 + f**2, 2 * f * g),
    sympy.asin: _asin,
    sympy.acos: lambda x: (np.arccos(x), *(-g for g in _asin(x)[1:])),
    sympy.atan: lambda x: (np.arctan(x), g := 1 / (1 + x**2), -2 * x * g**2),
    sympy.sinh: lambda x: (f := np.sinh(x), np.cosh(x), f),
    sympy.cosh: lambda x: (f := np.cosh(x), np.sinh(x), f),
    sympy.tanh: lambda x: (f := np.tanh(x), g := 1 / np.cosh(x) ** 2, -2 * f * g),
    sympy.exp: lambda x: (f := np.exp(x), f, f),
    sympy.log: lambda x: (np.log(x), 1 / x, -1 / x**2),
    sympy.Abs: lambda x: (np.abs(x), np.sign(x), _corner(x)),
    sympy.sign: lambda x: (np.sign(x), _corner(x), _corner(x)),
}
