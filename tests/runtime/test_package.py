"""The compiled module as a package: its metadata, and its independence of other modules."""

from __future__ import annotations

import contextlib
import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.builds import CHANGED, TEXT
from support.cases import SCENES
from support.session import MODULES, Modules

import eomc
from eomc.model.system import System, symbol, t


def test_module_describes_its_scene(cartpole: ModuleType, driven: ModuleType) -> None:
    assert cartpole.coordinates == ("x", "theta")
    assert cartpole.parameters == ("m_c", "m_p", "l", "g")
    assert cartpole.inputs == ()
    assert driven.inputs == ("force",)
    assert (cartpole.nq, cartpole.nu) == (2, 0) and (driven.nq, driven.nu) == (2, 1)
    assert {"nq", "nu"} <= {*cartpole.__all__}
    assert cartpole.defaults == {"m_c": 2.0, "m_p": 2.0, "l": 2.0, "g": 9.8}
    assert cartpole.units["theta"] == "rad"
    assert driven.units["force"] == "N"
    assert cartpole.title == "Cart-pole"
    assert "m_c = 2.0: kg, mass of the cart" in cartpole.__doc__
    assert set(cartpole.__all__) >= {"D", "C", "g", "bias", "acceleration", "step", "simulate"}


def test_start_is_that_of_the_scene_after_any_assignment(cartpole: ModuleType) -> None:
    q, qd = cartpole.start
    assert q.tolist() == [0, math.pi / 2]
    assert qd.tolist() == [0, 0]
    with contextlib.suppress(ValueError):  # it may be read-only
        q[0] = 7
    try:
        assert cartpole.start[0].tolist() == [0, math.pi / 2]
        assert cartpole.simulate(steps=0).q.tolist() == [[0, math.pi / 2]]
    finally:
        if q.flags.writeable:
            q[0] = 0


def test_params_have_the_names_of_the_scene(cartpole: ModuleType) -> None:
    p = cartpole.Params(m_c=3.0)
    assert p.m_c == 3.0
    assert p.m_p == 2.0
    p.m_p = 5
    assert repr(p) == "Params(m_c=3, m_p=5, l=2, g=9.8)"
    assert list(p) == list(cartpole.parameters)
    with pytest.raises(ValueError, match=r"params: 'mass' is not one of m_c, m_p, l, g"):
        p.mass = 1.0
    with pytest.raises(ValueError, match=r"params: m_c: nan is not a finite number"):
        p.m_c = math.nan


def test_parameter_can_have_any_name_that_a_scene_allows(everything: ModuleType) -> None:
    """`values`, `h`, `I`: in Params too they mean the scene's parameters."""
    p = everything.Params()
    assert {n: getattr(p, n) for n in everything.parameters} == everything.defaults
    for name in everything.parameters:
        params = everything.Params(**{name: 2.5})
        assert getattr(params, name) == 2.5, name


def test_modules_are_independent_of_each_other(
    cartpole: ModuleType, driven: ModuleType, modules: Modules
) -> None:
    """Each has its own names, sizes and numbers; loading a scene again returns the same module."""
    spring = modules("mass_spring")
    assert [m.D(np.zeros(len(m.coordinates))).shape for m in (cartpole, spring)] == [(2, 2), (1, 1)]
    assert spring.simulate(h=0.01, duration=1).q[-1] == pytest.approx(math.cos(1), abs=1e-9)
    assert eomc.load(SCENES / "cartpole.toml", MODULES) is cartpole
    assert driven.Params is not cartpole.Params


@pytest.mark.usefixtures("quickly_compiled", "existing_build")
def test_changed_scene_is_a_new_module_in_the_same_process(scene: Path, root: Path) -> None:
    """The old module still works."""
    old = eomc.load(scene, root)
    scene.write_text(CHANGED, encoding="utf-8")
    new = eomc.load(scene, root)
    assert new.g([1.0]) == 2 * old.g([1.0])
    assert new.simulate(steps=10).q[-1] != old.simulate(steps=10).q[-1]
    scene.write_text(TEXT, encoding="utf-8")
    assert eomc.load(scene, root).g([1.0]) == old.g([1.0])


def test_package_depends_only_on_numpy_and_cffi(tmp_path: Path) -> None:
    """PYTHONPATH=build, `import cartpole`; neither the generator nor SymPy is importable."""
    folder = eomc.build(SCENES / "cartpole.toml", MODULES).folder
    code = """
import importlib.abc, sys
class Refuse(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("eomc", "sympy", "jinja2", "click", "rich"):
            raise ImportError(f"{name} is not for a compiled scene")
sys.meta_path.insert(0, Refuse())
import cartpole
assert cartpole.simulate().status == "ok"
assert cartpole.__name__ == "cartpole"
strange = {m.split(".")[0] for m in sys.modules} & {"eomc", "sympy", "scipy"}
assert not strange, strange
print(cartpole.__file__)
"""
    process = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True, text=True, cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(folder.parent)},
    )  # fmt: skip
    assert process.returncode == 0, process.stderr
    assert Path(process.stdout.strip()).parent == folder


@pytest.fixture(scope="module")
def minimal_module(modules: Modules) -> ModuleType:
    """A module of a System without any option."""
    return modules.unoptimised(System.make("made", {"x": 1}, "x_dot**2/2", "x**2/2"))


@pytest.mark.parametrize(
    ("call", "argument"),
    [
        (lambda m: m.linearize([0], [0]), "linearize=True"),
        (lambda m: m.discretize([0], [0]), "discretize=True"),
        (lambda m: m.sensitivity([0], [0]), 'linearize="parameters"'),
        (lambda m: m.simulate(method="euler"), "methods="),
        (lambda m: m.simulate(tol=1e-6), "tolerance=1e-9"),
        (lambda m: m.output([0], [0]), "outputs="),
        (lambda m: m.simulate_batch([[0]]), "batch=True"),
        (lambda m: m.inverse_dynamics([0], [0], [0]), "inverse_dynamics=True"),
        (lambda m: m.constraints([0]), "constraints="),
        (lambda m: m.momentum([0], [0]), "which System.make has not"),
        (lambda m: m.pose([0], "tip"), "which System.make has not"),
    ],
)
def test_missing_option_of_a_system_is_named_as_argument_of_make(
    minimal_module: ModuleType, call: Callable[[ModuleType], Any], argument: str
) -> None:
    with pytest.raises((ValueError, AttributeError)) as error:
        call(minimal_module)
    assert argument in str(error.value)
    assert "System.make" in str(error.value)


def test_missing_option_of_a_scene_is_named_as_key_of_run(cartpole: ModuleType) -> None:
    for call in (cartpole.linearize, cartpole.discretize):
        with pytest.raises(ValueError, match=r"\[run\] (linearize|discretize) = true") as error:
            call([0, 0], [0, 0])
        assert "System.make" not in str(error.value)


def test_system_can_be_built_with_inverse_dynamics(modules: Modules) -> None:
    system = System.make(
        "inverse", {"x": 1}, "m*x_dot**2/2", "x**2/2", parameters={"m": 2}, inverse_dynamics=True
    )
    tau = modules.unoptimised(system).inverse_dynamics([0.5], [0.0], [3.0])
    assert tau == pytest.approx([6.5])


def test_module_from_sympy_expressions() -> None:
    """A time-dependent kinetic energy and an input have the same compiled interface."""
    x, v, m, u = symbol("x"), symbol("x_dot"), symbol("m"), symbol("u")
    system = System.make(
        "rocket", {x: (0.0, 1.0)}, m * (2 - t) * v**2 / 2, parameters={m: 3}, inputs={u: t},
        forces={x: u}, h=0.1, duration=1,
    )  # fmt: skip
    rocket = eomc.load(system, MODULES)
    assert rocket.D([0.0], t=0.5) == pytest.approx(4.5)
    # d/dt (m (2 - t) v) = t: m (2 - t) v = 6 + t^2/2
    run = rocket.simulate(h=0.001, duration=1)
    assert run.qd[-1, 0] == pytest.approx(6.5 / 3, abs=1e-12)
