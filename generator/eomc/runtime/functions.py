"""D, C, g, accelerations and the other functions of a state: arrays in, arrays out.

q and qd are (nq,), or (n, nq) for n states. For n states the results have a leading axis n, and t
may be (n,), u (n, nu), and the value of a parameter (n,).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import copysign, inf
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy import empty
from numpy.typing import ArrayLike

from .arguments import Arguments, Array, Parameters, StateArguments, as_flag, as_number
from .info import SceneInfo, slices
from .package import Component, named_outputs, option
from .status import STATUS, check_finite, refuse

ROWS_PER_CALL = 20_000  # rows times coordinates squared in one call of C, some ms at most


class StateFunction(NamedTuple):
    """Facts about a function of the state, such as D or energy.

    Attributes
    ----------
    shape : callable
        Function that takes the `SceneInfo` and returns the shape of the result at one state.
    of_velocity : bool
        Whether the generated C function takes the velocities qd as well as q.
    of_inputs : bool
        Whether it takes inputs; otherwise other numbers take their place, as accelerations.
    """

    shape: Callable[[SceneInfo], tuple[int, ...]]
    of_velocity: bool = True
    of_inputs: bool = True


FUNCTIONS: Mapping[str, StateFunction] = {
    "D": StateFunction(lambda m: (m.nq, m.nq), of_velocity=False),
    "C": StateFunction(lambda m: (m.nq, m.nq)),
    "g": StateFunction(lambda m: (m.nq,), of_velocity=False),
    "bias": StateFunction(lambda m: (m.nq,)),
    "tau": StateFunction(lambda m: (m.nq,)),
    "kinetic_energy": StateFunction(lambda _: ()),
    "potential_energy": StateFunction(lambda _: (), of_velocity=False),
    "energy": StateFunction(lambda _: ()),
    "jacobi": StateFunction(lambda _: ()),
    "power": StateFunction(lambda _: ()),
    "signal": StateFunction(lambda m: (m.nu,)),
    "signal_slopes": StateFunction(lambda m: (m.nu, 2 * m.nq)),
    "signal_sensitivity": StateFunction(lambda m: (m.nu, len(m.parameters))),
    "applied": StateFunction(lambda m: (m.nu,)),
    "outputs": StateFunction(lambda m: (len(m.outputs),)),
    "output_slopes": StateFunction(lambda m: (len(m.outputs), 3 * m.nq + m.nu)),
    "sensitivity": StateFunction(lambda m: (m.nq, len(m.parameters))),
    "output_sensitivity": StateFunction(lambda m: (len(m.outputs), len(m.parameters))),
    "frame_poses": StateFunction(
        lambda m: (len(m.frames), 3 if m.plane else 12), of_velocity=False
    ),
    "frame_velocities": StateFunction(lambda m: (len(m.frames), m.frame_size)),
    "frame_accelerations": StateFunction(lambda m: (len(m.frames), m.frame_size), of_inputs=False),
    "frame_jacobians": StateFunction(
        lambda m: (len(m.frames), m.frame_size, m.nq), of_velocity=False
    ),
    "frame_forces": StateFunction(lambda m: (m.nq,), of_velocity=False, of_inputs=False),
    "inverse_dynamics": StateFunction(lambda m: (m.nq,), of_inputs=False),
    "momentum": StateFunction(lambda m: (6 if m.plane else 10,)),
    "constraints": StateFunction(lambda m: (len(m.constraints.names),)),
    "constraint_rates": StateFunction(lambda m: (len(m.constraints.names),)),
    "constraint_jacobian": StateFunction(
        lambda m: (len(m.constraints.names), m.nq), of_velocity=False
    ),
    "constraint_slopes": StateFunction(lambda m: (len(m.constraints.names), m.nq)),
    "multipliers": StateFunction(lambda m: (len(m.constraints.names),)),
    "reactions": StateFunction(lambda m: (len(m.constraints.loops), m.frame_size), of_inputs=False),
    "events": StateFunction(lambda m: (len(m.events),)),
    "jumps": StateFunction(lambda m: (len(m.events), 2 * m.nq)),
    "event_slopes": StateFunction(
        lambda m: (len(m.events), 2 * m.nq + m.nu + len(m.parameters) + 1)
    ),
}


class Functions(Component):
    """Functions of the state of a compiled scene: D, C, g, energies, accelerations, derivatives.

    All methods take one state, q and qd (nq,), or n states, (n, nq). For n states the results have
    a leading axis n, and t may be (n,), u (n, nu), and the value of a parameter (n,). Other
    arguments: t is the time, s. u: constant inputs (nu,), or a mapping that gives all inputs by
    name; None: the signals of the scene. params: a mapping of the parameters that differ from the
    scene's values, or all of them (np,). out: a C-contiguous array of the result's shape and the
    module's dtype, into which the result is written. Angles in rad, all else in SI units. Invalid
    arguments raise ValueError.
    """

    path = "functions"

    def __init__(self, arguments: Arguments) -> None:
        self.arguments, self.info, self.c = arguments, arguments.info, arguments.c
        self.nq, self.dtype = self.info.nq, self.info.dtype
        self.c_functions: dict[str, Any] = {}  # by name: C function, row of FUNCTIONS

    def evaluate(
        self, name: str, q: ArrayLike, qd: ArrayLike | None, t: Any = 0.0, u: Any = None,
        params: Any = None, out: Any = None,
    ) -> Any:  # fmt: skip
        """Evaluate a function of FUNCTIONS at one state, or at many in one call of C.

        u: inputs, or an array of the numbers in their place, one for all states or one each.
        """
        address, real, null = self.c.tools
        if (bound := self.c_functions.get(name)) is None:
            of = FUNCTIONS[name]
            bound = getattr(self.c.lib, name, None), of.shape(self.info), *of[1:]
            self.c_functions[name] = bound
        function, shape, of_velocity, of_inputs = bound
        at: Any
        if of_velocity:
            from_q, from_qd, at, _ = self.arguments.read_state(q, qd)
        else:
            at, from_q, from_qd = q, self.arguments.as_list(q, self.arguments.small_shape), null
            if from_q is None:
                at = self.arguments.array(q, "q", self.nq)
                from_q = address(real, at)
        rows = at.shape[:-1]
        result = self.arguments.output_array(out, rows + shape)
        if rows or not of_inputs:
            inputs, numbers = (u, None) if of_inputs else (None, u)
            acts = StateArguments(self.arguments, rows, t, inputs, params, numbers)
            to, size = address(real, result), result[:1].size if rows else 0
            for k, many in slices(rows[0] if rows else 1, ROWS_PER_CALL // self.nq**2 + 1):
                if function is None:
                    break
                here = self.nq * k
                moving = from_qd + here if of_velocity and k else from_qd
                function(
                    many, to + size * k, from_q + here if k else from_q, moving, *acts.pointers(k)
                )
        else:
            time, (inputs, p) = as_number(t, "t"), self.arguments.input_pointers(u, params)
            if function is not None:
                function(1, address(real, result), from_q, from_qd, time, inputs, p, null)
        if function is None:  # no forces, no power
            result[...] = 0
        return result if result.ndim else result[()]

    def _all_rows(self, call: Callable[..., int], count: int, first: int) -> tuple[int, str]:
        """Call C for all states, in slices; return the states done and the status of the next.

        call: a function of (first state, states) that returns 8 (states done) + status.
        """
        for k, many in slices(count, first):
            if (code := call(k, many)) & 7:
                return k + (code >> 3), STATUS[code & 7]
        return count, "ok"

    def D(self, q: ArrayLike, t: float = 0.0, params: Parameters = None, out: Any = None) -> Any:
        """Return the mass matrix D(q), symmetric positive definite (in other texts M).

        Parameters
        ----------
        q : (nq,) or (n, nq) array_like
            Generalized coordinates.
        t, params, out
            Time, s; parameters that differ from the scene's; array that receives the result.

        Returns
        -------
        (nq, nq) or (n, nq, nq) array
            Kinetic energy is qd^T D qd / 2 for models whose K is quadratic in qd.
        """
        return self.evaluate("D", q, None, t, None, params, out)

    def C(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, params: Parameters = None,
        out: Any = None,
    ) -> Any:  # fmt: skip
        """Return the Coriolis matrix C(q, qd) in Christoffel form: dD/dt - 2 C is skew-symmetric.

        Parameters
        ----------
        q, qd : (nq,) or (n, nq) array_like
            State.
        t, params, out
            Time, s; parameters that differ from the scene's; array that receives the result.

        Returns
        -------
        (nq, nq) or (n, nq, nq) array
        """
        return self.evaluate("C", q, qd, t, None, params, out)

    def g(self, q: ArrayLike, t: float = 0.0, params: Parameters = None, out: Any = None) -> Any:
        """Return g(q) = dP/dq, the gradient of the potential energy P.

        Parameters
        ----------
        q : (nq,) or (n, nq) array_like
            Generalized coordinates.
        t, params, out
            Time, s; parameters that differ from the scene's; array that receives the result.

        Returns
        -------
        (nq,) or (n, nq) array
            Generalized forces, N or N m, on the left-hand side of D qdd + C qd + g = tau.
        """
        return self.evaluate("g", q, None, t, None, params, out)

    def bias(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, params: Parameters = None,
        out: Any = None,
    ) -> Any:  # fmt: skip
        """Return the bias force C(q, qd) qd + g(q), computed without forming C.

        Parameters
        ----------
        q, qd : (nq,) or (n, nq) array_like
            State.
        t, params, out
            Time, s; parameters that differ from the scene's; array that receives the result.

        Returns
        -------
        (nq,) or (n, nq) array
            Generalized forces, N or N m.
        """
        return self.evaluate("bias", q, qd, t, None, params, out)

    def tau(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, u: Any = None,
        params: Parameters = None, out: Any = None,
    ) -> Any:  # fmt: skip
        """Return the generalized force tau of the inputs, friction and other applied forces.

        tau = Q - dR/dqd, where Q are the applied forces and R is the dissipation function. Forces
        that derive from the potential energy P are in `g` instead.

        Parameters
        ----------
        q, qd : (nq,) or (n, nq) array_like
            State.
        u : (nu,) or (n, nu) array_like or mapping, optional
            Inputs; by default the signals of the scene (its formulas for the inputs).
        t, params, out
            Time, s; parameters that differ from the scene's; array that receives the result.

        Returns
        -------
        (nq,) or (n, nq) array
            Generalized forces, N or N m.
        """
        return self.evaluate("tau", q, qd, t, u, params, out)

    def kinetic_energy(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, params: Parameters = None,
        out: Any = None,
    ) -> Any:  # fmt: skip
        """Return the kinetic energy K(q, qd), J: a number, or (n,) for n states.

        t: time, s; params: parameters that differ from the scene's; out: array for the result.
        """
        return self.evaluate("kinetic_energy", q, qd, t, None, params, out)

    def potential_energy(
        self, q: ArrayLike, t: float = 0.0, params: Parameters = None, out: Any = None
    ) -> Any:
        """Return the potential energy P(q), J: a number, or (n,) for n states.

        t: time, s; params: parameters that differ from the scene's; out: array for the result.
        """
        return self.evaluate("potential_energy", q, None, t, None, params, out)

    def energy(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, params: Parameters = None,
        out: Any = None,
    ) -> Any:  # fmt: skip
        """Return the energy K(q, qd) + P(q), J: a number, or (n,) for n states.

        t: time, s; params: parameters that differ from the scene's; out: array for the result.
        """
        return self.evaluate("energy", q, qd, t, None, params, out)

    def jacobi(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, params: Parameters = None,
        out: Any = None,
    ) -> Any:  # fmt: skip
        """Return Jacobi's integral qd . dK/dqd - K + P, J: a number, or (n,) for n states.

        It equals the energy K + P if K is purely quadratic in qd. Otherwise, as in a rotating
        frame, it is conserved instead of the energy. t: time, s; params: parameters that differ
        from the scene's; out: array that receives the result.
        """
        name = "jacobi" if self.has_jacobi else "energy"
        return self.evaluate(name, q, qd, t, None, params, out)

    @property
    def has_jacobi(self) -> bool:
        """True if Jacobi's integral differs from the energy.

        They differ if the kinetic energy K is not purely quadratic in qd.
        """
        return hasattr(self.c.lib, "jacobi")

    @property
    def has_power(self) -> bool:
        """True if forces or explicit time dependence may change the energy (or Jacobi's integral).

        If False, `power` is always zero.
        """
        return hasattr(self.c.lib, "power")

    def power(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, u: Any = None,
        params: Parameters = None, out: Any = None,
    ) -> Any:  # fmt: skip
        """Return the power, W, by which forces change the energy.

        It is the power of inputs, friction, other forces and driven supports. If the kinetic energy
        K is not purely quadratic in qd, it is the rate of change of Jacobi's integral (see
        `jacobi`) instead of the energy.

        Parameters
        ----------
        q, qd : (nq,) or (n, nq) array_like
            State.
        u : (nu,) or (n, nu) array_like or mapping, optional
            Inputs; by default the signals of the scene.
        t, params, out
            Time, s; parameters that differ from the scene's; array that receives the result.

        Returns
        -------
        float or (n,) array
        """
        return self.evaluate("power", q, qd, t, u, params, out)

    def signal(self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, params: Parameters = None) -> Any:
        """Return the values of the scene's input signals at a state and time, before saturation.

        Parameters
        ----------
        q, qd : (nq,) or (n, nq) array_like
            State.
        t, params
            Time, s; parameters that differ from the scene's.

        Returns
        -------
        (nu,) or (n, nu) array
            A value for each input, in the order of `inputs`.
        """
        return self.evaluate("signal", q, qd, t, None, params)

    @property
    def has_limits(self) -> bool:
        """True if at least one input of the scene has limits (saturates)."""
        return hasattr(self.c.lib, "applied")

    def limits(self, params: Parameters = None) -> dict[str, tuple[float, float]]:
        """Return the limits of each input.

        Parameters
        ----------
        params : mapping or (np,) array_like, optional
            Parameters that differ from those of the scene, since limits may depend on them.

        Returns
        -------
        dict
            (smallest, largest) value by the input's name; -inf and inf for an input without limits.
        """
        far, params = float(np.finfo(self.dtype).max), self.arguments.parameters(params)
        both = [
            self.saturate(np.full(self.info.nu, x, self.dtype), params).tolist()
            for x in (-far, far)
        ]
        ends = [[x if abs(x) < far else copysign(inf, x) for x in some] for some in both]
        return dict(zip(self.info.inputs, zip(*ends, strict=True), strict=True))

    def applied(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, u: Any = None, params: Parameters = None
    ) -> Array:
        """Return the inputs that act at a state: `u`, or the signals, saturated at their limits.

        Parameters
        ----------
        q, qd : (nq,) or (n, nq) array_like
            State.
        u : (nu,) or (n, nu) array_like or mapping, optional
            Inputs before saturation; by default the signals of the scene.
        t, params
            Time, s; parameters that differ from the scene's.

        Returns
        -------
        (nu,) or (n, nu) array
        """
        if self.has_limits:
            return np.asarray(self.evaluate("applied", q, qd, t, u, params))
        at, moving = self.arguments.state(q, qd)
        rows = at.shape[:-1]
        u_rows = StateArguments(self.arguments, rows, t, u, params).u_rows
        inputs = self.signal(at, moving, t, params) if u_rows is None else u_rows
        return np.asarray(np.broadcast_to(inputs, (*rows, self.info.nu)))

    def saturate(self, u: Array, params: Any) -> Array:
        """Inputs (..., nu) within their limits: what becomes of the largest and least numbers.

        params: those of all inputs, or a row each for the first axis of u.
        """
        if not self.has_limits:
            return u
        far = np.full(self.info.nu, np.finfo(self.dtype).max, self.dtype)
        q, qd = self.info.initial_state
        if len(table := self.arguments.parameter_rows(params)) > 1:
            q, qd = (np.tile(x, (len(table), 1)) for x in (q, qd))
        else:
            table = table[0]
        ends = [self.evaluate("applied", q, qd, 0.0, x, table) for x in (-far, far)]
        if q.ndim > 1:
            ends = [x.reshape(len(x), *(1,) * (u.ndim - 2), self.info.nu) for x in ends]
        return np.asarray(np.clip(u, *ends))

    def output(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, u: Any = None,
        params: Parameters = None, out: Any = None,
    ) -> Array:  # fmt: skip
        """Return the scene's outputs at a state.

        Parameters
        ----------
        q, qd : (nq,) or (n, nq) array_like
            State.
        u : (nu,) or (n, nu) array_like or mapping, optional
            Inputs; by default the signals of the scene.
        t, params, out
            Time, s; parameters that differ from the scene's; array that receives the result.

        Returns
        -------
        (ny,) or (n, ny) array
            Values in the order of the names in `outputs`; nan where an output needs accelerations
            and D is singular.

        Raises
        ------
        ValueError
            If the scene has no outputs.
        """
        if not self.info.outputs:
            raise ValueError(f"output: {self.info.name} has none: {named_outputs()}")
        values: Array = self.evaluate("outputs", q, qd, t, u, params, out)
        return values

    def acceleration(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, u: Any = None,
        params: Parameters = None, out: Any = None,
    ) -> Array:  # fmt: skip
        """Return the accelerations qdd, from D qdd + C qd + g = tau (+ A^T lambda of constraints).

        Parameters
        ----------
        q, qd : (nq,) or (n, nq) array_like
            State.
        u : (nu,) or (n, nu) array_like or mapping, optional
            Inputs; by default the signals of the scene.
        t, params, out
            Time, s; parameters that differ from the scene's; array that receives the result.

        Returns
        -------
        (nq,) or (n, nq) array
            Accelerations, m/s^2 or rad/s^2.

        Raises
        ------
        MotionError
            If D is singular or a result is not finite; `out` is then unchanged.
        """
        from_q, from_qd, at, moving = self.arguments.read_state(q, qd)
        values = result = empty(at.shape, self.dtype)
        if out is not None:
            result = self.arguments.output_array(out, at.shape)
        to, function, completed = self.c.pointer(values), self.c.lib.acceleration, 0
        if at.ndim == 1:
            time, (inputs, p) = as_number(t, "t"), self.arguments.input_pointers(u, params)
            code = function(1, to, from_q, from_qd, time, inputs, p, self.c.null)
            status = STATUS[code & 7]
        else:
            n, acts = self.nq, StateArguments(self.arguments, at.shape[:1], t, u, params)
            completed, status = self._all_rows(
                lambda k, many: function(
                    many, to + n * k, from_q + n * k, from_qd + n * k, *acts.pointers(k)
                ),
                len(at), ROWS_PER_CALL // n**2 + 1,
            )  # fmt: skip
        if status != "ok":
            what = "" if status == "singular" else "the acceleration is not finite there"
            refuse(status, at, moving, completed, what)
        if values is not result:
            result[...] = values
        return result

    @property
    def has_slopes(self) -> bool:
        """True if the module was built with derivatives of its accelerations (`linearize`)."""
        return hasattr(self.c.lib, "linearization")

    def linearize(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, u: Any = None, params: Any = None, *,
        outputs: bool = False, closed: bool = False, out: tuple[Array, Array] | None = None,
    ) -> tuple[Array, ...]:  # fmt: skip
        """Linearise the motion at a state: d(dx)/dt = A dx + B du for the state x = [q; qd].

        Derivatives are exact to rounding.

        Parameters
        ----------
        q, qd : (nq,) or (n, nq) array_like
            State at which to linearise, or n states.
        t : float or (n,) array_like
            Time, s.
        u : (nu,) or (n, nu) array_like or mapping, optional
            Inputs. By default the values of the scene's signals, which are held constant even if a
            signal depends on the state.
        params : mapping or array_like, optional
            Parameters that differ from those of the scene; each value may be (n,).
        outputs : bool
            Return C and D of the outputs, too.
        closed : bool
            Let the scene's signals follow the state: A is then the matrix of the closed loop, and B
            belongs to inputs that are added to the signals. Only without `u`.
        out : (A, B), optional
            Arrays that receive A and B. Their contents are undefined after an error.

        Returns
        -------
        A : (2 nq, 2 nq) array
            [[0, 1], [dqdd/dq, dqdd/dqd]], in m or rad per s^2, per m, rad or their rates. For n
            states this and all other results have a leading axis n.
        B : (2 nq, nu) array
            [0; dqdd/du].
        C, D : (ny, 2 nq) and (ny, nu) arrays, if `outputs`
            Derivatives of the outputs: dy = C dx + D du.

        Raises
        ------
        MotionError
            If D is singular or a derivative is not finite.
        ValueError
            If the module was built without these derivatives, or has no outputs or no feedback
            signal.
        """
        if not self.has_slopes:
            raise ValueError(
                f"linearize: {self.info.name} was built without it: build it with "
                f"{option('linearize')}"
            )
        outputs, closed = as_flag(outputs, "outputs"), as_flag(closed, "closed")
        if outputs and not self.info.outputs:
            raise ValueError(f"linearize: {self.info.name} has no outputs: {named_outputs()}")
        if outputs and not hasattr(self.c.lib, "output_slopes"):
            raise ValueError(
                f"linearize: {self.info.name} was built without derivatives of its outputs: "
                "build it "
                f"with {option('linearize')}"
            )
        at, moving = self.arguments.state(q, qd)
        A, B = self.slopes(at, moving, u, t, params, out)
        both = [(A, B)]
        if outputs:
            n, m = self.nq, self.info.nu
            slopes = self.evaluate("output_slopes", at, moving, t, u, params)
            by_state, by_u, by_qdd = np.split(slopes, [2 * n, 2 * n + m], axis=-1)
            both.append((by_state + by_qdd @ A[..., n:, :], by_u + by_qdd @ B[..., n:, :]))
        if closed:
            K = self.feedback(at, moving, u, t, params)
            for by_state, by_u in both:
                by_state += by_u @ K
        return tuple(x for pair in both for x in pair)

    def slopes(
        self, q: Array, qd: Array, u: Any, t: float, params: Any, out: Any = None
    ) -> tuple[Array, Array]:
        """Return A and B of states (nq,) or (n, nq). Raises MotionError."""
        n, m, rows = self.nq, self.info.nu, q.shape[:-1]
        A, B = self.arguments.output_matrices(out, "(A, B)", q, qd)
        targets = [(self.c.pointer(x), 2 * n * w) for x, w in ((A, 2 * n), (B, m))]
        from_q, from_qd = self.c.pointer(q), self.c.pointer(qd)
        acts = StateArguments(self.arguments, rows, t, u, params)
        completed, status = self._all_rows(
            lambda k, many: self.c.lib.linearization(
                many, *(to + k * size for to, size in targets), from_q + n * k, from_qd + n * k,
                *acts.pointers(k),
            ),
            q.size // n, ROWS_PER_CALL // n**3 + 1,
        )  # fmt: skip
        if status != "ok":
            what = "" if status == "singular" else "a derivative is not finite there"
            refuse(status, q, qd, completed, what)
        return A, B

    def feedback(self, q: Array, qd: Array, u: Any, t: float, params: Any) -> Array:
        """du/dx of the scene's signals, (nu, 2 nq), with a leading n for many states."""
        if u is not None:
            raise ValueError(
                "closed: is for the scene's signals: give no u, which would be constant"
            )
        if not hasattr(self.c.lib, "signal_slopes"):
            raise ValueError(
                f"closed: {self.info.name} has no loop to close: no signal is a smooth function "
                "of the "
                "state"
            )
        K: Array = self.evaluate("signal_slopes", q, qd, t, None, params)
        return K

    def sensitivity(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, u: Any = None,
        params: Parameters = None, *, outputs: bool = False,
    ) -> Any:  # fmt: skip
        """Return the derivatives of the accelerations (and outputs) with respect to the parameters.

        Parameters
        ----------
        q, qd : (nq,) or (n, nq) array_like
            State, or several.
        t, u, params
            As in `acceleration`. Inputs are held constant.
        outputs : bool, optional
            Whether to return the derivatives of the outputs too.

        Returns
        -------
        E : (nq, np) array
            ∂q̈/∂p, a column for each parameter in its order; (n, nq, np) for n states.
        F : (ny, np) array, if `outputs`
            dy/dp of the outputs y at a constant state, through the accelerations too.

        Raises
        ------
        MotionError
            If a derivative is not finite.
        ValueError
            If the module was built without these derivatives, or has no outputs.
        """
        if not hasattr(self.c.lib, "sensitivity"):
            self.refuse_sensitivity("sensitivity")
        E: Array = self.evaluate("sensitivity", q, qd, t, u, params)
        check_finite(E, 2, q, qd, "a derivative")
        if not as_flag(outputs, "outputs"):
            return E
        if not self.info.outputs:
            raise ValueError(f"sensitivity: {self.info.name} has no outputs: {named_outputs()}")
        slopes = self.evaluate("output_slopes", q, qd, t, u, params)
        by_qdd = slopes[..., 2 * self.nq + self.info.nu :]
        return E, self.evaluate("output_sensitivity", q, qd, t, u, params) + by_qdd @ E

    def acceleration_jvp(
        self, q: ArrayLike, qd: ArrayLike, along: Sequence[ArrayLike | None], t: float = 0.0,
        u: Any = None, params: Any = None,
    ) -> Array:  # fmt: skip
        """Return the Jacobian-vector product J v: the derivative of the accelerations along v.

        J contains the derivatives of the accelerations by q, qd, u and the parameters. The
        derivatives are exact to rounding.

        Parameters
        ----------
        q, qd : (nq,) or (n, nq) array_like
            State, or several.
        along : tuple (dq, dqd, du, dp)
            The direction v: (nq,), (nq,), (nu,) and (np,), or a row for each state. None, or an
            entry that is left out at the end: zeros.
        t, u, params
            As in `linearize`. The inputs are constant, even if a signal depends on the state.

        Returns
        -------
        (nq,) or (n, nq) array

        Raises
        ------
        MotionError
            If D is singular or a derivative is not finite.
        ValueError
            If an argument is invalid.
        """
        parts = [*along]
        sizes = (self.nq, self.nq, self.info.nu, len(self.info.parameters))
        if len(parts) > len(sizes):
            raise ValueError(f"along: {len(parts)} entries, expected (dq, dqd, du, dp)")
        parts += [None] * (len(sizes) - len(parts))
        vector = [
            self.arguments.for_each_state(np.zeros(k) if x is None else x, f"along[{i}]", (k,), q)
            for i, (k, x) in enumerate(zip(sizes, parts, strict=True))
        ]
        direction = np.concatenate(vector, axis=-1)
        return self.product("acceleration_jvp", q, qd, direction, self.nq, (t, u, params))

    def acceleration_vjp(
        self, q: ArrayLike, qd: ArrayLike, qdd_bar: ArrayLike, t: float = 0.0, u: Any = None,
        params: Any = None,
    ) -> tuple[Array, ...]:  # fmt: skip
        """Return the vector-Jacobian product J^T w: the gradient of w . qdd (reverse mode).

        J contains the derivatives of the accelerations by q, qd, u and the parameters. The cost is
        a few accelerations, whatever the number of parameters. The derivatives are exact to
        rounding.

        Parameters
        ----------
        q, qd : (nq,) or (n, nq) array_like
            State, or several.
        qdd_bar : (nq,) or (n, nq) array_like
            The weights w of the accelerations, such as the derivatives of a cost by them.
        t, u, params
            As in `linearize`. The inputs are constant, even if a signal depends on the state.

        Returns
        -------
        q_bar, qd_bar : (nq,) or (n, nq) arrays
            Derivatives of w . qdd by q and qd.
        u_bar, p_bar : (nu,) and (np,), or (n, nu) and (n, np) arrays
            Derivatives by the inputs and by the parameters.

        Raises
        ------
        MotionError
            If D is singular or a derivative is not finite.
        ValueError
            If an argument is invalid.

        References
        ----------
        A. Griewank, A. Walther, Evaluating Derivatives, 2nd ed., SIAM, 2008, ch. 3.
        """
        n, m = self.nq, self.info.nu
        weights = self.arguments.for_each_state(qdd_bar, "qdd_bar", (n,), q)
        width = 2 * n + m + len(self.info.parameters)
        bar = self.product("acceleration_vjp", q, qd, weights, width, (t, u, params))
        return tuple(np.split(bar, [n, 2 * n, 2 * n + m], axis=-1))

    def product(
        self, name: str, q: ArrayLike, qd: ArrayLike, vector: Array, width: int,
        conditions: tuple[Any, Any, Any],
    ) -> Array:  # fmt: skip
        """Return a product of the accelerations' derivatives with a vector.

        name: of the C function. width: number of results for each state. conditions: t, u, params.
        """
        at, moving = self.arguments.state(q, qd)
        result, n = empty((*at.shape[:-1], width), self.dtype), self.nq
        acts = StateArguments(self.arguments, at.shape[:-1], *conditions)
        to, by, from_q, from_qd = map(self.c.pointer, (result, vector, at, moving))
        function, size = getattr(self.c.lib, name), vector.shape[-1]
        completed, status = self._all_rows(
            lambda k, many: function(
                many, to + width * k, by + size * k, from_q + n * k, from_qd + n * k,
                *acts.pointers(k),
            ),
            at.size // n, ROWS_PER_CALL // n**2 + 1,
        )  # fmt: skip
        if status != "ok":
            what = "" if status == "singular" else "a derivative is not finite there"
            refuse(status, at, moving, completed, what)
        return result

    def refuse_sensitivity(self, name: str) -> NoReturn:
        """Raise ValueError: the module has no derivatives with respect to parameters.

        name: the function that needs them.
        """
        raise ValueError(
            f"{name}: {self.info.name} was built without derivatives with respect to parameters: "
            "build it, with parameters, with " + option("linearize", '"parameters"')
        )

    def rhs(self, t: float, x: ArrayLike, u: Any = None, params: Parameters = None) -> Array:
        """Return dx/dt = [qd; qdd] for x = [q; qd], as `scipy.integrate.solve_ivp` calls it.

        Parameters
        ----------
        t : float
            Time, s.
        x : (2 nq,) array_like
            State: q, then qd.
        u, params
            Inputs, (nu,) or by name (None: the scene's signals); parameters that differ from the
            scene's.

        Returns
        -------
        (2 nq,) array

        Raises
        ------
        MotionError
            If D is singular or an acceleration is not finite.
        """
        n, state = self.nq, self.arguments.numbers(x, "x")
        if state.shape != (2 * n,):
            raise ValueError(f"x: shape {state.shape}, expected ({2 * n},): q, then qd")
        out = empty(2 * n, self.dtype)
        out[:n] = state[n:]
        out[n:] = self.acceleration(state[:n], state[n:], t, u, params)
        return out
