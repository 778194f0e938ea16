"""Two-point RK4: an acceleration in two parts, one of them for two configurations at once."""

from __future__ import annotations

import subprocess
import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import ModuleType

import mpmath
import numpy as np
import pytest
from support.cases import FMA, SCENES, fast_kit, scene_system
from support.compilation import compiled
from support.session import Modules, needs, tiers
from sympy import S

import eomc
from eomc.derive import lagrange
from eomc.derive.tape import Stage
from eomc.emit.common.c_expression import DOUBLE
from eomc.emit.common.c_names import Target
from eomc.emit.optimised.lanes import Accelerations
from eomc.model import system
from eomc.program import program, two_point
from eomc.program.ir import Assignment, Operand, Product, Sum
from eomc.scene import read as scene
from eomc.toolchain.files import write_files
from eomc.verify import symbolic

# angles as coordinates, as sums, with a number, with a parameter and times a coordinate; a
# coordinate that is no angle; time, feedback and friction
ODD = """
eomc = 1
name = "odd"
[coordinates]
x = { start = 0.3, rate = 0.2 }
a = { start = 0.4, rate = -1.0 }
b = { start = -0.7, rate = 0.6 }
c = { start = 1.1 }
d = { start = 2.0, rate = 0.4 }
e = { start = -0.2 }
[parameters]
phase = 0.3
m = 1.2
[inputs]
u = { signal = "0.3*sin(2*t) - 0.1*a_dot + 0.05*c - m*x/20" }
w = { signal = "0.1*cos(t)" }
[definitions]
K1 = "m*x_dot**2*(2 + x**2/10)/2 + a_dot**2 + b_dot**2 + c_dot**2 + d_dot**2 + 2*e_dot**2"
K2 = "a_dot*b_dot*cos(a - b)/3 + b_dot*c_dot*sin(b + 1/2)/4 + x_dot*c_dot*cos(c + phase)/5"
P = "cos(2*a) + sin(b + 1/2) + cos(c + phase)/2"
K3 = "c_dot*d_dot*cos(c - d)/3 + d_dot*e_dot*cos(2*e)/4 + t*x_dot/9"
[energy]
kinetic = "K1 + K2 + K3"
potential = "P + sin(a*b)/4 + x**2*(1 + cos(3*t)/5) + cos(d)"
[forces]
a = "u"
e = "w - 0.1*e_dot*abs(e_dot)"
x = "-x_dot*u/10"
[run]
h = 0.01
"""


# without inertia about f where a is 0
POLES = """
eomc = 1
name = "poles"
[coordinates]
a = { start = 0.0 }
b = { start = 0.7 }
c = { start = 0.9 }
d = { start = 1.1 }
e = { start = 1.3 }
f = { start = 0.0, rate = 1.0 }
[energy]
kinetic = "a_dot**2 + b_dot**2 + c_dot**2 + d_dot**2 + e_dot**2 + sin(a)**2*f_dot**2 + K"
potential = "cos(b) + cos(c) + cos(d) + cos(e)"
[definitions]
K = "b_dot*c_dot*cos(b - c)/2 + c_dot*d_dot*cos(c - d)/2 + d_dot*e_dot*cos(d - e)/2"
"""


# a rope of six bars between two hooks
ROPE = """
eomc = 1
name = "rope"
[coordinates]
a = { start = 0.9, rate = 0.5 }
b = { start = 0.6 }
c = { start = 0.2 }
d = { start = -0.3, rate = 1.0 }
e = { start = -0.7, guess = true }
f = { start = -0.9, guess = true }
[definitions]
x = "cos(a) + cos(b) + cos(c) + cos(d) + cos(e) + cos(f)"
y = "sin(a) + sin(b) + sin(c) + sin(d) + sin(e) + sin(f)"
K = "a_dot**2 + b_dot**2 + c_dot**2 + d_dot**2 + e_dot**2 + f_dot**2"
[energy]
kinetic = "K + a_dot*b_dot*cos(a - b)/2 + d_dot*e_dot*cos(d - e)/3"
potential = "5*sin(a) + 4*sin(b) + 3*sin(c) + 2*sin(d) + sin(e)"
[constraints]
along = "x - 4.7"
across = "y + 0.2"
[run]
h = 0.005
duration = 1.0
method = ["rk4", "gauss16"]
"""


@cache
def scene_with_odd_angles() -> system.System:
    return system.from_scene(scene.parse(ODD, "odd.toml"))


@cache
def target_of_odd_angles() -> Target:
    return Target(program.build(lagrange.derive(scene_with_odd_angles())), DOUBLE)


def chain(links: int) -> str:
    """Write point masses on links with absolute angles, released at rest."""
    numbers = range(1, links + 1)
    angles = "".join(f"a{k} = {{ start = {0.3 + 0.1 * k:.1f} }}\n" for k in numbers)
    places = 'x0 = "0"\ny0 = "0"\n'
    for k in numbers:
        places += f'x{k} = "x{k - 1} + l*sin(a{k})"\ny{k} = "y{k - 1} - l*cos(a{k})"\n'
    kinetic = " + ".join(f"dot(x{k})**2 + dot(y{k})**2" for k in numbers)
    height = " + ".join(f"y{k}" for k in numbers)
    return (
        f'eomc = 1\nname = "links{links}"\n[coordinates]\n{angles}'
        f"[parameters]\nm = 1.0\nl = 1.0\ng = 9.81\n[definitions]\n{places}"
        f'[energy]\nkinetic = "m*({kinetic})/2"\npotential = "m*g*({height})"\n'
    )


def with_run(text: str, name: str, run: str) -> str:
    """Return the scene under its own name, with these options under [run]."""
    head = text.partition("[run]")[0].replace('name = "', f'name = "{name}')
    return f"{head}[run]\n{run}\n"


def batch_and_order_8(text: str) -> str:
    """Return the scene with batches, and with a method of order 8."""
    return with_run(text, "many_", 'batch = true\nmethod = ["rk4", "dp8"]')


def test_two_parts_compute_the_whole_acceleration() -> None:
    """The first part depends on neither time, inputs nor velocities."""
    accelerations = Accelerations(target_of_odd_angles())
    function, parts = accelerations.function, accelerations.parts
    assert parts is not None and len(accelerations.angles) >= two_point.MIN_ANGLES
    sines = {name for a in accelerations.angles for name in (a.sine, a.cosine)}
    first_part = {"phase", "m", *(a.name for a in function.early)}
    assert parts.configuration.uses <= {"x", "a", "b", "c", "d", "e"} | sines | first_part
    place = {"x", "a", "b", "c", "d", "e"} | sines | {a.name for a in parts.configuration.body}
    for a in parts.velocity.body:
        assert not place.issuperset(set(a.value.names) - first_part)
        if isinstance(a.value, Product):  # one factor of the position-dependent terms
            known = [name for name in a.value.factors if name in place | first_part]
            assert len(known) <= 1 or place.isdisjoint(known)
            assert abs(a.value.coefficient) == 1 or place.isdisjoint(known)
    assert {o.name for o in parts.configuration.outputs} == set(parts.handed)
    assert set(parts.handed) <= parts.velocity.uses
    assert len(parts.configuration.checks) + len(parts.velocity.checks) <= len(function.checks)


def test_products_are_sorted_by_latency() -> None:
    """Of two products the later one comes first, where it is fused with the sum."""
    u, v, late, last = ((S.One, name) for name in ("u", "v", "late", "last"))
    values = {
        "late": Product(S.One, ("u", "v")),
        "last": Sum((late, v)),
        "sum": Sum((last, u, late)),
        "soon": Product(S.One, ("u", "u")),
        "then": Product(S.One, ("last", "v")),
        "both": Sum(((S.One, "soon"), (S.NegativeOne, "then"))),
    }
    function = target_of_odd_angles().program["acceleration"]
    body = tuple(Assignment(name, value, Stage.VELOCITY) for name, value in values.items())
    outputs = (Operand(S.One, "sum"), Operand(S.One, "both"))
    sorted_function = two_point._sort_by_latency(replace(function, body=body, outputs=outputs))
    values_by_name = {a.name: a.value for a in sorted_function.body}
    assert values_by_name["sum"] == Sum((u, late, last))
    assert values_by_name["both"] == Sum(((S.NegativeOne, "then"), (S.One, "soon")))


MORE = """
eomc = 1
name = "more"
[coordinates]
a = { start = 0.3, rate = 0.7 }
b = { start = -0.4, rate = 0.2 }
c = { start = 1.2 }
d = { start = 0.9, rate = -0.6 }
e = { start = -1.3 }
[energy]
kinetic = "a_dot**2 + b_dot**2*(2 + cos(a)) + c_dot**2*(2 + cos(b)) + d_dot**2 + e_dot**2*L"
potential = "cos(a) + cos(b) + cos(c) + cos(d) + cos(e) + sin(a + b)"
[definitions]
L = "2 + cos(d)*sin(c)/2 + tanh(b)/9 + max(a, b)/20"
[run]
h = 0.01
"""


@pytest.mark.slow
def test_more_angles_than_coordinates_are_accepted(modules: Modules) -> None:
    """Every coordinate is an angle, and a sum of two is a further one."""
    module = modules.of_text(MORE)
    trusted = symbolic.reference_for(system.from_scene(scene.parse(MORE, "more.toml")))
    _, q, qd = trusted.simulate(h=0.01, steps=50)
    run = module.simulate(h=0.01, steps=50)
    np.testing.assert_allclose(run.q, q, rtol=1e-11)
    np.testing.assert_allclose(run.qd, qd, rtol=1e-10, atol=1e-11)


def source_of(module: ModuleType, end: str) -> str:
    """Return the optimised form of a module, from NAME.h or NAME.c."""
    (file,) = (Path(str(module.__file__)).parent / "fast").glob(f"*.{end}")
    return file.read_text(encoding="utf-8")


@pytest.mark.slow
def test_scenes_with_few_angles_are_not_split(modules: Modules) -> None:
    for name in ("cartpole", "double_pendulum", "tumbling_box", "suspension"):
        assert "_configuration;" not in source_of(modules.unoptimised(scene_system(name)), "c")
    assert "} chain_configuration;" in source_of(modules.unoptimised(scene_system("chain")), "c")


@pytest.mark.parametrize("h", tiers((0.001, 0.02, 0.2, 0.45), 0.45))
def test_short_and_long_steps_agree_with_reference(h: float, modules: Modules) -> None:
    """Rotations by a small angle, by nearly the limit, and by more, which needs new sines."""
    built = modules.unoptimised if h == 0.45 else modules.of_text  # optimised in the slow tier
    module, trusted = built(ODD), symbolic.derive(scene_with_odd_angles())
    for u in (None, [0.2, -0.1]):
        run = module.simulate(h=h, steps=12, u=u)
        _, q, qd = trusted.simulate(h=h, steps=12, u=u)
        scale = np.abs(qd).max() + 1
        np.testing.assert_allclose(run.q, q, rtol=1e-11, atol=1e-12 * scale)
        np.testing.assert_allclose(run.qd, qd, rtol=1e-11, atol=1e-12 * scale)


@pytest.mark.slow
@pytest.mark.parametrize("links", (5, 8))
def test_chains_by_link_multipliers_agree_with_reference(links: int, modules: Modules) -> None:
    module = modules.of_text(chain(links))
    links_system = system.from_scene(scene.parse(chain(links), "links.toml"))
    trusted = symbolic.reference_for(links_system)
    _, q, qd = trusted.simulate(h=0.002, steps=50)
    run = module.simulate(h=0.002, steps=50)
    np.testing.assert_allclose(run.q, q, rtol=1e-11)
    np.testing.assert_allclose(run.qd, qd, rtol=1e-10, atol=1e-11)


@pytest.mark.slow
def test_large_angle_is_passed_to_libm(modules: Modules) -> None:
    """Reduction by pi/2 in parts has no correct digit left there."""
    module = modules.unoptimised(chain(5))
    trusted = symbolic.reference_for(system.from_scene(scene.parse(chain(5), "links.toml")))
    q = np.array([3e15, -2e12, 1e9, 7e22, 0.5])
    qd = np.linspace(-1, 1, 5)
    expected = trusted.acceleration(q, qd)
    np.testing.assert_allclose(module.acceleration(q, qd), expected, rtol=1e-12, atol=1e-12)


def test_large_angle_does_not_affect_others_in_its_register(modules: Modules) -> None:
    """The angles are sums of coordinates, which are exact here."""
    module = modules.unoptimised((SCENES / "chain.toml").read_text(encoding="utf-8"))
    for at in range(5):
        q = np.arange(5, 10) / 16
        q[at] = 2.0**34
        sines = np.sin(np.cumsum(q))
        height = 0.5 * (np.arange(4.5, 0, -1) @ sines)
        np.testing.assert_allclose(module.potential_energy(q), 9.81 * height, rtol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("index", tiers([0, 4], 4))
def test_steps_at_an_angle_too_large_to_change(index: int, modules: Modules) -> None:
    """At 7e22 rad the spacing of doubles is 8e6; the other links swing about that link."""
    module = modules.unoptimised(chain(5))
    trusted = symbolic.reference_for(system.from_scene(scene.parse(chain(5), "links.toml")))
    start, rates = module.start
    start[index] = 7e22
    _, q, _ = trusted.simulate(start, rates, h=0.01, steps=20)
    run = module.simulate(start, rates, h=0.01, steps=20)
    assert (run.q[:, index] == 7e22).all()
    # a rotation by h^2 a inside a step is below the spacing; a wrong sine gives an error of 0.1
    np.testing.assert_allclose(run.q, q, rtol=0, atol=1e-4)


def test_failures_return_the_last_good_state(modules: Modules) -> None:
    """A singular D, by parameters or at a position, and a state that is not finite."""
    module = modules.unoptimised(chain(5))
    q, qd = module.start
    with warnings.catch_warnings(action="ignore"):
        singular = module.simulate(h=0.01, steps=3, params={"m": 0.0})
        fast = module.simulate(q, qd + 1e160, h=0.5, steps=20)
        poles = modules.unoptimised(POLES).simulate(h=0.01, steps=3)
    statuses = singular.status, poles.status, fast.status
    assert statuses == ("singular", "singular", "not finite")
    for run in (singular, poles, fast):
        assert len(run.q) == 1
        assert np.isfinite(run.q).all()


@pytest.mark.slow
@pytest.mark.parametrize("text", [ODD, chain(6)], ids=["odd", "chain"])
def test_batches_and_other_steppers_agree(text: str, modules: Modules) -> None:
    """They share the same two parts."""
    module = modules.of_text(batch_and_order_8(text))
    q, qd = module.start
    starts = q + 0.02 * np.arange(40)[:, None] * np.linspace(-1, 1, len(q))
    moving = np.tile(qd, (40, 1))
    for h in (0.01, 0.05):
        batch = module.simulate_batch(starts, moving, h, steps=20)
        assert set(batch.status) == {"ok"}
        for k in (0, 17, 39):
            alone = module.simulate(starts[k], qd, h=h, steps=20)
            np.testing.assert_allclose(batch.q[k, -1], alone.q[-1], rtol=1e-10, atol=1e-11)
    stiff = with_run(text, "stiff_", 'method = ["rk4", "gauss8", "gauss16"]')
    implicit = modules.of_text(stiff)
    expected = module.simulate(h=0.005, steps=100, method="dp8").x[-1]
    for method in ("gauss8", "gauss16"):
        run = implicit.simulate(h=0.005, steps=100, method=method)
        np.testing.assert_allclose(run.x[-1], expected, rtol=1e-9, atol=1e-10)


def test_steps_use_two_points_and_predict_no_angles(modules: Modules) -> None:
    header, source = (source_of(modules.unoptimised(chain(5)), end) for end in "hc")
    assert "predicted" not in header and "predicted" not in source
    # stages 0 and 2, each for two points: in the step and in the separate accelerations
    assert source.count("links5_both_configurations(&w->k, at, next") == 1
    assert source.count("links5_both_configurations(&k, q, q, s, s") == 1


@pytest.mark.slow
def test_steps_with_constraints_use_two_points(modules: Modules) -> None:
    """The stages of gauss16 are computed one by one."""
    module = modules.unoptimised(ROPE)
    assert "rope_both_configurations(&w->k, at, next" in source_of(module, "c")
    run, other = (module.simulate(h=0.002, method=name) for name in ("rk4", "gauss16"))
    assert run.status == "ok"
    np.testing.assert_allclose(run.x[-1], other.x[-1], rtol=0, atol=1e-8)
    assert np.abs(module.constraints(run.q[-1], run.qd[-1])).max() < 1e-14


@pytest.mark.slow
def test_sums_are_compensated_in_two_point_form(modules: Modules) -> None:
    """Compare 130,000 short steps, whose only error is rounding, with 256 steps of order 8.

    Both then err by some units of rounding, 2^-53 of numbers near 1, which the motion multiplies by
    five or ten in a second. With plain sums the error is some hundreds of units, the root of the
    number of steps.
    """
    module = modules.of_text(batch_and_order_8(chain(6)))
    short = module.simulate(h=2.0**-17, steps=2**17, every=2**17)
    few = module.simulate(h=2.0**-8, steps=2**8, method="dp8")
    assert np.abs(short.x[-1] - few.x[-1]).max() < 60 * 2.0**-53


@pytest.mark.slow
def test_weights_sum_to_one_in_two_point_form(modules: Modules) -> None:
    """A step of an oscillator beside five angles is a linear map, whose power is the reference.

    In 326 turns a relative error of h/6, 2^-54, causes an error of 1e-13.
    """
    text = MORE.replace('"more"', '"beside"').replace("[energy]", "x = { start = 1.0 }\n[energy]")
    text = text.replace('kinetic = "', 'kinetic = "x_dot**2/2 + ')
    module = modules.of_text(text.replace('potential = "', 'potential = "2*x**2 + '))
    steps = 2**20
    with mpmath.workdps(50):
        z = mpmath.matrix([[0, 1], [-4, 0]]) / 1024
        step = mpmath.eye(2) + z + z**2 / 2 + z**3 / 6 + z**4 / 24
        exact = step**steps * mpmath.matrix([1, 0])
        run = module.simulate(h=1 / 1024, steps=steps, every=steps)
        result = run.q[-1, -1], run.qd[-1, -1]
        error = max(abs(mpmath.mpf(float(x)) - y) for x, y in zip(result, exact, strict=True))
    assert error < (1e-14 if FMA else 2e-13)  # the error of h/6


DIRT = """#include "dirt_odd.h"
#include <string.h>
static double q[DIRT_ODD_NQ], qd[DIRT_ODD_NQ];
static void dirt(void)
{
    volatile unsigned char stack[65536];

    memset((void *)stack, 0xff, sizeof stack);
    memcpy(q, dirt_odd_q0, sizeof q);
    memcpy(qd, dirt_odd_qd0, sizeof qd);
}
#define TRY(name) \\
    dirt(); \\
    options.method = DIRT_ODD_METHOD_##name; \\
    output.steps = 0; \\
    ended |= dirt_odd_integrate(q, qd, 0, &dirt_odd_defaults, &options, &output) != DIRT_ODD_OK; \\
    ended |= output.steps != 9
int main(void)
{
    dirt_odd_options options = { .h = 0.005, .steps = 9 };
    dirt_odd_output output = { 0 };
    int ended = 0;

    TRY(RK4);
    TRY(DP8);
    TRY(GAUSS8);
    TRY(GAUSS16);
    return ended;
}
"""


def test_steps_read_no_uninitialised_values(tmp_path: Path) -> None:
    """Vectors are as long as registers; gauss8 once left the padding uninitialised."""
    needs("gcc")
    run = 'method = ["rk4", "dp8", "gauss8", "gauss16"]'
    dirty_system = system.from_scene(scene.parse(with_run(ODD, "dirt_", run), "dirt_odd.toml"))
    write_files({**fast_kit(eomc.sources(dirty_system)), "dirt.c": DIRT}, tmp_path)
    command = "gcc -std=gnu99 -O0 -march=native dirt.c dirt_odd.c -lm -o dirt"
    compiled(*command.split(), cwd=tmp_path)
    assert subprocess.run([tmp_path / "dirt"]).returncode == 0
