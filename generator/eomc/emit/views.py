"""Data for the templates of main.c, selftest.c, the build files and the Python package."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from eomc.base.texts import FreeText
from eomc.integrators.tableaux import Method
from eomc.program.ir import Cost


@dataclass(frozen=True)
class Main:
    """Data for c/main.c.jinja: an example program that simulates the scene.

    The scene is the TOML file (or Python model) that the code is generated from. The program prints
    time, state, outputs and energy as CSV.

    Attributes
    ----------
    has_p
        Whether the C functions take parameters.
    method
        Integration method, as in the C name of the workspace type.
    adaptive
        Whether steps are adaptive; the scene then has a tolerance.
    rows, t_end, tolerance
        Number of printed lines, end time (s) and error tolerance, for adaptive steps.
    h, steps, every
        Step size (s), number of steps, and steps between printed lines, for steps of fixed size.
    events
        Whether the scene has events.
    columns
        Names of the CSV columns, in pieces that each fit on a line.
    run, energy, outputs, accelerations
        C calls: of the integrator, the energy, the outputs, and the accelerations that the outputs
        read. Empty if not needed.
    refuses
        Whether the C function of the outputs returns a status.
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
    """Arguments of one test call in selftest.c, as C literals.

    Attributes
    ----------
    arrays
        Values of q and qd, then of each array in `SelfTest.arrays`.
    t
        Time in s.
    span
        Size of a step or length of a run, in s.
    u
        Inputs; empty if the scene's signals supply them.
    other
        Whether the parameters are `SelfTest.other` rather than those of the scene.
    """

    arrays: tuple[tuple[str, ...], ...]
    t: str
    span: str
    u: tuple[str, ...]
    other: bool


@dataclass(frozen=True)
class Case:
    """Expected result of a C function for one state, with an error limit.

    Attributes
    ----------
    state
        Index into `SelfTest.states`.
    expected
        Expected numbers as C literals.
    limit
        Largest permitted error, relative to the largest expected number.
    """

    state: int
    expected: tuple[str, ...]
    limit: float


@dataclass(frozen=True)
class Tested:
    """A test function of selftest.c, which calls one function of the generated header.

    Attributes
    ----------
    name
        Name of the tested function without the scene's prefix.
    kind
        Form of the test's body in the template: "values", "number", "status", "moved", "run",
        "batch", "derivative" or "adaptive".
    call
        The C call that is tested.
    memory
        C type of the workspace of an adaptive run; "" for other kinds.
    cases
        Expected results for several states.
    """

    name: str
    kind: str
    call: str
    memory: str
    cases: tuple[Case, ...]


@dataclass(frozen=True)
class SelfTest:
    """Data for c/selftest.c.jinja: a C program that tests the generated functions.

    Attributes
    ----------
    states
        Arguments of the test calls.
    other
        Values of a second set of parameters; empty if no state uses it.
    has_p
        Whether the C functions take parameters.
    arrays
        Name and size of each array of a state besides q and qd.
    tested
        The test functions with their expected results.
    events, inputs
        Whether the scene has events and inputs.
    most
        Largest number of expected numbers in a case.
    large, large_limit
        Whether some states have large angles, and their limit in rad, for a comment.
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
    """Data for c/CMakeLists.txt.jinja, which builds the generated C as a library.

    Other projects use the library by add_subdirectory or find_package.
    """

    TEMPLATE: ClassVar[str] = "c/CMakeLists.txt"
    stamp: tuple[FreeText, ...]
    prefix: str
    PREFIX: str
    version: str


@dataclass(frozen=True)
class PkgConfig:
    """Data for c/package.pc.in.jinja: a pkg-config file of the generated C library.

    CMake completes and installs the file.
    """

    TEMPLATE: ClassVar[str] = "c/package.pc.in"
    stamp: tuple[FreeText, ...]
    prefix: str
    version: str


@dataclass(frozen=True)
class Counted:
    """The name of a generated C function, and the operation counts of one call."""

    name: str
    cost: Cost


@dataclass(frozen=True)
class Stepped:
    """The name of a C function that makes a step of an integration method.

    `words` states how often a step computes the accelerations.
    """

    name: str
    words: str


@dataclass(frozen=True)
class Costs:
    """Data for c/costs.txt.jinja: a table of operation counts of the C functions.

    `width` is the width of the column of names, in characters.
    """

    TEMPLATE: ClassVar[str] = "c/costs.txt"
    stamp: tuple[FreeText, ...]
    prefix: str
    width: int
    functions: tuple[Counted, ...]
    steps: tuple[Stepped, ...]


@dataclass(frozen=True)
class Bound:
    """An evaluation function, such as D or energy, in the Python binding, called for n states.

    Attributes
    ----------
    name
        Name of the function without the scene's prefix.
    call
        C call for the state with index k, with an assignment if the function returns a number.
    solve
        C call that first computes the accelerations which the function reads; "" if it reads none.
    at
        C call at x = [q; qd], for SciPy's LowLevelCallable; "" unless the function returns a double
        that depends on the state and parameters only.
    refuses
        Number of results for each state, as C text, if the function returns a status; otherwise "".
    """

    name: str
    call: str
    solve: str
    at: str
    refuses: str


@dataclass(frozen=True)
class BoundMethod:
    """C calls of one integration method in the Python binding.

    Attributes
    ----------
    step, run, batch
        Calls for one step, for a run, and for a run of many instances.
    derivative
        Call for the derivatives of a step from the state with index k; "" if these are not
        generated.
    step_between, derivative_between
        Calls for each further step and its derivatives, where the derivatives of several steps are
        multiplied; "" as for `derivative`.
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
    """Adaptive steps in the Python binding.

    Attributes
    ----------
    memory
        C type of the workspace.
    run, batch
        C calls for a run, and for runs of many instances.
    events
        Whether the scene has events.
    """

    memory: str
    run: str
    events: bool
    batch: str


@dataclass(frozen=True)
class Binding:
    """Data for the template python/binding.c.jinja: C functions that Python calls for many states.

    Attributes
    ----------
    evaluations
        The evaluation functions, such as D or energy.
    acceleration, project, linearization
        C calls for the accelerations, the projection onto the constraints and the linearization;
        "" for those that are not generated.
    batch
        Whether runs of many instances are generated.
    methods, adaptive
        Integration methods with steps of fixed size, and adaptive steps (None without a tolerance).
    parameter_count, input_count
        Number of parameters and inputs of the scene.
    timed
        Whether the C functions of steps take the time.
    """

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
    """Data for the template python/binding.cdef.jinja: declarations of the Python binding for cffi.

    The fields are those of `Binding` with the same names.
    """

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
    """A coordinate, parameter, input or output, as listed in the Python package.

    Attributes
    ----------
    written
        Its name in the scene, which may differ from the name in C.
    words
        Its unit and note.
    number
        Value of a parameter as Python text; otherwise "".
    """

    written: str
    words: FreeText
    number: str = ""


@dataclass(frozen=True)
class Face:
    """Data for the template python/face.py.jinja: the __init__.py of the generated Python package.

    Attributes
    ----------
    extension
        Name of the compiled extension module.
    digest
        Digest (SHA-256) of the scene.
    coordinate_units, input_units, output_units, units
        Units by name; `units` has all that are not empty, also of parameters.
    plane
        Whether frames, momentum or reactions are planar.
    start
        Initial values of the coordinates and of the velocities.
    follows
        Formulas of the initial values that depend on parameters, by name.
    h, duration, tolerance
        Default step size (s), duration (s) and error tolerance of a simulation.
    fixed
        Whether assembly keeps the initial value of each coordinate, then of each velocity.
    holonomic, redundant
        Number of holonomic constraint equations, and indices of the redundant ones.
    modes
        For each coordinate with stick-slip friction, the index of the discrete coordinate that
        stores whether it slides or sticks, and its own index.
    discrete
        Number of discrete coordinates that are parameters set by state jumps.
    functions
        Names of the model's public functions in the package.
    optional
        Option of [run] and the functions that it would add, for options that are off.
    from_python
        Whether the model was made in Python rather than from a scene.
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
    """Data for the template python/stub.pyi.jinja: type stubs of the generated Python package."""

    TEMPLATE: ClassVar[str] = "python/stub.pyi"
    stamp: tuple[FreeText, ...]
    batch: bool
    functions: tuple[str, ...]


@dataclass(frozen=True)
class Form:
    """A variant of the compiled extension in a wheel, for processors with certain features.

    Attributes
    ----------
    name
        Name of the variant.
    extension
        Name of the extension module.
    needs
        CPU features that the variant requires, as named by /proc/cpuinfo in Linux.
    """

    name: str
    extension: str
    needs: tuple[str, ...]


@dataclass(frozen=True)
class Compiled:
    """Data for the template python/compiled.py.jinja: a module that imports one of the variants.

    By default it imports the first of `forms` whose features the processor has.
    """

    TEMPLATE: ClassVar[str] = "python/compiled.py"
    prefix: str
    version: str
    forms: tuple[Form, ...]


@dataclass(frozen=True)
class Quad:
    """Data for the template report/reference_solution.c.jinja: a simulation in quadruple precision.

    parameters: number of parameters. call: C call of the accelerations.
    """

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
