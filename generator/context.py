"""What the templates are given: prototypes, bodies and calls as finished text.

A prototype has only what its function needs: t where time matters, u where inputs do, p where
there are parameters. Every such choice is made here, none in a template.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from importlib.resources import files
from typing import Any

from sympy import Rational

from eomc import __version__, ccode
from eomc.assignments import Function, evaluate, rename
from eomc.ccode import DOUBLE, Body, Real, indent
from eomc.program import TIME, Program, nearby
from eomc.steppers import METHODS, RK4, Row
from eomc.system import System

# names that the templates use inside functions; a user's name that is one of them gets a "_"
_OURS = frozenset(
    "q qd qdd t t0 u p c a h r v D C g K P bias tau power energy now k n good status first steps "
    "every rows q_rows qd_rows u_stride a1 a2 a3 a4 h_2 h_6 hh_2 hh_4 hh_6 trouble held at moving "
    "prepared".split()
)
LARGE = 1000  # operations from which an acceleration is called, not inlined four times


@dataclass(frozen=True)
class _Kind:
    """What is known of a function before it is looked at: results, arguments, meaning."""

    out: str
    shape: str  # "", "n" or "n*n"
    qd: bool
    u: bool
    doc: str


_KINDS: Mapping[str, _Kind] = {
    "D": _Kind("D", "n*n", False, False, "D(q): mass matrix, nq x nq, symmetric."),
    "C": _Kind("C", "n*n", True, False, "C(q, qd): Coriolis matrix, nq x nq, Christoffel form."),
    "g": _Kind("g", "n", False, False, "g(q): dP/dq, the forces of the potential energy."),
    "bias": _Kind("bias", "n", True, False, "bias = C(q, qd) qd + g(q), without forming C."),
    "tau": _Kind("tau", "n", True, True, "tau = Q - dR/dqd: inputs, friction and other forces."),
    "kinetic_energy": _Kind("", "", True, False, "K(q, qd), J."),
    "potential_energy": _Kind("", "", False, False, "P(q), J."),
    "energy": _Kind("", "", True, False, "K + P, J."),
    "jacobi": _Kind(
        "", "", True, False, "qd.dK/dqd - K + P, J: what is conserved here in place of K + P."
    ),
    "power": _Kind(
        "",
        "",
        True,
        True,
        "Power into the system, W: d(energy)/dt, or d(jacobi)/dt if there is one.",
    ),
    "signal": _Kind("u", "m", True, False, "u: the scene's own signals for the inputs."),
}


def resource(package: str, name: str) -> str:
    """The text of a template or of hand-written C."""
    return (files(f"eomc.{package}") / name).read_text(encoding="utf-8")


class Context:
    """The variables of the templates."""

    def __init__(self, program: Program, real: Real) -> None:
        self.program = program
        self.system: System = program.system
        self.real = real
        self.prefix = self.system.name
        self.PREFIX = self.prefix.upper()
        self.sincos = False  # found out while bodies are printed
        s = self.system
        taken = {
            f"{self.PREFIX}_{w}" for w in ("H", "NQ", "NU", "OK", "SINGULAR", "NOT_FINITE", "STAMP")
        }
        indexed = [*(c.name for c in s.coordinates), *(i.name for i in s.inputs)]
        wishes = [f"{self.PREFIX}_{name}" for name in indexed]
        self.enum = dict(zip(indexed, _unique(wishes, taken), strict=True))
        self.needs_p = bool(s.parameters)
        acceleration = program["acceleration"]
        signal = program.functions.get("signal")
        self.signal_state = signal is not None and bool(
            signal.uses & {x.name for x in (*s.q, *s.qd)}
        )
        self.signal_t = signal is not None and TIME in signal.uses
        self.driven = TIME in acceleration.uses or self.signal_t

    # pieces of argument lists, each with its comma before it

    def _arguments(self, *parts: str) -> str:
        return ", ".join(p for p in parts if p)

    @property
    def _p_arg(self) -> str:
        return f"const {self.prefix}_params *p" if self.needs_p else ""

    @property
    def _p_call(self) -> str:
        return "p" if self.needs_p else ""

    def _takes_t(self, name: str) -> bool:
        """Whether a function's result depends on time, by itself or by the signals."""
        takes_u = name in _KINDS and _KINDS[name].u and self.system.inputs
        return TIME in self.program[name].uses or bool(takes_u and self.signal_t)

    def values(self) -> dict[str, Any]:
        """Every variable of every template."""
        s, real = self.system, self.real
        functions = [self._function(name) for name in _KINDS if name in self.program]
        dynamics = self._dynamics()
        n = len(s.coordinates)
        return {
            "title": s.title,
            "prefix": self.prefix,
            "PREFIX": self.PREFIX,
            "real": real.name,
            "dtype": real.dtype,
            "lit": lambda text: text + real.suffix,
            "stamp": self._stamp(),
            "handshake": f"0x{s.digest[:8]}u",
            "digest": s.digest,
            "notes": [line for note in self.program.notes for line in textwrap.wrap(note, 92)],
            "description": self._description(),
            "coordinates": [
                {"name": c.name, "enum": self.enum[c.name], "unit": c.unit, "note": c.note,
                 "comment": _comment(c.unit, c.note)}
                for c in s.coordinates
            ],
            "inputs": [
                {"name": i.name, "enum": self.enum[i.name], "unit": i.unit, "note": i.note,
                 "comment": _comment(i.unit, i.note)}
                for i in s.inputs
            ],
            "parameters": [
                {"name": p.name, "unit": p.unit, "note": p.note,
                 "comment": _comment(p.unit, p.note), "value": self._literal(p.value),
                 "number": repr(p.value), "named": f"/* {p.name} */"}
                for p in s.parameters
            ],
            "q0": [self._literal(c.start) for c in s.coordinates],
            "qd0": [self._literal(c.rate) for c in s.coordinates],
            "start": [c.start for c in s.coordinates],
            "rates_at_start": [c.rate for c in s.coordinates],
            "n": n,
            "m": len(s.inputs),
            "functions": functions,
            "names": [c.name for c in s.coordinates],
            "order": [s.coordinates[k].name for k in self.program.order],
            "run": s.run,
            "indent": indent,
            "broken": lambda text: "\n".join(ccode.broken(text)),
            "has_t": self.driven,
            "has_u": bool(s.inputs),
            "has_p": self.needs_p,
            "batch": s.run.batch,
            "pieces": self._pieces(functions, dynamics),
            **dynamics,
            **self._example(),
            **self._selftest(),
            **self._face(),
        }  # fmt: skip

    def _literal(self, value: float) -> str:
        text = repr(value)
        return (
            text if "." in text or "e" in text or "n" in text else text + ".0"
        ) + self.real.suffix

    def _stamp(self) -> list[str]:
        """What made the file from what, and the command; no date."""
        s = self.system
        source = s.file.replace("\\", "/").rsplit("/", 1)[-1]
        digest = f"(sha256 {s.digest[:16]})"
        if not source:
            return [f"Generated by eomc {__version__} from a system made in Python {digest}"]
        return [
            f"Generated by eomc {__version__} from {source} {digest}:",
            f"    eomc build {source}",
        ]

    def _description(self) -> list[str]:
        s = self.system
        lines = textwrap.wrap(" ".join(s.note.split()), 92) if s.note else []
        if lines:
            lines.append("")
        if s.renamed:
            renamed = ", ".join(f"{given} is {used}" for given, used in s.renamed)
            lines += [*textwrap.wrap(f"Names that C can't bear: {renamed}.", 92), ""]
        return [line.replace("*/", "* /") for line in lines]

    # --- evaluation functions ------------------------------------------------------------------

    def _where(self) -> dict[str, str]:
        """How names from outside are written: p->m_c for parameters, theta_ where theta is ours."""
        s = self.system
        out = {x.name: f"p->{x.name}" for x in s.parameters}
        mine = [*(x.name for x in s.q), *(x.name for x in s.qd), *(i.name for i in s.inputs)]
        return out | {n: _local(n) for n in mine}

    def _body(
        self, function: Function, where: Mapping[str, str] | None = None, **options: Any
    ) -> Body:
        clash = {a.name: a.name + "_" for a in (*function.early, *function.body) if a.name in _OURS}
        made = ccode.body(
            rename(function, clash),
            self.prefix,
            self._where() | dict(where or {}),
            self.real,
            **options,
        )
        self.sincos |= made.sincos
        return made

    def _loads(self, function: Function, state: str = "[]", inputs: str = "[]") -> list[str]:
        """Locals for the coordinates, velocities and inputs that are used.

        state, inputs: "[]" where they stand in arrays, "->" where in structs.
        """
        s, real = self.system, self.real.name
        read = [(c.q.name, c.name, "q", state) for c in s.coordinates]
        read += [(c.qd.name, c.name, "qd", state) for c in s.coordinates]
        read += [(i.name, i.name, "u", inputs) for i in s.inputs]
        return [
            f"const {real} {_local(name)} = "
            + (f"{array}->{of};" if how == "->" else f"{array}[{self.enum[of]}];")
            for name, of, array, how in read
            if name in function.uses
        ]

    def _function(self, name: str) -> dict[str, Any]:
        """One evaluation function: prototype, documentation, body."""
        kind, function, s = _KINDS[name], self.program[name], self.system
        real, NQ, NU = self.real.name, f"{self.PREFIX}_NQ", f"{self.PREFIX}_NU"
        size = {"n*n": f"{NQ}*{NQ}", "n": NQ, "m": NU}.get(kind.shape, "")
        takes_u = kind.u and bool(s.inputs)
        takes_q = name != "signal" or self.signal_state
        takes_t = self._takes_t(name)
        arguments = self._arguments(
            f"{real} {kind.out}[{size}]" if size else "",
            f"{real} t" if takes_t and name == "signal" else "",
            f"const {real} q[{NQ}]" if takes_q else "",
            f"const {real} qd[{NQ}]" if takes_q and kind.qd else "",
            f"{real} t" if takes_t and name != "signal" else "",
            f"const {real} *u" if takes_u else "",
            self._p_arg,
        )
        body = self._body(function)
        used = function.uses
        unused = []
        reads_u = takes_u and bool(used & {i.name for i in s.inputs})
        passes = reads_u and self.signal_state  # to the signals
        read_q = bool(used & {x.name for x in s.q})
        read_qd = bool(used & {x.name for x in s.qd})
        if takes_q and not read_q and not passes:
            unused.append("q")
        if takes_q and kind.qd and not read_qd and not passes:
            unused.append("qd")
        if self.needs_p and not used & {p.name for p in s.parameters}:
            if not reads_u:
                unused.append("p")
        if takes_u and not reads_u:
            unused.append("u")
        if takes_t and TIME not in used and not reads_u:
            unused.append("t")
        results = (
            [f"{kind.out}[{i}] = {r};" for i, r in enumerate(body.results)]
            if size
            else [f"return {body.results[0]};"]
        )
        doc = [kind.doc]
        if takes_u:
            doc.append("u: the inputs; NULL for the scene's signals.")
        doc.append(f"{_sentence(function)}")
        return {
            "name": name,
            "doc": doc,
            "prototype": f"{'void' if size else real} {self.prefix}_{name}({arguments})",
            "takes_u": takes_u,
            "reads_u": reads_u,
            "size": size,
            "unused": unused,
            "loads": self._loads(function),
            "blocks": [*body.early, *body.blocks],
            "results": results,
            "signal_call": self._signal_call("now", "q", "qd"),
            "binding_call": self._binding_call(name, kind, size, takes_q, takes_t, takes_u),
        }

    def _binding_call(
        self, name: str, kind: _Kind, size: str, takes_q: bool, takes_t: bool, takes_u: bool
    ) -> str:
        """The call for row k of many."""
        NQ, signal = f"{self.PREFIX}_NQ", name == "signal"
        at = f"q + {NQ}*k" if takes_q else ""
        arguments = self._arguments(
            f"out + {size}*k" if size else "",
            "t" if takes_t and signal else "",
            at,
            at.replace("q", "qd", 1) if kind.qd else "",
            "t" if takes_t and not signal else "",
            "u" if takes_u else "",
            self._p_cast,
        )
        return f"{'' if size else 'out[k] = '}{self.prefix}_{name}({arguments});"

    @property
    def _p_cast(self) -> str:
        return f"(const {self.prefix}_params *)p" if self.needs_p else ""

    def _signal_call(self, out: str, q: str, qd: str) -> str:
        if "signal" not in self.program:
            return ""
        arguments = self._arguments(
            out, "t" if self.signal_t else "", *((q, qd) if self.signal_state else ()), self._p_call
        )
        return f"{self.prefix}_signal({arguments});"

    # --- accelerations and steppers ------------------------------------------------------------

    def _dynamics(self) -> dict[str, Any]:
        """What belongs to accelerations and steppers."""
        s, function, real = self.system, self.program["acceleration"], self.real.name
        body = self._body(function, keep=_in_prepared, parameters=[p.name for p in s.parameters])
        early = [line for block in body.early for line in block.lines]
        own = [p.name for p in s.parameters]
        kept = list(body.kept)
        if s.run.batch and "signal" in self.program:  # lanes read nothing else
            kept = [n for n in own if n in kept or n in self.program["signal"].uses] + [
                n for n in kept if n not in own
            ]
        takes_c, takes_p = bool(kept), self.needs_p and "signal" in self.program
        t, u = "t" if self.driven else "", "u" if s.inputs else ""
        c, p = "c" if takes_c else "", "p" if takes_p else ""
        has_prepare = bool(kept or body.early_failures)
        scalar = self._mode(function, body, takes_c, takes_p)
        NQ = f"{self.PREFIX}_NQ"
        t_arg, u_arg = f"{real} t" if t else "", f"const {real} *u" if u else ""
        outer = self._arguments(u_arg, self._p_arg)
        x = f"{real} q[{NQ}], {real} qd[{NQ}]"
        rows = f"long every, {real} *q_rows, {real} *qd_rows"
        t0_arg = f"{real} t0" if t else ""
        return {
            "prepared_members": kept,
            "prepare_early": early,
            "prepare_sets": [f"c->{n} = {'p->' if n in own else ''}{n};" for n in kept],
            "prepare_result": _none_of(body.early_failures),
            "has_prepare": has_prepare,
            "prepare_arguments": self._arguments(
                f"{self.prefix}_prepared *c" if takes_c else "", self._p_arg
            ),
            "prepare_call": self._arguments("&prepared" if takes_c else "", self._p_call),
            "p_unused": self.needs_p and not has_prepare and not takes_p,
            "takes_c": takes_c,
            "cost": _sentence(function),
            "scalar": scalar,
            "lane": self._lane(function, kept) if s.run.batch else None,
            "rates_now": f"{self.prefix}_{scalar['rates']}(&a, &at, &moving{scalar['call']('t')})",
            "stepper_call": _after(t, "h", u, c, p),
            "methods": [
                _method(name, [c.name for c in s.coordinates], self.real) for name in s.run.methods
            ],
            "method_names": repr(s.run.methods),
            "t_call": _after(t),
            "p_call": _after(self._p_call),
            "acceleration_prototype": f"{self.prefix}_status {self.prefix}_acceleration("
            + self._arguments(
                f"{real} qdd[{NQ}]", f"const {real} q[{NQ}]", f"const {real} qd[{NQ}]", t_arg, outer
            ) + ")",
            "step_prototype": lambda name: f"{self.prefix}_status {self.prefix}_{name}_step("
            + self._arguments(x, t_arg, f"{real} h", outer) + ")",
            "run_prototype": lambda name: f"long {self.prefix}_{name}_run("
            + self._arguments(
                x, t0_arg, f"{real} h", "long first", "long steps",
                u_arg and f"{u_arg}, long u_stride", rows, self._p_arg,
                f"{self.prefix}_status *status",
            ) + ")",
            "batch_prototype": lambda name: f"void {self.prefix}_{name}_batch("
            + self._arguments(
                "long count", f"{real} *q", f"{real} *qd", t0_arg, f"{real} h", "long first",
                "long steps", u_arg and f"{u_arg}, long u_instance, long u_step",
                f"{rows}, long row_count", self._p_arg and f"{self._p_arg}, long p_instance",
                "long *done", "int *status",
            ) + ")",
            "tile": self._tile(len(kept)),
            "input_names": [i.name for i in s.inputs],
            "sincos": self.sincos,
            "prepare_first": self._arguments("&prepared" if takes_c else "", self._p_call),
            "prepare_lane": self._arguments(
                "&prepared" if takes_c else "", "p + k*p_instance" if self.needs_p else ""
            ),
            "retry_call": _after(
                t, "h", u and "u ? u + (base + i)*u_instance + n*u_step : 0",
                "&c" if takes_c else "", "p + (base + i)*p_instance" if takes_p else "",
            ),
            "tile_prototype": lambda name: (
                f"{self.PREFIX}_LANE {real} {self.prefix}_{name}_tile_step("
                + self._arguments(f"{self.prefix}_tile *s", t_arg, f"{real} h", u and "int held")
                + ")"
            ),
            "batch_binding": lambda name: f"{self.prefix}_{name}_batch("
            + self._arguments(
                "count", "q", "qd", t and "t0", "h", "first", "steps",
                u and "u, u_instance, u_step", "every", "q_rows", "qd_rows", "row_count",
                f"{self._p_cast}, p_instance" if self.needs_p else "", "done", "status",
            ) + ")",
            "enums": [self.enum[c.name] for c in s.coordinates],
        }  # fmt: skip

    def _mode(self, function: Function, body: Body, takes_c: bool, takes_p: bool) -> dict[str, Any]:
        """solve, rates and steppers for one trajectory: they return whether D was regular."""
        s, real, P = self.system, self.real.name, self.prefix
        timed, u = TIME in function.uses, bool(s.inputs)
        inline = "inline " if function.cost.flops <= LARGE else ""
        vector = f"const {P}_vector *"
        t_arg = f"{real} t" if self.driven else ""
        u_arg = f"const {real} *u" if u else ""
        c_arg = f"const {P}_prepared *c" if takes_c else ""
        p_arg = self._p_arg if takes_p else ""
        c, p = "c" if takes_c else "", "p" if takes_p else ""
        state = f"{vector}q, {vector}qd"

        def rates(time: str) -> str:
            if u:
                return _after(time if self.driven else "", "u", c, p)
            return _after(time if timed else "", c)

        return {
            "head": f"static {inline}int",
            "inline": f"static {inline}",
            "solve": "solve",
            "rates": "rates" if u else "solve",
            "suffix": "",
            "solve_arguments": self._arguments(
                f"{P}_vector *a", state, f"{real} t" if timed else "", u_arg, c_arg
            ),
            "solve_u": _after("t" if timed else "", "u", c),
            "solve_now": _after("t" if timed else "", "now", c),
            "rates_arguments": self._arguments(f"{P}_vector *a", state, t_arg, u_arg, c_arg, p_arg),
            "stepper_arguments": self._arguments(
                f"{P}_vector *r, {P}_vector *v, {state}", t_arg, f"{real} h", u_arg, c_arg, p_arg
            ),
            "unused": self._unread(function),
            "loads": self._loads(function, "->", "[]"),
            "blocks": body.blocks,
            "results": [
                f"a->{c.name} = {r};" for c, r in zip(s.coordinates, body.results, strict=True)
            ],
            "end": [f"return {_none_of(body.failures)};"],
            "signal_is_array": self.signal_state,
            "signal_call": self._signal_call("now", "at", "moving"),
            "call": rates,
            "first": "int good = ",
            "and": "good &= ",
            "last": "return good;",
            "own_signal": None,
        }

    def _lane(self, function: Function, kept: Sequence[str]) -> dict[str, Any]:
        """The same for one of many: no branches; what goes wrong is noted in *trouble."""
        s, real, P = self.system, self.real.name, self.prefix
        body = self._body(
            function, keep=_in_prepared, parameters=[p.name for p in s.parameters], lane=True
        )
        takes_c, held = bool(kept), bool(s.inputs)
        names = [c.name for c in s.coordinates]
        mode = self._mode(function, body, takes_c, False)
        trouble, u_arg = f"{real} *trouble", f"const {P}_inputs *u" if s.inputs else ""
        c, inline = "c" if takes_c else "", f"{self.PREFIX}_LANE"
        vector = f"const {P}_vector *"
        state = f"{vector}q, {vector}qd"
        timed = TIME in function.uses
        c_arg = f"const {P}_prepared *c" if takes_c else ""
        t_arg = f"{real} t" if self.driven else ""
        one = f"1.0{self.real.suffix}"

        def rates(time: str) -> str:
            if s.inputs:
                return _after(time if self.driven else "", "u", "held", c, "trouble")
            return _after(time if timed else "", c, "trouble")

        signal = None
        if "signal" in self.program:
            given = self.program["signal"]
            where = {p.name: f"c->{p.name}" for p in s.parameters}
            made = self._body(given, where=where, lane=True)
            signal = {
                "arguments": self._arguments(
                    f"{P}_inputs *u", f"{real} t" if self.signal_t else "",
                    state if self.signal_state else "", c_arg if where else "", trouble,
                ),
                "unused": [
                    name
                    for name, used in (
                        ("c", not where or (takes_c and given.uses & set(where))),
                        ("trouble", made.sincos),
                    )
                    if not used
                ],
                "loads": self._loads(given, "->", "->") if self.signal_state else [],
                "blocks": [*made.early, *made.blocks],
                "results": [
                    f"u->{i.name} = {r};" for i, r in zip(s.inputs, made.results, strict=True)
                ],
                "call": self._arguments(
                    "&now", "t" if self.signal_t else "", "q, qd" if self.signal_state else "",
                    c if where else "", "trouble",
                ),
            }  # fmt: skip
        return mode | {
            "head": f"{inline} void",
            "inline": inline + " ",
            "solve": "solve_lane",
            "rates": "rates_lane" if s.inputs else "solve_lane",
            "suffix": "_lane",
            "solve_arguments": self._arguments(
                f"{P}_vector *a", state, f"{real} t" if timed else "", u_arg, c_arg, trouble
            ),
            "solve_u": _after("t" if timed else "", "held ? u : &now", c, "trouble"),
            "rates_arguments": self._arguments(
                f"{P}_vector *a", state, t_arg, u_arg, "int held", c_arg, trouble
            ),
            "stepper_arguments": self._arguments(
                f"{P}_vector *r, {P}_vector *v, {state}", t_arg, f"{real} h",
                u_arg and f"{u_arg}, int held", c_arg, trouble,
            ),
            "stepper_call": _after(
                "t" if self.driven else "", "h", "&u, held" if s.inputs else "",
                "&c" if takes_c else "", "&trouble",
            ),
            "unused": [*mode["unused"], *([] if body.failures or body.sincos else ["trouble"])],
            "loads": self._loads(function, "->", "->"),
            "end": [f"*trouble = {x} ? {one} : *trouble;" for x in body.failures],
            "call": rates,
            "first": "",
            "and": "",
            "last": "",
            "own_signal": signal,
            "from_tile": [
                self._gathered("vector", "q", "s->q_", names),
                self._gathered("vector", "qd", "s->qd_", names),
                *([self._gathered("inputs", "u", "s->u_", [i.name for i in s.inputs])] * held),
                *([self._gathered("prepared", "c", "s->c_", kept)] * takes_c),
            ],
            "from_tile_again": [
                self._gathered("vector", "at", "s.q_", names),
                self._gathered("vector", "moving", "s.qd_", names),
                *([self._gathered("prepared", "c", "s.c_", kept)] * takes_c),
            ],
        }  # fmt: skip

    def _gathered(self, what: str, name: str, arrays: str, members: Sequence[str]) -> str:
        """A struct of one instance, put together from a tile's arrays."""
        inside = ", ".join(f"{arrays}{member}[i]" for member in members)
        return f"const {self.prefix}_{what} {name} = {{ {inside} }};"

    def _tile(self, kept: int) -> int:
        """Instances side by side: 64, fewer where their states would not stay in the L1 cache."""
        bytes_each = 8 * (2 * len(self.system.q) + len(self.system.u) + kept + 2)
        return max(8, min(64, 1 << (16_384 // bytes_each).bit_length() - 1))

    def _unread(self, function: Function) -> list[str]:
        """Arguments that the body of a function does not read."""
        s = self.system
        return [
            argument
            for argument, names in (("q", s.q), ("qd", s.qd), ("u", s.u))
            if names and not function.uses & {x.name for x in names}
        ]

    def _example(self) -> dict[str, Any]:
        """What main.c needs: the scene's own run, some two hundred rows of it."""
        run, s = self.system.run, self.system
        steps = max(1, math.ceil(run.duration / run.h * (1 - 1e-12)))
        timed = self._takes_t("energy")
        call = f"{self.prefix}_energy(" + "{}" + _after(self._p_call) + ")"
        names = [c.name for c in s.coordinates]
        return {
            "h": self._literal(run.h),
            "steps": steps,
            "main_every": max(1, steps // 200),
            "columns": ["t", *names, *(f"{n}_dot" for n in names), "energy"],
            "energy_call": call.format("q, qd, t" if timed else "q, qd"),
            "energy_call_end": call.format(
                f"q, qd, ({self.real.name})steps*h" if timed else "q, qd"
            ),
        }

    def _selftest(self) -> dict[str, Any]:
        """States near the start and what the program gives there, computed in Python."""
        s = self.system
        states = []
        for k in range(6):
            known = nearby(s, k)
            x = [known[name.name] for name in (*s.q, *s.qd)]
            try:
                if "signal" in self.program:
                    u, _ = evaluate(self.program["signal"], known)
                    known |= {i.name: x for i, x in zip(s.inputs, u, strict=True)}
                values = [evaluate(self.program[f], known) for f in ("D", "bias", "acceleration")]
            except (ArithmeticError, ValueError):
                continue
            if values[2][1] and max(map(abs, values[2][0])) < 1e8:
                states.append(
                    {
                        "x": [self._literal(value) for value in x],
                        "expected": [self._literal(x) for v, _ in values for x in v],
                    }
                )
        state = self._arguments("q", "qd")

        def call(name: str) -> str:
            kind = _KINDS[name]
            arguments = self._arguments(
                name, "q", "qd" if kind.qd else "", self._zero if self._takes_t(name) else "",
                "NULL" if kind.u and s.inputs else "", "&" + self.prefix + "_defaults"
                if self.needs_p else "",
            )  # fmt: skip
            return f"{self.prefix}_{name}({arguments});"

        return {
            "states": states[:3],
            "tolerance": 1e-9 if self.real is DOUBLE else 1e-3,
            "calls": {
                "D": call("D"),
                "bias": call("bias"),
                "tau": call("tau") if "tau" in self.program else "",
                "acceleration": f"{self.prefix}_acceleration("
                + self._arguments(
                    "qdd", state, self._zero if self.driven else "",
                    "NULL" if s.inputs else "", f"&{self.prefix}_defaults" if self.needs_p else "",
                ) + ")",
            },
        }  # fmt: skip

    @property
    def _zero(self) -> str:
        return "0.0" + self.real.suffix

    def _face(self) -> dict[str, Any]:
        """What the Python package needs."""
        s = self.system
        NQ = f"{self.PREFIX}_NQ"
        t, u = "t" if self.driven else "", "u" if s.inputs else ""
        units = {c.name: c.unit for c in s.coordinates} | {p.name: p.unit for p in s.parameters}
        units |= {i.name: i.unit for i in s.inputs}
        return {
            "title_literal": repr(s.title),
            "coordinate_units": repr({c.name: c.unit for c in s.coordinates}),
            "parameter_values": repr({p.name: p.value for p in s.parameters}),
            "input_units": repr({i.name: i.unit for i in s.inputs}),
            "units": repr({name: unit for name, unit in units.items() if unit}),
            "timed": repr(
                tuple(n for n in ("energy", "jacobi") if n in self.program and self._takes_t(n))
            ),
            "face_functions": [
                "C", "D", "acceleration", "bias", "energy", "g", "jacobi", "kinetic_energy",
                "potential_energy", "power", "rhs", "signal", "simulate",
                *(["simulate_batch"] if s.run.batch else []), "step",
                *(["step_batch"] if s.run.batch else []), "tau",
            ],
            "acceleration_binding": f"{self.prefix}_acceleration("
            + self._arguments(f"out + {NQ}*k", f"q + {NQ}*k", f"qd + {NQ}*k", t, u, self._p_cast)
            + ")",
            "run_binding": lambda name: f"{self.prefix}_{name}_run("
            + self._arguments(
                "q", "qd", "t0" if t else "", "h", "first", "steps", u and "u, u_stride",
                "every", "q_rows", "qd_rows", self._p_cast, "&found",
            ) + ")",
        }  # fmt: skip

    def _pieces(
        self, functions: Sequence[Mapping[str, Any]], dynamics: Mapping[str, Any]
    ) -> list[str]:
        """The hand-written C that this scene needs, under its own prefix."""
        if not self.sincos:
            return []
        text = resource("csrc", "sincos.h")
        text = text.replace("#include <math.h>\n", "")
        return [
            text.replace("eomc_", f"{self.prefix}_").replace("EOMC_", f"{self.PREFIX}_").strip()
        ]


def _after(*parts: str) -> str:
    """What follows in an argument list, each part with its comma."""
    return "".join(f", {part}" for part in parts if part)


def _method(name: str, coordinates: Sequence[str], real: Real) -> dict[str, Any]:
    """A stepper as its template wants it; RK4 has one of its own, written out by hand."""
    m = METHODS[name]

    def number(x: Fraction) -> str:
        return ccode.number(Rational(x.numerator, x.denominator), real)

    def total(row: Row, of: str) -> str:
        terms = [(x, k + 1) for k, x in enumerate(row) if x]
        text = " + ".join(f"{number(x)}*a{k}.{of}" for x, k in terms).replace("+ -", "- ")
        return text or number(Fraction(0))

    def lines(c: Fraction, positions: Row, velocities: Row) -> list[str]:
        step = "h" if c == 1 else f"{number(c)}*h"
        return [
            line
            for x in coordinates
            for line in (
                f"r->{x} = q->{x} + ({step}*qd->{x} + hh*({total(positions, x)}));",
                f"v->{x} = qd->{x} + h*({total(velocities, x)});",
            )
        ]

    stages = [] if m is RK4 else list(zip(m.c, m.a_squared, m.a, strict=True))[1:]
    return {
        "name": m.name,
        "title": m.title,
        "order": m.order,
        "source": m.source,
        "stages": m.stages,
        "limits": m.limits,
        "template": "rk4.c.jinja" if m is RK4 else "explicit.c.jinja",
        "body": [
            {"lines": lines(c, *rows), "time": "t + h" if c == 1 else f"t + {number(c)}*h"}
            for c, *rows in stages
        ],
        "end": lines(Fraction(1), m.b_a, m.b),
    }


def _in_prepared(name: str) -> str:
    return f"c->{name}"


def _none_of(conditions: Sequence[str]) -> str:
    return f"!({' || '.join(conditions)})" if conditions else "1"


def _local(name: str) -> str:
    return name + "_" if name in _OURS else name


def _unique(wishes: Iterable[str], taken: set[str]) -> list[str]:
    """Upper-case enumerators, in the author's own case where that would clash."""
    out = []
    wishes = list(wishes)
    uppers = [w.upper() for w in wishes]
    for wish, upper in zip(wishes, uppers, strict=True):
        used = upper if uppers.count(upper) == 1 else wish
        while used in taken:
            used += "_"
        taken.add(used)
        out.append(used)
    return out


def _comment(unit: str, note: str) -> str:
    text = ", ".join(t for t in (unit, " ".join(note.split())) if t)
    return f"/* {text.replace('*/', '* /')} */" if text else ""


def _sentence(function: Function) -> str:
    cost = str(function.cost)
    return cost[0].upper() + cost[1:] + "."
