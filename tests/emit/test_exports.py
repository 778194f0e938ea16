"""Exported packages: their functions beside those of the scene's module, and their derivatives.

The reference of derivatives is the automatic differentiation of the library that the package is
for, applied to the accelerations that are written line by line.
"""

from __future__ import annotations

import importlib
import re
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from support.cases import SCENES
from support.fmus import plain
from support.session import EVERYTHING, ROOT, tiers

import eomc
from eomc.base.errors import EomcError, SceneError
from eomc.cli.main import main
from eomc.model.system import System, from_scene
from eomc.scene.read import parse

FOLDER = Path(tempfile.mkdtemp(prefix="eomc-exports-"))  # of this process
# every function that has a derivative, with names that the package uses itself
SMOOTH = EVERYTHING.replace("-gamma*sign(theta_dot)/10 + push*heaviside(x)", "push*abs(x_dot)")
FALLS = """
eomc = 1
name = "falls"
[coordinates]
y = { unit = "m", start = 1.0 }
[energy]
kinetic = "y_dot**2/2"
potential = "9.81*y"
"""


def name_of(scene: str) -> str:
    """Return the name of a scene, of a file in scenes/ or of a text."""
    return scene.split('"')[1] if "\n" in scene else scene


def system_of(scene: str) -> System:
    text = scene if "\n" in scene else (SCENES / f"{scene}.toml").read_text(encoding="utf-8")
    return from_scene(parse(text, "test.toml"))


@cache
def exported(scene: str, library: str) -> ModuleType:
    """Export a scene once and import the package."""
    pytest.importorskip(library, reason=f"no {library}: pip install '.[{library}]'")
    system = system_of(scene)
    if system.constraints:
        system = eomc.read(SCENES / f"{scene}.toml")
    with pytest.MonkeyPatch.context() as patch:
        strict = " -Wall -Wextra -Wpedantic -Werror" if library == "casadi" else ""
        patch.setenv("EOMC_CFLAGS", f"-O0{strict}")
        folder = eomc.export(system, library, FOLDER / f"{system.name}_{library}")
        patch.syspath_prepend(str(FOLDER))
        return importlib.import_module(folder.name)


def random_point(module: ModuleType, seed: int) -> tuple[np.ndarray, ...]:
    """Return x = [q; qd], u and p near the start of the scene."""
    rng = np.random.default_rng(seed)
    start, p = (np.array(x, float).ravel() for x in (module.start, module.defaults))
    x = start + 0.1 * rng.standard_normal(start.size)
    return x, rng.standard_normal(module.nu), p * (1 + 0.05 * rng.random(p.size))


def inputs_of(module: ModuleType, u: np.ndarray) -> np.ndarray | None:
    """Return the inputs as a module takes them: None if the scene has none."""
    return u if module.nu else None


def symbolic_step(package: ModuleType, steps: int, h: float) -> Any:
    """Return the function (x, u, p) -> x' of CasADi for steps of RK4 from t = 0.3 s."""
    import casadi

    f = package.function()
    symbols = [
        casadi.SX.sym(n, k)
        for n, k in (("x", 2 * package.nq), ("u", package.nu), ("p", package.np))
    ]
    x, u, p = symbols
    for k in range(steps):
        t = 0.3 + k * h
        k1 = f(x, u, p, t)
        k2 = f(x + h / 2 * k1, u, p, t + h / 2)
        k3 = f(x + h / 2 * k2, u, p, t + h / 2)
        k4 = f(x + h * k3, u, p, t + h)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return casadi.Function("step", symbols, [x])


def dense(value: Any) -> np.ndarray:
    """Return a matrix of CasADi as an array."""
    import casadi

    return casadi.DM(value).full()


def largest_error(values: Any, expected: Any) -> float:
    """Return the largest difference, relative to the largest expected value."""
    expected = np.asarray(expected, float)
    return float(np.abs(np.asarray(values, float) - expected).max() / np.abs(expected).max())


CASADI_SCENES = ["cartpole_driven", SMOOTH, "kapitza_pendulum", "quadrotor", "four_bar", "chain"]
casadi_scenes = pytest.mark.parametrize(
    "scene", tiers(CASADI_SCENES, CASADI_SCENES[0]), ids=name_of
)


@casadi_scenes
def test_accelerations_for_casadi_agree_with_the_module(scene: str) -> None:
    package, module = exported(scene, "casadi"), plain(scene)
    for seed in range(5):
        x, u, p = random_point(package, seed)
        q, qd = np.split(x, 2)
        expected = np.concatenate([qd, module.acceleration(q, qd, 0.3, inputs_of(module, u), p)])
        for function, tolerance in ((package.compiled("ode"), 0.0), (package.function(), 1e-13)):
            assert largest_error(dense(function(x, u, p, 0.3)).ravel(), expected) <= tolerance
    assert package.coordinates == tuple(module.coordinates)
    assert (
        dict(zip(package.parameters, dense(package.defaults).ravel(), strict=True))
        == module.defaults
    )


@casadi_scenes
def test_compiled_jacobians_agree_with_those_of_symbolic_accelerations(scene: str) -> None:
    package = exported(scene, "casadi")
    import casadi

    x, u, p = random_point(package, 7)
    arguments = [casadi.MX.sym(n, len(v)) for n, v in zip("xupt", (x, u, p, [0.0]), strict=True)]
    jacobians = []
    for f in (package.compiled("ode"), package.function()):
        blocks = [casadi.jacobian(f(*arguments), a) for a in arguments[:3]]
        function = casadi.Function("jacobians", arguments, blocks)
        jacobians.append([dense(block) for block in function(x, u, p, 0.3)])
    for compiled, symbolic in zip(*jacobians, strict=True):
        assert compiled.shape == symbolic.shape
        assert not symbolic.size or largest_error(compiled, symbolic) < 1e-12
    assert jacobians[0][0].shape == (2 * package.nq,) * 2


@pytest.mark.parametrize(
    "scene", tiers(["cartpole_driven", "kapitza_pendulum", SMOOTH], "cartpole_driven"), ids=name_of
)
def test_step_for_casadi_agrees_with_the_module_and_with_symbolic_derivatives(scene: str) -> None:
    package, module = exported(scene, "casadi"), plain(scene)
    step, h, t = package.compiled("step"), package.h, 0.3
    x, u, p = random_point(package, 3)
    q, qd = np.split(x, 2)
    assert np.array_equal(
        dense(step(x, u, p, t)).ravel(),
        np.concatenate(module.step(q, qd, h, t, inputs_of(module, u), p)),
    )
    expected = symbolic_step(package, 1, h).jacobian()(x, u, p, 0)
    for block, symbolic in zip(step.jacobian()(x, u, p, t, 0)[:3], expected, strict=True):
        assert not symbolic.numel() or largest_error(dense(block), dense(symbolic)) < 1e-13


@casadi_scenes
def test_adjoints_agree_with_jacobians(scene: str) -> None:
    package = exported(scene, "casadi")
    f, (x, u, p) = package.compiled("ode"), random_point(package, 5)
    weights = np.linspace(0.5, 1.5, len(x))
    adjoints = f.reverse(1)(x, u, p, 0.3, 0, weights)
    for adjoint, block in zip(adjoints[:3], f.jacobian()(x, u, p, 0.3, 0)[:3], strict=True):
        assert not block.numel() or largest_error(dense(adjoint).T, weights @ dense(block)) < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["quadrotor", "four_bar"])
def test_step_for_casadi_ends_on_the_constraints(scene: str) -> None:
    """Derivatives are those of the step with its projection, here beside central differences."""
    package, module = exported(scene, "casadi"), plain(scene)
    step, h, t, d = package.compiled("step"), package.h, 0.0, 1e-6
    x, u, p = dense(package.start).ravel(), np.full(package.nu, 0.5), package.defaults
    q, qd = np.split(x, 2)
    end = dense(step(x, u, p, t)).ravel()
    assert np.array_equal(end, np.concatenate(module.step(q, qd, h, t, inputs_of(module, u))))
    assert np.abs(module.constraints(*np.split(end, 2))).max() < 1e-12
    columns = [
        dense(step(x + e, u, p, t) - step(x - e, u, p, t)).ravel() for e in d * np.eye(len(x))
    ]
    assert (
        largest_error(dense(step.jacobian()(x, u, p, t, 0)[0]), np.array(columns).T / 2 / d) < 1e-8
    )


def test_states_without_accelerations_are_reported_to_casadi() -> None:
    package = exported("cartpole_driven", "casadi")
    x, u, p = random_point(package, 1)
    for function in (package.compiled("ode"), package.compiled("ode").jacobian()):
        arguments = {"x": x, "u": u, "p": -p}
        with pytest.raises(RuntimeError, match="valuation"):
            function(**arguments)


def test_step_size_of_an_export_is_chosen(tmp_path: Path) -> None:
    pytest.importorskip("casadi")
    result = CliRunner().invoke(
        main,
        ["export", "casadi", str(SCENES / "simple_pendulum.toml"), "--step-size", "0.05", "--out",
         str(tmp_path / "longer")],
        env={"EOMC_CFLAGS": "-O0"},
    )  # fmt: skip
    assert result.exit_code == 0 and result.output.endswith("import it as longer\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(tmp_path))
        package = importlib.import_module("longer")
    q, qd = plain("simple_pendulum").step([0.4], [0.1], h=0.05)
    assert np.array_equal(
        dense(package.compiled("step")([0.4, 0.1], [], package.defaults, 0)).ravel(), [*q, *qd]
    )
    assert package.h == 0.05


@pytest.mark.parametrize("library", ["casadi", "jax", "torch"])
def test_what_has_no_derivatives_is_refused_by_name(library: str, tmp_path: Path) -> None:
    scene = tmp_path / "scene.toml"
    event = '[[event]]\nname = "ground"\nwhen = "y"\naction = "stop"\n'
    sign = '[forces]\ny = "-sign(y_dot)"\n'
    for text, message in (
        (FALLS + event, "the event 'ground' interrupts a run"),
        (FALLS + sign, "make them smooth, say tanh"),
    ):
        scene.write_text(text, encoding="utf-8")
        with pytest.raises(SceneError, match=message):
            eomc.export(scene, library, tmp_path / "folder")
    scene.write_text(FALLS, encoding="utf-8")
    for words, message in (
        (["--step-size", "-1"], "the step size is a positive number of seconds"),
        (["--out", str(tmp_path)], "has files that eomc did not write"),
    ):
        (tmp_path / "__init__.py").write_text("mine = 1\n", encoding="utf-8")
        result = CliRunner().invoke(main, ["export", library, str(scene), *words])
        assert result.exit_code == 2 and message in result.output, result.output
    with pytest.raises(EomcError, match="one of casadi, jax, torch"):
        eomc.export(scene, "tensorflow", tmp_path / "folder")
    assert not (tmp_path / "folder").exists()


def test_export_without_a_compiler_writes_the_sources(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    messages: list[Any] = []
    folder = eomc.export(
        system_of("simple_pendulum"), "casadi", tmp_path / "p", warn=messages.append
    )
    assert [m.message for m in messages] and "sources only: no C compiler" in messages[-1].message
    assert {file.name for file in folder.iterdir()} == {
        "__init__.py", "simple_pendulum.c", "simple_pendulum.h", "simple_pendulum_casadi.c",
    }  # fmt: skip


# --- JAX ------------------------------------------------------------------------------------------


def jax_package(scene: str) -> tuple[ModuleType, ModuleType]:
    """Return the package of a scene for JAX, with double precision, and jax."""
    package = exported(scene, "jax")
    import jax

    jax.config.update("jax_enable_x64", True)
    return package, jax


def gradients(function: Any, weights: np.ndarray, *values: np.ndarray) -> list[np.ndarray]:
    """Return the gradients of weights . f(*values) by each value, by CasADi's own derivatives."""
    blocks = function.jacobian()(*values, 0)
    return [weights @ dense(block) for block in (blocks if len(values) > 1 else (blocks,))]


array_scenes = pytest.mark.parametrize(
    "scene", tiers(["cartpole_driven", SMOOTH, "kapitza_pendulum"], "cartpole_driven"), ids=name_of
)


@array_scenes
def test_gradients_of_jax_agree_with_symbolic_derivatives(scene: str) -> None:
    package, jax = jax_package(scene)
    symbolic = exported(scene, "casadi")
    (x, u, p), n, h = random_point(symbolic, 2), symbolic.nq, 0.01
    weights, f = np.linspace(0.5, 1.5, 2 * n), symbolic.function()
    acceleration_of = symbolic_acceleration(f, n)
    qdd = package.acceleration(x[:n], x[n:], u, p, 0.3)
    assert largest_error(qdd, dense(f(x, u, p, 0.3)).ravel()[n:]) < 1e-13
    actual = jax.grad(
        lambda x, u, p: weights[:n] @ package.acceleration(x[:n], x[n:], u, p, 0.3), (0, 1, 2)
    )(x, u, p)
    expected = gradients(acceleration_of, weights[:n], x, u, p)
    assert_close(actual, expected)
    step = symbolic_step(symbolic, 3, h)

    def weighted_end(x: Any, u: Any, p: Any) -> Any:
        q, qd = package.step(x[:n], x[n:], u, p, 0.3, h=h, steps=3)
        return weights[:n] @ q + weights[n:] @ qd

    assert_close([weighted_end(x, u, p)], [weights @ dense(step(x, u, p)).ravel()])
    actual = jax.jit(jax.grad(weighted_end, (0, 1, 2)))(x, u, p)
    assert_close(actual, gradients(step, weights, x, u, p))


def symbolic_acceleration(f: Any, n: int) -> Any:
    """Return the accelerations (x, u, p) -> qdd at t = 0.3 s of the function f of CasADi."""
    import casadi

    symbols = [casadi.SX.sym(f.name_in(k), f.size1_in(k)) for k in range(3)]
    return casadi.Function("acceleration", symbols, [f(*symbols, 0.3)[n:]])


def assert_close(actual: Any, expected: Any) -> None:
    for own, reference in zip(actual, expected, strict=True):
        if np.size(reference):
            assert largest_error(np.ravel(own), np.ravel(reference)) < 1e-11


def test_batches_of_jax_agree_with_single_states() -> None:
    package, jax = jax_package("cartpole_driven")
    rng = np.random.default_rng(0)
    q, qd, u = (rng.standard_normal((4, 3, k)) for k in (2, 2, 1))
    p = package.defaults * (1 + 0.1 * rng.random((4, 1, 4)))

    def cost(q: Any, qd: Any, u: Any, p: Any) -> Any:
        q, qd = package.step(q, qd, u, p, h=0.02)
        return (q**2).sum() + (qd * package.acceleration(q, qd, u, p)).sum()

    gradient = jax.grad(cost, (0, 1, 2, 3))
    whole = gradient(q, qd, u, p)
    nested = jax.vmap(jax.vmap(gradient, (0, 0, 0, None)))(q, qd, u, p[:, 0])
    for k in np.ndindex(4, 3):
        single = gradient(q[k], qd[k], u[k], p[k[0], 0])
        for part in range(4):
            assert np.allclose(nested[part][k], single[part], rtol=1e-12, atol=1e-12)
            if part < 3:
                assert np.allclose(whole[part][k], single[part], rtol=1e-12, atol=1e-12)
    assert np.allclose(whole[3][:, 0], nested[3].sum(1), rtol=1e-12)
    q_all, qd_all = package.run(q[0], qd[0], u, h=0.02, steps=5)
    for k in range(3):
        run = package.model.simulate(q[0, k], qd[0, k], 0.02, u=np.repeat(u[:, k], 5, 0), steps=20)
        assert np.allclose(q_all[:, k], run.q[5::5], rtol=1e-12, atol=1e-12)
        assert np.allclose(qd_all[:, k], run.qd[5::5], rtol=1e-12, atol=1e-12)


def test_jax_without_double_precision_returns_rounded_results() -> None:
    package, jax = jax_package("cartpole_driven")
    exact = package.acceleration([0.1, 0.2], [0.3, 0.4], [1.0])
    jax.config.update("jax_enable_x64", False)
    try:
        rounded = package.acceleration([0.1, 0.2], [0.3, 0.4], [1.0])
        gradient = jax.grad(lambda u: package.acceleration([0.1, 0.2], [0.3, 0.4], u)[0])(
            jax.numpy.ones(1)
        )
    finally:
        jax.config.update("jax_enable_x64", True)
    assert rounded.dtype == gradient.dtype == np.float32
    assert largest_error(rounded, exact) < 1e-6


def test_errors_of_jax_name_the_argument_or_the_state() -> None:
    package, jax = jax_package("cartpole_driven")
    with pytest.raises(ValueError, match=r"u: shape \(2,\), expected \(..., 1\)"):
        package.acceleration([0.1, 0.2], [0.3, 0.4], [1.0, 2.0])
    with pytest.raises(Exception, match=r"positive definite|singular"):
        package.acceleration([0.1, 0.2], [0.3, 0.4], [1.0], -package.defaults).block_until_ready()
    with pytest.raises(Exception, match="no step from q = "):
        jax.block_until_ready(package.step([0.1, 0.2], [0.3, 1e200], [1.0]))
    by_time = jax.grad(lambda t: package.acceleration([0.1, 0.2], [0.3, 0.4], [1.0], None, t)[0])
    assert by_time(0.5) == 0.0


@pytest.mark.slow
def test_batches_of_jax_take_the_first_explicit_method() -> None:
    """Scenes without parameters have gradients of size 0 by them."""
    implicit = FALLS.replace("falls", "implicit") + '[run]\nmethod = ["gauss4", "dp8"]\n'
    package, jax = jax_package(implicit)
    assert tuple(package.model.methods) == ("dp8",)
    gradient = jax.grad(lambda p: package.step([1.0], [2.0], p=p)[0][0])(np.zeros(0))
    assert gradient.shape == (0,)


@pytest.mark.slow
def test_time_advances_in_runs_of_jax_and_has_no_derivative() -> None:
    package, jax = jax_package("kapitza_pendulum")
    value, gradient = jax.value_and_grad(
        lambda x: package.acceleration(x[:1], x[1:2], (), None, x[2])[0]
    )(np.array([0.3, 0.1, 0.5]))
    assert np.isfinite(value) and np.isfinite(gradient[:2]).all() and np.isnan(gradient[2])
    run = package.model.simulate([0.3], [0.1], 0.01, steps=12, t0=0.5)
    q, _ = package.run([0.3], [0.1], np.zeros((4, 0)), None, 0.5, h=0.01, steps=3)
    assert np.allclose(q, run.q[3::3], rtol=1e-12)


# --- PyTorch --------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["cartpole_driven", SMOOTH, "kapitza_pendulum"], ids=name_of)
def test_gradients_of_torch_agree_with_symbolic_derivatives(scene: str) -> None:
    package = exported(scene, "torch")
    import torch

    symbolic = exported(scene, "casadi")
    (x, u, p), n, h = random_point(symbolic, 2), symbolic.nq, 0.01
    weights = np.linspace(0.5, 1.5, 2 * n)
    step, f = symbolic_step(symbolic, 3, h), symbolic_acceleration(symbolic.function(), n)
    values = [torch.tensor(v, requires_grad=True) for v in (x, u, p)]
    state, inputs, parameters = values
    qdd = package.acceleration(state[:n], state[n:], inputs, parameters, 0.3)
    assert_close([qdd.detach()], [dense(f(x, u, p))])
    (torch.tensor(weights[:n]) @ qdd).backward()
    assert_close([v.grad for v in values], gradients(f, weights[:n], x, u, p))
    for v in values:
        v.grad = None
    end = torch.cat(package.step(state[:n], state[n:], inputs, parameters, 0.3, h=h, steps=3))
    (torch.tensor(weights) @ end).backward()
    assert_close([end.detach()], [dense(step(x, u, p))])
    assert_close([v.grad for v in values], gradients(step, weights, x, u, p))


@pytest.mark.slow
def test_batches_and_runs_of_torch_agree_with_the_module() -> None:
    package = exported("cartpole_driven", "torch")
    import torch

    generator = torch.Generator().manual_seed(0)
    q, qd, u = (torch.randn(4, 3, k, generator=generator, dtype=torch.double) for k in (2, 2, 1))
    p = (package.defaults * torch.linspace(0.9, 1.1, 4)[:, None, None]).requires_grad_()
    end = package.step(q, qd, u, p, h=0.02)
    (end[0] * end[1]).sum().backward()
    for k in range(4):
        own = p[k, 0].detach().clone().requires_grad_()
        single = package.step(q[k], qd[k], u[k], own, h=0.02)
        (single[0] * single[1]).sum().backward()
        assert torch.allclose(own.grad, p.grad[k, 0], rtol=1e-12)
        assert torch.allclose(single[0], end[0][k], rtol=1e-13)
    states = package.run(q[0], qd[0], u, h=0.02, steps=5)
    for k in range(3):
        inputs = np.repeat(u[:, k].numpy(), 5, 0)
        run = package.model.simulate(q[0, k].numpy(), qd[0, k].numpy(), 0.02, u=inputs, steps=20)
        for own, expected in zip(states, (run.q, run.qd), strict=True):
            assert np.allclose(own[:, k], expected[5::5], rtol=1e-12, atol=1e-12)
    rounded = package.acceleration(q.float(), qd.float(), u.float())
    assert rounded.dtype == torch.float32
    assert torch.allclose(rounded.double(), package.acceleration(q, qd, u), rtol=1e-5, atol=1e-5)
    with pytest.raises(ValueError, match=r"q: shape \(1,\), expected \(..., 2\)"):
        package.acceleration([0.1], [0.2], [0.3])
    with pytest.raises(package.model.MotionError, match="no step from q = "):
        package.step([0.1, 0.2], [0.3, 1e200], [1.0])
    time = torch.tensor(0.5, dtype=torch.double, requires_grad=True)
    package.acceleration(q, qd, u, None, time).sum().backward()
    assert time.grad == 0.0


# --- the page -------------------------------------------------------------------------------------


def run_page(library: str, folder: Path) -> None:
    """Run the commands and the Python of a section of docs/optimisation.md in a folder."""
    page = (ROOT / "docs" / "optimisation.md").read_text(encoding="utf-8")
    section = re.split(r"^## ", page, flags=re.M)
    (text,) = [s for s in section if s.partition("\n")[0] == library]
    commands, program = (re.findall(rf"```{k}\n(.*?)```", text, re.S)[0] for k in ("sh", "python"))
    for command in commands.splitlines():
        result = CliRunner().invoke(main, command.split()[1:], env={"EOMC_CFLAGS": "-O0"})
        assert result.exit_code == 0, result.output
    process = subprocess.run(
        [sys.executable, "-W", "error", "-c", program], cwd=folder, capture_output=True, text=True
    )
    assert (process.returncode, process.stderr) == (0, ""), process.stderr


@pytest.mark.slow
@pytest.mark.parametrize("section", ["CasADi", "JAX", "PyTorch"])
def test_page_about_exports_runs(
    section: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    library = {"PyTorch": "torch"}.get(section, section.lower())
    pytest.importorskip(library, reason=f"no {library}: pip install '.[{library}]'")
    monkeypatch.chdir(tmp_path)
    if section != "CasADi":  # which writes the scene
        shutil.copy(SCENES / "cartpole_driven.toml", tmp_path)
    run_page(section, tmp_path)
