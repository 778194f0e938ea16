"""Accelerations over a lane type: one number, a vector register, or two configurations at once.

Every function of optimised C that a step calls is printed here for any lane, the corrections onto
the constraints included. The lane determines types, arguments and the representation of failures.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from sympy import Expr, S

from eomc.emit.common import c_function as c
from eomc.emit.common import solver
from eomc.emit.common.amalgamate import amalgamate
from eomc.emit.common.c_expression import DOUBLE, FOUR, MIN_SIMD_ANGLES, Block, CBody, Printer, Real
from eomc.emit.common.c_function import CArgument, CFunction, GeneratedFunction
from eomc.emit.common.c_names import Target, cost_sentence, rename_reserved
from eomc.emit.common.functions import CORRECTION, RATE_TERMS, SceneFunctions
from eomc.emit.common.solver import SolverModel, library_names, state_arguments
from eomc.program import outline, two_point
from eomc.program.ir import Call, Function, Operand, Sum, rename
from eomc.program.program import TIME
from eomc.program.two_point import Angle

MAX_INLINED_OPERATIONS = 300  # of accelerations, up to which every stage inlines them


def padded_size(n: int) -> int:
    """Return the smallest multiple of four that is at least `n`."""
    return -(-n // FOUR) * FOUR


def interleaved_index(k: int) -> int:
    """Return the position of coordinate or angle number `k` in the vectors of two_point.c.

    That template computes with two configurations q in one vector register. In each group of four,
    it stores the coordinates or angles in the order 0, 2, 1, 3.
    """
    return k - k % FOUR + (0, 2, 1, 3)[k % FOUR]


def _forward(function: CFunction, library: str, *passed: str) -> str:
    """Return the definition of a function that calls a function of the library."""
    call = f"{library}({', '.join(passed)})"
    reads = frozenset(a.name for a in function.arguments)
    body = (Block("", (c.return_statement(call),)),)
    return replace(function, body=body, reads=reads).definition


@dataclass(frozen=True)
class Accelerations:
    """The accelerations q̈ of a scene, split into functions for the methods of optimised C.

    Attributes
    ----------
    target
        The program and its C names.
    constants
        Names of precomputed expressions, which depend on the parameters only.
    angles
        Angles whose sines and cosines are arguments of the remaining function.
    parts
        The remaining function, split into a position-dependent and a velocity-dependent part; None
        where this split is not faster.
    """

    target: Target

    @cached_property
    def function(self) -> Function:
        """The function of the program for the accelerations, before it is split."""
        return self.target.program["acceleration"]

    @cached_property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the scene's parameters."""
        return tuple(p.name for p in self.target.system.parameters)

    @cached_property
    def precomputed_and_remaining(self) -> tuple[Function, Function]:
        """The accelerations as two functions of the program.

        The first computes all expressions that depend on the parameters only, once for a run; the
        second computes the accelerations from these, at every stage.
        """
        precomputed, remaining = outline.split_precomputed(self.function, self.parameter_names)
        projections = [self._split_projection[0]] if self._split_projection else []
        names = [o.name for f in (precomputed, *projections) for o in f.outputs]
        others = ("signal", "rate_terms")  # other functions of steps that read parameters
        read_by_others = {n for name in others if (f := self.target.program.functions.get(name))
                for n in f.uses}  # fmt: skip
        results = [n for n in self.parameter_names if n in names or n in read_by_others]
        results += [n for n in names if n not in self.parameter_names]
        return replace(
            precomputed,
            early=tuple(a for f in (precomputed, *projections) for a in f.early),
            outputs=tuple(Operand(S.One, n) for n in results),
            checks=tuple(pair for f in (precomputed, *projections) for pair in f.checks),
        ), remaining

    @cached_property
    def _split_projection(self) -> tuple[Function, Function] | None:
        """The projection, split in the same way."""
        whole = self.target.program.functions.get("projection")
        if whole is None:
            return None
        precomputed, remaining = outline.split_precomputed(whole, self.parameter_names)
        new_names = {a.name: f"rows_{a.name}" for a in precomputed.early}
        return rename(precomputed, new_names), rename(remaining, new_names)

    @cached_property
    def correction(self) -> tuple[Function, bool]:
        """The function for corrections of a state onto the constraints, and a flag.

        The function reads precomputed expressions of the parameters. If the flag is True, it also
        takes the sines and cosines that the accelerations take; if False, it computes its own.
        """
        assert self._split_projection is not None
        remaining = self._split_projection[1]
        angles, separated = two_point.separate_angles(remaining, self.target.names)
        known = {(frozenset(a.terms), a.offset): a for a in self.angles}
        pairs = [(a, known.get((frozenset(a.terms), a.offset))) for a in angles]
        names = {
            old: new for a, b in pairs if b for old, new in ((a.sine, b.sine), (a.cosine, b.cosine))
        }
        computed = {a.name for a in separated.body}
        if not angles or not all(b for _, b in pairs) or computed & {*names.values()}:
            return remaining, False
        return rename(separated, names), True

    @property
    def constants(self) -> tuple[str, ...]:
        """Names of the precomputed expressions, which depend on the parameters only."""
        return tuple(o.name for o in self.precomputed_and_remaining[0].outputs)

    @cached_property
    def angles_and_function(self) -> tuple[tuple[Angle, ...], Function]:
        """The angles in the accelerations, and the function for the accelerations without sines.

        The function takes the sines and cosines of the angles as arguments, so that a step can
        obtain them by rotating those of another stage. There are no angles if eomc has no sine and
        cosine of its own for the type of numbers.
        """
        if not self.target.real.reach:
            return (), self.precomputed_and_remaining[1]
        return two_point.separate_angles(self.precomputed_and_remaining[1], self.target.names)

    @property
    def angles(self) -> tuple[Angle, ...]:
        """Angles whose sines and cosines are arguments of the function for the accelerations."""
        return self.angles_and_function[0]

    @cached_property
    def parts(self) -> two_point.Parts | None:
        """The accelerations, split into a position-dependent and a velocity-dependent function.

        None if the scene does not use RK4 in double precision, or if the split is not faster.
        """
        target = self.target
        if target.real is not DOUBLE or "rk4" not in target.system.run.methods:
            return None
        early = {a.name for a in self.function.early}
        return two_point.split(
            self.angles_and_function[1], self.angles, target.system, {*self.parameter_names, *early}
        )

    @property
    def simd_angles(self) -> bool:
        """Whether single trajectories compute the sines of four angles in one vector register."""
        constrained = bool(self.target.system.constraints)
        return self.parts is not None or (constrained and len(self.angles) >= MIN_SIMD_ANGLES)

    @property
    def is_long(self) -> bool:
        """Whether the C function for the accelerations is too long to be inlined in every stage.

        Compilation would take too long if it were inlined.
        """
        return outline.weight(self.angles_and_function[1]) > MAX_INLINED_OPERATIONS


@dataclass(frozen=True)
class Signature:
    """Name, arguments and results of a C function that `Lane.generate_function` generates.

    Attributes
    ----------
    name
        The C name, without the scene's prefix and the lane's suffix.
    out, places
        The C argument for the results (None if there are none), and the C expression to which each
        result is assigned, such as "a[0]".
    takes
        Names of the arguments described in `Lane.argument`; None for all of `Lane.argument_names`.
    constants
        C expressions of precomputed values by name, where they differ from `Lane.where`.
    extra
        Additional arguments: for each, the C argument, the names that it supplies, and a format for
        the C expression of such a name.
    """

    name: str
    out: CArgument | None
    places: Sequence[str]
    takes: Sequence[str] | None = None
    constants: Mapping[str, str] | None = None
    extra: Sequence[tuple[CArgument, frozenset[str], str]] = ()


@dataclass(frozen=True)
class Lane:
    """Generator of C functions, above all of the accelerations q̈, for one C type: a *lane*.

    Attributes
    ----------
    accelerations
        The accelerations of the scene, as functions of the program.
    name
        Selects the C type: "" for plain numbers; "wide" for a vector register with one value of
        each of several instances or stages; "two" for a register with the values of two
        configurations q. The C names of the functions end in it.
    """

    accelerations: Accelerations
    name: str = ""

    @property
    def prefix(self) -> str:
        """The prefix of all generated C names: the scene's name."""
        return self.accelerations.target.prefix

    @property
    def suffix(self) -> str:
        """The suffix of C names for this lane type, such as "_wide"; "" for plain numbers."""
        return f"_{self.name}" if self.name else ""

    @cached_property
    def real(self) -> Real:
        """The C type of a value: a number or a vector register."""
        scalar = self.accelerations.target.real
        if not self.name:
            return scalar
        name = f"{self.prefix}_{self.name}"
        return replace(scalar, name=name, function_suffix="", lane=self.name)

    @property
    def mask(self) -> str:
        """The C type that records failures of a computation.

        It is int for plain numbers, and for a vector register a mask with one element for each
        value of the register.
        """
        return f"{self.real.name}_mask" if self.name else "int"

    @property
    def clear(self) -> str:
        """The C initialiser of a `mask` without failures."""
        return "{ 0 }" if self.name else "0"

    @cached_property
    def target(self) -> Target:
        """The program and its C names; the C type of numbers is replaced by this lane type."""
        return replace(self.accelerations.target, real=self.real)

    @property
    def NQ(self) -> str:
        """The C macro for the number of coordinates."""
        return f"{self.target.PREFIX}_NQ"

    @property
    def constants(self) -> str:
        """The C type of the struct with the precomputed expressions of the parameters."""
        return f"{self.prefix}_constants{self.suffix if self.name != 'two' else ''}"

    @property
    def inline(self) -> str:
        """The name of the C macro before functions that are inlined."""
        return f"{self.target.PREFIX}_INLINE"

    @property
    def noinline(self) -> str:
        """The name of the C macro before functions that are not inlined."""
        return f"{self.target.PREFIX}_NOINLINE"

    @property
    def unroll(self) -> str:
        """The name of the C macro before loops over coordinates: it unrolls them or does not.

        The loops are not unrolled if vectors of coordinates are padded: compilers then put the
        loops into vector registers.
        """
        return f"{self.target.PREFIX}_{'ROLLED' if self.two_point else 'UNROLL'}"

    @property
    def computes_own_sines(self) -> bool:
        """Whether the C function for the accelerations can compute the sines of its angles itself.

        If False, all its callers pass sines and cosines as an argument.
        """
        run = self.target.system.run
        return not self.name or run.tolerance is not None or {*run.methods} != {"rk4"}

    @property
    def two_point(self) -> bool:
        """Whether the accelerations are split into two C functions.

        `configuration` computes the position-dependent part for two configurations q in one vector
        register. `velocity` computes the accelerations from it, at one of these two.
        Vectors of coordinates are then padded with zeros to a multiple of four.
        """
        return not self.name and self.accelerations.parts is not None

    @property
    def count(self) -> str:
        """The C enumerator for the number of values in a vector register."""
        return f"{self.target.PREFIX}_{self.name.upper()}_COUNT"

    @property
    def simd_angles(self) -> bool:
        """Whether the sines of four angles are computed in one vector register."""
        return not self.name and self.accelerations.simd_angles

    @cached_property
    def width(self) -> int:
        """Number of elements of the C vectors of coordinates.

        This is the number of coordinates. If the vectors are padded, zeros are added so that the
        coordinates, and the angles among them, can be read in groups of four.
        """
        n = len(self.target.names)
        if not self.two_point:
            return n
        first = self.contiguous_angles or 0
        return max(
            padded_size(n),
            padded_size(first + padded_size(len(self.accelerations.angles))),
        )

    @property
    def c_width(self) -> str:
        """The number of elements of the C vectors of coordinates (`width`), as a C expression."""
        return str(self.width) if self.two_point else self.NQ

    @cached_property
    def contiguous_angles(self) -> int | None:
        """Index of the first of the coordinates that are the angles of the accelerations.

        None if the angles, whose sines the accelerations read, are not consecutive coordinates.
        """
        names = self.target.names
        indices = [
            names.index(a.terms[0][1])
            for a in self.accelerations.angles
            if len(a.terms) == 1 and a.terms[0][0] == 1 and a.offset == 0
        ]
        count = len(self.accelerations.angles)
        if len(indices) < count or indices != list(range(indices[0], indices[0] + count)):
            return None
        return indices[0]

    # arguments

    def argument(self, name: str) -> CArgument:
        """Return the declaration of the C argument `name`, with its type for this lane.

        name: "q" or "qd" for coordinates or velocities; "s" for the struct of sines and cosines of
        the angles; "t" for the time; "u" for the inputs; "c" for the struct of precomputed
        expressions of the parameters.
        """
        if name == "t":
            return CArgument(self.real.name, "t")
        if name == "s":
            return c.input_array(f"{self.prefix}_sines{self.suffix}", "s")
        if name == "c":
            return c.input_array(self.constants, "c")
        return c.input_array(self.real.name, name)

    @cached_property
    def argument_names(self) -> tuple[str, ...]:
        """Names of the arguments that the C function for the accelerations takes, in order.

        They are those of q, qd, s, t, u, c (see `argument`) that this scene has: s if it has
        angles, t if its steps depend on time, u if it has inputs, c if it has precomputed
        expressions.
        """
        s = self.accelerations
        return (
            "q", "qd", *(["s"] if s.angles else []), *(["t"] if self.target.driven else []),
            *(["u"] if self.target.system.inputs else []), *(["c"] if s.constants else []),
        )  # fmt: skip

    @cached_property
    def names_of(self) -> dict[str, frozenset[str]]:
        """The names of the values that each C argument contains, by the argument's name.

        The arguments are q, qd, t, u, s and c, see `argument`. For example, "q" contains all
        coordinates.
        """
        groups = self.target.groups()
        sines = {n for a in self.accelerations.angles for n in (a.sine, a.cosine)}
        groups = {k: v for k, v in groups.items() if k in ("q", "qd", "t", "u")}
        return groups | {"s": frozenset(sines), "c": frozenset(self.accelerations.constants)}

    @cached_property
    def where(self) -> dict[str, str]:
        """The C expression, such as "s->s[0]", for each value in the structs s and c, by its name.

        s contains sines and cosines of angles, c precomputed expressions of the parameters.
        """
        expressions = {n: c.member("c", n) for n in self.accelerations.constants}
        for n, a in enumerate(self.accelerations.angles):
            k = interleaved_index(n) if self.name == "two" else n
            expressions[a.sine] = f"{c.member('s', 's')}[{k}]"
            expressions[a.cosine] = f"{c.member('s', 'c')}[{k}]"
        return expressions

    # bodies

    def _loads(self, function: Function) -> Block:
        """Return definitions of local variables for the q, qd and u that a function reads."""
        element = self.target.element
        state = self._interleaved if self.name == "two" else element
        return Block("", tuple(self.target.loads(function, state, element)))

    def _interleaved(self, array: str, name: str) -> str:
        """Return the element of a coordinate in the interleaved layout of two points."""
        return f"{array}[{interleaved_index(self.target.names.index(name))}]"

    def generate_function(
        self,
        function: Function,
        signature: Signature,
        doc: str = "",
        in_order: bool = False,
        inline: bool = True,
    ) -> GeneratedFunction:
        """Return a C function that evaluates a function of the program.

        The C function stores the results in an argument, and returns where it failed (a `mask`).

        Parameters
        ----------
        function
            The function of the program.
        signature
            The name, the arguments and the results of the C function.
        doc
            The comment above the C function.
        in_order
            Whether the C code adds the terms of sums in the order of the program.
        inline
            Whether the C function is inlined, unless it is so long that it is split into several
            ones.
        """
        function = rename_reserved(function)
        out, supplied_by = signature.out, self._supplied_by(signature)
        outer = CFunction(
            f"{self.prefix}_{signature.name}{self.suffix}",
            self.mask,
            (*([out] if out else []), *(a for a, _ in supplied_by)),
            qualifier=self.inline if inline else self.noinline,
            doc=(doc,) if doc else (),
        )
        if outline.is_large(function):
            return self._in_pieces(outer, function, signature, in_order)
        where = self._expressions(signature)
        body = self.target.body(function, where, pivots=self.pivots, in_order=in_order)
        read = {a.name for a, names in supplied_by if names & function.uses}
        reads = read | {a.name for a in outer.arguments[:1] if a is out}
        statements = self._statements(function, body, signature.places)
        return GeneratedFunction(replace(outer, body=statements, reads=frozenset(reads)))

    def _supplied_by(self, signature: Signature) -> list[tuple[CArgument, frozenset[str]]]:
        """Return the C arguments of a function except `out`, each with the names it supplies."""
        constants, takes = signature.constants, signature.takes
        supplied = self.names_of | ({"c": frozenset(constants)} if constants is not None else {})
        names = self.argument_names if takes is None else takes
        extra = [(argument, names) for argument, names, _ in signature.extra]
        return [*((self.argument(n), supplied[n]) for n in names), *extra]

    def _expressions(self, signature: Signature) -> dict[str, str]:
        """Return the C expressions of precomputed and additional values of a function, by name."""
        where = dict(self.where if signature.constants is None else signature.constants)
        for _, names, form in signature.extra:
            where |= {n: form.format(n) for n in names}
        return where

    def _in_pieces(
        self, outer: CFunction, function: Function, signature: Signature, in_order: bool
    ) -> GeneratedFunction:
        """Return a long function as calls of outlined functions, which share values in a struct."""
        name, out, places = signature.name, signature.out, signature.places
        supplied_by, where = self._supplied_by(signature), self._expressions(signature)
        parts = outline.split(function, outline.PIECE)
        shared = {n: c.member("v", n) for part in parts for n in part.keeps}
        values = f"{self.prefix}_{name}_values{self.suffix}"
        pieces: list[CFunction] = []
        calls: list[str] = []
        for k, part in enumerate(parts, 1):
            f = part.function
            body = self.target.body(
                f, where | {n: shared[n] for n in part.reads},
                stored={n: shared[n] for n in part.keeps}, pivots=self.pivots,
                in_order=in_order,
            )  # fmt: skip
            head = [c.output_array(values, "v")] if part.reads or part.keeps else []
            head += [out] if out and part.outputs else []
            arguments = (*head, *(a for a, names in supplied_by if names & f.uses))
            fails = self._fails(body)
            piece = CFunction(
                f"{self.prefix}_{name}_{k}{self.suffix}",
                self.mask if fails else "void",
                arguments,
                self._statements(f, body, [places[n] for n in part.outputs], fails),
                frozenset(a.name for a in arguments),
                self.noinline,
                (f"{name}, {k} of {len(parts)}: {outline.weight(f)} operations.",),
            )
            pieces.append(piece)
            calls += (
                c.record_failures([piece.call(v="&v")])
                if fails
                else [c.call_statement(piece.call(v="&v"))]
            )
        if self.two_point and out == self.out:
            calls += [c.assign(f"a[{k}]", self.target.zero) for k in range(len(places), self.width)]
        locals_ = [c.declare(self.mask, f"failed = {self.clear}")]
        locals_ += [c.declare(values, "v")] if shared else []
        blocks = (locals_, calls, [c.return_statement("failed")])
        reads = frozenset(a.name for f in pieces for a in f.arguments)
        struct = c.define_struct(values, self.real.name, list(shared)) if shared else ""
        body_ = tuple(Block("", tuple(lines)) for lines in blocks)
        return GeneratedFunction(replace(outer, body=body_, reads=reads), tuple(pieces), struct)

    @property
    def pivots(self) -> int:
        """Number of pivots that are tested when D q̈ = τ - bias is solved for the accelerations.

        The tolerance of these tests, which detect a singular D, depends on it.
        """
        return len(self.accelerations.function.checks)

    def _fails(self, body: CBody) -> bool:
        """Return True if a body can fail."""
        return bool(body.failures or (self.name and body.sincos))

    def _statements(
        self, function: Function, body: CBody, places: Sequence[str], fails: bool = True
    ) -> tuple[Block, ...]:
        """Return loads, statements and results. Failures are returned if `fails`."""
        if list(places) == self.places and self.two_point:
            sets = self._stored("a", body.results, self.width)
        else:
            sets = tuple(c.assign(to, x) for to, x in zip(places, body.results, strict=True))
        failure_statements = c.record_failures(body.failures)
        if not fails:
            return (self._loads(function), *body.early, *body.blocks, Block("", sets))
        head = Block("", (c.declare(self.mask, f"failed = {self.clear}"),))
        end = Block("", (*sets, *failure_statements, c.return_statement("failed")))
        return (head, self._loads(function), *body.early, *body.blocks, end)

    def _stored(self, array: str, values: Sequence[str], width: int) -> tuple[str, ...]:
        """Return statements that store numbers; if `simd_angles`, in groups of four with zeros."""
        if not self.simd_angles:
            return tuple(c.assign(f"{array}[{k}]", x) for k, x in enumerate(values))
        padded = [*values, *[self.target.zero] * (width - len(values))]
        return tuple(
            c.call_statement(f"{self.prefix}_put({array} + {k}, {', '.join(padded[k : k + FOUR])})")
            for k in range(0, width, FOUR)
        )

    # functions

    @cached_property
    def out(self) -> CArgument:
        """The declaration of the C argument "a", the array into which accelerations are stored."""
        return c.output_array(self.real.name, "a")

    @cached_property
    def places(self) -> list[str]:
        """C expressions of the elements of the array a of accelerations, one per coordinate."""
        return [self.target.element("a", n) for n in self.target.names]

    @cached_property
    def rates(self) -> GeneratedFunction:
        """The C function for the accelerations from the state, its sines and the inputs."""
        doc = cost_sentence(self.accelerations.function)
        signature = Signature("rates", self.out, self.places)
        return self.generate_function(self.accelerations.angles_and_function[1], signature, doc)

    @cached_property
    def signal(self) -> GeneratedFunction | None:
        """The C function for the scene's signals: formulas for the inputs u by time and state.

        None if the scene has no signals.
        """
        if "signal" not in self.target.program:
            return None
        arguments = [*(["t"] if self.target.signal_t else [])]
        arguments += ["q", "qd"] if self.target.signal_state else []
        arguments += ["c"] if self.accelerations.constants else []
        parameters = {n: c.member("c", n) for n in self.accelerations.parameter_names}
        places = [f"u[{self.target.enum[n]}]" for n in self.target.input_names]
        out = c.output_array(self.real.name, "u")
        signature = Signature("signals", out, places, arguments, parameters)
        return self.generate_function(
            self.target.program["signal"], signature, "The scene's signals."
        )

    @property
    def parameters(self) -> str:
        """The C definition of the struct with the scene's parameters; "" if none is needed."""
        names = self.accelerations.parameter_names if self.target.needs_p else ()
        return c.define_struct(self._parameters, self.real.name, names) if names else ""

    @property
    def _parameters(self) -> str:
        """The C type of the struct with the scene's parameters in this lane."""
        return f"{self.prefix}_params{self.suffix}"

    @cached_property
    def linearization(self) -> GeneratedFunction:
        """The C function for the rows of [da/dq, da/dqd], then da/du, then a if steps need it."""
        n, m = len(self.target.names), len(self.target.input_names)
        rows = [range(k, k + 2 * n + m) for k in range(0, n * (2 * n + m), 2 * n + m)]
        columns = (slice(2 * n), slice(2 * n, None))
        order = [k for part in columns for row in rows for k in row[part]]
        function = self.target.program["linearization"]
        outputs = [function.outputs[k] for k in order] + [*function.outputs[len(order) :]]
        doc = "The rows of [da/dq, da/dqd], those of da/du at constant inputs, and a where needed."
        return self._derivatives("slopes", replace(function, outputs=tuple(outputs)), doc)

    @cached_property
    def sensitivity(self) -> GeneratedFunction:
        """The C function for the derivatives of the accelerations with respect to parameters."""
        function = self.target.program["sensitivity"]
        return self._derivatives("sensitivity", function, "The rows of da/dp.")

    def _derivatives(self, name: str, function: Function, doc: str) -> GeneratedFunction:
        """Return the C function for derivatives, which reads parameters in lanes of their own."""
        places = [f"r[{k}]" for k in range(len(function.outputs))]
        takes = [a for a in self.argument_names if a not in "sc"]
        parameters = frozenset(self.accelerations.parameter_names)
        p = c.input_array(self._parameters, "p")
        extra = [(p, parameters, c.member("p", "{}"))] if self.target.needs_p else ()
        out = c.output_array(self.real.name, "r")
        signature = Signature(name, out, places, takes, {}, extra)
        return self.generate_function(function, signature, doc, inline=False)

    @cached_property
    def compute_constants(self) -> GeneratedFunction:
        """The C function that precomputes expressions that depend on the parameters only.

        It fails if the parameters make the mass matrix D singular.
        """
        parameters, target = frozenset(self.accelerations.parameter_names), self.target
        p = c.input_array(f"{self.prefix}_params", "p")
        out = c.output_array(self.constants, "c") if self.accelerations.constants else None
        places = [c.member("c", n) for n in self.accelerations.constants]
        extra = [(p, parameters, c.member("p", "{}"))] if target.needs_p else ()
        signature = Signature("compute_constants", out, places, (), {}, extra)
        return self.generate_function(
            self.accelerations.precomputed_and_remaining[0],
            signature,
            "Constants of the parameters.",
        )

    @cached_property
    def constants_struct(self) -> str:
        """The C definition of the struct with the precomputed expressions of the parameters."""
        return c.define_struct(self.constants, self.real.name, self.accelerations.constants)

    @property
    def angles_at(self) -> CFunction:
        """The C function for the angles at q."""
        return self._angles_function("angles_at", "q", offset=True)

    @property
    def changes(self) -> CFunction:
        """The C function for the changes of the angles if q changes by d."""
        return self._angles_function("changes", "d", offset=False)

    def _angles_function(self, what: str, vector: str, offset: bool) -> CFunction:
        """Return the C function for the angles of the accelerations, or for changes of them.

        An angle is a linear combination of coordinates plus a constant; the accelerations read its
        sine and cosine. The C function stores all angles in an array, in rad.

        what: its C name, without prefix and suffix. vector: the name of its argument, a vector of
        coordinates or of their changes. offset: True for angles; False for changes of angles, to
        which the constants are not added.
        """
        angles = self.accelerations.angles
        values = [self.angle_text(a, vector, a.offset if offset else S.Zero) for a in angles]
        if self.two_point and self.contiguous_angles is not None:
            sums = c.copy_loop("x", vector, self.contiguous_angles, self.angle_count)
        else:
            sums = self._stored("x", values, padded_size(len(values)))
        return CFunction(
            f"{self.prefix}_{what}{self.suffix}", "void",
            (c.output_array(self.real.name, "x"), c.input_array(self.real.name, vector)),
            (Block("", sums),), frozenset({"x", vector}), self.inline,
        )  # fmt: skip

    def angle_text(self, angle: Angle, vector: str, offset: Expr) -> str:
        """Return an angle as a C expression: a linear combination of coordinates, plus `offset`.

        vector: the C name of a vector of coordinates. offset: a constant, in rad.
        """
        where = {n: self.target.element(vector, n) for _, n in angle.terms}
        return Printer(self.prefix, self.real, where).value(Sum(angle.terms, offset))[0]

    @cached_property
    def math_functions(self) -> tuple[str, ...]:
        """Sorted names of the mathematical functions in the scene's accelerations and signals.

        The projection onto the constraints and the linearization are included. Sine and cosine are
        not, except of parameters in derivatives.
        """
        derivatives = ("linearization", "sensitivity")
        others = map(self.target.program.functions.get, ("signal", "projection", *derivatives))
        functions = [self.accelerations.function, *filter(None, others)]
        assignments = [a for f in functions for a in (*f.early, *f.body)]
        names = {a.value.function for a in assignments if isinstance(a.value, Call)}
        names -= {"sin", "cos", "reciprocal"}
        early = [a for f in functions if f.name in derivatives for a in f.early]
        names |= {a.value.function for a in early if isinstance(a.value, Call)} - {"reciprocal"}
        return tuple(sorted({"sign" if n == "heaviside" else n for n in names}))

    @property
    def sincos(self) -> str:
        """The name of the C function for the sine and cosine of one angle."""
        return f"{self.prefix}_sincos{self.accelerations.target.real.function_suffix}"

    @property
    def angle_count(self) -> str:
        """Number of elements of C arrays of angles, as C text.

        This is the number of angles. It is rounded up to a multiple of four if the sines of four
        angles are computed at once. "" without angles.
        """
        n = len(self.accelerations.angles)
        return (
            ""
            if not n
            else str(
                padded_size(n) if self.accelerations.simd_angles and self.name != "wide" else n
            )
        )

    @cached_property
    def accelerations_function(self) -> CFunction:
        """Prototype of the C function for the accelerations at a state.

        If the inputs u are NULL, the function computes them from the scene's signals (formulas for
        inputs). If the sines s of the angles are NULL, it computes these too.
        """
        arguments = (self.out, *map(self.argument, self.argument_names))
        called = self.two_point or self.accelerations.is_long
        return CFunction(
            f"{self.prefix}_accelerations{self.suffix}", self.mask, arguments,
            qualifier=self.noinline if called else self.inline,
        )  # fmt: skip

    # two points

    @property
    def configuration_struct(self) -> str:
        """The C definition of the struct with the position-dependent part of the accelerations.

        It has values at two configurations q.
        """
        parts = self.accelerations.parts
        assert parts is not None
        names = f"{self.prefix}_configuration", f"{self.prefix}_two"
        return c.define_struct(*names, parts.handed)

    @property
    def both_configurations(self) -> CFunction:
        """The C function for the position-dependent part at the configurations q1 and q2.

        s1 and s2 are the sines at these.
        """
        sines, real = f"{self.prefix}_sines", self.real.name
        arguments = (
            c.output_array(f"{self.prefix}_configuration", "k"),
            *(c.input_array(real, n) for n in ("q1", "q2")),
            *(c.input_array(sines, n) for n in ("s1", "s2")),
            *([self.argument("c")] if self.accelerations.constants else []),
        )
        name = f"{self.prefix}_both_configurations"
        return CFunction(name, "int", arguments, qualifier=self.inline)

    @cached_property
    def configuration(self) -> GeneratedFunction:
        """The C function for the position-dependent part of the accelerations.

        It computes this part for two configurations q at once.
        """
        parts = self.accelerations.parts
        assert parts is not None
        out = c.output_array(f"{self.prefix}_configuration", "k")
        takes = [n for n in self.argument_names if n in ("q", "s", "c")]
        places = [c.member("k", n) for n in parts.handed]
        signature = Signature("configurations", out, places, takes)
        return self.generate_function(
            parts.configuration, signature, in_order=True, inline=parts.short
        )

    @cached_property
    def velocity(self) -> GeneratedFunction:
        """The C function for the velocity-dependent part, which returns the accelerations.

        It reads the position-dependent part, which `configuration` computes for two configurations
        q, at one of these two.
        """
        parts = self.accelerations.parts
        assert parts is not None
        shared, form = frozenset(parts.handed), f"{c.member('k', '{}')}[point]"
        argument = c.input_array(f"{self.prefix}_configuration", "k")
        extra = [(argument, shared, form), (CArgument("int", "point"), shared, form)]
        signature = Signature("velocities", self.out, self.places, extra=extra)
        doc = "The accelerations at point 0 or 1 of k."
        return self.generate_function(
            parts.velocity, signature, doc, in_order=True, inline=parts.short
        )

    # projection onto the constraints

    @cached_property
    def project_end(self) -> CFunction:
        """Prototype of the C function that makes the end of a step satisfy the constraints.

        The C function changes r and v, the increments of q and q̇ in the step, in place.
        """
        out = tuple(c.output_array(self.real.name, n) for n in "rv")
        singular_flag = () if self.name else (CArgument("int *", "singular"),)
        return CFunction(
            f"{self.prefix}_projected{self.suffix}",
            self.mask if self.name else f"{self.prefix}_status",
            (*out, *map(self.argument, self._constraint_arguments()), *singular_flag),
            qualifier=self.noinline,
        )

    @cached_property
    def project_stage(self) -> CFunction:
        """Prototype of the C function that projects one stage onto the constraints.

        A stage is an intermediate state (q, q̇) within a step. The function corrects the state once,
        so that the constraint residuals vanish to first order.
        """
        state = tuple(c.output_array(self.real.name, n) for n in ("at", "moving"))
        others = (n for n in self._constraint_arguments(sines=False) if n in "tc")
        return CFunction(
            f"{self.prefix}_onto", "int", (*state, *map(self.argument, others)),
            qualifier=self.noinline,
        )  # fmt: skip

    @cached_property
    def correction(self) -> GeneratedFunction:
        """The C function for the corrections of q and q̇ that satisfy the constraints."""
        function = self.accelerations.correction[0]
        places = [f"d[{k}]" for k in range(len(function.outputs))]
        out, takes = c.output_array(self.real.name, "d"), self._constraint_arguments()
        signature = Signature("projection", out, places, takes)
        return self.generate_function(
            function, signature, f"{CORRECTION} {cost_sentence(function)}"
        )

    @cached_property
    def rate_terms(self) -> GeneratedFunction | None:
        """The C function for the rates of constraint equations that corrections may drop.

        It also computes the sum of |terms| of each rate, as its scale. None if there are none.
        """
        function = self.target.program.functions.get("rate_terms")
        if function is None:
            return None
        parameters = {n: c.member("c", n) for n in self.accelerations.parameter_names}
        places = [f"rates[{k}]" for k in range(len(function.outputs))]
        takes = self._constraint_arguments(sines=False)
        out = c.output_array(self.real.name, "rates")
        signature = Signature("rate_terms", out, places, takes, parameters)
        return self.generate_function(function, signature, RATE_TERMS, inline=False)

    def _constraint_arguments(self, sines: bool = True) -> tuple[str, ...]:
        """Return the arguments that the constraints depend on, among q, qd, s, t, c."""
        timed = TIME in self.target.program["projection"].uses
        known = sines and self.accelerations.correction[1]
        names = ("q", "qd", *(["s"] if known else []), *(["t"] if timed else []), "c")
        return tuple(n for n in self.argument_names if n in names)

    def projection_source(self, functions: SceneFunctions) -> tuple[str, ...]:
        """Return C definitions of the projection of the end of a step and of its stages.

        functions: the scene's C functions that do not depend on the lane.
        """
        takes, sines = self._constraint_arguments(), self.accelerations.correction[1]
        members = (self.argument("c"),) if "c" in takes else ()
        names = library_names(
            SolverModel(functions, members, (), self.c_width),
            EOM_CORRECTION_SIZE=str(solver.correction_size(self.target)),
            eom_model=self.constants,
            eom_sines=f"{self.prefix}_sines",
        )
        rate_terms = self.rate_terms
        roots = ["eom_project_end", *(["eom_project_stage"] if functions.iterates_stages else [])]
        features = solver.step_features(functions, increments=True, sines=sines)
        t = "t" if "t" in takes else "0"
        end = [*("r", "v", "q", "qd"), *(["s"] if sines else []), t, *("c" if "c" in takes else ())]
        stage = ["at", "moving", t, *("c" if "c" in takes else ())]
        wrappers = [_forward(self.project_end, f"{self.prefix}_project_end", *end, "singular")]
        if functions.iterates_stages:
            wrappers.append(_forward(self.project_stage, f"{self.prefix}_project_stage", *stage))
        return (
            self.correction.text,
            *([rate_terms.text] if rate_terms else []),
            *map(names.apply, self._correction_functions(sines)),
            *amalgamate(("step_projection.c",), roots, names, features),
            *wrappers,
        )

    def _correction_functions(self, sines: bool) -> Iterator[str]:
        """Yield the definitions of the functions that the library's projection calls.

        They have the library's names. sines: whether the correction takes sines and cosines.
        """
        s = (c.input_array("eom_sines", "s"),) if sines else ()
        own = Block("", (c.declare("eom_sines", "own"),))
        compute = Block("", c.compute_if_null("s", "own", f"{self.prefix}_sines_at(&own, q)"))
        yield self._library_function(
            "evaluate_correction", self.correction.function, "d", s, (own, compute) if sines else ()
        )
        if self.rate_terms:
            yield self._library_function("evaluate_rate_terms", self.rate_terms.function, "rates")

    def _library_function(
        self,
        name: str,
        inner: CFunction,
        out: str,
        more: tuple[CArgument, ...] = (),
        blocks: tuple[Block, ...] = (),
    ) -> str:
        """Return a function with the library's arguments that calls a function of this lane.

        name: its name after `eom_`. inner: the function of this lane. out: the argument for the
        result. more: arguments before the time. blocks: statements before the call.
        """
        q, qd, t = state_arguments("real")
        call = inner.call(c="m")
        last = c.call_statement(call) if inner.result == "void" else c.return_statement(call)
        reads = {a.name for a in inner.arguments} - {"c"}
        if any(a.name == "c" for a in inner.arguments) or "c" not in self._constraint_arguments():
            reads.add("m")
        return CFunction(
            f"eom_{name}",
            inner.result,
            (
                *(c.output_array("real", out), q, qd, *more, t),
                c.input_array("eom_model", "m"),
            ),
            (*blocks, Block("", (last,))),
            frozenset(reads),
            self.inline,
        ).definition
