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
from eomc.model import api_arguments
from eomc.model.api_arguments import or_empty
from eomc.model.from_sympy import Maker, SystemArguments
from eomc.model.hybrid import add_hybrid_dynamics
from eomc.model.mechanics import Mechanics
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
from eomc.scene.scene import RunSettings

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
    """A mechanical system in SymPy symbols: d/dt dL/dqd - dL/dq + dR/dqd = Q with L = K - P - a.qd.

    It is read from a scene by `eomc.read`, or made from expressions by `System.make`. Its
    attributes are those of `Mechanics`.
    """

    def __repr__(self) -> str:
        return f"<System {self.name}: {self.size}>"

    @property
    def size(self) -> str:
        """Text with the numbers of coordinates, inputs and parameters."""
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
        r"""Make a system from SymPy expressions and return it.

        Names as text may replace symbols, and formulas in the syntax of scenes may replace
        expressions. The velocity of a symbol `theta` is the symbol `theta_dot`; the velocity of a
        dynamicsymbol is `theta.diff()`. Units are SI units and radians.

        Parameters
        ----------
        name
            Name of the system, of its Python module and of its C files.
        coordinates
            Symbols or dynamicsymbols, or a mapping from these to initial values or to pairs
            (value, velocity). Initial values are numbers or formulas of parameters.
        kinetic, dissipation
            Kinetic energy and Rayleigh's dissipation function.
        potential
            Potential energy. It may have terms linear in the velocities, such as
            e*B*(y*x_dot - x*y_dot)/2 of a charge in a magnetic field, which are not part of the
            energy.
        parameters
            Mapping from symbols to numbers.
        forces
            Mapping from coordinates to generalized forces (N or N m).
        inputs
            Symbols, or a mapping from symbols to default values.
        definitions
            Mapping from symbols to expressions.
        outputs
            Mapping from names to expressions. The acceleration of `theta` in them is `theta_ddot`,
            or the second derivative of a dynamicsymbol.
        constraints
            Mapping from names to expressions that are zero. They depend on coordinates and t, or
            are linear in the velocities.
        guess
            Coordinates whose initial values may be changed to satisfy the constraints, as those of
            coordinates without an initial value are.
        units
            Mapping from symbols or names to units, for display.
        title
            Title for display; by default the name.
        h, duration
            Default step size and duration of a run in s.
        methods
            Names of the methods with fixed steps to generate, or "auto" for adaptive steps.
        real, batch, linearize, discretize, inverse_dynamics
            Settings of the generated code, as in the table [run] of a scene.
        limits
            Mapping from inputs to saturation limits (lower, upper); None for no limit.
        events
            Mapping from names to event functions, or to dicts as [[event]] in a scene:
            {"when": y, "direction": "falling", "action": "jump", y_dot: -e*y_dot}.
        tolerance
            Tolerance of adaptive steps. By default 1e-9 (larger in single precision) for systems
            with events, friction or the method "auto"; other systems then have fixed steps only.
        picture
            Dict as the table [picture] in a scene: {"lines": [[[0, 0], [x, -l]]]}.
        friction
            Mapping from coordinates to Coulomb friction (N or N m) with stick-slip transitions.

        Returns
        -------
        System
            The system. Names that are invalid in C (`\theta`, `lambda`) are replaced in it, as
            listed in its attribute `renamed`.

        Raises
        ------
        EomcError
            If an argument is invalid or an expression has an undeclared name.
        TypeError
            If there is no argument of a given name.

        Examples
        --------
        >>> from sympy.physics.mechanics import dynamicsymbols
        >>> theta, (m, l, g) = dynamicsymbols("theta"), sympy.symbols("m l g")
        >>> System.make("pendulum", {theta: 0.5}, m*l**2*theta.diff()**2/2,
        ...             -m*g*l*sympy.cos(theta), parameters={m: 1, l: 1, g: 9.81}).qd
        (theta_dot,)
        """
        arguments = {key: x for key, x in locals().items() if key not in ("cls", "unknown")}
        api_arguments.check_arguments(unknown, arguments)
        if kinetic is None:
            raise api_arguments.argument_error(
                "kinetic", f"None is not an expression: {api_arguments.LAGRANGIAN}"
            )
        run = RunSettings(
            h=h,
            duration=duration,
            methods=api_arguments.as_tuple(methods),
            real=real,
            batch=batch,
            linearize=linearize,
            discretize=discretize,
            inverse_dynamics=inverse_dynamics,
            tolerance=tolerance,
        )
        system_arguments = SystemArguments(
            name=name,
            coordinates=coordinates,
            kinetic=kinetic,
            potential=potential,
            dissipation=dissipation,
            parameters=or_empty(parameters),
            forces=or_empty(forces),
            inputs=inputs,
            definitions=or_empty(definitions),
            outputs=or_empty(outputs),
            constraints=or_empty(constraints),
            guess=guess,
            limits=or_empty(limits),
            events=or_empty(events),
            friction=or_empty(friction),
            picture=picture,
            units=or_empty(units),
            title=title,
            run=api_arguments.run_settings(run, bool(events or friction)),
        )
        maker = Maker(system_arguments)
        system = maker.make(cls)
        if faults := system.beyond_float():
            raise SceneError(faults)
        system = add_hybrid_dynamics(system, maker.frictions)
        return replace(system, again=partial(cls.make, **arguments))
