"""A mechanical system in SymPy, as a user makes it.

From a checked scene (from_scene.py) or in Python (`System.make`), with symbols or with
`sympy.physics.mechanics.dynamicsymbols`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Never

from eomc.base.errors import SceneError
from eomc.model import api_arguments, from_sympy
from eomc.model.api_arguments import or_empty
from eomc.model.coulomb_friction import add_stick_slip
from eomc.model.discrete import add_discrete_coordinates
from eomc.model.event_function import check_event_functions
from eomc.model.mechanics import Mechanics
from eomc.model.saturation import saturate_inputs
from eomc.model.symbols import (
    Constraint,
    Coordinate,
    Event,
    Input,
    Output,
    Parameter,
    Reaction,
    dot,
    symbol,
    t,
)

__all__ = [
    "Constraint",
    "Coordinate",
    "Event",
    "Input",
    "Output",
    "Parameter",
    "Reaction",
    "System",
    "dot",
    "symbol",
    "t",
]


class System(Mechanics):
    """d/dt dL/dqd - dL/dq + dR/dqd = Q, from a scene or, by `make`, from expressions.

    Its fields are those of `Mechanics`.
    """

    def __repr__(self) -> str:
        return f"<System {self.name}: {self.size}>"

    @property
    def size(self) -> str:
        """The numbers of coordinates, inputs and parameters, as text."""
        counts = {
            "coordinate": self.coordinates, "input": self.inputs, "parameter": self.parameters,
        }  # fmt: skip
        return ", ".join(f"{len(x)} {what}{'s' * (len(x) != 1)}" for what, x in counts.items())

    @classmethod
    def make(
        cls,
        name: str,
        coordinates: Sequence[Any] | Mapping[Any, Any],
        kinetic: Any = None,
        potential: Any = 0,
        *,
        parameters: Mapping[Any, float] | None = None,
        dissipation: Any = 0,
        forces: Mapping[Any, Any] | None = None,
        inputs: Mapping[Any, Any] | Sequence[Any] = (),
        definitions: Mapping[Any, Any] | None = None,
        outputs: Mapping[str, Any] | None = None,
        constraints: Mapping[str, Any] | None = None,
        guess: Sequence[Any] = (),
        units: Mapping[Any, str] | None = None,
        title: str = "",
        h: float = 0.001,
        duration: float = 10.0,
        methods: Sequence[str] = ("rk4",),
        real: str = "double",
        batch: bool = False,
        linearize: bool | str = False,
        discretize: bool = False,
        inverse_dynamics: bool = False,
        limits: Mapping[Any, Sequence[Any]] | None = None,
        events: Mapping[str, Any] | None = None,
        tolerance: float | None = None,
        picture: Mapping[str, Any] | None = None,
        friction: Mapping[Any, Any] | None = None,
        **unknown: Never,
    ) -> System:
        r"""Make a system from SymPy expressions.

        coordinates: symbols, names or dynamicsymbols, or a mapping from these to initial values or
        pairs (value, velocity), as numbers or formulas of parameters. Names may replace symbols,
        and formulas as in scenes may replace expressions. With plain symbols the velocity of
        `theta` is the symbol `theta_dot`; with dynamicsymbols it is `theta.diff()`. parameters,
        inputs (to their default signal) and definitions are mappings from symbols, outputs from
        names; `theta_ddot`, or the second derivative of a dynamicsymbol, is an acceleration there.
        potential: P, or a generalized potential with terms linear in the velocities, such as
        e*B*(y*x_dot - x*y_dot)/2 of a charge in a magnetic field, which are no part of the energy.
        constraints: mapping from names to expressions that are zero, over coordinates and t, or
        linear in the velocities. Assembly changes coordinates without an initial value (None, or a
        plain list of coordinates) and those in `guess`. limits: mapping from inputs to saturation
        limits (lower, upper), None for no limit. events: mapping from names to event functions, or
        to dicts as in [[event]], {"when": y, "direction": "falling", "action": "jump", y_dot:
        -e*y_dot}. tolerance: of adaptive steps, 1e-9 by default if there are events. picture: a
        dict as in [picture] of a scene, with expressions or formulas: {"lines": [[[0, 0], [x,
        -l]]]}. Names that are invalid in C (`\theta`, `lambda`) are replaced, as listed in
        `renamed`. friction: mapping from coordinates to Coulomb friction (N or N m) with stick-slip
        transitions, as [run] friction = "stick". Raises EomcError for undeclared names.

        >>> from sympy.physics.mechanics import dynamicsymbols
        >>> theta, (m, l, g) = dynamicsymbols("theta"), sympy.symbols("m l g")
        >>> System.make("pendulum", {theta: 0.5}, m*l**2*theta.diff()**2/2,
        ...             -m*g*l*sympy.cos(theta), parameters={m: 1, l: 1, g: 9.81}).qd
        (theta_dot,)
        """
        arguments = {key: x for key, x in locals().items() if key not in ("cls", "unknown")}
        api_arguments.check_arguments(unknown, arguments)
        if kinetic is None:
            raise api_arguments.fault(
                "kinetic", f"None is not an expression: {api_arguments.LAGRANGIAN}"
            )
        run = api_arguments.run(
            h, duration, methods, real, batch, linearize, discretize, tolerance,
            bool(events or friction), inverse_dynamics,
        )  # fmt: skip
        maker = from_sympy.Maker(name)
        system = maker.make(
            cls, coordinates, kinetic, potential, or_empty(parameters), dissipation,
            or_empty(forces), inputs, or_empty(definitions), or_empty(outputs),
            or_empty(constraints), guess, or_empty(units), title, run,
            or_empty(limits), or_empty(events), picture, or_empty(friction),
        )  # fmt: skip
        if faults := system.beyond_float():
            raise SceneError(faults)
        system = add_stick_slip(
            add_discrete_coordinates(saturate_inputs(check_event_functions(system))),
            maker.frictions,
        )
        return replace(system, again=partial(cls.make, **arguments))
