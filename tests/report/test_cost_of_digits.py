"""The report: its measurements compared with theory, and the output of its command."""

from __future__ import annotations

import json
import math
import re
import sys
import warnings
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy
from click.testing import CliRunner
from support.cases import SCENES, case_system
from support.session import ROOT, needs

from eomc import pipeline
from eomc.base.errors import EomcError
from eomc.cli.main import main
from eomc.emit.render import Sources
from eomc.integrators.tableaux import METHODS
from eomc.model.system import Event, System
from eomc.report import cost_of_digits, page, typeset
from eomc.report.cost_of_digits import WorkPrecisionReport

REPORTS = ROOT / "build" / "tests" / "reports"
OSCILLATING = """eomc = 1
name = "oscillating"
[coordinates]
x = { start = 1.0 }
[energy]
kinetic = "x_dot**2/2"
potential = "9*x**2/2"
"""


@pytest.fixture(autouse=True)
def gcc() -> None:
    needs("gcc")


def oscillator() -> System:
    """Return x = cos(3 t), with D = 1."""
    x, v = sympy.symbols("x x_dot")
    return System.make("oscillating", {x: 1.0}, v**2 / 2, 9 * x**2 / 2, h=0.01, duration=4.0)


@cache
def measured() -> WorkPrecisionReport:
    return cost_of_digits.measure(oscillator(), REPORTS, longest=0.02, methods=("rk4", "dp8"))


@pytest.mark.slow
def test_errors_of_rk4_agree_with_theory() -> None:
    """x'' = -w^2 x: phase lag w t z^4/120 with z = w h; relative loss of energy w t z^5/72."""
    rk4 = measured().lines[0]
    for p in rk4.points:
        z = 3 * p.h
        if z < 0.2 and p.along > 1e-10:
            lag = np.linspace(0, 12, 2001) * z**4 / 120
            theory = np.max(np.abs(np.cos(np.linspace(0, 12, 2001) - lag)
                                   - np.cos(np.linspace(0, 12, 2001))))  # fmt: skip
            assert p.along == pytest.approx(theory, rel=0.15)
            # of K + P = 9/2, where K and P change by 9/2 each
            assert p.energy == pytest.approx(12 * z**5 / 72 / 2, rel=0.1)
            assert p.evaluations == 4 * p.steps


@pytest.mark.slow
def test_every_number_of_digits_is_reported() -> None:
    r = measured()
    rows = page.digit_rows(r)
    assert [row[0] for row in rows] == [str(d) for d in range(3, 16)]
    for row in rows:
        best = r.best(int(row[0]))
        assert row[1] == (best.method if best else "out of reach")
    reported = []
    for words in page.recommendations(r):
        first, last = re.match(r"for (\d+)(?: to (\d+))? digits up to", words).groups()
        reported += range(int(first), int(last or first) + 1)
        reached = {r.best(d) for d in range(int(first), int(last or first) + 1)}
        assert len(reached) == 1 and (None in reached) == ("out of reach" in words)
    assert reported == [*range(3, 16)]
    rk4 = r.lines[0]
    coarse = replace(rk4, points=tuple(p for p in rk4.points if p.along > 1e-8))
    worse = replace(r, lines=(coarse,))
    assert [row[1] for row in page.digit_rows(worse)][5:] == ["out of reach"] * 8
    assert page.recommendations(worse)[-1].startswith("for 8 to 15 digits up to t = 4 s: out of")


@pytest.mark.slow
def test_order_stability_and_rounding_are_measured() -> None:
    rk4, dp8 = measured().lines
    assert rk4.observed == pytest.approx(4, abs=0.3)
    assert dp8.observed == pytest.approx(8, abs=0.8)
    # h omega <= 2.83 and 5.96
    assert rk4.stable_to == pytest.approx(METHODS["rk4"].limits[0] / 3, rel=1e-6)
    assert dp8.stable_to == pytest.approx(METHODS["dp8"].limits[0] / 3, rel=1e-6)
    assert abs(measured().eigenvalue.imag) == pytest.approx(3, rel=1e-6)
    for line in (rk4, dp8):
        assert (
            line.stable_to / 8 < line.usable_h <= line.stable_to
        )  # halved until the error is below 1
    assert 0 < dp8.rounding < 0.1
    assert 1e-17 < min(p.along for p in dp8.points) < 1e-13


@pytest.mark.slow
def test_recommended_stepper_is_the_quickest_with_enough_digits() -> None:
    r = measured()
    for digits in (3, 6, 9, 12):
        recommended = r.best(digits)
        assert recommended is not None and recommended.along <= 10.0**-digits
        assert not any(
            p.along <= 10.0**-digits and p.seconds < recommended.seconds for p in r.points
        )
        words = page.recommendation(r, digits)
        assert words.startswith(
            f"for {digits} digits up to t = 4 s: {recommended.method} with h = "
        )
        assert f"(4 s/{recommended.steps})" in words
    assert "out of reach" in page.recommendation(r, 17)
    best = r.best(12)
    assert best is not None and best.method == "dp8"


def test_perturbation_of_an_oscillator_does_not_grow() -> None:
    """In the energy norm it only rotates."""
    g = measured().growth
    assert not g.wild and g.horizon == math.inf
    assert g.amplification[-1] == pytest.approx(1, rel=0.1)


def test_growth_proportional_to_the_motion_is_not_chaos() -> None:
    """x'' = x for 40 s: differences grow by e^40, and so does x, which loses no digit."""
    t = np.linspace(0, 40, 65)
    running = cost_of_digits._classify_growth(t, np.exp(t), 1e-3 * np.expm1(t), 1e-3 * np.exp(t))
    assert not running.wild and running.horizon == math.inf
    bounded = cost_of_digits._classify_growth(t, np.exp(t), np.ones(65), np.ones(65))
    assert bounded.wild and bounded.rate == pytest.approx(1)
    assert bounded.horizon == pytest.approx(math.log(0.1 * 2**53), abs=40 / 64)


@pytest.mark.usefixtures("quickly_compiled")
@pytest.mark.slow
def test_adaptive_steps_are_compared_with_fixed_ones(tmp_path: Path) -> None:
    """Steps are by tolerance; events, which the reference ignores, are omitted."""
    x = sympy.Symbol("x")
    system = replace(oscillator(), events=(Event("middle", x, action="stop"),))
    r = cost_of_digits.measure(system, tmp_path, longest=0.005, methods=("rk4", "adaptive"))
    rk4, line = r.lines
    assert not any(p.adaptive for p in rk4.points) and all(p.adaptive for p in line.points)
    assert [p.tol for p in line.points] == list(cost_of_digits.TOLERANCES)
    for p in line.points:
        assert p.status == "ok" and p.along < 20 * p.tol + 2e-15
        assert p.h == pytest.approx(4 / p.steps)
    assert line.order == 16 and math.isnan(line.usable_h)
    recommended = r.best(12)
    assert recommended is not None and recommended.adaptive
    words = page.recommendation(r, 12)
    assert words.startswith(
        f"for 12 digits up to t = 4 s: adaptive steps with tol = {recommended.tol:g}"
    )
    assert page.stepper_rows(r)[1][-3] == f"tol {min(line.points, key=lambda p: p.along).tol:g}"
    assert "Error against tolerance" in page.write_page(r)
    assert json.loads(json.dumps(page.as_dict(r), allow_nan=False))["lines"][0]["points"][0][
        "tol"
    ] is None  # fmt: skip


@pytest.mark.slow
def test_condition_and_jumps_are_reported(tmp_path: Path) -> None:
    """D = [[1, c], [c, 1]], c = 1 - 1e-9 cos x: condition (1 + c)/(1 - c) = 2e9 at x = 0."""
    x, y, v, w = sympy.symbols("x y x_dot y_dot")
    c = 1 - sympy.Rational(1, 10**9) * (1 + x**2)
    system = System.make(
        "nearly", {x: (0.0, 1.0), y: (0.0, 1.0)}, (v**2 + w**2) / 2 + c * v * w,
        forces={x: sympy.Abs(y) / 10**6}, duration=0.5, h=0.01,
    )  # fmt: skip
    r = cost_of_digits.measure(system, tmp_path, longest=0.005, methods=("rk4",))
    assert r.condition[0] == pytest.approx(2e9, rel=1e-3)
    assert r.condition[1] == 0.0
    remarks = " ".join(page.remarks(r))
    assert "nearly singular at t = 0 s, x = 0, y = 0: condition number 2e+09" in remarks
    assert "jump or bend (abs)" in remarks
    smooth = " ".join(page.remarks(measured()))
    assert (
        "D is regular: its condition number, once scaled to a diag" in smooth
        and "jump" not in smooth
    )


def test_stable_steps_of_known_eigenvalues() -> None:
    assert cost_of_digits.stable_step(np.array([100j, -100j]), (2.83, 2.79)) == pytest.approx(
        0.0283
    )
    assert cost_of_digits.stable_step(np.array([-1000 + 0j, 1j]), (2.83, 2.79)) == pytest.approx(
        2.79e-3
    )
    growing = np.array([5 + 0j])
    assert cost_of_digits.stable_step(growing, (2.83, 2.79)) == math.inf
    assert cost_of_digits.stable_step(np.array([-1000 + 0j]), (math.inf, math.inf)) == math.inf


class _Page(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.links: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [v or "" for k, v in attrs if k in ("src", "href", "xlink:href")]


@pytest.mark.slow
def test_page_is_one_file_with_its_pictures() -> None:
    pytest.importorskip("matplotlib")
    text = page.write_page(measured())
    read = _Page()
    read.feed(text)
    assert read.tags.count("svg") == 3 and "script" not in read.tags
    assert all(link.startswith("#") for link in read.links)  # nothing external
    for words in page.recommendations(measured()):
        assert words in text
    assert text == page.write_page(measured())


def test_page_is_written_without_matplotlib_and_latex2mathml(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("matplotlib", "matplotlib.figure", "latex2mathml", "latex2mathml.converter"):
        monkeypatch.setitem(sys.modules, name, None)
    typeset._convert_to_mathml.cache_clear()
    measurement = measured()
    monkeypatch.setattr(cost_of_digits, "measure", lambda *_, **__: measurement)
    scene = tmp_path / "oscillating.toml"
    scene.write_text(OSCILLATING)
    (tmp_path / "oscillating").mkdir()
    result = CliRunner().invoke(main, ["report", str(scene), "--build", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert (
        "the page has no pictures, which need matplotlib: pip install matplotlib" in result.output
    )
    text = (tmp_path / "oscillating" / "report.html").read_text()
    assert "The page has no pictures, which need matplotlib" in text
    assert "kinetic energy:" in text  # the equations as text
    assert "<figure" not in text and "Motion</h2>" not in text
    assert all(words in text for words in page.recommendations(measured()))


@pytest.mark.slow
def test_page_escapes_names() -> None:
    pytest.importorskip("matplotlib")
    text = page.write_page(replace(measured(), title="<script>"))
    assert "<script>" not in text and "&lt;script&gt;" in text


def test_measurements_as_json() -> None:
    figures = json.loads(json.dumps(page.as_dict(measured()), allow_nan=False))
    assert [line["method"] for line in figures["lines"]] == ["rk4", "dp8"]
    assert figures["best"]["6"]["along"] <= 1e-6
    for digits, best in figures["best"].items():
        assert best is None or best["along"] <= 10.0 ** -int(digits)
    assert figures["digits"] > 25
    assert figures["condition"][0] == pytest.approx(1.0)


@pytest.mark.parametrize(("mode", "steps"), [(0.0, 8), (10j, 128)])
def test_first_steps_are_few_per_revolution(mode: complex, steps: int) -> None:
    """At most 12 radians, a quarter of that for safety; eight steps for a motion without modes."""
    values = np.array([mode, -mode])
    stable_to = cost_of_digits.stable_step(values, METHODS["gauss8"].limits)
    assert cost_of_digits.fewest_steps(values, stable_to, 400.0) == steps


def test_stepper_without_a_digit_is_omitted_from_the_energy_figure() -> None:
    report, drawn = measured(), list[str]()
    inaccurate = tuple(replace(p, along=math.inf) for p in report.lines[0].points)
    lines = (replace(report.lines[0], points=inaccurate), report.lines[1])

    class Axes:
        def semilogy(self, *_: Any, label: str, **__: Any) -> None:
            drawn.append(label.split(",")[0])

        def __getattr__(self, name: str) -> Any:
            return lambda *_, **__: None

    page._energy(Axes(), replace(report, lines=lines), report.lines[1].points[0])
    assert drawn == ["dp8"]


def test_times_are_printed_with_a_unit() -> None:
    times = (2.0, 1.2, 0.999, 4.88e-3, 1e-3, 1.23e-5, 1.1e-6, 3e-9, math.inf)
    expected = ["2 s", "1.2 s", "999 ms", "4.88 ms", "1 ms", "12.3 us", "1.1 us", "3 ns", "-"]
    assert [page._time(seconds) for seconds in times] == expected


@pytest.mark.slow
def test_report_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cost_of_digits, "METHODS", {n: METHODS[n] for n in ("rk4", "dp8")})
    scene, file = str(SCENES / "mass_spring.toml"), tmp_path / "figures.json"
    words = ["report", scene, "--build", str(tmp_path)]
    with warnings.catch_warnings(action="error"):
        result = CliRunner().invoke(main, [*words, "--json", str(file)])
    assert result.exit_code == 0, result.output
    assert "smallest error" in result.output
    assert re.search(r"(?m)^wrote .*report\.html$", result.output)
    best = r"(?m)^for \d+(?: to \d+)? digits up to t = 20 s: ((rk4|dp8) with h|adaptive .*tol) = "
    assert re.search(best, result.output)
    assert (tmp_path / "mass_spring" / "report.html").read_text().startswith("<!DOCTYPE html>")
    assert json.loads(file.read_text())[0]["scene"] == "mass_spring"
    short = CliRunner().invoke(main, [*words, "--digits", "8"])
    assert short.exit_code == 0
    assert len(short.output.splitlines()) == 1
    assert short.output.startswith("mass_spring: for 8 digits up to t = ")


@pytest.mark.slow
def test_chaos_is_reported(tmp_path: Path) -> None:
    """The case's own amplification at the end is 1.7e11, from a perturbed initial state."""
    system = case_system("double_pendulum_chaotic")
    r = cost_of_digits.measure(system, tmp_path, longest=0.02, methods=("rk4", "dp8"))
    assert r.growth.wild
    assert 1e10 < r.growth.amplification[-1] < 1e13  # in another norm than the case
    assert r.growth.horizon > 15
    assert "no run in doubles means anything" in " ".join(page.remarks(r))
    smallest = min(p.along for p in r.points)
    assert 1e-9 < smallest < 1e-2  # 1.7e11 times rounding


@pytest.mark.usefixtures("quickly_compiled")
def test_unusable_stepper_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def sources(system: System, *arguments: object, **options: object) -> Sources:
        if "rk4" in system.run.methods:
            raise EomcError("rk4 is refused here")
        return plain(system, *arguments, **options)  # type: ignore[arg-type]

    plain = pipeline.sources
    monkeypatch.setattr(pipeline, "sources", sources)
    module, skipped = cost_of_digits.build_variant(oscillator(), ("rk4", "dp8"), tmp_path)
    assert module.methods == ("dp8",) and skipped == {"rk4": "rk4 is refused here"}
    with pytest.raises(EomcError, match="no stepper can be used: rk4 is refused here"):
        cost_of_digits.build_variant(oscillator(), ("rk4",), tmp_path)


def test_progress_starts_before_the_reference_is_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    reports: list[tuple[int, int]] = []

    def raise_after_first_report(*_: Any, **__: Any) -> Any:
        assert reports == [(0, len(METHODS) + 3)]
        raise EomcError("seen")

    monkeypatch.setattr(cost_of_digits.reference_solution, "solve", raise_after_first_report)
    with pytest.raises(EomcError, match="seen"):
        cost_of_digits.measure(SCENES / "cartpole.toml", progress=lambda *how: reports.append(how))
