"""Templates do the same for every scene: divided runs, refusals, batches, lanes, sines."""

from __future__ import annotations

import pytest
from support.cases import RUN_VARIANTS, SCENES, text_of
from support.session import Modules, tiers
from support.template_checks import check_templates

from eomc.mechanism.assembly import assembled
from eomc.model.system import from_scene
from eomc.scene.read import parse

TEXTS = {file.stem: (file.stem, "") for file in sorted(SCENES.glob("*.toml"))} | RUN_VARIANTS


@pytest.mark.parametrize("name", tiers(TEXTS, "cartpole"))
def test_every_way_through_the_c_code_gives_the_same_motion(name: str, modules: Modules) -> None:
    system = assembled(from_scene(parse(text_of(*TEXTS[name]), f"{name}.toml")))
    report = check_templates(system, modules.unoptimised(system))
    assert report.passed, report.table()
