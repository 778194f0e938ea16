"""Names of scenes do not collide with names of temporaries, such as w1."""

from __future__ import annotations

import pytest
from support.session import Modules, tiers

from eomc.model.system import from_scene
from eomc.scene.read import parse
from eomc.verify import convergence
from eomc.verify.check import check

UNUSED = """eomc = 1
name = "called_w"
[coordinates]
x = { start = 0.5 }
[parameters]
m = 2
w1 = 0.125
w2 = 3
[inputs]
f = { signal = "sin(t)*w2" }
[energy]
kinetic = "m*x_dot**2/2"
potential = "-exp(-x**2) + x**2/10"
[forces]
x = "-0.2*x_dot**3 + f"
"""
COORDINATES = """eomc = 1
name = "called_w"
[coordinates]
w2 = { start = 0.5, unit = "rad" }
w5 = { start = 0.2, rate = 0.3 }
k1 = { start = 0.1 }
[parameters]
d_w2 = 2
w1 = 0.5
D_w5 = 1.5
[inputs]
w3 = { signal = "w1*w2" }
[energy]
kinetic = "(d_w2 + cos(w2))*w5_dot**2/2 + (2 + sin(w5))*w2_dot**2/2 + w1*k1_dot**2/2"
potential = "cos(w2) + exp(-w5**2) + k1**2*(1 + sin(w2)**2)/2"
[forces]
w5 = "-0.1*w5_dot + w3"
"""
BATCH = "batch = true"
IMPLICIT = 'method = "gauss4"\nlinearize = "parameters"'


@pytest.mark.slow
@pytest.mark.parametrize(
    "run", tiers([BATCH, "", IMPLICIT], ""), ids=["batch", "plain", "implicit"]
)
@pytest.mark.parametrize(
    "text", tiers([UNUSED, COORDINATES], COORDINATES), ids=["unused", "coordinates"]
)
def test_names_of_scenes_do_not_collide_with_temporaries(
    text: str, run: str, modules: Modules, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A parameter that a function did not read once shared its name with a temporary.

    The temporary then got the value of the parameter.
    """
    monkeypatch.setattr(convergence, "advice_checks", lambda *_: ())
    system = from_scene(parse(f"{text}[run]\nduration = 2\nh = 0.01\n{run}\n"))
    report = check(system, modules.unoptimised(system), states=4)
    assert report.passed, report.table()
