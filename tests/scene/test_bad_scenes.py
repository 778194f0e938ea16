"""Every mistake in tests/scene/bad/*.toml gives exactly the message beside it.

After an intended change `make golden` writes the messages again. Read each one as its user would
before accepting it.
"""

from __future__ import annotations

import pytest
from support import bad_scenes as cases
from support.bad_scenes import BadScene, bad_scenes, diagnose

from eomc.model.system import from_scene
from eomc.scene.read import parse

SCENES = {scene.name: scene for scene in bad_scenes()}


@pytest.mark.parametrize("name", cases.BASES)
def test_scenes_without_the_mistakes_are_accepted(name: str) -> None:
    from_scene(parse(cases.BASES[name], f"{name}.toml"))


def test_names_of_cases_occur_once() -> None:
    assert len(SCENES) == len(bad_scenes()) >= 335


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_message_is_the_accepted_one(scene: BadScene) -> None:
    assert diagnose(scene)[1] == scene.message


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_every_problem_names_file_line_and_key(scene: BadScene) -> None:
    problems = diagnose(scene)[0]
    assert problems
    lines = scene.text.decode("utf-8", errors="replace").split("\n")
    for problem in problems:
        assert problem.file == "scene.toml"
        assert problem.message
        layout = problem.message.startswith(("not TOML", "the file is"))
        assert problem.key or layout
        # a missing key, or a fault of the whole file, has no line
        nowhere = problem.message.startswith("missing: ") and "." not in problem.key
        assert problem.line or nowhere or "is empty" in problem.message
        if problem.line:
            assert problem.source == lines[problem.line - 1].rstrip()
            assert problem.column < max(len(problem.source), 1) + 1


def test_messages_fit_the_screen() -> None:
    message = diagnose(SCENES["bound_length"])[1]
    assert all(len(line) < 200 for line in message.splitlines())


def test_accepted_messages_replace_the_previous_ones() -> None:
    for file in cases.FILES:
        text = file.read_text(encoding="utf-8")
        assert cases.accept_messages(text) == text
        first, rest = text.split("message = '''\n", 1)
        without = f"{first.rstrip()}\n\n" + rest.split("'''\n", 1)[1]
        assert cases.accept_messages(without) == text
        assert cases.accept_messages(text.replace("error: ", "error: old ")) == text


@pytest.mark.parametrize("change", ["-a\n+c\n", "-x\n", "-b\n+a\n-x\n"])
def test_changes_of_lines_that_do_not_occur_once_are_refused(change: str) -> None:
    with pytest.raises(AssertionError, match="occurs"):
        cases.apply_change("a\nb\na\n", change)
