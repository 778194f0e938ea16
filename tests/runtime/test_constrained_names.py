"""Requests for constraints that do not exist: the message lists the existing names."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import eomc
from eomc.model.system import Constraint, Reaction, System
from eomc.runtime.package import model_of

FUNCTIONS = (
    "constraints constraint_rates constraint_jacobian multipliers project tangent reactions"
).split()


def rod(**options: bool) -> System:
    scene_system = System.make(
        "rod_named", {"x": (0.6, 0.0), "y": (-0.8, 0.0)}, "(x_dot**2 + y_dot**2)/2", "9.81*y",
        outputs={"rod": "x**2 + y**2 - 1"}, h=0.01, duration=0.1, **options,
    )  # fmt: skip
    row = Constraint("rod", scene_system.outputs[0].formula)
    pull = Reaction("pull", (row.multiplier, 0 * row.multiplier, 0 * row.multiplier))
    return replace(scene_system, outputs=(), constraints=(row,), reactions=(pull,), plane=True)


@pytest.fixture(scope="module")
def module(unoptimised_file: None, tmp_path_factory: pytest.TempPathFactory) -> ModuleType:
    return eomc.load(rod(linearize=True), tmp_path_factory.mktemp("named"))


def test_unknown_names_are_refused_with_the_known_ones(module: ModuleType) -> None:
    run = module.simulate()
    for mapping, name, known in (
        (run.multipliers, "multipliers", "rod"),
        (run.constraints, "constraints", "rod"),
        (run.reactions, "reactions", "pull"),
        (module.reactions(*module.start), "reactions", "pull"),
    ):
        with pytest.raises(KeyError, match=f"{name}: 'hinge' is not one of {known}"):
            mapping["hinge"]
        assert list(mapping) == [known] and "hinge" not in mapping
        copied = pickle.loads(pickle.dumps(mapping))
        assert type(copied) is dict and copied.keys() == mapping.keys()
    with pytest.raises(KeyError, match="did you mean 'rod'"):
        run.multipliers["Rod"]


def test_tangent_of_many_states_has_a_leading_axis(module: ModuleType) -> None:
    q, qd = np.array([[0.6, -0.8], [0.8, 0.6]]), np.array([[0.8, 0.6], [0.0, 0.0]])
    tangents = module.tangent(q, qd)
    assert tangents.shape == (2, 4, 2)
    for k in range(2):
        np.testing.assert_array_equal(tangents[k], module.tangent(q[k], qd[k]))
    assert module.tangent(q[:0], qd[:0]).shape == (0, 4, 0)
    with pytest.raises(ValueError, match=r"tangent: 2 changes keep .* at state 0, 4 at state 1"):
        module.tangent([[0.6, -0.8], [0.0, 0.0]], np.zeros((2, 2)))


def test_state_with_non_finite_results_is_reported(
    module: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    q, qd = np.array([[0.6, -0.8], [1.7e308, 0.0]]), np.zeros((2, 2))
    for state in (q[1], qd[1]), (q, qd):
        with pytest.raises(module.MotionError, match=r"at q = \[1\.7e\+308 .* slope is not finite"):
            module.tangent(*state)
    q[1] = 0.8, 0.6
    monkeypatch.setattr(
        model_of(module).constraints,
        "multipliers_or_nan",
        lambda *_: np.array([[1.0], [np.inf]]),
    )
    message = r"at q = \[0\.8 0\.6\], qd = \[0\. 0\.\]: the multiplier of rod is not finite there"
    with pytest.raises(module.MotionError, match=message):
        module.multipliers(q, qd)


def test_fixed_must_be_a_list_of_names(module: ModuleType) -> None:
    for fixed in (3, 2.5, True):
        with pytest.raises(ValueError, match="no list of names: x, y, x_dot, y_dot"):
            module.project(*module.start, fixed=fixed)
    for fixed in ("z", ["z"], ["z", "x"], ["x", "z"]):
        with pytest.raises(ValueError, match="fixed: 'z'"):
            module.project(*module.start, fixed=fixed)
    q, _ = module.project([0.6, 1.0], [0.0, 0.0], fixed=(name for name in ["x"]))
    np.testing.assert_allclose(q, [0.6, 0.8], rtol=1e-15)


def test_missing_options_of_a_scene_are_named(quickly_compiled: None, tmp_path: Path) -> None:
    module = eomc.load(replace(rod(), reactions=()), tmp_path)
    with pytest.raises(ValueError, match=r"build it with System\.make\(\.\.\., linearize=True"):
        module.tangent(*module.start)
    with pytest.raises(AttributeError, match=r"reactions: rod_named has no \[\[loop\]\]"):
        module.reactions(*module.start)
    with pytest.raises(KeyError, match="reactions: there is no 'rod': this scene has none"):
        module.simulate().reactions["rod"]


def test_constraint_functions_of_a_scene_without_constraints_are_refused(
    quickly_compiled: None, tmp_path: Path
) -> None:
    free = replace(rod(), constraints=(), reactions=(), plane=False)
    module = eomc.load(free, tmp_path)
    for name in (*FUNCTIONS, "constraint_names", "loops"):
        assert not hasattr(module, name)
        with pytest.raises(AttributeError, match=f"{name}: rod_named has no constraints: give"):
            getattr(module, name)
    with pytest.raises(AttributeError, match="has no attribute 'tangents'"):
        _ = module.tangents
    for attribute in ("multipliers", "constraints", "reactions"):
        assert getattr(module.simulate(), attribute) == {}
