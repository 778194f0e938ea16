"""A key has a line and a column, however deep it is in its statement."""

from __future__ import annotations

import pytest

from eomc.scene.toml_text import SourceMap


@pytest.mark.parametrize(
    "text",
    [
        "coordinates = { x = { start = 1, strat = 2 } }",
        "coordinates.x = { start = 1, strat = 2 }",
        "coordinates.x.strat = 2",
        "[coordinates]\nx = { start = 1, strat = 2 }",
        "[coordinates]\nx.strat = 2",
        "[coordinates.x]\nstart = 1\nstrat = 2",
    ],
)
def test_key_of_a_coordinate_has_its_position(text: str) -> None:
    result = SourceMap(text, "s.toml").problem(("coordinates", "x", "strat"), "unknown")
    lines = text.split("\n")
    assert result.line == len(lines) and result.source == lines[-1]
    assert (result.column, result.width) == (lines[-1].index("strat"), len("strat"))
