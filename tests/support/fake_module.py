"""A substitute for a compiled module, made of the reference, and ways to break it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from sympy import Expr

from eomc.model.system import System
from eomc.verify.symbolic import SymbolicReference, simplify_trig


def simplify_reference(reference: SymbolicReference) -> SymbolicReference:
    """Return the reference in simplified forms, which round differently."""

    def short(e: Expr) -> Expr:
        return simplify_trig(e, reference.system.qd)

    names = ("D", "C", "g", "bias", "tau", "friction")
    expressions = {name: getattr(reference, name).applyfunc(short) for name in names}
    K, P = short(reference.kinetic), short(reference.potential)
    expressions |= {"kinetic": K, "potential": P, "energy": K + P}
    expressions |= {name: short(getattr(reference, name)) for name in ("jacobi", "power")}
    return replace(reference, **expressions)


class FakeModule:
    """The interface of a compiled module, implemented by the reference alone."""

    weights = np.array([1, 2, 2, 1]) / 6

    def __init__(self, reference: SymbolicReference) -> None:
        self.reference = reference
        system = reference.system
        self.coordinates = tuple(c.name for c in system.coordinates)
        self.parameters = tuple(p.name for p in system.parameters)
        self.inputs = tuple(i.name for i in system.inputs)
        self.defaults = {p.name: p.value for p in system.parameters}
        self.start = tuple(np.array([(c.start, c.rate) for c in system.coordinates]).T)

    def D(self, q: Any, t: float = 0.0, params: Any = None) -> Any:
        return self.reference.evaluate("D", q, None, t, None, params)

    def g(self, q: Any, t: float = 0.0, params: Any = None) -> Any:
        return self.reference.evaluate("g", q, None, t, None, params)

    def potential_energy(self, q: Any, t: float = 0.0, params: Any = None) -> Any:
        return self.reference.evaluate("potential", q, None, t, None, params)

    def C(self, q: Any, qd: Any, t: float = 0.0, params: Any = None) -> Any:
        return self.reference.evaluate("C", q, qd, t, None, params)

    def bias(self, q: Any, qd: Any, t: float = 0.0, params: Any = None) -> Any:
        return self.reference.evaluate("bias", q, qd, t, None, params)

    def kinetic_energy(self, q: Any, qd: Any, t: float = 0.0, params: Any = None) -> Any:
        return self.reference.evaluate("kinetic", q, qd, t, None, params)

    def energy(self, q: Any, qd: Any, t: float = 0.0, params: Any = None) -> Any:
        return self.reference.evaluate("energy", q, qd, t, None, params)

    def jacobi(self, q: Any, qd: Any, t: float = 0.0, params: Any = None) -> Any:
        return self.reference.evaluate("jacobi", q, qd, t, None, params)

    def tau(self, q: Any, qd: Any, t: float = 0.0, u: Any = None, params: Any = None) -> Any:
        return self.reference.evaluate("tau", q, qd, t, u, params)

    def power(self, q: Any, qd: Any, t: float = 0.0, u: Any = None, params: Any = None) -> Any:
        return self.reference.evaluate("power", q, qd, t, u, params)

    def acceleration(
        self, q: Any, qd: Any, t: float = 0.0, u: Any = None, params: Any = None
    ) -> Any:
        return self.reference.acceleration(q, qd, t, u, params)

    def advice(self, q: Any, qd: Any, h: float, **how: Any) -> None:
        return None

    def step(
        self, q: Any, qd: Any, *, h: float, t: float = 0.0, u: Any = None, params: Any = None
    ) -> Any:
        x, slopes = np.array([q, qd]), [np.zeros((2, len(q)))]
        for part in (0, 0.5, 0.5, 1):
            y = x + part * h * slopes[-1]
            slopes.append(np.array([y[1], self.acceleration(*y, t + part * h, u, params)]))
        return tuple(x + h * sum(w * k for w, k in zip(self.weights, slopes[1:], strict=True)))

    def simulate(
        self, q0: Any = None, qd0: Any = None, h: Any = None, steps: int = 1, every: int = 1,
        u: Any = None, params: Any = None,
    ) -> Any:  # fmt: skip
        h = self.reference.system.run.h if h is None else h
        x = (self.start[0] if q0 is None else q0, self.start[1] if qd0 is None else qd0)
        rows = [(0.0, *x)]
        for n in range(steps):
            x = self.step(*x, h=h, t=n * h, u=u, params=params)
            if (n + 1) % every == 0 or n + 1 == steps:
                rows.append(((n + 1) * h, *x))
        t, q, qd = map(np.array, zip(*rows, strict=True))
        energy = np.array([self.energy(q, qd, t, params) for t, q, qd in rows])
        return SimpleNamespace(t=t, q=q, qd=qd, energy=energy, status="ok")


def modify(method: str, by: Callable[[Any], Any]) -> Callable[[FakeModule], None]:
    """Return a breakage that applies `by` to the method's result."""

    def bend(module: FakeModule) -> None:
        right = getattr(module, method)
        setattr(module, method, lambda *place, **how: by(right(*place, **how)))

    return bend


def negate(*index: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that flips the sign of one entry of an array."""

    def flip(right: np.ndarray) -> np.ndarray:
        wrong = np.array(right)
        wrong[index] *= -1
        return wrong

    return flip


def ignore(method: str, to: str) -> Callable[[FakeModule], None]:
    """Return a breakage: the method ignores one of its arguments."""

    def bend(module: FakeModule) -> None:
        right = getattr(module, method)
        setattr(module, method, lambda *place, **how: right(*place, **{**how, to: None}))

    return bend


def set_(name: str, value: Any) -> Callable[[FakeModule], None]:
    return lambda module: setattr(module, name, value)


def delay_time(module: FakeModule) -> None:
    """Break the module: steps use an earlier time."""
    right = module.step
    module.step = lambda *x, t=0.0, **how: right(*x, t=t / 2, **how)  # type: ignore[method-assign]


@dataclass
class FakeRun:
    """The columns of a run of a system."""

    system: System
    t: Any
    q: Any
    qd: Any
    energy: Any
    jacobi: Any = None
    others: dict[str, Any] = field(default_factory=dict)  # inputs and outputs

    @property
    def model(self) -> Any:
        parts = (self.system.coordinates, self.system.inputs, self.system.outputs)
        coordinates, inputs, outputs = ([x.name for x in part] for part in parts)
        units = {x.name: x.unit for part in parts for x in part}
        info = SimpleNamespace(coordinates=coordinates, inputs=inputs, outputs=outputs, units=units)
        return SimpleNamespace(info=info)

    @property
    def request(self) -> Any:
        return SimpleNamespace(u=None)

    @property
    def column_names(self) -> list[str]:
        return ["jacobi"] if self.jacobi is not None else []

    def __getitem__(self, name: str) -> Any:
        names = self.model.info.coordinates
        columns = dict(zip(names, self.q.T, strict=True)) | self.others
        return (columns | dict(zip([f"{x}_dot" for x in names], self.qd.T, strict=True)))[name]
