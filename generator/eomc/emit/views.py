"""Views of the templates besides both forms of C: frozen dataclasses with values only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from eomc.base.texts import FreeText
from eomc.integrators.tableaux import Method
from eomc.program.ir import Cost


@dataclass(frozen=True)
class Main:
    """c/main.c.jinja: the scene's own run, adaptive where it has a tolerance.

    run, energy, outputs: calls; accelerations: outputs'; refuses: whether these have a status.
    """

    TEMPLATE: ClassVar[str] = "c/main.c"
    title: FreeText
    stamp: tuple[FreeText, ...]
    prefix: str
    PREFIX: str
    real: str
    has_p: bool
    method: str
    adaptive: bool
    rows: int
    t_end: str
    tolerance: str
    events: bool
    h: str
    steps: int
    every: int
    columns: tuple[str, ...]
    run: str
    energy: str
    outputs: str
    accelerations: str
    refuses: bool


@dataclass(frozen=True)
class State:
    """A state of selftest.c as literals.

    arrays: q, qd and what else functions read. span: the length of a step or a run. u: empty where
    the signals act. other: whether the second set of parameters is taken.
    """

    arrays: tuple[tuple[str, ...], ...]
    t: str
    span: str
    u: tuple[str, ...]
    other: bool


@dataclass(frozen=True)
class Case:
    """The number of a state, what is expected there, the limit relative to its largest entry."""

    state: int
    expected: tuple[str, ...]
    limit: float


@dataclass(frozen=True)
class Tested:
    """A function of selftest.c that makes a call to one of the header, and its cases.

    kind: which of the forms of the template it has. memory: the type of what a run hands on.
    """

    name: str
    kind: str
    call: str
    memory: str
    cases: tuple[Case, ...]


@dataclass(frozen=True)
class SelfTest:
    """c/selftest.c.jinja. other: the second set of parameters. arrays: of a state, and extents.

    events, inputs: whether there are any. most: numbers of the largest result. large: whether there
    are states with large angles.
    """

    TEMPLATE: ClassVar[str] = "c/selftest.c"
    title: FreeText
    stamp: tuple[FreeText, ...]
    prefix: str
    PREFIX: str
    real: str
    states: tuple[State, ...]
    other: tuple[str, ...]
    has_p: bool
    arrays: tuple[tuple[str, str], ...]
    tested: tuple[Tested, ...]
    events: bool
    inputs: bool
    most: int
    large_limit: str
    large: bool


@dataclass(frozen=True)
class CMake:
    """c/CMakeLists.txt.jinja: a library of the C, for add_subdirectory and find_package."""

    TEMPLATE: ClassVar[str] = "c/CMakeLists.txt"
    stamp: tuple[FreeText, ...]
    prefix: str
    PREFIX: str
    version: str


@dataclass(frozen=True)
class PkgConfig:
    """c/package.pc.in.jinja, which CMake fills in and installs."""

    TEMPLATE: ClassVar[str] = "c/package.pc.in"
    stamp: tuple[FreeText, ...]
    prefix: str
    version: str


@dataclass(frozen=True)
class Counted:
    """A function of mechanics and its operations."""

    name: str
    cost: Cost


@dataclass(frozen=True)
class Stepped:
    """A step of a method, and a description of its calls."""

    name: str
    words: str


@dataclass(frozen=True)
class Costs:
    """c/costs.txt.jinja. width: of the column of names."""

    TEMPLATE: ClassVar[str] = "c/costs.txt"
    stamp: tuple[FreeText, ...]
    prefix: str
    width: int
    functions: tuple[Counted, ...]
    steps: tuple[Stepped, ...]


@dataclass(frozen=True)
class Bound:
    """An evaluation function in the binding: name and call for row k of many.

    solve: the call for the accelerations that it reads, if any. at: for functions of the state that
    return a number, the call at x. refuses: for functions that return a status, the number of
    elements of a row.
    """

    name: str
    call: str
    solve: str
    at: str
    refuses: str


@dataclass(frozen=True)
class BoundMethod:
    """A method in the binding, and the calls of its functions; derivative: if there is one.

    step_between, derivative_between: of a step behind others, as a control period has them.
    """

    name: str
    implicit: bool
    step: str
    run: str
    batch: str
    derivative: str
    step_between: str
    derivative_between: str


@dataclass(frozen=True)
class BoundAdaptive:
    """Adaptive steps in the binding: the type of their memory, calls, whether events are."""

    memory: str
    run: str
    events: bool
    batch: str


@dataclass(frozen=True)
class Binding:
    """python/binding.c.jinja. project, linearization: their calls, if there are."""

    TEMPLATE: ClassVar[str] = "python/binding.c"
    prefix: str
    PREFIX: str
    real: str
    evaluations: tuple[Bound, ...]
    acceleration: str
    project: str
    linearization: str
    batch: bool
    methods: tuple[BoundMethod, ...]
    adaptive: BoundAdaptive | None
    parameter_count: int
    input_count: int
    timed: bool  # whether steps depend on the time


@dataclass(frozen=True)
class Declarations:
    """python/binding.cdef.jinja: the declarations of the binding for cffi."""

    TEMPLATE: ClassVar[str] = "python/binding.cdef"
    real: str
    evaluations: tuple[Bound, ...]
    project: str
    linearization: str
    batch: bool
    methods: tuple[BoundMethod, ...]
    adaptive: BoundAdaptive | None


@dataclass(frozen=True)
class Named:
    """A coordinate, parameter or input by its author's name; the value of a parameter."""

    written: str
    words: FreeText
    number: str = ""


@dataclass(frozen=True)
class Face:
    """python/face.py.jinja. start: coordinates and velocities; functions: public, of the model.

    optional: further functions by the key of [run] that adds them.
    """

    TEMPLATE: ClassVar[str] = "python/face.py"
    title: FreeText
    stamp: tuple[FreeText, ...]
    prefix: str
    extension: str
    digest: str
    dtype: str
    coordinates: tuple[Named, ...]
    parameters: tuple[Named, ...]
    inputs: tuple[Named, ...]
    outputs: tuple[Named, ...]
    coordinate_units: FreeText
    parameter_values: Mapping[str, float]
    input_units: FreeText
    output_units: FreeText
    frames: tuple[str, ...]
    plane: bool
    units: FreeText
    start: tuple[list[float], list[float]]
    follows: FreeText
    h: float
    duration: float
    tolerance: float | None
    events: tuple[str, ...]
    constraints: tuple[str, ...]
    fixed: tuple[bool, ...]
    holonomic: int
    redundant: tuple[int, ...]
    modes: tuple[tuple[int, int], ...]
    discrete: int
    reactions: tuple[str, ...]
    batch: bool
    methods: tuple[Method, ...]
    functions: tuple[str, ...]
    optional: tuple[tuple[str, tuple[str, ...]], ...]
    from_python: bool


@dataclass(frozen=True)
class Stub:
    """python/stub.pyi.jinja: the package as type checkers see it."""

    TEMPLATE: ClassVar[str] = "python/stub.pyi"
    stamp: tuple[FreeText, ...]
    batch: bool
    functions: tuple[str, ...]


@dataclass(frozen=True)
class Form:
    """A variant of the extension in a wheel: name, file, and CPU features that it needs, as in
    Linux.
    """

    name: str
    extension: str
    needs: tuple[str, ...]


@dataclass(frozen=True)
class Compiled:
    """python/compiled.py.jinja: selection of one of several extensions."""

    TEMPLATE: ClassVar[str] = "python/compiled.py"
    prefix: str
    version: str
    forms: tuple[Form, ...]


@dataclass(frozen=True)
class Quad:
    """report/reference_solution.c.jinja: a motion in __float128. parameters: how many."""

    TEMPLATE: ClassVar[str] = "report/reference_solution.c"
    prefix: str
    PREFIX: str
    parameters: int
    call: str


View = (
    Main
    | SelfTest
    | CMake
    | PkgConfig
    | Costs
    | Binding
    | Declarations
    | Face
    | Stub
    | Compiled
    | Quad
)
