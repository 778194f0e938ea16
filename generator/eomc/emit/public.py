"""The public C functions of a scene as values: their prototypes, which both forms of C have."""

from __future__ import annotations

from dataclasses import dataclass, replace

from eomc.emit.c_function import CArgument, CFunction, filled, given, member
from eomc.emit.c_names import Target
from eomc.emit.evaluations import KINDS, extent, refuses, source, takes_qdd, takes_t

STATE = ("q", "qd")
LIMITS = ("t_end", "tol", "h_most")  # of adaptive steps


@dataclass(frozen=True)
class Public:
    """What a header declares for a scene."""

    target: Target

    def usual(self, *names: str) -> tuple[CArgument, ...]:
        """Those of q, qd, t, h, u, p that this scene has."""
        target, real = self.target, self.target.real.name
        there = {
            "q": given(real, "q", f"{target.PREFIX}_NQ"),
            "qd": given(real, "qd", f"{target.PREFIX}_NQ"),
            "qdd": given(real, "qdd", f"{target.PREFIX}_NQ"),
            "wrenches": given(real, "wrenches", extent(target, "f*twist")),
            "lambda": given(real, "lambda", extent(target, "c")),
            "t": CArgument(real, "t") if target.driven else None,
            "h": CArgument(real, "h"),
            "u": given(real, "u") if target.system.inputs else None,
            "p": given(f"{target.prefix}_params", "p") if target.needs_p else None,
        }
        return tuple(a for name in names if (a := there[name]))

    def evaluations(self) -> tuple[CFunction, ...]:
        """D, C, g, bias, tau, the energies, the sensitivity, the signals: those that there are."""
        return tuple(map(self.evaluation, (n for n in KINDS if source(self.target, n) is not None)))

    def evaluation(self, name: str) -> CFunction:
        """One of them."""
        kind, target, real = KINDS[name], self.target, self.target.real.name
        signal = name == "signal"
        t = (CArgument(real, "t"),) if takes_t(target, name) else ()
        moving = STATE if "qd" in kind.takes.split() else STATE[:1]
        returns = "void" if kind.out else real
        return CFunction(
            f"{target.prefix}_{name}",
            f"{target.prefix}_status" if refuses(target, name) else returns,
            (
                *([filled(real, kind.out, extent(target, kind.shape))] if kind.out else []),
                *(t if signal else ()),
                *(self.usual(*moving) if not signal or target.signal_state else ()),
                *(self.usual("qdd") if takes_qdd(target, name) else ()),
                *(self.usual(kind.given) if kind.given else ()),
                *(() if signal else t),
                *self.usual(*(["u"] if kind.takes_u else []), "p"),
            ),
        )

    @property
    def acceleration(self) -> CFunction:
        """qdd, with a status."""
        target = self.target
        qdd = filled(target.real.name, "qdd", f"{target.PREFIX}_NQ")
        return self._status("acceleration", qdd, *self.usual(*STATE, "t", "u", "p"))

    @property
    def linearization(self) -> CFunction:
        """A_q, A_qd and B, with a status."""
        target, NQ = self.target, f"{self.target.PREFIX}_NQ"
        widths = {"A_q": NQ, "A_qd": NQ}
        if target.system.inputs:
            widths["B"] = f"{target.PREFIX}_NU"
        # C++20 has no product of two enumerations
        out = (
            filled(target.real.name, name, f"{NQ}*{w}" if w == NQ else f"(int){NQ}*{w}")
            for name, w in widths.items()
        )
        return self._status("linearization", *out, *self.usual(*STATE, "t", "u", "p"))

    @property
    def project(self) -> CFunction:
        """A state moved onto the constraints, with a status."""
        names = ("D", "constraints", "constraint_jacobian", "constraint_rates")
        t = self.usual(*["t"] if any(takes_t(self.target, n) for n in names) else [])
        held = given("int", "held")
        return self._status("project", *self._moved, *t, held, *self.usual("p"))

    def step(self, method: str) -> CFunction:
        """One step in place."""
        return self._status(f"{method}_step", *self._moved, *self.usual("t", "h", "u", "p"))

    @property
    def fixed_step(self) -> CFunction:
        """The same of any method, as what keeps an adaptive run has it."""
        return replace(self.step("fixed"), name=member("memory", "step"))

    @property
    def fixed_type(self) -> CFunction:
        """Its type."""
        return self.step("fixed")

    def derivative(self, method: str) -> CFunction:
        """Phi and Gamma of one step, with a status."""
        target, NQ = self.target, f"{self.target.PREFIX}_NQ"
        out = [filled(target.real.name, "Phi", f"4*{NQ}*{NQ}")]
        if target.system.inputs:
            out.append(filled(target.real.name, "Gamma", f"2*{NQ}*{target.PREFIX}_NU"))
        return self._status(f"{method}_derivative", *out, *self.usual(*STATE, "t", "h", "u", "p"))

    def run(self, method: str) -> CFunction:
        """Many steps in place."""
        P = self.target.prefix
        strides = [CArgument("long", "u_stride")] if self.target.system.inputs else []
        return CFunction(
            f"{P}_{method}_run",
            "long",
            (
                *self._moved, *self._steps, *self.usual("u"), *strides, *self._rows,
                *self.usual("p"), CArgument(f"{P}_{method}_memory *", "memory"),
                CArgument(f"{P}_status *", "status"),
            ),
        )  # fmt: skip

    def batch(self, method: str) -> CFunction:
        """The same of many instances."""
        target, real = self.target, self.target.real.name
        strides = [CArgument("long", name) for name in ("u_instance", "u_step", "p_instance")]
        return CFunction(
            f"{target.prefix}_{method}_batch",
            "void",
            (
                CArgument("long", "count"), filled(real, "q"), filled(real, "qd"), *self._steps,
                *self.usual("u"), *(strides[:2] if target.system.inputs else []), *self._rows,
                CArgument("long", "row_count"), *self.usual("p"),
                *(strides[2:] if target.needs_p else []),
                CArgument("long *", "done"), CArgument("int *", "status"),
            ),
        )  # fmt: skip

    def adaptive(self, method: str) -> CFunction:
        """Steps of the size that a tolerance asks for."""
        P, real = self.target.prefix, self.target.real.name
        name = f"{P}_{method}_adaptive"
        return CFunction(
            name,
            "long",
            (
                *self._moved, filled(real, "t"), *(CArgument(real, n) for n in LIMITS),
                *self.usual("u"), CArgument("long", "steps"), given(real, "times"),
                CArgument("long", "count"), *(filled(real, f"{n}_rows") for n in ("t", *STATE)),
                *(self.adaptive_events if self.target.system.events else ()),
                *self.usual("p"), CArgument(f"{name}_memory *", "memory"),
                CArgument(f"{P}_status *", "status"),
            ),
        )  # fmt: skip

    def adaptive_batch(self, method: str) -> CFunction:
        """The same of many instances."""
        target, real = self.target, self.target.real.name
        name = f"{target.prefix}_{method}_adaptive"
        strides = [CArgument("long", name) for name in ("u_instance", "p_instance")]
        return CFunction(
            f"{name}_batch",
            "int",
            (
                CArgument("long", "count"), *(filled(real, n) for n in (*STATE, "t")),
                *(CArgument(real, n) for n in LIMITS),
                *self.usual("u"), *(strides[:1] if target.system.inputs else []),
                CArgument("long", "steps"), given(real, "times"), CArgument("long", "row_count"),
                *(filled(real, f"{n}_rows") for n in STATE),
                *(self.adaptive_events if target.system.events else ()), *self.usual("p"),
                *(strides[1:] if target.needs_p else []),
                CArgument(f"{name}_memory *", "memory"), CArgument("long *", "kept"),
                CArgument("int *", "status"),
            ),
        )  # fmt: skip

    @property
    def adaptive_events(self) -> tuple[CArgument, ...]:
        """Where events that were found go."""
        return (
            CArgument("long", "room"), filled("long", "events"), filled("int", "which"),
            filled(self.target.real.name, "event_rows"),
        )  # fmt: skip

    def _status(self, name: str, *arguments: CArgument) -> CFunction:
        return CFunction(f"{self.target.prefix}_{name}", f"{self.target.prefix}_status", arguments)

    @property
    def _moved(self) -> tuple[CArgument, ...]:
        real, NQ = self.target.real.name, f"{self.target.PREFIX}_NQ"
        return tuple(filled(real, name, NQ) for name in STATE)

    @property
    def _steps(self) -> tuple[CArgument, ...]:
        real = self.target.real.name
        t0 = [CArgument(real, "t0")] if self.target.driven else []
        return (*t0, CArgument(real, "h"), CArgument("long", "first"), CArgument("long", "steps"))

    @property
    def _rows(self) -> tuple[CArgument, ...]:
        rows = (filled(self.target.real.name, f"{name}_rows") for name in STATE)
        return (CArgument("long", "every"), *rows)
