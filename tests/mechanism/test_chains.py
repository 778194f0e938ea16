"""Random closed chains: guesses are assembled, ranks detected, and forces as in the reference."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from support.session import tiers

from eomc.base.errors import SceneError
from eomc.derive import lagrange
from eomc.mechanism.assembly import assembled
from eomc.model.system import System, from_scene
from eomc.program import program
from eomc.program.ir import evaluate
from eomc.scene.read import parse
from eomc.verify.taylor import TaylorReference

ROUGH = 0.2  # largest deviation of a guess


@dataclass(frozen=True)
class Chain:
    """A chain of bars between two fixed pins; q: angles at which it is closed.

    fixed: which of them are fixed initial values; extra: number of redundant constraints.
    """

    system: System
    q: np.ndarray
    fixed: np.ndarray
    extra: int


def chain(seed: int, rough: float = ROUGH) -> Chain:
    """Return a chain of 4 to 12 bars, including the ground, with random lengths, masses and points.

    Angles are absolute; the end of the last bar is at a random point of the bar. Every third chain
    has a redundant bar between two bars that a parallelogram makes parallel.
    """
    random = np.random.default_rng(seed)
    bars = int(random.integers(4, 13))
    n = bars - 1
    length, mass = random.uniform(0.3, 1.5, n), random.uniform(0.2, 3.0, n)
    q = random.uniform(-np.pi, np.pi, n)
    ends = length.copy()
    ends[-1] *= random.uniform(0.4, 1.0)  # the last bar is pinned there
    pin = np.array([ends @ np.cos(q), ends @ np.sin(q)])
    fixed = np.zeros(n, dtype=bool)
    fixed[random.permutation(n)[: n - 2]] = True
    off = np.where(fixed, 0, random.uniform(-rough, rough, n))
    guess = q * (1 + off)
    x = " + ".join(f"{ends[k]!r}*cos(q{k})" for k in range(n))
    y = " + ".join(f"{ends[k]!r}*sin(q{k})" for k in range(n))
    rows = [f'x = "{x} - ({pin[0]!r})"', f'y = "{y} - ({pin[1]!r})"']
    extra = 0
    if seed % 3 == 0:  # a redundant bar between two points
        factors = random.uniform(-2, 2, 2)
        rows.append(f'again = "{factors[0]!r}*({x} - ({pin[0]!r})) + sin({y} - ({pin[1]!r}))"')
        extra = 1
    kinetic, potential = [], []
    for k in range(n):
        cx = " + ".join(
            [*(f"{length[j]!r}*cos(q{j})" for j in range(k)), f"{length[k] / 2!r}*cos(q{k})"]
        )
        cy = cx.replace("cos", "sin")
        kinetic.append(
            f"{mass[k]!r}*(dot({cx})**2 + dot({cy})**2)/2"
            f" + {mass[k] * length[k] ** 2 / 12!r}*q{k}_dot**2/2"
        )
        potential.append(f"{mass[k] * 9.81!r}*({cy})")
    starts = "\n".join(
        f"q{k} = {{ start = {float(guess[k])!r}, guess = {str(not fixed[k]).lower()} }}"
        for k in range(n)
    )
    text = f"""
eomc = 1
name = "chain_{seed}"
[coordinates]
{starts}
[constraints]
{chr(10).join(rows)}
[energy]
kinetic = "{" + ".join(kinetic)}"
potential = "{" + ".join(potential)}"
[run]
duration = 1.0
"""
    return Chain(from_scene(parse(text.replace("np.float64", ""), "chain.toml")), q, fixed, extra)


COUNT = 200
GROUPS = range(0, COUNT, 10)


def assembled_system(chain_case: Chain) -> System | None:
    """Assemble the chain from its guess; return None if it is refused."""
    try:
        return assembled(chain_case.system)
    except SceneError:
        return None


@pytest.mark.slow
@pytest.mark.parametrize("first", GROUPS)
def test_guesses_within_a_fifth_are_assembled(first: int) -> None:
    """95 of 100 are assembled with a report of the moves; fixed angles are unchanged."""
    count = 0
    for seed in range(first, first + 10):
        chain_case = chain(seed)
        system = assembled_system(chain_case)
        if system is None:
            continue
        count += 1
        q = np.array([c.start for c in system.coordinates])
        np.testing.assert_array_equal(q[chain_case.fixed], chain_case.q[chain_case.fixed])
        closure = system.closure
        assert closure is not None
        assert (closure.rank, len(closure.redundant)) == (2, chain_case.extra)
        assert closure.freedoms == len(chain_case.q) - 2
        guess = np.array([c.start for c in chain_case.system.coordinates])
        assert {m.name for m in closure.moves} == {f"q{k}" for k in np.flatnonzero(q != guess)}
    assert count >= 9


@pytest.mark.parametrize("seed", tiers(range(0, COUNT, 8), 48))
def test_accelerations_and_multipliers_agree_with_reference(seed: int) -> None:
    system = assembled_system(chain(seed))
    if system is None:
        pytest.skip("refused")
    functions, reference = program.build(lagrange.derive(system)), TaylorReference(system)
    q, qd = np.array([(c.start, c.rate) for c in system.coordinates]).T
    values = dict(zip((x.name for x in (*system.q, *system.qd)), (*q, *qd), strict=True))
    a, _ = evaluate(functions["acceleration"], values | {"t": 0.0})
    multipliers, _ = evaluate(functions["multipliers"], values | {"t": 0.0})
    for result, expected in (
        (a, reference.acceleration(q, qd)), (multipliers, reference.multipliers(q, qd)),
    ):  # fmt: skip
        size = float(np.max(np.abs(expected)))
        np.testing.assert_allclose(result, expected, rtol=0, atol=1e-10 * size)
