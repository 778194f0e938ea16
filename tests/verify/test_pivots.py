"""Pivots that are not tested, or compared with a wrong scale, in every route to accelerations."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support import trees
from support.forks import in_a_fork
from support.mutants import Bench, Mutant, variant
from support.session import tiers

from eomc.derive import lagrange
from eomc.derive.ldl import Solution
from eomc.model.system import System, from_scene
from eomc.program.ir import evaluator, nearby
from eomc.program.lower import lower
from eomc.program.routes import ROUTES, RouteInputs
from eomc.scene.read import parse
from eomc.verify import symbolic

# A pivot, and its limit: zero, or the rounding error of the diagonal entry.
PIVOT = re.compile(r"((?:\w+->)?[dD]_\w+|-?w\d+) <= (0|[\d.]+e-\d+\*([\w>.-]*\w))(?=[;) ?|])")


def chain(links: int, run: str = "") -> System:
    """Return rods in a row, each with its own mass, so that each pivot can fail separately."""
    bodies = [
        {"name": f"link{k}", "joint": "revolute", "coordinates": f"q{k}", "mass": f"m{k}",
         "center": ["l/2", 0], "inertia": f"m{k}*l**2/12",
         **({"parent": f"link{k - 1}", "offset": ["l", 0]} if k > 1 else {})}
        for k in range(1, links + 1)
    ]  # fmt: skip
    masses = {f"m{k}": 1 + k / 10 for k in range(1, links + 1)}
    text = trees.text(bodies, [0, "-g"], {**masses, "l": 0.7, "g": 9.81}, start=0.1)
    return from_scene(parse(f"{text}\n[run]\nh = 0.001\n{run}", "rods.toml"))


def changes(source: str) -> Iterator[Mutant]:
    """Yield changes: no test of a pivot; a limit relative to a mass, or zero, in place of the
    scale.
    """
    for match in PIVOT.finditer(source):
        start, end = match.span()
        if source[source.rfind("\n", 0, start) : start].lstrip().startswith(("* ", "/*")):
            continue
        yield Mutant(start, end, "0")
        if match[3]:  # sufficient for a D of another unit
            yield Mutant(*match.span(3), f"1e20*{match[3]}")
            yield Mutant(*match.span(3), f"-1e20*{match[3]}")


def surviving_changes(system: System, name: str, folder: Path, least: int) -> list[str]:
    """Return the changes of pivot tests that pass the check."""

    def survivors() -> list[str]:
        bench = Bench(name, folder, system)
        tried = list(changes(bench.shipped.source))
        assert len(tried) >= least, len(tried)
        return [bench.place(m) for m in tried if bench.judge(m)[0] not in ("killed", "no C")]

    kind, value = in_a_fork(survivors, 1200)
    assert kind == "done", value
    assert isinstance(value, list)
    return value


@pytest.mark.slow
@pytest.mark.parametrize("name, least", [("cartpole", 2), ("cartpole_batch", 3)])
def test_check_detects_changed_pivots_of_scenes(name: str, least: int, tmp_path: Path) -> None:
    assert surviving_changes(variant(name), name, tmp_path, least) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    "links, run, least", [(2, "", 2), (3, "", 3), (6, "", 6), (4, "batch = true", 4)]
)
def test_check_detects_changed_pivots_of_trees(
    links: int, run: str, least: int, tmp_path: Path
) -> None:
    assert surviving_changes(chain(links, run), f"rods{links}", tmp_path, least) == []


SOLVED = ["cartpole", "heavy_top", "tumbling_box", "rods3"]


@pytest.mark.parametrize("name", tiers(SOLVED, "cartpole", "heavy_top", "tumbling_box"))
def test_pivots_are_schur_complements_of_D(name: str) -> None:
    """Compare the limits with diagonal entries; by the articulated route with a trace."""
    system = chain(3) if name == "rods3" else variant(name)
    reference, material = symbolic.reference_for(system), RouteInputs(lagrange.derive(system))
    programs = {r.name: r.accelerations(material) for r in ROUTES.values()}
    solved = {
        r: way for r, way in programs.items() if isinstance(way, Solution) and way.matrix == "D"
    }
    assert solved
    values = nearby(system, 3)
    place = [[values[f"{c.name}{end}"] for c in system.coordinates] for end in ("", "_dot")]
    parameters = {p.name: values[p.name] for p in system.parameters}
    D = reference.evaluate("D", *place, 0.0, None, parameters)
    for route, way in solved.items():
        pairs = [x for pair in way.pivots for x in pair]
        computed = evaluator(lower("pivots", way.tape, pairs, system.names))(values)[0]
        assert len(way.order) == len(way.pivots) == len(D)
        for n, (k, pivot, size) in enumerate(
            zip(way.order, computed[::2], computed[1::2], strict=True)
        ):
            part = D[np.ix_(way.order[: n + 1], way.order[: n + 1])]
            schur = 1 / np.linalg.inv(part)[-1, -1]
            if route != "articulated":
                assert pivot / size == pytest.approx(schur / D[k, k], rel=1e-9)
                continue
            assert pivot == pytest.approx(schur, rel=1e-9)
            assert size == pivot or D[k, k] <= size <= 4 * D[k, k]
