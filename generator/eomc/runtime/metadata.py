"""Metadata of a compiled scene: methods, tolerance, events."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

from .constrained import ConstraintRows
from .package import MODEL, option, reduced
from .statics import Statics

_MANY = 1000  # runs of fewer steps may take one call of C
CHUNK = 16_384  # steps times coordinates of the first call of C, some ms
SOME = 20  # runs of as many steps are checked against the stability limit, once per method and h


class ModelInfo(Statics):
    """A compiled scene with the data that runs need, such as step size, methods and events.

    Attributes
    ----------
    h, duration : float
        Step size and duration of the scene, s.
    tolerance : float or None
        Tolerance of adaptive steps; None if the module was built without them.
    methods : tuple of str
        Names of the methods for fixed steps; the first is the default.
    events : tuple of str
        Names of the events.
    source : path, System or None
        What `eomc.load` built the module from; pictures need it.
    """

    source: Any = None  # path or System that eomc.load built it from; pictures need it

    def __init__(
        self, extension: Any, *, h: float, duration: float,
        methods: Mapping[str, tuple[int, int, float, float]], tolerance: float | None = None,
        events: tuple[str, ...] = (), constrained: tuple[Any, ...] = (), **scene: Any,
    ) -> None:  # fmt: skip
        """Create the model from a compiled extension module (cffi).

        methods: (order, number of stages, stability limit h omega of undamped modes, stability
        limit h lambda of decaying modes) by the name of the method. constrained: the fields of
        `ConstraintRows`. scene: arguments of the base class. Others are as in the class docstring.
        """
        super().__init__(extension, **scene)
        self.h, self.duration, self.tolerance = h, duration, tolerance
        self.events = events
        self._rows = ConstraintRows(*constrained)
        self.methods = tuple(methods)
        self._method_data = dict(methods)
        self._loops = {name: self._loop(name, stages) for name, (_, stages, *_) in methods.items()}
        self._warned: set[Any] = set()  # (method, step size) and "u", of warnings already issued
        self._room = 0  # capacity for rows of an adaptive run
        self._passes_over = False  # True: fixed steps ignore events, as `check` needs

    @property
    def orders(self) -> dict[str, int]:
        """Order of convergence of each integration method, as a dict by the method's name."""
        return {name: order for name, (order, *_) in self._method_data.items()}

    @property
    def stability_limits(self) -> dict[str, tuple[float, float]]:
        """Stability limits of each integration method, as a dict by the method's name.

        A value is (largest h omega, largest h lambda) for the step size h. omega is the frequency
        of an undamped mode, rad/s; lambda is the rate of decay of a mode, 1/s.
        """
        return {name: (turn, decay) for name, (_, _, turn, decay) in self._method_data.items()}

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced(MODEL)

    def _itself(self) -> Self:
        return self

    def _loop(self, name: str, stages: int) -> tuple[Any, Any, int, int, Any, Any]:
        """Return a method's step and loop in C, steps per call, stages, workspace type, counter."""
        step, run = (getattr(self._lib, f"{name}_{what}") for what in ("step", "run"))
        work = self._ffi.typeof(f"{name}_work *")
        counted = getattr(self._lib, f"{name}_evaluations", None)
        short = (
            -1 if counted or self._rows.names or self.events else min(_MANY - 1, CHUNK // self.nq)
        )
        return step, run, short, stages, work, counted

    def _called(self, method: str, steps: Any, calls: Any) -> Any:
        """Return the number of evaluations: of steps with events, and of further step calls."""
        return 2 * steps + self._method_data[method][1] * calls

    def _method(self, method: str | None) -> str:
        """Return the name of a method of the module; None: the first. Raises ValueError."""
        if method is None:
            return self.methods[0]
        if not isinstance(method, str) or method not in self.methods:
            raise ValueError(
                f"method: {method!r} is not in this module, which has {', '.join(self.methods)}: "
                f"build it with a list of several, {option('method', '[...]')}"
            )
        return method

    def _stepper(self, method: str | None, what: str) -> Any:
        """Return the C function of a method: its step, run or batch."""
        return getattr(self._lib, f"{self._method(method)}_{what}")
