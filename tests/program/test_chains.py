"""Random closed chains: guesses are assembled, ranks detected, and forces as in the reference."""

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
