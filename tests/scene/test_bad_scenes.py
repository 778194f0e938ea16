"""Every mistake in tests/scene/bad/*.toml gets the message beside it, word for word.

After a change that is meant: `python tests/scene/test_bad_scenes.py` writes the messages anew. Read
each one as its user would before keeping it.
"""

from functools import cache
from pathlib import Path

import pytest

from eomc.base.errors import Problem, SceneError
from eomc.model.from_scene import from_scene
from eomc.scene.read import read

BAD = Path(__file__).parent / "bad"
SCENES = sorted(BAD.glob("*.toml"))


@cache
def said(file: Path) -> tuple[tuple[Problem, ...], str]:
    """The problems of a scene, and the message that its user sees."""
    try:
        warnings = from_scene(read(file)).warnings
    except SceneError as fault:
        return fault.problems, str(fault)
    return warnings, "\n".join(map(str, warnings))


def problems(file: Path) -> tuple[Problem, ...]:
    return said(file)[0]


def message(file: Path) -> str:
    return said(file)[1].replace(str(file), file.name) + "\n"


def test_there_are_many_and_none_is_orphaned():
    assert len(SCENES) >= 35
    assert {f.stem for f in BAD.glob("*.txt")} == {f.stem for f in SCENES}


@pytest.mark.parametrize("file", SCENES, ids=lambda f: f.stem)
def test_the_message_is_the_golden_one(file):
    golden = file.with_suffix(".txt")
    assert golden.exists(), f"{golden.name} is missing: python {Path(__file__).name} writes it"
    assert message(file) == golden.read_text(encoding="utf-8")


@pytest.mark.parametrize("file", SCENES, ids=lambda f: f.stem)
def test_every_problem_names_file_line_and_key(file):
    found = problems(file)
    assert found
    lines = file.read_text(encoding="utf-8", errors="replace").split("\n")
    for problem in found:
        assert problem.file == str(file)
        assert problem.message
        layout = problem.message.startswith(("not TOML", "the file is"))
        assert problem.key or layout
        # what is missing altogether, or all there is, stands in no line
        nowhere = problem.message.startswith("missing: ") and "." not in problem.key
        assert problem.line or nowhere or "is empty" in problem.message
        if problem.line:
            assert problem.source == lines[problem.line - 1].rstrip()
            assert problem.column < max(len(problem.source), 1) + 1


def test_messages_stay_within_the_screen(file=BAD / "bound_length.toml"):
    assert all(len(line) < 200 for line in message(file).splitlines())


if __name__ == "__main__":
    for each in SCENES:
        each.with_suffix(".txt").write_text(message(each), encoding="utf-8")
