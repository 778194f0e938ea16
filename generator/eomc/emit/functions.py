"""The functions of mechanics in C, for both forms: matrices, energies, forces, accelerations.

State in arrays, parameters in a struct. Each is straight-line code, in pieces where it is long.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from eomc.emit import c_function as c
from eomc.emit import heading
from eomc.emit.c_expression import REALS, Block, Body, Real, several
from eomc.emit.c_function import CArgument, CFunction
from eomc.emit.c_names import Target, sentence, unclashed
from eomc.emit.evaluations import KINDS, doc, extent, refuses, source
from eomc.emit.plain.parts import Computed
from eomc.emit.plain.views import (
    Indexed,
    Parameter,
)
from eomc.emit.public import Public
from eomc.integrators.tableaux import METHODS
from eomc.model.symbols import Constraint, Coordinate, Event, Input, Output
from eomc.program import outline
from eomc.program.ir import Function
from eomc.program.program import Program

STATE = ("q", "qd")
READ = (*STATE, "qdd", "wrenches", "lambda", "t", "u", "p")
RATE_TERMS = "Rates of rows that may be left out, then the sums of their terms' sizes."
FEW = 16  # statements that are read at a glance, without comments between them


@dataclass(frozen=True)
class Functions:
    """A program on its way to C: the arguments that its functions have, and their bodies."""

    target: Target

    @property
    def prefix(self) -> str:
        """What every C name begins with."""
        return self.target.prefix

    @property
    def PREFIX(self) -> str:
        """What every macro and enumerator begins with."""
        return self.target.PREFIX

    @property
    def real(self) -> str:
        """The name of the element type."""
        return self.target.real.name

    @property
    def names(self) -> dict[str, str]:
        """What nearly every view begins with."""
        return {"prefix": self.prefix, "PREFIX": self.PREFIX, "real": self.real}

    def together(self, function: Function) -> bool:
        """Whether sines of several angles are computed side by side.

        Not those of D, by which selftest.c judges the sines that steps take.
        """
        return self.target.real.reach > 0 and function.name not in ("D", "D_column")

    @property
    def several(self) -> bool:
        """Whether a function has several angles of which that holds."""
        functions = self.target.program.functions.values()
        return any(self.together(f) and several(f) for f in functions)

    @property
    def NQ(self) -> str:
        """The number of coordinates, in C."""
        return f"{self.PREFIX}_NQ"

    @property
    def NU(self) -> str:
        """The number of inputs, in C."""
        return f"{self.PREFIX}_NU"

    @property
    def status(self) -> str:
        """The type of what functions that can fail return."""
        return f"{self.prefix}_status"

    @property
    def ok(self) -> str:
        """The status of success."""
        return f"{self.PREFIX}_OK"

    @property
    def singular(self) -> str:
        """The status where D is not positive definite."""
        return f"{self.PREFIX}_SINGULAR"

    @cached_property
    def public(self) -> Public:
        """The prototypes of what the header declares."""
        return Public(self.target)

    @cached_property
    def brought(self) -> Mapping[str, frozenset[str]]:
        """The names of the program that each argument brings."""
        return self.target.groups()

    def argument(self, name: str) -> CArgument:
        """One of the usual arguments: q, qd, t, h, u, p."""
        if name in (*STATE, "qdd"):
            return c.given(self.real, name, self.NQ)
        if name == "u":
            return c.given(self.real, name)
        if name == "p":
            return c.given(f"{self.prefix}_params", name)
        return CArgument(self.real, name)

    def usual(self, *names: str) -> tuple[CArgument, ...]:
        """Those of the usual arguments that this scene has: u where it has inputs, p likewise."""
        there = {"u": bool(self.target.system.inputs), "p": self.target.needs_p}
        return tuple(self.argument(n) for n in names if there.get(n, True))

    @property
    def swept(self) -> bool:
        """Whether stages are found by sweeps."""
        run = self.target.system.run
        return run.tolerance is not None or any(METHODS[name].sweeps for name in run.methods)

    @property
    def moves_stages(self) -> tuple[CArgument, ...]:
        """Of sweeps: whether stages are moved onto the constraints, where there are."""
        return (CArgument("int", "onto"),) if self.projection else ()

    @property
    def state(self) -> tuple[str, ...]:
        """What accelerations depend on: q, qd, and t where the motion depends on it."""
        return (*STATE, "t") if self.target.driven else STATE

    def pointers(self, function: Function, *names: str) -> tuple[CArgument, ...]:
        """The arguments that a static function needs, arrays as pointers."""
        needed = [n for n in names if function.uses & self.brought[n]]
        arrays = (*STATE, "qdd", "wrenches", "lambda", "along")
        return tuple(c.given(self.real, n) if n in arrays else self.argument(n) for n in needed)

    # the scene's signals

    @cached_property
    def signal(self) -> CFunction | None:
        """The prototype of the signals, where there are inputs."""
        if "signal" not in self.target.program:
            return None
        state = STATE if self.target.signal_state else ()
        names = (*(["t"] if self.target.signal_t else []), *state)
        out = c.filled(self.real, "u", self.NU)
        arguments = (out, *map(self.argument, names), *self.usual("p"))
        return CFunction(f"{self.prefix}_signal", "void", arguments)

    def signals(self, function: Function) -> tuple[Block, ...]:
        """u set to the signals where it is NULL, in a function that reads inputs."""
        if self.signal is None or not self.reads_u(function):
            return ()
        lines = c.otherwise_signal("now", self.signal.call(u="now"))
        return (Block("", (c.local(self.real, f"now[{self.NU}]"),)), Block("", lines))

    def reads_u(self, function: Function) -> bool:
        """Whether a function reads inputs."""
        return bool(self.brought["u"] and function.uses & self.brought["u"])

    def read(self, function: Function, follows: bool = True) -> frozenset[str]:
        """The usual arguments that a function reads, if it `follows` the signals theirs too."""
        names = {n for n, brings in self.brought.items() if function.uses & brings}
        if follows and self.reads_u(function) and self.signal is not None:
            names |= {a.name for a in self.signal.arguments}
        return frozenset(names)

    # bodies

    def loads(self, function: Function) -> Block:
        """Locals for the coordinates, velocities, inputs and directions that are read."""
        return Block(
            "", tuple(self.target.loads(function, self.target.element, self.target.element))
        )

    def straight(self, function: Function, out: str) -> tuple[tuple[Block, ...], Body]:
        """The statements of a function, its results in `out`, or returned where that is empty."""
        body = self.target.body(function, together=self.together(function))
        ends = tuple(c.assign(f"{out}[{k}]", x) for k, x in enumerate(body.results))
        last = Block("", ends if out else (c.result(body.results[0]),))
        return (*self.statements(function, body), last), body

    def statements(self, function: Function, body: Body) -> tuple[Block, ...]:
        """Loads and statements, by stage with a comment where they are many."""
        blocks = (self.loads(function), *body.early, *body.blocks)
        lines = tuple(line for b in blocks for line in b.lines)
        return blocks if len(lines) > FEW else (Block("", lines),)

    def cut(
        self, function: Function, what: str, out: str, given: Sequence[str]
    ) -> tuple[str, tuple[CFunction, ...], tuple[Block, ...]]:
        """A long function in pieces: their struct, the pieces, and the statements that call them.

        out: the array that results go to, of which a piece fills its places.
        """
        function = unclashed(function)
        parts = outline.split(function, outline.PIECE)
        handed = {n: c.member("s", n) for part in parts for n in part.keeps}
        type = f"{self.prefix}_{what}_values"
        made: list[CFunction] = []
        calls: list[str] = []
        for k, part in enumerate(parts, 1):
            f, P = part.function, f"{self.prefix}_{what}_{k}"
            body = self.target.body(
                f, {n: handed[n] for n in part.reads}, stored={n: handed[n] for n in part.keeps},
                pivots=len(function.checks), together=self.together(function),
            )  # fmt: skip
            failures = c.unless(body.failures, self.singular)
            found = zip(part.outputs, body.results, strict=True)
            ends = (*(c.assign(f"{out}[{place}]", x) for place, x in found), *failures)
            ends += (c.result(self.ok),) if failures else ()
            piece = CFunction(
                P,
                self.status if failures else "void",
                (
                    *([c.filled(type, "s")] if part.reads or part.keeps else []),
                    *([c.filled(self.real, out)] if part.outputs else []),
                    *self.pointers(f, *given),
                ),
                (self.loads(f), *body.early, *body.blocks, Block("", ends)),
                self.read(f, follows=False) | {"s", out},
                "static",
                (f"{what}, {k} of {len(parts)}: {outline.weight(f)} operations.",),
            )
            made.append(piece)
            call = piece.call(s="&s")
            calls += c.unless([call], self.singular) if failures else [c.do(call)]
        values = c.struct(type, self.real, list(handed)) if handed else ""
        locals_ = Block("", (c.local(type, "s"),) if handed else ())
        return values, tuple(made), (locals_, Block("", tuple(calls)))

    # functions

    @cached_property
    def evaluations(self) -> tuple[Computed, ...]:
        """Those that the program has, in their order."""
        return tuple(self.evaluation(n) for n in KINDS if source(self.target, n) is not None)

    def evaluation(self, name: str) -> Computed:
        """One of D, C, g, bias, tau, the energies, the signals, the sensitivity."""
        kind, target = KINDS[name], self.target
        function = source(target, name)
        assert function is not None
        told = sentence(function)
        by_columns = name not in target.program
        said = [doc(target, name)]
        if kind.takes_u and target.system.inputs:
            said.append("u: the inputs; NULL for the scene's signals.")
        if refuses(target, name):
            said.append(f"Where the status is not OK, {kind.out} is untouched.")
        if by_columns:
            told = f"By {len(target.names)} columns, each: {told[0].lower()}{told[1:]}"
        reads = self.read(function) | {kind.out}
        public = replace(self.public.evaluation(name), reads=reads, doc=(*said, told))
        if by_columns:
            return self._by_columns(public, function, name)
        if name == "energy" and (summed := self._summed(public)):
            return summed
        if outline.is_large(function):
            out = kind.out or ("power" if name == "power" else "energy")
            size, last = "1", Block("", (c.result(f"{out}[0]"),))
            if refuses(target, name):
                out, size, last = "a", extent(target, kind.shape), self._told(name)
            values, parts, calls = self.cut(function, name, out, READ)
            if out != kind.out:
                one = Block("", (c.local(self.real, f"{out}[{size}]"), *calls[0].lines))
                calls = (one, calls[1], last)
            body = (*self.signals(function), *calls)
            return Computed(replace(public, body=body), parts, values)
        (*blocks, last), found = self.straight(function, kind.out)
        if refuses(target, name):
            array = c.listed(self.real, "a", extent(target, kind.shape), found.results)
            blocks.append(Block("", (array, *c.unless(found.failures, self.singular))))
            last = self._told(name)
        return Computed(replace(public, body=(*self.signals(function), *blocks, last)))

    def _told(self, name: str) -> Block:
        """The end of a function that refuses: results `a` where they go, and the status."""
        size = extent(self.target, KINDS[name].shape)
        unfinite = [f"!{self.prefix}_finite(a, {size})"] if KINDS[name].refuses else []
        told = c.unless(unfinite, f"{self.PREFIX}_NOT_FINITE")
        return Block("", (*told, *c.copied(KINDS[name].out, "a", 0, size), c.result(self.ok)))

    def _summed(self, energy: CFunction) -> Computed | None:
        """K + P by their own functions, whose arguments energy has."""
        parts = [self.evaluation(f"{what}_energy").function for what in ("kinetic", "potential")]
        read = frozenset(a.name for part in parts for a in part.arguments)
        if not read <= {a.name for a in energy.arguments}:
            return None
        body = (Block("", (c.result(" + ".join(part.call() for part in parts)),)),)
        return Computed(replace(energy, body=body, reads=read, doc=energy.doc[:1]))

    def _by_columns(self, public: CFunction, function: Function, name: str) -> Computed:
        """A matrix as a loop over its columns, the matrix times each unit vector."""
        kind = KINDS[name]
        doc = f"{kind.out} times along. {sentence(function)}"
        made = self.static(function, f"{name}_column", "column", doc)
        parts, call = (*made.parts, made.function), made.function.call()
        return Computed(public, parts, made.values, call, kind.out, kind.symmetric)

    def static(
        self, function: Function, what: str, out: str, doc: str, fails: bool = False
    ) -> Computed:
        """A static function that fills `out`; one that `fails` has pivots, and returns a status."""
        values, parts = "", tuple[CFunction, ...]()
        failures: tuple[str, ...] = ()
        if outline.is_large(function):
            values, parts, blocks = self.cut(function, what, out, ("along", *READ))
        else:
            blocks, body = self.straight(function, out)
            failures = c.unless(body.failures, self.singular)
        if fails:
            blocks += (Block("", (*failures, c.result(self.ok))),)
        along = (c.given(self.real, "along"),) if out == "column" else ()
        made = CFunction(
            f"{self.prefix}_{what}",
            self.status if fails else "void",
            (c.filled(self.real, out), *along, *self.pointers(function, *READ)),
            blocks,
            self.read(function, follows=False) | {out},
            "static",
            (doc,),
        )
        return Computed(made, parts, values)

    @cached_property
    def projection(self) -> Computed | None:
        """What q and qd lack for constraints to hold, where there are; static."""
        function = self.target.program.functions.get("projection")
        if function is None:
            return None
        return self.static(function, "projection", "d", sentence(function), fails=True)

    @cached_property
    def rate_terms(self) -> Computed | None:
        """Rates of rows that corrections may leave out, and sizes of their terms; static."""
        function = self.target.program.functions.get("rate_terms")
        if function is None:
            return None
        return self.static(function, "rate_terms", "rates", RATE_TERMS)

    @cached_property
    def projection_along(self) -> Computed | None:
        """The same, and its derivatives along a direction, where steps have them; static."""
        function = self.target.program.functions.get("projection_along")
        if function is None:
            return None
        doc = f"The same, and its derivatives along `along`. {sentence(function)}"
        return self.static(function, "projection_along", "column", doc, fails=True)

    @cached_property
    def projected(self) -> CFunction:
        """A state behind a step, moved onto the constraints; of the plain form."""
        moved, more = self._moved
        q, far = self.argument("q"), CArgument("int *", "singular")
        return c.static(f"{self.prefix}_projected", self.status, *moved, q, *more, far)

    @cached_property
    def onto(self) -> CFunction:
        """A stage moved onto them, to first order."""
        moved, more = self._moved
        return c.static(f"{self.prefix}_onto", "int", *moved, *more)

    @property
    def _moved(self) -> tuple[tuple[CArgument, ...], tuple[CArgument, ...]]:
        """The state that is moved onto constraints, and what else they are read from."""
        read = self.read(self.target.program["projection"]) if self.projection else frozenset()
        state = tuple(c.filled(self.real, n) for n in "rv")
        return state, self.usual(*(n for n in ("t", "p") if n in read))

    @cached_property
    def acceleration(self) -> Computed:
        """qdd, with a status."""
        function = self.target.program["acceleration"]
        force = "tau + A^T lambda" if self.target.system.constraints else "tau"
        doc = [
            f"qdd from D qdd + C qd + g = {force}. Where the status is not OK, qdd is untouched."
        ]
        if self.target.system.inputs:
            doc.append("u: the inputs; NULL for the scene's signals.")
        values, parts = "", tuple[CFunction, ...]()
        unfinite = c.unless([f"!{self.prefix}_finite(a, {self.NQ})"], f"{self.PREFIX}_NOT_FINITE")
        if outline.is_large(function):
            values, parts, blocks = self.cut(function, "acceleration", "a", READ)
            first = Block("", (c.local(self.real, f"a[{self.NQ}]"), *blocks[0].lines))
            blocks = (first, *blocks[1:])
        else:
            body = self.target.body(function, together=self.together(function))
            array = c.listed(self.real, "a", self.NQ, body.results)
            failures = c.unless(body.failures, self.singular)
            *most, last = self.statements(function, body)
            last = Block(last.comment, (*last.lines, array))
            blocks = (*most, last, Block("", failures))
        last = Block("", (*blocks[-1].lines, *unfinite))
        reads = self.read(function) | {"qdd"}
        made = replace(
            self.public.acceleration,
            body=(*self.signals(function), *blocks[:-1], last),
            reads=reads,
            doc=(*doc, sentence(function)),
        )
        return Computed(made, parts, values)


def of(program: Program, real: Real | None = None) -> Functions:
    """A program as plain C: libm's sine and cosine, whatever the element type."""
    return Functions(Target(program, replace(real or REALS[program.system.run.real], reach=0.0)))


def indexed(
    plain: Functions,
    some: Sequence[Constraint | Coordinate | Event | Input | Output],
    prefix: str = "",
) -> tuple[Indexed, ...]:
    """Coordinates, inputs, outputs, constraints or events with their enumerators."""
    enum = plain.target.enum
    return tuple(Indexed(enum[prefix + x.name], heading.words(x.unit, x.note)) for x in some)


def parameters(plain: Functions) -> tuple[Parameter, ...]:
    """Names, values and comments."""
    return tuple(
        Parameter(p.name, plain.target.literal(p.value), heading.words(p.unit, p.note))
        for p in plain.target.system.parameters
    )


def handshake(plain: Functions) -> str:
    """What header and source must share: not those of the fast form, whose memory is another."""
    digest = hashlib.sha256(f"plain {plain.target.system.digest}".encode()).hexdigest()
    return f"0x{digest[:8]}u"
