"""Facts about a compiled scene (names, dimensions, initial values), and its C functions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .package import Defaults, option

Array = NDArray[Any]


class ConstraintInfo(NamedTuple):
    """Facts about the constraint equations and the discrete coordinates of a scene.

    A discrete coordinate is one that only state jumps change.

    Attributes
    ----------
    names : tuple of str
        Names of the constraint equations.
    loops : tuple of str
        Names of the loops (joints that close a kinematic chain) that have reactions.
    fixed : tuple of bool
        For each coordinate, then for each velocity: True if its initial value stays unchanged when
        an initial state is assembled, that is, moved onto the constraints.
    holonomic : int
        Number of holonomic constraint equations, which come first.
    redundant : tuple of int
        Indices of the constraint equations that follow from the others. Their multipliers are 0.
    modes : tuple of (int, int)
        For each Coulomb friction with sticking: the index of the coordinate that contains its mode
        (sticking, or the sliding direction), and that of the coordinate that slides. The modes are
        the last coordinates.
    discrete : int
        Number of parameters that state jumps set. They are coordinates, before the modes.
    """

    names: tuple[str, ...] = ()
    loops: tuple[str, ...] = ()
    fixed: tuple[bool, ...] = ()
    holonomic: int = 0
    redundant: tuple[int, ...] = ()
    modes: tuple[tuple[int, int], ...] = ()
    discrete: int = 0


class MethodInfo(NamedTuple):
    """Facts about an integration method of fixed steps.

    Attributes
    ----------
    order : int
        Order of convergence.
    stages : int
        Number of evaluations of the accelerations in a step of an explicit method.
    oscillation_limit : float
        Largest stable h omega for an undamped mode of the angular frequency omega, rad/s.
    decay_limit : float
        Largest stable h lambda for a mode that decays with the rate lambda, 1/s.
    """

    order: int
    stages: int
    oscillation_limit: float
    decay_limit: float

    @property
    def is_implicit(self) -> bool:
        """True for a Gauss method, whose order is larger than the number of stages."""
        return self.order > self.stages


@dataclass(frozen=True, eq=False, kw_only=True)
class SceneInfo:
    """Facts about a compiled scene.

    Attributes
    ----------
    name, title : str
        Name and title of the scene.
    digest : str
        Hash of the content of the scene.
    dtype : numpy.dtype
        Number type of the module, float64 or float32.
    coordinates, inputs, parameters, outputs : tuple of str
        Names, in the order of the arrays.
    defaults : Mapping
        Value of each parameter in the scene, by name.
    units : dict of str
        Unit of each quantity, by the name of the quantity.
    initial_state : pair of (nq,) arrays
        Positions and velocities at the start of the scene; read-only.
    p0 : (np,) array
        Values of the parameters in the scene; read-only.
    start_formulas : mapping of str
        Formulas of those initial values that depend on parameters, by the name of the coordinate
        or velocity.
    h, duration : float
        Step size and duration of the scene, s.
    methods : tuple of str
        Names of the methods of fixed steps; the first is the default.
    method_table : mapping of MethodInfo
        Facts about these methods, by name.
    tolerance : float or None
        Tolerance of adaptive steps; None if the module was built without them.
    events, frames : tuple of str
        Names of the events, and of the bodies and points that have poses.
    plane : bool
        Whether the scene is plane: a twist has three components instead of six.
    constraints : ConstraintInfo
        Facts about the constraint equations.
    discrete_count : int
        Number of the coordinates that only state jumps change.
    nq, nu : int
        Numbers of coordinates and of inputs.
    """

    name: str
    title: str
    digest: str
    dtype: np.dtype[Any]
    coordinates: tuple[str, ...]
    inputs: tuple[str, ...]
    parameters: tuple[str, ...]
    outputs: tuple[str, ...]
    defaults: Mapping[str, float]
    units: Mapping[str, str]
    initial_state: tuple[Array, Array]
    p0: Array
    start_formulas: Mapping[str, str]
    h: float
    duration: float
    methods: tuple[str, ...]
    method_table: Mapping[str, MethodInfo]
    tolerance: float | None
    events: tuple[str, ...]
    frames: tuple[str, ...]
    plane: bool
    constraints: ConstraintInfo
    discrete_count: int
    nq: int
    nu: int

    @classmethod
    def create(cls, scene: Mapping[str, Any]) -> SceneInfo:
        """Create the facts from the arguments that the generated __init__.py gives to `Model`.

        scene: name, title, dtype (a str), coordinates, inputs and outputs (units by name),
        parameters (values by name), units, start (two lists), h, duration, methods (fields of
        `MethodInfo` by name), digest; if the scene has them, tolerance, events, frames, plane,
        follows (the `start_formulas`) and constrained (fields of `ConstraintInfo`).
        """
        dtype = np.dtype(scene["dtype"])

        def constant(values: Sequence[float]) -> Array:
            array = np.array(values, dtype)
            array.flags.writeable = False
            return array

        names = ("coordinates", "inputs", "parameters", "outputs", "methods", "events", "frames")
        values: dict[str, Any] = {name: tuple(scene.get(name, ())) for name in names}
        values |= {name: scene[name] for name in ("name", "title", "digest", "h", "duration")}
        q, qd = scene["start"]
        constraints = ConstraintInfo(*scene.get("constrained", ()))
        return cls(
            **values,
            dtype=dtype,
            defaults=Defaults(scene["parameters"]),
            units=dict(scene["units"]),
            initial_state=(constant(q), constant(qd)),
            p0=constant(tuple(scene["parameters"].values())),
            start_formulas=scene.get("follows", {}),
            method_table={name: MethodInfo(*x) for name, x in scene["methods"].items()},
            tolerance=scene.get("tolerance"),
            plane=scene.get("plane", False),
            constraints=constraints,
            discrete_count=len(constraints.modes) + constraints.discrete,
            nq=len(scene["coordinates"]),
            nu=len(scene["inputs"]),
        )

    @property
    def start(self) -> tuple[Array, Array]:
        """Copies of the scene's initial positions q and velocities qd, (nq,) each."""
        q, qd = self.initial_state
        return q.copy(), qd.copy()

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the coordinates, then of the velocities, such as "theta_dot"."""
        return (*self.coordinates, *(f"{name}_dot" for name in self.coordinates))

    @property
    def discrete_coordinates(self) -> tuple[str, ...]:
        """Names of the coordinates that only state jumps change.

        They are the last coordinates and have no velocities.
        """
        return self.coordinates[self.nq - self.discrete_count :]

    @property
    def frame_size(self) -> int:
        """Number of components of a twist or wrench: 6, in plane scenes 3."""
        return 3 if self.plane else 6

    def row_bytes(self, rows: int) -> int:
        """Return the size in bytes of the positions and velocities at `rows` rows of a run."""
        return rows * 2 * self.nq * self.dtype.itemsize

    def with_discrete(self, x: Any, half: int) -> Any:
        """Append the scene's values of discrete coordinates to positions or velocities.

        x: positions (half 0) or velocities (half 1) of the coordinates that move, (..., n). An
        array of any other shape, or None, is returned unchanged.
        """
        count = self.discrete_count
        if x is None or not count or np.shape(x)[-1:] != (self.nq - count,):
            return x
        shape = (*np.shape(x)[:-1], count)
        values = self.initial_state[half][-count:]
        return np.concatenate([x, np.broadcast_to(values, shape)], axis=-1)

    def method_name(self, method: str | None) -> str:
        """Return the name of a method of the module; None: the first. Raises ValueError."""
        if method is None:
            return self.methods[0]
        if not isinstance(method, str) or method not in self.method_table:
            raise ValueError(
                f"method: {method!r} is not in this module, which has {', '.join(self.methods)}: "
                f"build it with a list of several, {option('method', '[...]')}"
            )
        return method

    def count_evaluations(self, method: str, steps: Any, calls: Any) -> Any:
        """Return the number of evaluations of the accelerations in a run with events.

        method: name of the method. steps: number of steps. calls: number of further calls of the
        step function, which locate events.
        """
        return 2 * steps + self.method_table[method].stages * calls


class CLibrary:
    """The compiled functions of a scene, and what their calls need.

    Attributes
    ----------
    ffi, lib
        The interface of cffi, and the C functions as its attributes.
    null
        The null pointer.
    tools : tuple
        (address, real, null): address(real, array) is a pointer to the numbers of an array.
        Unpacking it once is faster than reading attributes.
    """

    def __init__(self, extension: Any, dtype: np.dtype[Any]) -> None:
        self.ffi, self.lib = extension.ffi, extension.lib
        real = self.ffi.typeof({"float64": "double[]", "float32": "float[]"}[dtype.name])
        self.null = self.ffi.NULL
        self.tools = (self.ffi.from_buffer, real, self.null)

    def pointer(self, array: NDArray[Any] | None) -> Any:
        """Return a pointer to the numbers of a C-contiguous array of the module's number type.

        Return the null pointer if `array` is None. The array has to exist as long as C uses it.
        """
        address, real, null = self.tools
        return null if array is None else address(real, array)


def next_chunk(count: int, elapsed: float, seconds: float = 0.05) -> int:
    """Return the number of items that are expected to take `seconds` to process.

    The estimate uses the time per item of the last chunk: `count` items in `elapsed` seconds. The
    result differs from `count` by at most a factor of 16.
    """
    max_growth = 16.0  # the first rows may be the cheap ones
    return int(count * min(max_growth, max(1 / max_growth, seconds / (elapsed + 1e-9)))) + 1


def slices(count: int, first: int) -> Iterator[tuple[int, int]]:
    """Yield consecutive slices (start, size) of `count` rows, each of which takes some 50 ms.

    The first slice has `first` rows. The size of each further slice follows from the time that the
    caller spent on the previous one.
    """
    start, size = 0, first
    while start < count:
        size = min(size, count - start)
        start_time = perf_counter()
        yield start, size
        start, size = start + size, next_chunk(size, perf_counter() - start_time)
