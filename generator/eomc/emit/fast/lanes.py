"""Accelerations over a lane type: one number, a register of several, or two points at once.

Every function of the fast form that a step calls is printed here once, for whichever lane: its
types, its arguments and how failures are noted are the lane's.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from sympy import Expr, S

from eomc.emit import c_function as c
from eomc.emit.c_expression import FOUR, Block, Body, Printer, Real
from eomc.emit.c_function import CArgument, CFunction
from eomc.emit.c_names import Target, rename_reserved, sentence
from eomc.emit.fast.accelerations import Accelerations
from eomc.emit.plain.parts import Computed
from eomc.program import outline
from eomc.program.ir import Call, Function, Sum
from eomc.program.trig import Angle

INLINE, NOINLINE = "INLINE", "NOINLINE"


def four(n: int) -> int:
    """The next multiple of four."""
    return -(-n // FOUR) * FOUR


def interleaved(k: int) -> int:
    """Where number k of two points stands among both, as two_point.c.jinja has it."""
    return k - k % FOUR + (0, 2, 1, 3)[k % FOUR]


@dataclass(frozen=True)
class Lane:
    """Accelerations with numbers of one type. name: what its C names end in, "" for one number."""

    accelerations: Accelerations
    name: str = ""

    @property
    def prefix(self) -> str:
        """What every C name begins with."""
        return self.accelerations.target.prefix

    @property
    def end(self) -> str:
        """What every C name of the lane ends in."""
        return f"_{self.name}" if self.name else ""

    @cached_property
    def real(self) -> Real:
        """The type."""
        scalar = self.accelerations.target.real
        if not self.name:
            return scalar
        name = f"{self.prefix}_{self.name}"
        return replace(scalar, name=name, function_suffix="", lane=self.name)

    @property
    def mask(self) -> str:
        """The type of failures."""
        return f"{self.real.name}_mask" if self.name else "int"

    @property
    def clear(self) -> str:
        """No failure."""
        return "{ 0 }" if self.name else "0"

    @cached_property
    def target(self) -> Target:
        """The program with numbers of this type."""
        return replace(self.accelerations.target, real=self.real)

    @property
    def NQ(self) -> str:
        """The number of coordinates, in C."""
        return f"{self.target.PREFIX}_NQ"

    @property
    def constants(self) -> str:
        """The type of the constants."""
        return f"{self.prefix}_constants{self.end if self.name != 'two' else ''}"

    @property
    def qualifiers(self) -> Mapping[str, str]:
        """Of functions that are to be inlined, and of those that are not."""
        return {kind: f"{self.target.PREFIX}_{kind}" for kind in (INLINE, NOINLINE)}

    @property
    def names(self) -> dict[str, Any]:
        """What texts over a lane name."""
        inline = self.qualifiers[INLINE]
        return {"inline": inline, "lane": self.real.name, "mask": self.mask, "L": self.end}

    @property
    def unroll(self) -> str:
        """What stands before loops over coordinates: in the two-point form they are vectors."""
        return f"{self.target.PREFIX}_{'ROLLED' if self.padded else 'UNROLL'}"

    @property
    def alone(self) -> bool:
        """Whether something computes all of its sines anew."""
        run = self.target.system.run
        return not self.name or run.tolerance is not None or {*run.methods} != {"rk4"}

    @property
    def padded(self) -> bool:
        """Whether vectors of coordinates are multiples of four numbers, with zeros behind."""
        return not self.name and self.accelerations.parts is not None

    @property
    def across(self) -> bool:
        """Whether four angles go into a register."""
        return not self.name and self.accelerations.across

    @cached_property
    def width(self) -> int:
        """Numbers in a vector of coordinates; angles that are coordinates are read there too."""
        n = len(self.target.names)
        if not self.padded:
            return n
        first = self.straight or 0
        return max(four(n), four(first + four(len(self.accelerations.angles))))

    @property
    def extent(self) -> str:
        """The same in C."""
        return str(self.width) if self.padded else self.NQ

    @cached_property
    def straight(self) -> int | None:
        """The first coordinate, where the angles are coordinates in their order."""
        names = self.target.names
        found = [
            names.index(a.terms[0][1])
            for a in self.accelerations.angles
            if len(a.terms) == 1 and a.terms[0][0] == 1 and a.offset == 0
        ]
        count = len(self.accelerations.angles)
        if len(found) < count or found != list(range(found[0], found[0] + count)):
            return None
        return found[0]

    # arguments

    def argument(self, name: str) -> CArgument:
        """One of q, qd, s, t, u, c."""
        if name == "t":
            return CArgument(self.real.name, "t")
        if name == "s":
            return c.given(f"{self.prefix}_sines{self.end}", "s")
        if name == "c":
            return c.given(self.constants, "c")
        return c.given(self.real.name, name)

    @cached_property
    def there(self) -> tuple[str, ...]:
        """What accelerations of this scene take, besides results."""
        s = self.accelerations
        return (
            "q", "qd", *(["s"] if s.angles else []), *(["t"] if self.target.driven else []),
            *(["u"] if self.target.system.inputs else []), *(["c"] if s.constants else []),
        )  # fmt: skip

    @cached_property
    def brought(self) -> dict[str, frozenset[str]]:
        """The names of the program that each argument brings."""
        groups = self.target.groups()
        sines = {n for a in self.accelerations.angles for n in (a.sine, a.cosine)}
        groups = {k: v for k, v in groups.items() if k in ("q", "qd", "t", "u")}
        return groups | {"s": frozenset(sines), "c": frozenset(self.accelerations.constants)}

    @cached_property
    def where(self) -> dict[str, str]:
        """How sines, cosines and constants are read."""
        found = {n: c.member("c", n) for n in self.accelerations.constants}
        for n, a in enumerate(self.accelerations.angles):
            k = interleaved(n) if self.name == "two" else n
            found[a.sine] = f"{c.member('s', 's')}[{k}]"
            found[a.cosine] = f"{c.member('s', 'c')}[{k}]"
        return found

    # bodies

    def _loads(self, function: Function) -> Block:
        element = self.target.element
        state = self._interleaved if self.name == "two" else element
        return Block("", tuple(self.target.loads(function, state, element)))

    def _interleaved(self, array: str, name: str) -> str:
        return f"{array}[{interleaved(self.target.names.index(name))}]"

    def computed(
        self,
        function: Function,
        what: str,
        out: CArgument | None,
        places: Sequence[str],
        extra: Iterable[tuple[CArgument, frozenset[str], str]] = (),
        doc: str = "",
        takes: Sequence[str] | None = None,
        constants: Mapping[str, str] | None = None,
        in_order: bool = False,
        inline: bool = True,
    ) -> Computed:
        """A function whose results go to `places` of `out`, and that returns what failed.

        extra: arguments besides the usual, the names that each brings, and how these are read.
        takes: the usual arguments, if not all that there are. constants: how those are read, where
        the function has its own.
        """
        function = rename_reserved(function)
        there = self.there if takes is None else takes
        brought = self.brought | ({"c": frozenset(constants)} if constants is not None else {})
        given = [(self.argument(n), brought[n]) for n in there]
        given += [(argument, names) for argument, names, _ in extra]
        where = dict(self.where if constants is None else constants)
        for _, names, form in extra:
            where |= {n: form.format(n) for n in names}
        whole = CFunction(
            f"{self.prefix}_{what}{self.end}",
            self.mask,
            (*([out] if out else []), *(a for a, _ in given)),
            qualifier=self.qualifiers[INLINE if inline else NOINLINE],
            doc=(doc,) if doc else (),
        )
        if outline.is_large(function):
            return self._in_pieces(whole, function, what, out, places, given, where, in_order)
        body = self.target.body(function, where, pivots=self.pivots, in_order=in_order)
        read = {a.name for a, names in given if names & function.uses}
        reads = read | {a.name for a in whole.arguments[:1] if a is out}
        statements = self._statements(function, body, places)
        return Computed(replace(whole, body=statements, reads=frozenset(reads)))

    def _in_pieces(
        self,
        whole: CFunction,
        function: Function,
        what: str,
        out: CArgument | None,
        places: Sequence[str],
        given: Sequence[tuple[CArgument, frozenset[str]]],
        where: Mapping[str, str],
        in_order: bool,
    ) -> Computed:
        """A long function as a call of its pieces, which hand values on in a struct."""
        parts = outline.split(function, outline.PIECE)
        handed = {n: c.member("v", n) for part in parts for n in part.keeps}
        values = f"{self.prefix}_{what}_values{self.end}"
        made: list[CFunction] = []
        calls: list[str] = []
        for k, part in enumerate(parts, 1):
            f = part.function
            body = self.target.body(
                f, dict(where) | {n: handed[n] for n in part.reads},
                stored={n: handed[n] for n in part.keeps}, pivots=self.pivots,
                in_order=in_order,
            )  # fmt: skip
            head = [c.filled(values, "v")] if part.reads or part.keeps else []
            head += [out] if out and part.outputs else []
            arguments = (*head, *(a for a, names in given if names & f.uses))
            fails = self._fails(body)
            piece = CFunction(
                f"{self.prefix}_{what}_{k}{self.end}",
                self.mask if fails else "void",
                arguments,
                self._statements(f, body, [places[n] for n in part.outputs], fails),
                frozenset(a.name for a in arguments),
                self.qualifiers[NOINLINE],
                (f"{what}, {k} of {len(parts)}: {outline.weight(f)} operations.",),
            )
            made.append(piece)
            calls += c.note([piece.call(v="&v")]) if fails else [c.do(piece.call(v="&v"))]
        if self.padded and out == self.out:
            calls += [c.assign(f"a[{k}]", self.target.zero) for k in range(len(places), self.width)]
        locals_ = [c.local(self.mask, f"failed = {self.clear}")]
        locals_ += [c.local(values, "v")] if handed else []
        blocks = (locals_, calls, [c.result("failed")])
        reads = frozenset(a.name for f in made for a in f.arguments)
        struct = c.struct(values, self.real.name, list(handed)) if handed else ""
        body_ = tuple(Block("", tuple(lines)) for lines in blocks)
        return Computed(replace(whole, body=body_, reads=reads), tuple(made), struct)

    @property
    def pivots(self) -> int:
        """How many the whole has: what rounding leaves of one grows with them."""
        return len(self.accelerations.whole.checks)

    def _fails(self, body: Body) -> bool:
        return bool(body.failures or (self.name and body.sincos))

    def _statements(
        self, function: Function, body: Body, places: Sequence[str], fails: bool = True
    ) -> tuple[Block, ...]:
        """Loads, statements, results; what failed is returned where it can."""
        if list(places) == self.places and self.padded:
            sets = self._stored("a", body.results, self.width)
        else:
            sets = tuple(c.assign(to, x) for to, x in zip(places, body.results, strict=True))
        noted = c.note(body.failures)
        if not fails:
            return (self._loads(function), *body.early, *body.blocks, Block("", sets))
        head = Block("", (c.local(self.mask, f"failed = {self.clear}"),))
        end = Block("", (*sets, *noted, c.result("failed")))
        return (head, self._loads(function), *body.early, *body.blocks, end)

    def _stored(self, array: str, values: Sequence[str], width: int) -> tuple[str, ...]:
        """Numbers into an array of that width, zeros behind, where angles go four at a time."""
        if not self.across:
            return tuple(c.assign(f"{array}[{k}]", x) for k, x in enumerate(values))
        whole = [*values, *[self.target.zero] * (width - len(values))]
        return tuple(
            c.do(f"{self.prefix}_put({array} + {k}, {', '.join(whole[k : k + FOUR])})")
            for k in range(0, width, FOUR)
        )

    # functions

    @cached_property
    def out(self) -> CArgument:
        """Where accelerations go."""
        return c.filled(self.real.name, "a")

    @cached_property
    def places(self) -> list[str]:
        """The accelerations there, one by one."""
        return [self.target.element("a", n) for n in self.target.names]

    @cached_property
    def rates(self) -> Computed:
        """The accelerations from the state, its sines and the inputs."""
        doc = sentence(self.accelerations.whole)
        return self.computed(self.accelerations.rotated[1], "rates", self.out, self.places, doc=doc)

    @cached_property
    def signal(self) -> Computed | None:
        """The scene's signals."""
        if "signal" not in self.target.program:
            return None
        takes = [*(["t"] if self.target.signal_t else [])]
        takes += ["q", "qd"] if self.target.signal_state else []
        takes += ["c"] if self.accelerations.constants else []
        own = {n: c.member("c", n) for n in self.accelerations.own}
        return self.computed(
            self.target.program["signal"], "signals", c.filled(self.real.name, "u"),
            [f"u[{self.target.enum[n]}]" for n in self.target.input_names],
            doc="The scene's signals.", takes=takes, constants=own,
        )  # fmt: skip

    @cached_property
    def compute_constants(self) -> Computed:
        """The constants from the parameters; what failed: parameters alone make D singular."""
        own, target = frozenset(self.accelerations.own), self.target
        p = c.given(f"{self.prefix}_params", "p")
        out = c.filled(self.constants, "c") if self.accelerations.constants else None
        return self.computed(
            self.accelerations.staged[0], "compute_constants", out,
            [c.member("c", n) for n in self.accelerations.constants],
            [(p, own, c.member("p", "{}"))] if target.needs_p else (),
            doc="Constants of the parameters.", takes=(), constants={},
        )  # fmt: skip

    def linear(self, what: str, vector: str, offset: bool) -> CFunction:
        """The angles at q, or how they change where q does."""
        angles = self.accelerations.angles
        values = [self.along(a, vector, a.offset if offset else S.Zero) for a in angles]
        if self.padded and self.straight is not None:
            sums = c.copied("x", vector, self.straight, self.angle_count)
        else:
            sums = self._stored("x", values, four(len(values)))
        return CFunction(
            f"{self.prefix}_{what}{self.end}", "void",
            (c.filled(self.real.name, "x"), c.given(self.real.name, vector)),
            (Block("", sums),), frozenset({"x", vector}), self.qualifiers[INLINE],
        )  # fmt: skip

    def along(self, angle: Angle, vector: str, offset: Expr) -> str:
        """An angle of a vector of coordinates."""
        where = {n: self.target.element(vector, n) for _, n in angle.terms}
        return Printer(self.prefix, self.real, where).value(Sum(angle.terms, offset))[0]

    @cached_property
    def calls(self) -> tuple[str, ...]:
        """Functions of the mathematics library that the lane has to have."""
        read = [self.accelerations.whole]
        others = ("signal", "projection")
        read += [f for n in others if (f := self.target.program.functions.get(n))]
        names = {
            a.value.function
            for f in read
            for a in (*f.early, *f.body)
            if isinstance(a.value, Call)
        } - {"sin", "cos", "reciprocal"}  # fmt: skip
        return tuple(sorted({"sign" if n == "heaviside" else n for n in names}))

    @property
    def sincos(self) -> str:
        """The function for the sine and cosine of one angle."""
        return f"{self.prefix}_sincos{self.accelerations.target.real.function_suffix}"

    @property
    def angle_count(self) -> str:
        """The number of angles, in C: to whole registers where those take them together."""
        n = len(self.accelerations.angles)
        return str(four(n) if self.accelerations.across and self.name != "wide" else n)

    @cached_property
    def all_in_one(self) -> CFunction:
        """The accelerations with sines and signals, where those are not given."""
        arguments = (self.out, *map(self.argument, self.there))
        called = self.padded or self.accelerations.long
        return CFunction(
            f"{self.prefix}_accelerations{self.end}", self.mask, arguments,
            qualifier=self.qualifiers[NOINLINE if called else INLINE],
        )  # fmt: skip

    # two points

    @cached_property
    def configuration(self) -> Computed:
        """What two configurations decide, printed for the lane of two."""
        parts = self.accelerations.parts
        assert parts is not None
        out = c.filled(f"{self.prefix}_configuration", "k")
        takes = [n for n in self.there if n in ("q", "s", "c")]
        places = [c.member("k", n) for n in parts.handed]
        return self.computed(
            parts.configuration, "configurations", out, places, takes=takes, in_order=True,
            inline=parts.short,
        )  # fmt: skip

    @cached_property
    def velocity(self) -> Computed:
        """The accelerations at one of two points, from what the configurations decide."""
        parts = self.accelerations.parts
        assert parts is not None
        handed, form = frozenset(parts.handed), f"{c.member('k', '{}')}[point]"
        known = c.given(f"{self.prefix}_configuration", "k")
        extra = [(known, handed, form), (CArgument("int", "point"), handed, form)]
        doc = "The accelerations at point 0 or 1 of k."
        return self.computed(
            parts.velocity, "velocities", self.out, self.places, extra, doc=doc, in_order=True,
            inline=parts.short,
        )  # fmt: skip
