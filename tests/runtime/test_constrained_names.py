"""What is asked of constraints that are not there, or not so: the names that there are."""

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


def rod(**asked: bool) -> System:
    made = System.make(
        "rod_named", {"x": (0.6, 0.0), "y": (-0.8, 0.0)}, "(x_dot**2 + y_dot**2)/2", "9.81*y",
        outputs={"rod": "x**2 + y**2 - 1"}, h=0.01, duration=0.1, **asked,
    )  # fmt: skip
    row = Constraint("rod", made.outputs[0].formula)
    pull = Reaction("pull", (row.multiplier, 0 * row.multiplier, 0 * row.multiplier))
    return replace(made, outputs=(), constraints=(row,), reactions=(pull,), plane=True)


@pytest.fixture(scope="module")
def module(unoptimised_file: None, tmp_path_factory: pytest.TempPathFactory) -> ModuleType:
    return eomc.load(rod(linearize=True), tmp_path_factory.mktemp("named"))


def test_of_unknown_names_those_that_there_are_are_told(module: ModuleType) -> None:
    run = module.simulate()
    for found, name, known in (
        (run.multipliers, "multipliers", "rod"),
        (run.constraints, "constraints", "rod"),
        (run.reactions, "reactions", "pull"),
        (module.reactions(*module.start), "reactions", "pull"),
    ):
        with pytest.raises(KeyError, match=f"{name}: 'hinge' is not one of {known}"):
            found["hinge"]
        assert list(found) == [known] and "hinge" not in found
        again = pickle.loads(pickle.dumps(found))
        assert type(again) is dict and again.keys() == found.keys()
    with pytest.raises(KeyError, match="did you mean 'rod'"):
        run.multipliers["Rod"]


def test_the_tangent_of_many_states_has_a_leading_n(module: ModuleType) -> None:
    q, qd = np.array([[0.6, -0.8], [0.8, 0.6]]), np.array([[0.8, 0.6], [0.0, 0.0]])
    found = module.tangent(q, qd)
    assert found.shape == (2, 4, 2)
    for k in range(2):
        np.testing.assert_array_equal(found[k], module.tangent(q[k], qd[k]))
    assert module.tangent(q[:0], qd[:0]).shape == (0, 4, 0)
    with pytest.raises(ValueError, match=r"tangent: 2 changes keep .* at state 0, 4 at state 1"):
        module.tangent([[0.6, -0.8], [0.0, 0.0]], np.zeros((2, 2)))


def test_where_something_is_not_finite_is_told(
    module: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    q, qd = np.array([[0.6, -0.8], [1.7e308, 0.0]]), np.zeros((2, 2))
    for at in (q[1], qd[1]), (q, qd):
        with pytest.raises(module.MotionError, match=r"at q = \[1\.7e\+308 .* slope is not finite"):
            module.tangent(*at)
    q[1] = 0.8, 0.6
    monkeypatch.setattr(
        model_of(module).constraints,
        "multipliers_or_nan",
        lambda *_: np.array([[1.0], [np.inf]]),
    )
    words = r"at q = \[0\.8 0\.6\], qd = \[0\. 0\.\]: the multiplier of rod is not finite there"
    with pytest.raises(module.MotionError, match=words):
        module.multipliers(q, qd)


def test_what_is_held_is_a_list_of_names(module: ModuleType) -> None:
    for held in (3, 2.5, True):
        with pytest.raises(ValueError, match="no list of names: x, y, x_dot, y_dot"):
            module.project(*module.start, fixed=held)
    for held in ("z", ["z"], ["z", "x"], ["x", "z"]):
        with pytest.raises(ValueError, match="fixed: 'z'"):
            module.project(*module.start, fixed=held)
    q, _ = module.project([0.6, 1.0], [0.0, 0.0], fixed=(name for name in ["x"]))
    np.testing.assert_allclose(q, [0.6, 0.8], rtol=1e-15)


def test_what_a_scene_has_to_ask_for_is_told(quickly_compiled: None, tmp_path: Path) -> None:
    module = eomc.load(replace(rod(), reactions=()), tmp_path)
    with pytest.raises(ValueError, match=r"build it with System\.make\(\.\.\., linearize=True"):
        module.tangent(*module.start)
    with pytest.raises(AttributeError, match=r"reactions: rod_named has no \[\[loop\]\]"):
        module.reactions(*module.start)
    with pytest.raises(KeyError, match="reactions: there is no 'rod': this scene has none"):
        module.simulate().reactions["rod"]


def test_without_constraints_their_functions_say_what_is_missing(
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
    for made in ("multipliers", "constraints", "reactions"):
        assert getattr(module.simulate(), made) == {}
