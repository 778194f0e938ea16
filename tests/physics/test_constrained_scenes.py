"""Shipped scenes with constraints against reference states of the same systems."""

import json
from collections.abc import Callable

import numpy as np
import pytest
from support.cases import SCENES
from support.session import tiers

import eomc

CASES = {
    case["name"]: case
    for case in json.loads((SCENES.parent / "tests/data/constrained.json").read_text())["cases"]
}


def crank(q: np.ndarray) -> np.ndarray:
    """Return the three angles and three positions of the case from the scene's two angles and
    position.
    """
    phi, psi, s = q
    return np.array([phi, phi + psi, s])


# Scene, case, the case's quantities that the scene has, and h; errors are those of the case's RK4.
SHIPPED: list[tuple[str, str, Callable, list[int], float]] = [
    ("pendulum_xy", "pendulum_over_the_top", np.asarray, [0, 1], 0.005),
    ("slider_crank", "slider_crank_bodies", crank, [2, 5, 6], 0.005),
    ("andrews_squeezer", "andrews_squeezer_forces", np.asarray, [*range(7)], 5e-5),
    ("bricard", "bricard_cube", np.asarray, [*range(5)], 0.01),
]


@pytest.mark.parametrize(("name", "case", "of", "which", "h"), tiers(SHIPPED, "pendulum_xy"))
def test_runs_end_at_the_reference_state(name, case, of, which, h, modules):
    module = modules.unoptimised(eomc.read(SCENES / f"{name}.toml"))
    known = CASES[case]
    start = np.array([float(x) for x in known["q0"]])[which]
    assert np.allclose(of(np.array(module.start[0])), start, atol=1e-12)
    run = module.simulate(h=h, duration=float(known["t_end"]))
    end = np.array([float(x) for x in known["q_ref"]])[which]
    (measured,) = [m["projected"] for m in known["rk4_measured"] if m["h"] == h]
    error = np.abs(of(run.q[-1]) - end).max() / max(1.0, np.abs(end).max())
    others = of is crank  # other coordinates have other discretization errors
    assert error <= (2 if others else 1.5) * measured["err_q"]


@pytest.mark.slow
def test_reaction_of_a_planar_pin_equals_its_multipliers(modules):
    module = modules.unoptimised(eomc.read(SCENES / "slider_crank.toml"))
    run = module.simulate(duration=0.5)
    assert run.reactions["pin"].shape == (len(run.t), 3)
    rows = np.array([run.multipliers["pin_x"], run.multipliers["pin_y"]]).T
    assert np.allclose(run.reactions["pin"][:, :2], rows, rtol=1e-14)
    assert not run.reactions["pin"][:, 2].any()
    # The force of the pin on the slider is the slider's mass times its acceleration along the
    # slide.
    a = np.array([module.acceleration(q, v) for q, v in zip(run.q, run.qd, strict=True)])
    assert np.allclose(run.reactions["pin"][:, 0], 2.0 * a[:, 2], rtol=1e-9, atol=1e-9)
