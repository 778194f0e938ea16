"""Attributes that MJCF does not have, misspelt ones, are told."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from mjcf_text import BODY, model

from eomc.robots.mjcf.attributes import attributes

BEFORE = """<compiler angel="radian"/><option gravty="0 0 -1"><flag gravitty="disable"/></option>
  <default clas="x"><joint dampng="1"/><tendon damp="1"/><position Kd="1"/>
  <default class="inner"><equality solreff="1"/></default></default>"""
AFTER = """<tendon><fixed name="t" stifness="1"><joint joint="j" coeff="2"/></fixed></tendon>
  <equality><joint name="e" joint1="j" polycoeff="1"/></equality>
  <actuator><position name="el" joint="j" Kp="40" kv="3"/>
  <motor name="m" joint="j" forcerage="-1 1" kp="3"/></actuator>
  <keyframe><key name="home" ctr="1"/></keyframe>"""
TOLD = [
    "angel of compiler", "gravty of option", "gravitty of flag", "clas of default",
    "dampng of joint in default", "damp of tendon in default", "Kd of position in default",
    "solreff of equality in default", 'stifness of fixed "t"', 'coeff of joint in fixed "t"',
    'polycoeff of joint "e" in equality', 'Kp of position "el"', 'forcerage of motor "m"',
    'kp of motor "m"', 'ctr of key "home"',
]  # fmt: skip


def told(tmp_path: Path, before: str, after: str, inside: str = BODY) -> list[str]:
    """The attributes that the import tells MJCF not to have."""
    left = model(tmp_path, inside, before, after).left_out
    lines = [words for words in left if words.startswith("attributes that MJCF")]
    return sorted(re.sub(r"^.*?: | and \d+ more$", "", lines[0]).split(", ")) if lines else []


def test_misspelt_attributes_are_told_wherever_they_stand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("eomc.robots.mjcf.file.SHOWN", 99)
    assert told(tmp_path, BEFORE, AFTER) == sorted(TOLD)
    left = "\n".join(model(tmp_path, BODY, BEFORE, AFTER).left_out)
    assert "options of MuJoCo" not in left and "flags of MuJoCo" not in left


def test_a_misspelt_attribute_of_a_site_that_is_read_is_told(tmp_path: Path) -> None:
    inside = BODY.replace("</body>", '<site name="s" pso="1 0 0"/></body><site name="o"/>')
    after = '<equality><connect site1="s" site2="o"/></equality>'
    assert told(tmp_path, "", after, inside) == ['pso of site "s"']


NAMES = 28  # the column in which MuJoCo's schema begins to list attributes
AROUND = set("mujoco option default body tendon fixed equality actuator keyframe".split())


@pytest.mark.slow  # in the tier that installs MuJoCo
def test_every_attribute_of_mujocos_schema_is_known() -> None:
    mujoco = pytest.importorskip("mujoco", minversion="4")
    way: list[str] = []  # to an element, which stands in the line of its first attributes
    unknown, compared = [], set()
    for line in mujoco.mj_printSchema(False, False).splitlines():
        depth = (len(line) - len(line.lstrip())) // 3
        names = line.split()
        if 3 * depth < NAMES - 3:
            kind, _, *names = names
            way = [*way[:depth], kind.removeprefix("(world)")]
        kind, around = way[-1], "".join(way[-2:-1])
        known = attributes(kind, around)
        if known and around in AROUND and way[-2:] != ["body", "plugin"]:
            compared.add(kind)
            unknown += [f"{name} of {kind} in {around}" for name in names if name not in known]
    assert not unknown
    assert {*"option flag position dcmotor fixed weld key geom site inertial".split()} <= compared
