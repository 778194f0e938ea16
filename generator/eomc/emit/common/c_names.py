"""Names of a program in C, which all parts of the code generation share.

Names of a scene become struct members, enumerators and local variables next to the definitions of
the C library, Python.h and users' headers. Names that may be macros get a trailing "_", which no
scene name has, and the header lists them. If all coordinates of a mechanism share a prefix, as
those of an imported robot often do, C leaves it out. Python keeps the author's names.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import takewhile

from sympy import Symbol

from eomc.base.names import MATHEMATICS, fault
from eomc.base.texts import FreeText, flat, line
from eomc.derive.frames import wrenches
from eomc.emit.common import c_expression, c_function
from eomc.emit.common.c_expression import CBody, CContext, Real
from eomc.model.symbols import (
    ALONG,
    Constraint,
    Coordinate,
    Event,
    Input,
    Output,
    Parameter,
    add_suffix,
)
from eomc.model.system import System
from eomc.program.ir import Call, Function, rename
from eomc.program.program import TIME, Program
from eomc.scene.formulas import fold_values, parse

# Names that templates use inside functions; a scene's name among them gets a trailing "_".
RESERVED_NAMES = frozenset(
    "q qd qdd t t0 u p c a h i j r s v D C g K P bias tau power energy now k n good status first "
    "steps every rows q_rows qd_rows u_stride a1 a2 a3 a4 h_2 h_6 hh_2 hh_4 hh_6 failed fixed at "
    "moving constants along column slopes outputs applied count failures point E poses velocities "
    "accelerations jacobians forces wrenches momentum events after phi rates lambda reactions "
    "d far total singular A bar qdd_bar".split()
)
# Macros and enumerators of the templates and csrc, without the scene's prefix. A coordinate or
# input with such a name is renamed in C.
OWN_MACROS = frozenset(
    "ACCUMULATED CONVERGED FAST_FMA FAST_FMAF FIXED_POINT FOUR_COUNT "
    "H INLINE INVALID ITERATION_CONTINUES ITERATION_CONVERGED ITERATION_FAILED LANES LAST_ATTEMPT "
    "LOCKED MAX_SWEEPS MAX_VOTES METHOD MIN_SWEEPS NC NE NEWTON_AT_MIDDLE NEWTON_AT_START "
    "NEWTON_FROM_ZERO NEWTON_STEPS NE_ROOM NF NOINLINE NOT_CONVERGED NOT_FINITE "
    "NO_CONVERGENCE NQ NU NY OK PREDICTION_COUNT ROLLED SINGULAR "
    "SLOW_SWEEPS STAMP STIFF_VOTES TILE TILE_BLOCKS TOO_LONG TWO_COUNT UNDEFINED "
    "UNROLL WIDE_BYTES WIDE_COUNT".split()
)
Access = Callable[[str, str], str]  # (array, name of the coordinate or input) -> its element in C


@dataclass(frozen=True)
class Item:
    """A coordinate, input, output, parameter, constraint or event of the scene, for templates.

    Attributes
    ----------
    name, scene_name
        Its name in C, and its name in the scene.
    enum
        Its C enumerator; "" for parameters, which are members of a struct.
    unit
        Its unit.
    words
        Its unit and note.
    explanation
        The same; before it, the name in the scene if the name in C is a part of that name.
    value
        Of a parameter: its value in the scene. Otherwise 0.
    """

    name: str
    scene_name: str
    enum: str
    unit: FreeText
    words: FreeText
    explanation: FreeText
    value: float = 0.0


EVENTS_PER_STEP = 32  # without events at the same time


@dataclass(frozen=True)
class Target:
    """A program together with the C type of its numbers, and the names that it has in C.

    The program is the list of functions derived from a scene. Scene names that C cannot use are
    renamed in it; `written` maps each new name to the name in the scene.
    """

    program: Program
    real: Real
    written: Mapping[str, str] = field(default_factory=dict)

    def scene_name(self, name: str) -> str:
        """Return the scene's name for a coordinate, parameter or input.

        `name` is its C name, which may have "_" appended.
        """
        return self.written.get(name, name)

    @property
    def system(self) -> System:
        """The mechanical system that the program computes."""
        return self.program.system

    @property
    def prefix(self) -> str:
        """The scene's name, with which all C names begin."""
        return self.system.name

    @property
    def PREFIX(self) -> str:
        """The scene's name in upper case, with which all macros and enumerators begin."""
        return self.prefix.upper()

    @property
    def digest(self) -> str:
        """The digest (SHA-256) of the scene, in hexadecimal digits."""
        return self.system.digest

    @cached_property
    def enum(self) -> dict[str, str]:
        """The C enumerator of each coordinate, input, output, event, constraint and frame.

        The keys are names of coordinates and inputs, and `OUT_`, `EVENT_`, `CONSTRAINT_` or
        `FRAME_` with the name of another item.
        """
        methods = (f"METHOD_{name.upper()}" for name in self.system.run.methods)
        reserved = {f"{self.PREFIX}_{w}" for w in (*OWN_MACROS, *methods)}
        indexed = [*(c.name for c in self.system.coordinates), *self.input_names]
        outputs = [f"OUT_{o.name}" for o in self.system.outputs]
        outputs += [f"EVENT_{e.name}" for e in self.system.events]
        outputs += [f"CONSTRAINT_{c.name}" for c in self.system.constraints]
        names = [*indexed, *outputs, *(f"FRAME_{f.name}" for f in self.system.output_frames)]
        preferred = [f"{self.PREFIX}_{name}" for name in names]
        return dict(zip(names, _unique(preferred, reserved), strict=True))

    @cached_property
    def coordinates(self) -> tuple[Item, ...]:
        """The coordinates, in the order of q."""
        return tuple(self._item(x) for x in self.system.coordinates)

    @cached_property
    def inputs(self) -> tuple[Item, ...]:
        """The inputs, in the order of u."""
        return tuple(self._item(x) for x in self.system.inputs)

    @cached_property
    def outputs(self) -> tuple[Item, ...]:
        """The outputs."""
        return tuple(self._item(x, "OUT_") for x in self.system.outputs)

    @cached_property
    def constraints(self) -> tuple[Item, ...]:
        """The constraint equations."""
        return tuple(self._item(x, "CONSTRAINT_") for x in self.system.constraints)

    @cached_property
    def events(self) -> tuple[Item, ...]:
        """The events; their explanations begin with direction and action."""
        items = [
            (self._item(x, "EVENT_"), f"{x.direction}, {x.action}") for x in self.system.events
        ]
        return tuple(
            replace(
                item, explanation=FreeText(", ".join(filter(None, (kind, item.explanation.text))))
            )
            for item, kind in items
        )

    @cached_property
    def parameters(self) -> tuple[Item, ...]:
        """The parameters, in the order of their C struct."""
        return tuple(self._item(x, value=x.value) for x in self.system.parameters)

    @cached_property
    def frames(self) -> tuple[str, ...]:
        """The C enumerators of the frames whose motion the scene requests."""
        return tuple(self.enum[f"FRAME_{f.name}"] for f in self.system.output_frames)

    @property
    def q0(self) -> tuple[float, ...]:
        """The initial coordinates."""
        return tuple(c.start for c in self.system.coordinates)

    @property
    def qd0(self) -> tuple[float, ...]:
        """The initial velocities."""
        return tuple(c.rate for c in self.system.coordinates)

    @cached_property
    def start_formulas(self) -> dict[str, str]:
        """The formulas of those initial values that depend on parameters.

        They are given by the name of a coordinate (`theta`) or velocity (`theta_dot`) in the scene.
        Parameters that state jumps change are replaced by their values.
        """
        s, written = self.system, self.scene_name
        set_by_jumps = {written(c.name): c.start for c in s.coordinates if c.name in s.discrete}
        return {
            f"{written(c.name)}{end}": fold_values(parse(text), set_by_jumps)
            for c in s.coordinates
            for end, text in (("", c.follows), ("_dot", c.rate_follows))
            if text
        }

    def _item(
        self,
        x: Coordinate | Input | Output | Constraint | Event | Parameter,
        kind: str = "",
        value: float = 0.0,
    ) -> Item:
        """Return an item of the scene. kind: what `enum` adds to the names of such items."""
        texts = [t for t in (line(x.unit), flat(x.note)) if t]
        scene_name = self.scene_name(x.name)
        full_name = [] if scene_name == x.name.rstrip("_") else [scene_name]
        return Item(
            x.name,
            scene_name,
            self.enum.get(kind + x.name, ""),
            FreeText(x.unit),
            FreeText(", ".join(texts)),
            FreeText(", ".join(full_name + texts)),
            value,
        )

    @property
    def input_names(self) -> list[str]:
        """The C names of the inputs, in the order of u."""
        return [i.name for i in self.system.inputs]

    @property
    def names(self) -> list[str]:
        """The C names of the coordinates, in the order of q."""
        return [c.name for c in self.system.coordinates]

    @cached_property
    def wrenches(self) -> list[Symbol]:
        """The symbols of the external forces (N) and moments (N m) that act at the scene's frames.

        They are in the order of the C array `wrenches`.
        """
        return wrenches(self.system)

    @property
    def multipliers(self) -> list[str]:
        """The names of the Lagrange multipliers, one for each constraint equation."""
        return [c.multiplier.name for c in self.system.constraints]

    @property
    def needs_p(self) -> bool:
        """Whether the scene has parameters, so that C functions take the argument p."""
        return bool(self.system.parameters)

    @cached_property
    def signal_uses(self) -> frozenset[str]:
        """The names that the scene's signals read: the functions that define its inputs."""
        signal = self.program.functions.get("signal")
        return signal.uses if signal else frozenset()

    @property
    def signal_state(self) -> bool:
        """Whether the scene's signals depend on q or qd."""
        return any(x.name in self.signal_uses for x in (*self.system.q, *self.system.qd))

    @property
    def signal_t(self) -> bool:
        """Whether the scene's signals depend on time."""
        return TIME in self.signal_uses

    @property
    def signal_parameters(self) -> bool:
        """Whether the scene's signals depend on parameters."""
        return any(p.name in self.signal_uses for p in self.system.parameters)

    @property
    def is_adaptive(self) -> bool:
        """Whether the source has adaptive steps: the scene has a tolerance."""
        return self.system.run.tolerance is not None

    @property
    def integrates(self) -> bool:
        """Whether the source has the function for runs with adaptive steps or events."""
        return self.is_adaptive or bool(self.system.events)

    @property
    def has_two_sided_jumps(self) -> bool:
        """Whether the state jumps at events of both directions."""
        return any(e.action == "jump" and e.direction == "both" for e in self.system.events)

    @property
    def max_events_per_step(self) -> int:
        """Number of events in one step at which the step is ended early."""
        return EVENTS_PER_STEP + sum(e.begins is not None for e in self.system.events)

    @cached_property
    def driven(self) -> bool:
        """Whether the motion depends on time, directly or through the scene's signals.

        Signals are the functions by which the scene defines its inputs.
        """
        functions = map(self.program.functions.get, ("acceleration", "projection"))
        return self.signal_t or any(f and TIME in f.uses for f in functions)

    @cached_property
    def sincos(self) -> bool:
        """Whether the generated C has its own function for sines and cosines.

        Otherwise the C code calls sin and cos of the C mathematics library, or needs neither.
        """
        return self.real.reach > 0 and any(
            isinstance(a.value, Call) and a.value.function in ("sin", "cos")
            for f in self.program.functions.values()
            for a in f.body
        )

    @property
    def zero(self) -> str:
        """The C literal of 0 in the scene's type of floating-point numbers, such as 0.0f."""
        return "0.0" + self.real.suffix

    def literal(self, value: float) -> str:
        """Return a C literal of the scene's type of floating-point numbers, such as 0.5f."""
        return self.real.literal(value)

    # bodies

    def where(self) -> dict[str, str]:
        """Return the C expression of each coordinate, velocity, input and parameter, by name.

        An example is `p->m_c` for the parameter m_c. Variables other than parameters are local
        variables in C; names that the C code reserves have "_" appended.
        """
        s = self.system
        expressions = {x.name: c_function.member("p", x.name) for x in s.parameters}
        locals_ = [x.name for x in (*s.q, *s.qd, *(s.qdd if s.reads_qdd else ()), *s.u)]
        return expressions | {n: local_name(n) for n in locals_}

    def body(
        self,
        function: Function,
        where: Mapping[str, str] | None = None,
        stored: Mapping[str, str] | None = None,
        pivots: int = 0,
        in_order: bool = False,
        together: bool = False,
    ) -> CBody:
        """Return the C statements of a function of the program.

        where: C expressions of variables, by name, in addition to those of `Target.where`. The
        other arguments are those of `c_expression.body`.
        """
        context = CContext(self.prefix, self.real, self.system.names)
        known = self.where() | dict(where or {})
        return c_expression.body(
            rename_reserved(function), context, known, stored, pivots, in_order, together
        )

    def loads(self, function: Function, state: Access, inputs: Access) -> list[str]:
        """Return definitions of C local variables for the array elements that a function reads.

        state, inputs: functions that map the name of an array and of a variable to the C expression
        of the element. `state` is for the arrays q, qd, qdd, along (a direction) and qdd_bar
        (weights of the accelerations); `inputs` is for u.
        """
        s, real, uses = self.system, self.real.name, function.uses
        NQ = f"{self.PREFIX}_NQ"
        read = [(c.q.name, state("q", c.name)) for c in s.coordinates]
        read += [(c.qd.name, state("qd", c.name)) for c in s.coordinates]
        if s.reads_qdd:
            read += [(c.qdd.name, state("qdd", c.name)) for c in s.coordinates]
        read += [(w.name, f"wrenches[{k}]") for k, w in enumerate(self.wrenches)]
        read += [(x, f"lambda[{k}]") for k, x in enumerate(self.multipliers)]
        read += [(name, inputs("u", name)) for name in self.input_names]
        read += [(add_suffix(c.q.name, ALONG), state("along", c.name)) for c in s.coordinates]
        along = [(c.qd.name, f"along[{NQ} + {self.enum[c.name]}]") for c in s.coordinates]
        along += [(name, f"along[2*{NQ} + {self.enum[name]}]") for name in self.input_names]
        first = f"2*{NQ} + {self.PREFIX}_NU" if s.inputs else f"2*{NQ}"
        along += [(p.name, f"along[{first} + {k}]") for k, p in enumerate(s.parameters)]
        along += [(c.qdd.name, state("qdd_bar", c.name)) for c in s.coordinates]
        read += [(add_suffix(name, ALONG), element) for name, element in along]
        return [
            c_function.define_constant(real, local_name(name), element)
            for name, element in read
            if name in uses
        ]

    def element(self, array: str, name: str) -> str:
        """Return the C expression of an array element, such as q[CARTPOLE_THETA].

        array: name of the C array. name: coordinate or input whose element it is.
        """
        return f"{array}[{self.enum[name]}]"

    def groups(self) -> dict[str, frozenset[str]]:
        """Return the names of the variables that each C argument supplies, by the argument's name.

        The arguments are q, qd, qdd, wrenches, lambda, t, u, p, along (a direction in q, qd, u and
        p) and qdd_bar (weights of the accelerations).
        """
        s = self.system
        return {
            "q": frozenset(x.name for x in s.q),
            "qd": frozenset(x.name for x in s.qd),
            "qdd": frozenset(x.name for x in s.qdd) if s.reads_qdd else frozenset(),
            "wrenches": frozenset(x.name for x in self.wrenches),
            "lambda": frozenset(self.multipliers),
            "t": frozenset({TIME}),
            "u": frozenset(self.input_names),
            "p": frozenset(p.name for p in s.parameters),
            "along": frozenset(
                add_suffix(x.name, ALONG) for x in (*s.q, *s.qd, *s.u, *s.parameters)
            ),
            "qdd_bar": frozenset(add_suffix(x.name, ALONG) for x in s.qdd),
        }


def rename_reserved(function: Function) -> Function:
    """Return the function with its values renamed where the C templates reserve their names.

    A renamed value has "_" appended to its name.
    """
    clash = {
        a.name: a.name + "_" for a in (*function.early, *function.body) if a.name in RESERVED_NAMES
    }
    return rename(function, clash) if clash else function


def local_name(name: str) -> str:
    """Return the C name of the local variable for a coordinate, velocity or input `name`."""
    return name + "_" if name in RESERVED_NAMES else name


def cost_sentence(function: Function) -> str:
    """Return a sentence for comments that states the operation counts of a call of a function."""
    cost = str(function.cost)
    return cost[0].upper() + cost[1:] + "."


def _unique(preferred: Iterable[str], reserved: set[str]) -> list[str]:
    """Return distinct C enumerators for the preferred ones, none of which is reserved.

    They are in upper case; names that would then coincide keep their case. Clashes get a trailing
    "_".
    """
    enumerators = []
    preferred = list(preferred)
    uppers = [w.upper() for w in preferred]
    for name, upper in zip(preferred, uppers, strict=True):
        enumerator = upper if uppers.count(upper) == 1 else name
        while enumerator in reserved or may_be_enumerator_of_others(enumerator):
            enumerator += "_"
        reserved.add(enumerator)
        enumerators.append(enumerator)
    return enumerators


# Most macros have three capitals and no small letter. The others of glibc and Python follow.
_UPPER_CASE = re.compile(r"[^a-z]*[A-Z][^a-z]*[A-Z][^a-z]*[A-Z][^a-z]*")
_OTHER_MACROS = re.compile(
    r"M_(\d_)?(E|PI|SQRT|LN|LOG)\w*|Py\w*|(PRI|SCN)[bdioux]\w*|L_(ctermid|cuserid|tmpnam)|P_tmpdir|"
    r"errno|math_errhandling|std(in|out|err)|st_[acm]time|sched_priority|static_assert|complex|"
    r"imaginary|I|noreturn|true|false|s[ai]_\w+|linux|unix|near|far|small|interface|"
    r"B(0|[1-9]\d{1,6})|(BS|FF|NL|VT)[01]|CR[0-3]|CS[5-8]"  # <termios.h>
)
# Prefixes of macros, with which an enumerator of a scene could coincide
_MACRO_FAMILIES = re.compile(
    "(?:ADJ|AIO|ALIGNOF|ATOMIC|BC|CHAR|CHARCLASS|CLOCKS?|CLONE|CLOSE|COLL|CPU|DBL|DELAYTIMER|ENABLE|"
    "EXIT|EXPR|FD|FE|FILENAME|FLT|FOPEN|FP|FV[CS]|HAVE|HUGE|IOV|ITIMER|LC|LDBL|MATH|MAX|MB|METH|MOD|"
    r"MQ|NGROUPS|NL|PIPE|PTHREAD|PY\w*|RAND|RE|RENAME|RTSIG|SCHED|SEEK|SEM|SIG|SIZEOF|STA|STATX|"
    r"STD(?:C|ERR|IN|OUT)|SYS|TIMER?|TMP|TTY|UTIME|WCHAR|WINT|WITH|XATTR|S?SIZE|SCHAR|SHRT|LL?ONG|INT\d*|INTMAX|INTPTR|"
    r"PTRDIFF|UCHAR|USHRT|UL?LONG|UINT\d*|UINTMAX|UINTPTR)_\w+|"
    r"(?:BIG|LITTLE|PDP)_ENDIAN|BYTE_ORDER|BOOL_(?:MAX|WIDTH)|(?:HOST_|LOGIN_)?NAME_MAX|LINE_MAX|"
    r"PATH_MAX|(?:NO)?WAIT_LOCK|WORD_BIT|WINDOW_HAS_FLAGS|MAJOR_IN_\w+|MVWDELCH_\w+|DOUBLE_IS_\w+|"
    r"[FRWX]_OK|F_T?LOCK|F_TEST|F_ULOCK|L_(?:SET|INCR|XTND)|S_I[A-Z]{3,}|S_BLKSIZE|"
    r"M_(?:\d_)?(?:E|PI|SQRT|LN|LOG)\w*"
)
_MATH_FUNCTIONS = frozenset(name + suffix for name in MATHEMATICS for suffix in ("f", "l", "q"))


def may_be_macro(name: str) -> bool:
    """Return True if a header of the C library or of Python may define a macro with this name."""
    return bool(_UPPER_CASE.fullmatch(name) or _OTHER_MACROS.fullmatch(name))


def may_be_enumerator_of_others(name: str) -> bool:
    """Return True if an enumerator of a scene may coincide with a macro of a header.

    The headers are those of the C library and of Python. name: the enumerator, which begins with
    the scene's name.
    """
    return not name.endswith("_") and bool(_MACRO_FAMILIES.fullmatch(name))


def name_in_c(name: str, prefix: str) -> str:
    """Return the C name for the name of a coordinate, parameter or input of the scene.

    It is the same name, with "_" appended if C cannot use it. prefix: the scene's name, with which
    other C names begin.
    """
    ours = name.lower().startswith(prefix.lower() + "_")
    return name + "_" if ours or may_be_macro(name) or name in _MATH_FUNCTIONS else name


def rename_for_c(program: Program) -> tuple[Program, Mapping[str, str]]:
    """Return the program with names that C can use, and a mapping of the changed names.

    The mapping leads from each new name of a coordinate, parameter or input to its name in the
    scene.
    """
    system = program.system
    declared = [c.name for c in system.coordinates]
    declared += [p.name for p in system.parameters] + [i.name for i in system.inputs]
    short = _short_names(program)
    c_names = {name: short.get(name) or name_in_c(name, system.name) for name in declared}
    renamed_to = {name: c_name for name, c_name in c_names.items() if c_name != name}
    new = dict(_derived(renamed_to))
    for function in program.functions.values():
        for a in (*function.early, *function.body):
            if (c_name := short.get(a.name) or name_in_c(a.name, system.name)) != a.name:
                new.setdefault(a.name, c_name)
    if not new:
        return program, {}
    renamed = replace(
        system,
        coordinates=tuple(replace(c, name=c_names[c.name]) for c in system.coordinates),
        parameters=tuple(replace(p, name=c_names[p.name]) for p in system.parameters),
        inputs=tuple(replace(i, name=c_names[i.name]) for i in system.inputs),
        renamed=(*system.renamed, *(x for x in renamed_to.items() if x[0] not in short)),
    )
    functions = {name: rename(f, new) for name, f in program.functions.items()}
    written = {c_name: name for name, c_name in renamed_to.items()}
    return replace(program, system=renamed, functions=functions), written


def _derived(renamed_to: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Yield the pairs of names, also for velocities, accelerations and directions."""
    for name, c_name in renamed_to.items():
        yield name, c_name
        yield name + ALONG, add_suffix(c_name, ALONG)
        for ending in ("_dot", "_ddot"):
            yield name + ending, add_suffix(c_name, ending)
            yield name + ending + ALONG, add_suffix(c_name, ending + ALONG)


def _short_names(program: Program) -> dict[str, str]:
    """Return C names without the prefix that all coordinates of a mechanism share, by full name.

    A mechanism is a system with bodies. The names are those of coordinates, parameters, inputs and
    of values such as `cos_panda_joint1`, where the prefix stands before the name of a coordinate.
    The result is empty if there is no such prefix or if a name without it could not stay as it is.
    """
    system = program.system
    own = [c.name for c in system.coordinates if c.name not in system.discrete]
    prefix = _shared_prefix(own)
    if not system.tree or not prefix:
        return {}
    declared = [*own, *(p.name for p in system.parameters), *(i.name for i in system.inputs)]
    declared = [name for name in declared if name.startswith(prefix)]
    functions = program.functions.values()
    values = {a.name for f in functions for a in (*f.early, *f.body)}
    others = {e.name for e in (*system.outputs, *system.events, *system.constraints)}
    others |= {f.name for f in system.output_frames} | values | set(system.names)
    short = {name: name.removeprefix(prefix) for name in declared}
    if any(_is_taken(new, system, others) for new in short.values()):
        return {}
    ends = "|".join(sorted(short.values(), key=len, reverse=True))
    part = re.compile(rf"(?<![A-Za-z0-9]){prefix}(?=(?:{ends})(?![A-Za-z0-9]))")
    for name in values - set(system.names):
        new = part.sub("", name)
        if new != name and new not in others and name_in_c(new, system.name) == new:
            others.add(new)
            short[name] = new
    return short


def _shared_prefix(names: Sequence[str]) -> str:
    """Return the first words that two or more names share, each followed by "_"; "" if none."""
    if len(names) < 2:
        return ""
    columns = zip(*(name.split("_")[:-1] for name in names), strict=False)
    shared = takewhile(lambda words: len(set(words)) == 1, columns)
    return "".join(f"{words[0]}_" for words in shared)


def _is_taken(new: str, system: System, others: set[str]) -> bool:
    """Return True if `new` cannot be a C name: not valid, a likely macro, or in use otherwise."""
    derived = {new, *(new + ending for ending in ("_dot", "_ddot"))}
    return fault(new) is not None or name_in_c(new, system.name) != new or bool(derived & others)
