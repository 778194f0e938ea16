"""Compare exact derivatives of the accelerations with differences of the accelerations."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support import point_masses
from support.cases import SCENES, variant
from support.session import MODULES, Modules, tiers

import eomc
from eomc.derive import lagrange
from eomc.model.system import from_scene
from eomc.program import program
from eomc.runtime.package import model_of
from eomc.scene.read import parse
from eomc.verify import equations
from eomc.verify.comparison import Comparison


def linearization(m: ModuleType, q: Any, qd: Any, t: float = 0.0, u: Any = None) -> list[Any]:
    """Return [A_q, A_qd, B] at one state from the C function."""
    model: Any = model_of(m)
    n, nu = len(m.coordinates), len(m.inputs)
    A, B = (np.full((2 * n, k), np.nan, m.dtype) for k in (2 * n, nu))
    inputs = None if u is None else np.ascontiguousarray(u, m.dtype)
    state = [np.ascontiguousarray(x, m.dtype) for x in (q, qd)]
    result = model.c.lib.linearization(
        1, *map(model.c.pointer, (A, B)), *map(model.c.pointer, state), t,
        model.c.pointer(inputs), model.c.pointer(model.info.p0), model.c.tools[2],
    )  # fmt: skip
    assert result >> 3 == 1 - (result & 7 != 0)
    if result & 7:
        raise ValueError(result & 7)
    assert np.array_equal(A[:n], np.eye(2 * n)[n:]) and not B[:n].any()
    return [A[n:, :n], A[n:, n:], B[n:]]


def differences(m: ModuleType, q: Any, qd: Any, t: float, u: Any) -> list[Any]:
    """Approximate them by central differences of order 8, accurate to 1e-10 of a column."""
    stencil = ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280))
    width = 4e-3

    def column(which: int, i: int) -> Any:
        def shifted_acceleration(k: int) -> Any:
            x = [np.array(q, float), np.array(qd, float), np.array(u, float)]
            x[which][i] += k * width
            return m.acceleration(x[0], x[1], t, x[2] if len(u) else None)

        return (
            sum(w * (shifted_acceleration(k) - shifted_acceleration(-k)) for k, w in stencil)
            / width
        )

    n = len(q)
    sizes = (n, n, len(u))
    return [
        np.array([column(which, i) for i in range(k)]).T.reshape(n, k)
        for which, k in enumerate(sizes)
    ]


def with_derivatives(scene: str) -> ModuleType:
    return eomc.load(variant(scene, f"lin_{scene}", linearize='"parameters"'), MODULES)


@pytest.mark.parametrize(
    "scene",
    tiers(
        (
            "cartpole_driven",
            "kapitza_pendulum",
            "chain",
            "tumbling_box",
            "suspension",
            "acrobot",
            "cartpole_bodies",
        ),
        "cartpole_driven",
    ),
)
@pytest.mark.usefixtures("quickly_compiled")
def test_linearization_agrees_with_differences(scene: str) -> None:
    m = with_derivatives(scene)
    rng = np.random.default_rng(3)
    q0, qd0 = m.start
    nu = len(m.inputs)
    for _ in range(4):
        q = q0 + 0.2 * rng.standard_normal(q0.shape)
        qd = qd0 + 0.3 * rng.standard_normal(q0.shape)
        u, t = rng.standard_normal(nu), 0.37
        exact, approximation = linearization(m, q, qd, t, u), differences(m, q, qd, t, u)
        for one, other in zip(exact, approximation, strict=True):
            size = np.max(np.abs(other), initial=1.0)
            assert np.max(np.abs(one - other), initial=0.0) < 1e-7 * size
    if nu:
        u = m.signal(q, qd, 0.37)
        for one, other in zip(
            linearization(m, q, qd, 0.37), linearization(m, q, qd, 0.37, u), strict=True
        ):
            assert np.array_equal(one, other)


@pytest.mark.usefixtures("quickly_compiled")
def test_linearize_is_the_derivative_of_the_acceleration() -> None:
    module: Any = with_derivatives("cartpole_driven")
    q, qd, u, d = np.array([0.3, 1.1]), np.array([-0.4, 0.7]), np.array([2.0]), 1e-6
    A, B = module.linearize(q, qd, u=u)
    assert A.shape == (4, 4) and B.shape == (4, 1)
    x = np.concatenate([q, qd, u])

    def acceleration(x: Any) -> Any:
        return module.rhs(0.0, x[:4], x[4:])

    slopes = [(acceleration(x + e) - acceleration(x - e)) / (2 * d) for e in d * np.eye(5)]
    # differences over 2e-6 of values below 100: errors of d^2 and of rounding, 1e-16*100/1e-6
    np.testing.assert_allclose(np.hstack([A, B]), np.transpose(slopes), rtol=1e-7, atol=1e-7)
    with pytest.raises(ValueError, match="expected"):
        module.linearize(q[None, None], qd[None, None], u=u)
    for call in (module.linearize, module.sensitivity):  # t, then u, as in all functions
        by_name = call(q, qd, t=0.5, u=u)
        assert all(map(np.array_equal, call(q, qd, 0.5, u), by_name))


@pytest.mark.slow
def test_long_chain_is_linearized_by_columns() -> None:
    path = variant("chain", "lin_long", method='["rk4", "dp8", "gauss8"]')
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("n = { value = 5,", "n = { value = 16,"), encoding="utf-8")
    m = eomc.load(path, MODULES)
    source = (MODULES / "lin_long" / "fast" / "lin_long.c").read_text(encoding="utf-8")
    assert "lin_long_slopes_column" in source
    q, qd = m.start
    exact, approximation = linearization(m, q, qd + 0.3), differences(m, q, qd + 0.3, 0.0, [])
    for one, other in zip(exact, approximation, strict=True):
        assert np.max(np.abs(one - other), initial=0.0) < 1e-7 * np.max(np.abs(other), initial=1.0)
    ends = [m.simulate(h=0.01, duration=0.5, method=name).q[-1] for name in ("dp8", "gauss8")]
    assert np.max(np.abs(ends[0] - ends[1])) < 1e-9


@pytest.mark.slow
def test_columns_of_a_chain_share_their_operations() -> None:
    text = point_masses.links([*range(-1, 7)], equal=False) + "\n[run]\nlinearize = true\n"
    functions = program.build(lagrange.derive(point_masses.read_system(text))).functions
    # 16 columns computed one by one take 16 times the acceleration or more
    assert functions["linearization"].cost.flops <= 6.5 * functions["acceleration"].cost.flops


def test_linearization_is_emitted_only_on_request() -> None:
    files = eomc.sources(eomc.read(SCENES / "cartpole.toml")).files
    for form in ("", "fast/"):
        assert "slopes" not in files[f"{form}cartpole.c"]
        assert "linearization" not in files[f"{form}cartpole.h"]


def test_linearization_of_discontinuous_forces_is_refused() -> None:
    path = variant("mass_spring", "lin_jump", linearize="true")
    text = path.read_text(encoding="utf-8")
    q = next(iter(eomc.read(path).coordinates)).name
    path.write_text(f'{text}\n[forces]\n{q} = "-sign({q}_dot)"\n', encoding="utf-8")
    with pytest.raises(eomc.SceneError, match="accelerations jump"):
        eomc.sources(eomc.read(path))


@pytest.mark.usefixtures("quickly_compiled")
@pytest.mark.parametrize(
    "name", tiers(("cartpole", "cartpole_driven", "heavy_top", "chain"), "cartpole_driven")
)
def test_parameter_derivatives_agree_with_differences(name: str, modules: Modules) -> None:
    """The central differences have errors of order h^2, and of rounding over h."""
    m = with_derivatives(name)
    random = np.random.default_rng(3)
    q, qd = random.uniform(0.3, 1.0, (2, len(m.coordinates)))
    u = random.standard_normal(len(m.inputs)) if m.inputs else None
    E = m.sensitivity(q, qd, u=u)
    assert E.shape == (len(q), len(m.parameters))
    for k, (p, value) in enumerate(m.defaults.items()):
        offset = 1e-5 * max(1.0, abs(value))
        up, down = (m.acceleration(q, qd, u=u, params={p: value + s * offset}) for s in (1, -1))
        size = max(1.0, np.abs(E).max())
        np.testing.assert_allclose(E[:, k], (up - down) / (2 * offset), rtol=1e-6, atol=1e-7 * size)
    assert np.abs(E).max() > 0
    with pytest.raises(ValueError, match='linearize = "parameters"'):
        modules(name).sensitivity(q, qd, u=u)


LOOP = """eomc = 1
name = "looped"
[coordinates]
x = { unit = "m" }
theta = { unit = "rad", start = 0.3 }
[parameters]
k = 4.0
[inputs]
force = { unit = "N", signal = "k*theta + 3*lean*theta_dot - x_dot**2", limits = [-9, 9] }
push = { unit = "N m", signal = "sin(t)" }
[definitions]
lean = "sin(theta + x)"
[energy]
kinetic = "x_dot**2 + x_dot*theta_dot*cos(theta) + theta_dot**2"
potential = "(9 + sin(t))*cos(theta)"
[forces]
x = "force"
theta = "push*cos(x)"
[outputs]
f = "force*theta_dot + x_ddot"
[run]
linearize = true
"""
STATES = np.random.default_rng(5).uniform(-1, 1, (2, 6, 2))


@pytest.mark.parametrize("how", [{}, {"outputs": True}, {"closed": True, "outputs": True}])
@pytest.mark.parametrize("t", [0.4, np.linspace(0, 1, 6)])
def test_batch_of_states_agrees_with_single_states(
    modules: Modules, how: dict[str, bool], t: Any
) -> None:
    m = modules.unoptimised(LOOP)
    q, qd = STATES
    values = np.linspace(1, 2, 6)
    many = m.linearize(q, qd, t=t, params={"k": values}, **how)
    assert [x.shape for x in many[:2]] == [(6, 4, 4), (6, 4, 2)]
    for k in range(6):
        now = np.broadcast_to(t, 6)[k]
        one = m.linearize(q[k], qd[k], t=float(now), params={"k": values[k]}, **how)
        assert all(np.array_equal(a[k], b) for a, b in zip(many, one, strict=True))
    assert [len(x) for x in m.linearize(q[:0], qd[:0])] == [0, 0]
    with pytest.raises(ValueError, match=r"t: shape \(3,\), expected one number or \(6,\)"):
        m.linearize(q, qd, t=np.zeros(3))


def test_angle_beyond_those_of_registers_is_linearized_by_scalar_code(modules: Modules) -> None:
    """Sines in vector registers are wrong beyond 2^20 rad."""
    m = modules.unoptimised(LOOP)
    q, qd = STATES.copy()
    q[3, 1] = 3e6
    singles = [m.linearize(*state) for state in zip(q, qd, strict=True)]
    for a, b in zip(m.linearize(q, qd), zip(*singles, strict=True), strict=True):
        assert np.array_equal(a, b)
    qd[4, 1] = 1e200
    with pytest.raises(m.MotionError, match=r"a derivative is not finite there"):
        m.linearize(q, qd)


def test_states_left_over_do_not_write_beyond_their_results(modules: Modules) -> None:
    m, (q, qd) = modules.unoptimised(LOOP), STATES
    A, B = np.full((6, 4, 4), np.nan), np.full((6, 4, 2), np.nan)
    m.linearize(q[:3], qd[:3], out=(A[:3], B[:3]))
    for result in (A, B):
        assert np.isfinite(result[:3]).all() and np.isnan(result[3:]).all()


def test_state_without_linearization_is_named(modules: Modules) -> None:
    polar = 'eomc = 1\nname = "polar"\n[coordinates]\nr = { start = 1 }\nphi = {}\n[energy]\n'
    m = modules.unoptimised(
        polar + 'kinetic = "(r_dot**2 + r**2*phi_dot**2)/2"\n[run]\nlinearize = true\n'
    )
    q, qd = np.array([[1.0, 0], [2, 1], [0, 3], [1, 2]]), np.zeros((4, 2))
    with pytest.raises(m.MotionError, match=r"at q = \[0. 3.\].*positive definite"):
        m.linearize(q, qd)


def test_closed_loop_linearization_agrees_with_differences(modules: Modules) -> None:
    """Differences of accelerations and outputs under the signals, accurate to about 1e-10."""
    m = modules.unoptimised(LOOP)
    for q, qd in np.moveaxis(STATES, 1, 0):
        A, B, C, D = m.linearize(q, qd, t=0.4, closed=True, outputs=True)
        with_constant_inputs = m.linearize(q, qd, t=0.4, outputs=True)
        assert np.array_equal(B, with_constant_inputs[1]) and np.array_equal(
            D, with_constant_inputs[3]
        )
        assert not np.array_equal(A, with_constant_inputs[0])
        x = np.hstack([q, qd])
        for k, offset in enumerate(1e-3 * np.eye(4)):
            for result, f in ((A[2:, k], m.acceleration), (C[:, k], m.output)):

                def shifted(j: int, f: Any = f, offset: Any = offset, x: Any = x) -> Any:
                    return f(*np.split(x + j * offset, 2), t=0.4)

                stencil = ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280))
                approximation = sum(w * (shifted(j) - shifted(-j)) for j, w in stencil) / 1e-3
                assert result == pytest.approx(approximation, rel=1e-9, abs=1e-9)


def test_closed_loop_without_smooth_signals_is_refused(
    modules: Modules, driven: ModuleType
) -> None:
    m, jumps = modules.unoptimised(LOOP), LOOP.replace('x_dot**2",', 'sign(x_dot)",')
    assert "sign" in jumps
    for module, words in ((m, "give no u"), (modules.unoptimised(jumps), "has no loop to close")):
        with pytest.raises(ValueError, match=words):
            module.linearize([0, 0], [0, 0], u=[1, 2] if module is m else None, closed=True)
    modules.unoptimised(jumps).linearize([0, 0], [0, 0])


def test_linearization_of_outputs_without_derivatives_is_refused(modules: Modules) -> None:
    """A method that needs derivatives of accelerations has only those."""
    text = LOOP.replace("linearize = true", 'method = "gauss4"')
    with pytest.raises(ValueError, match="without derivatives of its outputs"):
        modules.unoptimised(text).linearize([0, 0], [0, 0], outputs=True)


def test_check_detects_a_wrong_closed_loop(modules: Modules) -> None:
    class WrongClosedLoop:
        def __getattr__(self, name: str) -> Any:
            return getattr(m, name)

        def linearize(self, *state: Any, closed: bool = False, **how: Any) -> Any:
            A, B = m.linearize(*state, closed=closed, **how)
            return A + 1e-8 * closed * np.abs(A).max(), B

    m, system = modules.unoptimised(LOOP), from_scene(parse(LOOP, "test.toml"))
    for module, passed in ((m, True), (WrongClosedLoop(), False)):
        comparison = Comparison(system, module, np.random.default_rng(0), 4)
        results = comparison.report(equations.closed_loop_checks)
        assert [(row.name, row.passed) for row in results] == [("closed loop", passed)], results
