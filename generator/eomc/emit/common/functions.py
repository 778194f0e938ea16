"""C functions of mechanics for both forms: matrices, energies, forces, accelerations.

They take the state as arrays and the parameters as a struct. Each is straight-line code; long ones
are divided into several C functions.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from eomc.emit.common import c_function as c
from eomc.emit.common.c_expression import REALS, Block, CBody, Real, group_angles
from eomc.emit.common.c_function import CArgument, CFunction, GeneratedFunction
from eomc.emit.common.c_names import Target, cost_sentence, rename_reserved
from eomc.emit.common.public import (
    EXTRA_ARGUMENTS,
    KINDS,
    Public,
    c_array_size,
    doc,
    program_function,
)
from eomc.integrators.tableaux import METHODS, Method
from eomc.program import outline
from eomc.program.ir import Function
from eomc.program.program import Program

STATE = ("q", "qd")
ARGUMENT_NAMES = (*STATE, "qdd", "wrenches", "lambda", "qdd_bar", "t", "u", "p")
ROTATION_ERRORS = (
    "Rotation errors of loops: 2 tan(a/2) n, if the second frame of a loop is rotated by the angle "
    "a about n; then cos(a/2)^2 of each; then the derivatives of the errors by q, by rows."
)
CORRECTION = (
    "d = the corrections of q and qd that satisfy the linearised constraints, then the inverse "
    "pivots of the rows."
)
CORRECTION_DERIVATIVES = (
    "The corrections of q and qd that satisfy the linearised constraints, and their derivatives "
    "along a direction."
)
RATE_TERMS = "Rates of equations that may be redundant, then the sums of the sizes of their terms."
MAX_UNCOMMENTED_LINES = 16  # statements without comments between stages


@dataclass(frozen=True)
class Linearization:
    """The C functions for the derivatives of the accelerations by q, q̇ and u.

    Attributes
    ----------
    width
        Length of one row [da/dq, da/dqd, da/du], as a C expression.
    slopes
        The static function that computes all rows, followed by the accelerations for the stages
        of a step.
    size
        The number of its results, as a C expression with the enumerators NQ and WIDTH (`width`).
    function
        The public function, which splits the rows into A_q, A_qd and B.
    signal
        The function of the scene's signals for u if the derivatives depend on u; otherwise None.
    """

    width: str
    slopes: GeneratedFunction
    size: str
    function: CFunction
    signal: CFunction | None


@dataclass(frozen=True)
class SceneFunctions:
    """The C functions generated for a program: prototypes, arguments and bodies.

    The program is the list of functions (D, bias, acceleration, ...) derived from a scene. The
    portable and the optimised form of the C code both use these functions.
    """

    target: Target

    @property
    def prefix(self) -> str:
        """The scene's name, with which all C names begin."""
        return self.target.prefix

    @property
    def PREFIX(self) -> str:
        """The scene's name in upper case, with which all macros and enumerators begin."""
        return self.target.PREFIX

    @property
    def real(self) -> str:
        """The C type of floating-point numbers: "double" or "float"."""
        return self.target.real.name

    @property
    def is_portable(self) -> bool:
        """Whether these are functions of portable C, which take sines from the C library."""
        return self.target.real.reach == 0

    def groups_angles(self, function: Function) -> bool:
        """Return True if `function` computes sines of several angles at once in vector registers.

        D is excluded: selftest.c uses D to verify the sines that the steps compute.
        """
        return self.target.real.reach > 0 and function.name not in ("D", "D_column")

    @property
    def has_grouped_angles(self) -> bool:
        """Whether some function computes sines of several angles at once in vector registers."""
        functions = self.target.program.functions.values()
        return any(self.groups_angles(f) and group_angles(f) for f in functions)

    @property
    def NQ(self) -> str:
        """The C enumerator for the number of coordinates, such as CARTPOLE_NQ."""
        return f"{self.PREFIX}_NQ"

    @property
    def NU(self) -> str:
        """The C enumerator for the number of inputs, such as CARTPOLE_NU."""
        return f"{self.PREFIX}_NU"

    @property
    def status(self) -> str:
        """The C type of status codes, which functions that can fail return."""
        return f"{self.prefix}_status"

    @property
    def ok(self) -> str:
        """The status code for success, as a C enumerator."""
        return f"{self.PREFIX}_OK"

    @property
    def singular(self) -> str:
        """The status code, as a C enumerator, for a mass matrix D that is not positive definite."""
        return f"{self.PREFIX}_SINGULAR"

    @cached_property
    def public(self) -> Public:
        """The prototypes of the functions that the generated C header declares."""
        return Public(self.target)

    @property
    def methods(self) -> tuple[Method, ...]:
        """The integration methods with steps of fixed size."""
        return tuple(METHODS[name] for name in self.target.system.run.methods)

    @property
    def handshake(self) -> str:
        """A hexadecimal C constant that must be the same in the C source and in its header.

        The C compiler reports a header of another scene or form. Optimised C has another constant
        than portable C, since its workspaces differ in size.
        """
        form = "plain" if self.is_portable else "fast"
        digest = hashlib.sha256(f"{form} {self.target.system.digest}".encode()).hexdigest()
        return f"0x{digest[:8]}u"

    @cached_property
    def supplied_names(self) -> Mapping[str, frozenset[str]]:
        """For each C argument (q, qd, u, p, ...), the names of the variables in it."""
        return self.target.groups()

    @property
    def iterates_stages(self) -> bool:
        """Whether some integration method solves for its stages by fixed-point iteration."""
        run = self.target.system.run
        return run.tolerance is not None or any(m.sweeps for m in self.methods)

    @property
    def onto_argument(self) -> tuple[CArgument, ...]:
        """The C argument `onto` in a tuple; the tuple is empty without constraints.

        It is a flag: whether the stages of a Runge-Kutta step are projected onto the constraints.
        """
        return (CArgument("int", "onto"),) if self.projection else ()

    @property
    def state(self) -> tuple[str, ...]:
        """Names of the C arguments for the state: q, qd and, if the motion depends on time, t."""
        return (*STATE, "t") if self.target.driven else STATE

    def pointer_arguments(self, function: Function, *names: str) -> tuple[CArgument, ...]:
        """Return those C arguments among `names` that a function of the program reads.

        Arrays are declared as pointers, without their size.
        """
        needed = [n for n in names if function.uses & self.supplied_names[n]]
        arrays = (*STATE, *EXTRA_ARGUMENTS)
        return tuple(
            c.input_array(self.real, n) if n in arrays else self.public.argument(n) for n in needed
        )

    # the scene's signals

    @cached_property
    def signal(self) -> CFunction | None:
        """The prototype of the C function that computes the inputs u by the scene's signals.

        A signal is the function of time and state by which the scene defines an input. None if the
        scene has no inputs.
        """
        return self.public.evaluation("signal") if self.public.has("signal") else None

    def signal_blocks(self, function: Function) -> tuple[Block, ...]:
        """Return C statements that compute the inputs u if the caller passes NULL for u.

        They call the C function of the scene's signals, the functions of time and state that define
        the inputs. Empty if `function` does not read inputs.
        """
        if self.signal is None or not self.reads_u(function):
            return ()
        lines = c.signal_if_null("now", self.signal.call(u="now"))
        return (Block("", (c.declare(self.real, f"now[{self.NU}]"),)), Block("", lines))

    def reads_u(self, function: Function) -> bool:
        """Return True if a function of the program reads inputs (elements of u)."""
        return bool(self.supplied_names["u"] and function.uses & self.supplied_names["u"])

    def arguments_read(self, function: Function, follows: bool = True) -> frozenset[str]:
        """Return the names of the C arguments (q, qd, u, p, ...) that a function reads.

        If the caller of a C function passes no inputs, the scene's signals compute them. These are
        functions of time and state. With `follows`, their arguments are included in the result if
        the function reads inputs.
        """
        names = {n for n, brings in self.supplied_names.items() if function.uses & brings}
        if follows and self.reads_u(function) and self.signal is not None:
            names |= {a.name for a in self.signal.arguments}
        return frozenset(names)

    # bodies

    def loads(self, function: Function) -> Block:
        """Return definitions of C local variables for the array elements that a function reads.

        An example is `const double theta = q[CARTPOLE_THETA];`.
        """
        return Block(
            "", tuple(self.target.loads(function, self.target.element, self.target.element))
        )

    def straight_line_body(self, function: Function, out: str) -> tuple[tuple[Block, ...], CBody]:
        """Return the C statements of a function of the program, and its results as C expressions.

        out: name of the C array that the statements write the results to; "" to return the only
        result.
        """
        body = self.target.body(function, together=self.groups_angles(function))
        ends = tuple(c.assign(f"{out}[{k}]", x) for k, x in enumerate(body.results))
        last = Block("", ends if out else (c.return_statement(body.results[0]),))
        return (*self.statements(function, body), last), body

    def statements(self, function: Function, body: CBody) -> tuple[Block, ...]:
        """Return the C statements of a function: definitions of local variables, then assignments.

        body: the assignments in C. Many statements are divided by stage (time, position, velocity)
        into blocks with comments; few form one block.
        """
        blocks = (self.loads(function), *body.early, *body.blocks)
        lines = tuple(line for b in blocks for line in b.lines)
        return blocks if len(lines) > MAX_UNCOMMENTED_LINES else (Block("", lines),)

    def outline(
        self, function: Function, name: str, out: str, arguments: Sequence[str]
    ) -> tuple[str, tuple[CFunction, ...], tuple[Block, ...]]:
        """Divide a long function into several C functions (pieces) that are called in sequence.

        Returns the definition of a struct with the values that the pieces share ("" if there are
        none), the pieces, and the statements that call them.

        name: part of the C names. out: array for the results; each piece writes some of its
        elements. arguments: names of the C arguments that pieces may take.
        """
        function = rename_reserved(function)
        size = outline.PORTABLE_PIECE if self.is_portable else outline.PIECE
        parts = outline.split(function, size)
        shared = {n: c.member("s", n) for part in parts for n in part.keeps}
        type = f"{self.prefix}_{name}_values"
        pieces: list[CFunction] = []
        calls: list[str] = []
        for k, part in enumerate(parts, 1):
            f, P = part.function, f"{self.prefix}_{name}_{k}"
            body = self.target.body(
                f, {n: shared[n] for n in part.reads}, stored={n: shared[n] for n in part.keeps},
                pivots=len(function.checks), together=self.groups_angles(function),
            )  # fmt: skip
            failures = c.return_if(body.failures, self.singular)
            results = zip(part.outputs, body.results, strict=True)
            ends = (*(c.assign(f"{out}[{place}]", x) for place, x in results), *failures)
            ends += (c.return_statement(self.ok),) if failures else ()
            piece = CFunction(
                P,
                self.status if failures else "void",
                (
                    *([c.output_array(type, "s")] if part.reads or part.keeps else []),
                    *([c.output_array(self.real, out)] if part.outputs else []),
                    *self.pointer_arguments(f, *arguments),
                ),
                (self.loads(f), *body.early, *body.blocks, Block("", ends)),
                self.arguments_read(f, follows=False) | {"s", out},
                "static",
                (f"{name}, {k} of {len(parts)}: {outline.weight(f)} operations.",),
            )
            pieces.append(piece)
            call = piece.call(s="&s")
            calls += c.return_if([call], self.singular) if failures else [c.call_statement(call)]
        values = c.define_struct(type, self.real, list(shared)) if shared else ""
        locals_ = Block("", (c.declare(type, "s"),) if shared else ())
        return values, tuple(pieces), (locals_, Block("", tuple(calls)))

    # functions

    @cached_property
    def evaluations(self) -> tuple[GeneratedFunction, ...]:
        """The C functions that evaluate quantities such as D or energy, in header order."""
        return tuple(self.evaluation(n) for n in KINDS if self.public.has(n))

    def evaluation(self, name: str) -> GeneratedFunction:
        """Return the C function, with its body, that evaluates a quantity.

        `name` is the name of the quantity, such as D, bias or signal.
        """
        kind, target = KINDS[name], self.target
        function = program_function(target, name)
        assert function is not None
        cost = cost_sentence(function)
        by_columns = name not in target.program
        paragraphs = [doc(target, name)]
        if kind.takes_u and target.system.inputs:
            paragraphs.append("u: the inputs; NULL for the scene's signals.")
        if self.public.refuses(name):
            paragraphs.append(f"Where the status is not OK, {kind.out} is untouched.")
        if by_columns:
            cost = f"By {len(target.names)} columns, each: {cost[0].lower()}{cost[1:]}"
        reads = self.arguments_read(function) | {kind.out}
        public = replace(self.public.evaluation(name), reads=reads, doc=(*paragraphs, cost))
        if by_columns:
            return self._by_columns(public, function, name)
        if name == "energy" and (summed := self._sum_of_energies(public)):
            return summed
        if outline.is_large(function, self.is_portable):
            out = kind.out or ("power" if name == "power" else "energy")
            size, last = "1", Block("", (c.return_statement(f"{out}[0]"),))
            if self.public.refuses(name):
                out, size, last = "a", c_array_size(target, kind.shape), self._status_block(name)
            values, parts, calls = self.outline(function, name, out, ("along", *ARGUMENT_NAMES))
            if out != kind.out:
                declarations = Block("", (c.declare(self.real, f"{out}[{size}]"), *calls[0].lines))
                calls = (declarations, calls[1], last)
            body = (*self.signal_blocks(function), *calls)
            return GeneratedFunction(replace(public, body=body), parts, values)
        (*blocks, last), statements_ = self.straight_line_body(function, kind.out)
        if self.public.refuses(name):
            array = c.define_array(
                self.real, "a", c_array_size(target, kind.shape), statements_.results
            )
            blocks.append(Block("", (array, *c.return_if(statements_.failures, self.singular))))
            last = self._status_block(name)
        return GeneratedFunction(
            replace(public, body=(*self.signal_blocks(function), *blocks, last))
        )

    def _status_block(self, name: str) -> Block:
        """Return the end of a C function with a status: copy the results `a` to the output.

        Functions whose results may overflow return NOT_FINITE before they copy.
        """
        size = c_array_size(self.target, KINDS[name].shape)
        unfinite = [f"!{self.prefix}_finite(a, {size})"] if KINDS[name].refuses else []
        finite_check = c.return_if(unfinite, f"{self.PREFIX}_NOT_FINITE")
        return Block(
            "",
            (
                *finite_check,
                *c.copy_loop(KINDS[name].out, "a", 0, size),
                c.return_statement(self.ok),
            ),
        )

    def _sum_of_energies(self, energy: CFunction) -> GeneratedFunction | None:
        """Return the C function `energy` as the sum of calls for kinetic and potential energy.

        Returns None if the two need arguments that `energy` does not have.
        """
        parts = [self.evaluation(f"{what}_energy").function for what in ("kinetic", "potential")]
        read = frozenset(a.name for part in parts for a in part.arguments)
        if not read <= {a.name for a in energy.arguments}:
            return None
        body = (Block("", (c.return_statement(" + ".join(part.call() for part in parts)),)),)
        return GeneratedFunction(replace(energy, body=body, reads=read, doc=energy.doc[:1]))

    def _by_columns(self, public: CFunction, function: Function, name: str) -> GeneratedFunction:
        """Return a C function that computes a matrix by columns, in a loop.

        Each column is the product of the matrix and a unit vector, which a static function
        computes.
        """
        kind = KINDS[name]
        doc = f"{kind.out} times along. {cost_sentence(function)}"
        column = self.static(function, f"{name}_column", "column", doc)
        parts, call = (*column.parts, column.function), column.function.call()
        return GeneratedFunction(public, parts, column.values, call, kind.out, kind.symmetric)

    def static(
        self, function: Function, name: str, out: str, doc: str, fails: bool = False
    ) -> GeneratedFunction:
        """Return a static C function that computes a function of the program.

        name: name in C. out: name of the array that the results are written to. doc: comment above
        the C function. fails: whether it checks the pivots of a matrix factorization and returns a
        status code.
        """
        values, parts = "", tuple[CFunction, ...]()
        failures: tuple[str, ...] = ()
        if outline.is_large(function, self.is_portable):
            values, parts, blocks = self.outline(function, name, out, ("along", *ARGUMENT_NAMES))
        else:
            blocks, body = self.straight_line_body(function, out)
            failures = c.return_if(body.failures, self.singular)
        if fails:
            blocks += (Block("", (*failures, c.return_statement(self.ok))),)
        along = (c.input_array(self.real, "along"),) if out == "column" else ()
        function_ = CFunction(
            f"{self.prefix}_{name}",
            self.status if fails else "void",
            (
                c.output_array(self.real, out),
                *along,
                *self.pointer_arguments(function, *ARGUMENT_NAMES),
            ),
            blocks,
            self.arguments_read(function, follows=False) | {out},
            "static",
            (doc,),
        )
        return GeneratedFunction(function_, parts, values)

    @cached_property
    def projection(self) -> GeneratedFunction | None:
        """The static C function that computes the corrections of q and qd onto the constraints.

        None without constraints.
        """
        return self._static_if_needed("projection", "d", CORRECTION, fails=True)

    @cached_property
    def rotation_errors(self) -> GeneratedFunction | None:
        """The static C function that computes the rotation errors of closed kinematic loops.

        It also computes their derivatives. None if no loop constrains the directions of axes. See
        `Constraint.rotation_error` for the definition.
        """
        return self._static_if_needed("rotation_errors", "errors", ROTATION_ERRORS)

    @cached_property
    def rate_terms(self) -> GeneratedFunction | None:
        """The static C function that computes the rates (time derivatives) of constraint equations.

        These are the equations that the projection may drop near singular configurations. The
        function also computes, as a scale for each rate, the sum of |terms|. None if there are no
        such equations.
        """
        return self._static_if_needed("rate_terms", "rates", RATE_TERMS)

    @cached_property
    def projection_along(self) -> GeneratedFunction | None:
        """The static C function that computes corrections of q and qd and their derivatives.

        The corrections move q and qd onto the constraints. The derivatives are along a direction in
        q, qd, u and p. None if the scene has no constraints or does not request derivatives of
        steps.
        """
        doc = CORRECTION_DERIVATIVES
        return self._static_if_needed("projection_along", "column", doc, fails=True)

    def _static_if_needed(
        self, name: str, out: str, doc: str, fails: bool = False
    ) -> GeneratedFunction | None:
        """Return the C function of a function of the program, or None if there is none.

        The arguments are those of `static`. The comment states the cost of functions that fail.
        """
        function = self.target.program.functions.get(name)
        if function is None:
            return None
        doc = f"{doc} {cost_sentence(function)}" if fails else doc
        return self.static(function, name, out, doc, fails)

    @property
    def constraint_texts(self) -> tuple[str, ...]:
        """The C text of the static functions for constraints that both forms of C have."""
        functions = (self.rotation_errors, self.projection_along)
        return tuple(f.text for f in functions if f)

    @cached_property
    def acceleration(self) -> GeneratedFunction:
        """The C function that computes the accelerations qdd; it returns a status code."""
        function = self.target.program["acceleration"]
        force = "tau + A^T lambda" if self.target.system.constraints else "tau"
        doc = [
            f"qdd from D qdd + C qd + g = {force}. Where the status is not OK, qdd is untouched."
        ]
        if self.target.system.inputs:
            doc.append("u: the inputs; NULL for the scene's signals.")
        values, parts = "", tuple[CFunction, ...]()
        unfinite = c.return_if(
            [f"!{self.prefix}_finite(a, {self.NQ})"], f"{self.PREFIX}_NOT_FINITE"
        )
        if outline.is_large(function, self.is_portable):
            values, parts, blocks = self.outline(function, "acceleration", "a", ARGUMENT_NAMES)
            first = Block("", (c.declare(self.real, f"a[{self.NQ}]"), *blocks[0].lines))
            blocks = (first, *blocks[1:])
        else:
            body = self.target.body(function, together=self.groups_angles(function))
            array = c.define_array(self.real, "a", self.NQ, body.results)
            failures = c.return_if(body.failures, self.singular)
            *leading, last = self.statements(function, body)
            last = Block(last.comment, (*last.lines, array))
            blocks = (*leading, last, Block("", failures))
        last = Block("", (*blocks[-1].lines, *unfinite))
        reads = self.arguments_read(function) | {"qdd"}
        result = replace(
            self.public.acceleration,
            body=(*self.signal_blocks(function), *blocks[:-1], last),
            reads=reads,
            doc=(*doc, cost_sentence(function)),
        )
        return GeneratedFunction(result, parts, values)

    @cached_property
    def linearization(self) -> Linearization | None:
        """The C functions for the derivatives of the accelerations by q, q̇ and u.

        The derivatives are A_q = ∂q̈/∂q, A_qd = ∂q̈/∂q̇ and B = ∂q̈/∂u. None if the program does not
        contain them.
        """
        target = self.target
        function = program_function(target, "linearization")
        if function is None:
            return None
        NQ, inputs = self.NQ, bool(target.system.inputs)
        width = f"2*{NQ} + {self.NU}" if inputs else f"2*{NQ}"
        cost, doc = cost_sentence(function), "[da/dq, da/dqd, da/du] at constant inputs, by rows."
        if "linearization" in target.program:
            slopes = self.static(function, "slopes", "slopes", doc, fails=True)
        else:
            column = "[da/dq, da/dqd, da/du] times along."
            one = self.static(function, "slopes_column", "column", column, fails=True)
            along = ("column", "along")
            arguments_ = tuple(a for a in one.function.arguments if a.name not in along)
            loop_function = replace(
                one.function,
                name=f"{self.prefix}_slopes",
                result=self.status,
                body=(),
                doc=(doc,),
                arguments=(c.output_array(self.real, "slopes"), *arguments_),
            )  # fmt: skip
            slopes = GeneratedFunction(
                loop_function, (*one.parts, one.function), one.values, one.function.call()
            )
            cost = f"By {width} columns, each: {cost[0].lower()}{cost[1:]}"
        outputs = frozenset(
            a.name for a in self.public.linearization.arguments if a.name[0] in "AB"
        )
        reads = self.arguments_read(function) | outputs
        public = replace(self.public.linearization, doc=(cost,), reads=reads)
        size = "NQ*WIDTH + NQ" if target.system.linearizes_stages else "NQ*WIDTH"
        signal = self.signal if self.reads_u(function) else None
        return Linearization(width, slopes, size, public, signal)


def portable_functions(
    program: Program, real: Real | None = None, written: Mapping[str, str] | None = None
) -> SceneFunctions:
    """Return the C functions of a program in portable form, which uses sin and cos of libm.

    real: C type of the numbers; None for the type that the scene specifies. written: names in the
    scene of names that differ in C, see `Target`.
    """
    real = replace(real or REALS[program.system.run.real], reach=0.0)
    return SceneFunctions(Target(program, real, written or {}))
