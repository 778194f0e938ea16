"""Random closed chains: guesses are assembled, ranks found, forces as the reference has them."""

from __future__ import annotations

import numpy as np
import pytest
from chains import Chain, chain
from conftest import tiers

from eomc.base.errors import SceneError
from eomc.derive import lagrange
from eomc.model.system import System
from eomc.program import program
from eomc.program.assembly import assembled
from eomc.program.interpret import evaluate
from eomc.verify.taylor import TaylorReference

COUNT = 200
GROUPS = range(0, COUNT, 10)


def closed(made: Chain) -> System | None:
    """The chain from its guess; None where it is refused."""
    try:
        return assembled(made.system)
    except SceneError:
        return None


@pytest.mark.slow
@pytest.mark.parametrize("first", GROUPS)
def test_guesses_within_a_fifth_are_assembled(first: int) -> None:
    """95 of 100, each told how far it has moved; the rest refused. Held angles stay."""
    found = 0
    for seed in range(first, first + 10):
        made = chain(seed)
        system = closed(made)
        if system is None:
            continue
        found += 1
        q = np.array([c.start for c in system.coordinates])
        np.testing.assert_array_equal(q[made.held], made.q[made.held])
        closure = system.closure
        assert closure is not None
        assert (closure.rank, len(closure.redundant)) == (2, made.extra)
        assert closure.freedoms == len(made.q) - 2
        guess = np.array([c.start for c in made.system.coordinates])
        assert {m.name for m in closure.moves} == {f"q{k}" for k in np.flatnonzero(q != guess)}
    assert found >= 9


@pytest.mark.parametrize("seed", tiers(range(0, COUNT, 8), 48))
def test_accelerations_and_multipliers_are_the_reference_s(seed: int) -> None:
    system = closed(chain(seed))
    if system is None:
        pytest.skip("refused")
    made, answer = program.build(lagrange.derive(system)), TaylorReference(system)
    q, qd = np.array([(c.start, c.rate) for c in system.coordinates]).T
    values = dict(zip((x.name for x in (*system.q, *system.qd)), (*q, *qd), strict=True))
    a, _ = evaluate(made["acceleration"], values | {"t": 0.0})
    multipliers, _ = evaluate(made["multipliers"], values | {"t": 0.0})
    for found, expected in (
        (a, answer.acceleration(q, qd)), (multipliers, answer.multipliers(q, qd)),
    ):  # fmt: skip
        size = float(np.max(np.abs(expected)))
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * size)
