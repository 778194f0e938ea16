"""The report's page about the scene: description, equations and motion, without network access."""

import re
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
from support import browser
from support.payloads import PAYLOADS
from support.session import ROOT, needs

from eomc import pipeline
from eomc.base import texts
from eomc.base.errors import EomcError
from eomc.model.system import System, from_scene
from eomc.report import cost_of_digits, equations, page, typeset
from eomc.report.typeset import write_mathml
from eomc.scene.read import parse

pytest.importorskip("matplotlib")
pytest.importorskip("latex2mathml")

KEPLER = """
eomc = 1
name = "kep"
[coordinates]
x = {{ start = 0.1 }}
y = {{ rate = 4.358898943540674 }}
[energy]
kinetic = "(x_dot**2 + y_dot**2)/2"
potential = "-1/sqrt(x**2 + y**2)"
{constraints}
[run]
duration = 0.5
tolerance = 1e-9
"""
REPORTS = ROOT / "build" / "tests" / "reports"
SLIDER = """
eomc = 1
name = "slider"
title = "A <b>slider</b>"
note = "On a rail, & pushed."
[coordinates]
x = { unit = "m", start = 1.0, rate = 0.5, note = "from the <wall>" }
[parameters]
m_c = { value = 2.0, unit = "kg" }
k = { value = 3.0, unit = "N/m" }
[inputs]
push = { unit = "N", signal = "sin(t)" }
[energy]
kinetic = "m_c*x_dot**2/2"
potential = "k*x**2/2"
[forces]
x = "push"
[outputs]
far = { formula = "2*x", unit = "m" }
[run]
h = 0.01
duration = 2.0
"""


def system() -> System:
    return from_scene(parse(SLIDER, "slider.toml"))


@cache
def page_text() -> str:
    needs("gcc")
    report = cost_of_digits.measure(system(), REPORTS, longest=0.005, methods=("rk4", "dp8"))
    return page.write_page(report, page.describe_scene(system(), report, REPORTS))


def test_equations_are_written_as_mathml() -> None:
    first, rest = map(write_mathml, equations.derive(system()).groups)
    ((more, line),) = first
    assert not more and line.startswith("<math") and 'displaystyle="true"' in line
    assert "<mi>k</mi>" in line and "push" in re.sub("<[^>]+>", "", line)
    symbols = [re.sub("<[^>]+>", "", line)[0] for _, line in rest[:6]]
    assert symbols == ["K", "P", "L", "D", "C", "g"]
    swing = equations.derive(pipeline.read(ROOT / "scenes" / "furuta_pendulum.toml"))
    first = write_mathml(swing.groups[0])
    assert [more for more, _ in first] == [False, True, False]
    assert '<mo lspace="0.17em" rspace="0.17em">sin</mo>' in first[0][1]


def test_equations_without_latex2mathml_name_the_package(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in [name for name in sys.modules if name.startswith("latex2mathml")]:
        monkeypatch.setitem(sys.modules, name, None)
    typeset._convert_to_mathml.cache_clear()
    with pytest.raises(EomcError, match="need latex2mathml: pip install latex2mathml"):
        write_mathml(equations.derive(system()).equations)


@pytest.mark.slow
def test_page_describes_the_scene() -> None:
    text = page_text()
    for expected in (
        "On a rail, &amp; pushed.", "from the &lt;wall&gt;", "m<sub>c</sub>", "1, 0.5", "N/m",
        "A &lt;b&gt;slider&lt;/b&gt;", "Equations of motion", "Motion", "Speed against error",
    ):  # fmt: skip
        assert expected in text, expected
    assert text.count("<math") == text.count("</math>") >= 9
    assert text.count("<svg") == 4 and "<script" not in text
    assert not re.search(r"(src|href)=\"(?!#)", text)
    assert "prefers-color-scheme: dark" in text


@pytest.mark.slow
def test_large_scene_states_how_it_is_computed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    needs("gcc")
    monkeypatch.setattr(equations, "MAX_DERIVED_OPERATIONS", 1_000)
    chain = pipeline.read(ROOT / "scenes" / "chain.toml")
    chain = replace(chain, run=replace(chain.run, duration=0.2))
    report = cost_of_digits.measure(chain, REPORTS, longest=0.002, methods=("rk4",))
    about = page.describe_scene(chain, report, REPORTS)
    assert not about.equations and "link2 on link1: turns about z" in about.text
    assert '<pre tabindex="0">Chain of links' in page.write_page(report, about)


@pytest.mark.parametrize("name", ["page", "latex", "escape", "attribute"])
def test_free_text_is_escaped(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    text = PAYLOADS[name]
    monkeypatch.setattr(page, "without_pictures", lambda: "no pictures")
    model = system()
    with_note = replace(model.coordinates[0], unit=text, note=text)
    about = page.describe_scene(replace(model, note=text, coordinates=(with_note,)), None, Path())  # type: ignore[arg-type]
    assert about.note == texts.html(texts.flat(text))
    assert about.coordinates[0][2:] == (texts.html(texts.flat(text)),) * 2


@pytest.mark.slow
@pytest.mark.skipif(bool(browser.MISSING), reason=browser.MISSING)
def test_page_in_a_browser_fetches_nothing_and_fits_400_pixels(tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    file.write_text(page_text(), encoding="utf-8")
    with browser.chromium(tmp_path / "profile") as window:
        dark = {}
        for scheme in ("light", "dark"):
            window.media(prefers_color_scheme=scheme)
            window.open(file, 500)  # the smallest width of a Chromium window
            window.run("document.body.style.width = '400px'; document.body.style.margin = '0'")
            dark[scheme] = window.run("return getComputedStyle(document.body).backgroundColor")
            wide = window.run("return document.documentElement.scrollWidth")
            assert wide <= window.run("return window.innerWidth")
            inside = "return [...document.body.children].filter(e => e.offsetWidth > 400).length"
            assert window.run(inside) == 0
            heights = """return [...document.querySelectorAll('math')]
                .map(m => m.getBoundingClientRect().height)"""
            assert min(window.run(heights)) > 10  # they are rendered
        assert dark["light"] != dark["dark"]
        assert window.logged() == []
        requests = [url for url in window.requested() if not url.startswith(("data:", "chrome"))]
        assert {*requests} == {file.as_uri()}


@pytest.mark.slow
def test_motion_is_drawn_by_adaptive_steps_where_they_are_best(tmp_path: Path) -> None:
    text = KEPLER.format(constraints="")
    system = from_scene(parse(text, "kep.toml"))
    report = cost_of_digits.measure(system, tmp_path, methods=("rk4", "adaptive"), longest=0.01)
    best = report.best(6)
    assert best is not None and best.adaptive
    assert page.describe_scene(system, report, tmp_path).caption.startswith(
        f"By steps that fit a tolerance of {best.tol:.0e}, within "
    )


@pytest.mark.slow
def test_perturbations_satisfy_the_constraints(tmp_path: Path) -> None:
    """From a point where a coordinate cannot grow by itself: the end of a rod."""
    rod = '[constraints]\nrod = "x**2 + y**2 - 0.01"'
    file = tmp_path / "kep.toml"
    file.write_text(KEPLER.format(constraints=rod))
    system = pipeline.read(file)
    report = cost_of_digits.measure(system, tmp_path, methods=("rk4",), longest=0.01)
    assert 1 < report.growth.amplification[-1] < 1000
