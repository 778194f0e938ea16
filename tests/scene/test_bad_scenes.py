"""Every mistake in tests/scene/bad/*.toml gives exactly the message in the file beside it.

After an intended change `python tests/scene/test_bad_scenes.py` writes the messages again. Read
each one as its user would before accepting it.
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
def problems_and_message(file: Path) -> tuple[tuple[Problem, ...], str]:
    """Return the problems of a scene and the message that its user reads."""
    try:
        warnings = from_scene(read(file)).warnings
    except SceneError as error:
        return error.problems, str(error)
    return warnings, "\n".join(map(str, warnings))


def problems(file: Path) -> tuple[Problem, ...]:
    return problems_and_message(file)[0]


def message(file: Path) -> str:
    return problems_and_message(file)[1].replace(str(file), file.name) + "\n"


def test_every_message_has_its_scene():
    assert len(SCENES) >= 35
    assert {f.stem for f in BAD.glob("*.txt")} == {f.stem for f in SCENES}


@pytest.mark.parametrize("file", SCENES, ids=lambda f: f.stem)
def test_message_is_the_accepted_one(file):
    accepted = file.with_suffix(".txt")
    assert accepted.exists(), f"{accepted.name} is missing: python {Path(__file__).name} writes it"
    assert message(file) == accepted.read_text(encoding="utf-8")


@pytest.mark.parametrize("file", SCENES, ids=lambda f: f.stem)
def test_every_problem_names_file_line_and_key(file):
    problems_of_file = problems(file)
    assert problems_of_file
    lines = file.read_text(encoding="utf-8", errors="replace").split("\n")
    for problem in problems_of_file:
        assert problem.file == str(file)
        assert problem.message
        layout = problem.message.startswith(("not TOML", "the file is"))
        assert problem.key or layout
        # a missing key, or a fault of the whole file, has no line
        nowhere = problem.message.startswith("missing: ") and "." not in problem.key
        assert problem.line or nowhere or "is empty" in problem.message
        if problem.line:
            assert problem.source == lines[problem.line - 1].rstrip()
            assert problem.column < max(len(problem.source), 1) + 1


def test_messages_fit_the_screen(file=BAD / "bound_length.toml"):
    assert all(len(line) < 200 for line in message(file).splitlines())


if __name__ == "__main__":
    for each in SCENES:
        each.with_suffix(".txt").write_text(message(each), encoding="utf-8")
