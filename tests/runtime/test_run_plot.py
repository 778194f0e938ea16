"""Plots of runs: panels, their curves, and the axes that they use."""

import base64
import dataclasses
import importlib.util
import io
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.session import Modules

from eomc.runtime.plot import Curve, broken, grouped, html, mathtext, rate_unit, wrapped

if importlib.util.find_spec("matplotlib") is None:
    pytest.skip("matplotlib is not installed", allow_module_level=True)


@pytest.fixture(autouse=True)
def pyplot() -> Iterator[Any]:
    """Import pyplot only when these tests run, not when they are collected."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    yield pyplot
    pyplot.close("all")


@pytest.fixture(scope="module")
def run(driven: ModuleType):
    return driven.simulate(duration=2.0, u={"force": 0.5})


def labels(axes) -> list[str]:
    return [a.get_ylabel() for a in np.ravel(axes)]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("shoulder_pan_joint", r"$\mathrm{shoulder\ pan\ joint}$"),
        ("wrist_1_joint", r"$\mathrm{wrist\ 1\ joint}$"),
        ("tip_x", r"$\mathrm{tip}_{\mathrm{x}}$"),
        ("m_pole", r"$m_{\mathrm{pole}}$"),
        ("theta_rod", r"$\theta_{\mathrm{rod}}$"),
        ("rod_prime", r"$\mathrm{rod}'$"),
    ],
)
def test_names_of_words_are_words_in_mathtext(name: str, expected: str) -> None:
    assert mathtext(name) == expected


def test_picture_is_written(run, tmp_path: Path, pyplot: Any) -> None:
    for k, options in enumerate(({}, {"phase": "theta"}, {"phase": ("x", "theta")})):
        run.plot("theta", file=tmp_path / f"{k}.png", **options)
        assert pyplot.imread(tmp_path / f"{k}.png").shape[1] >= 600
    with pytest.raises(ValueError, match=r"'p\.png' is no column: give file='p\.png'"):
        run.plot("p.png")


def test_constant_inputs_are_drawn_as_steps(run, driven: ModuleType) -> None:
    (constant,), (signal,) = (
        r.plot("force").get_lines() for r in (run, driven.simulate(duration=2.0))
    )
    assert constant.get_drawstyle() == "steps-post" and signal.get_drawstyle() == "default"


def test_default_panels_are_coordinates_inputs_and_energy(run) -> None:
    axes = run.plot()
    expected = ["$x$ (m)", r"$\theta$ (rad)", r"$\mathrm{force}$ (N)", "energy (J)"]
    assert labels(axes) == expected and axes[-1].get_xlabel() == "$t$ (s)"
    assert [a.get_xlabel() for a in axes[:-1]] == [""] * 3
    for a, name in zip(axes, ("x", "theta", "force", "energy"), strict=True):
        (line,) = a.get_lines()
        assert np.array_equal(line.get_xdata(), run.t)
        assert np.array_equal(line.get_ydata(), run[name])


def test_outputs_and_velocities_are_plotted_by_name(everything: ModuleType) -> None:
    run = everything.simulate(duration=0.2)
    axes = run.plot("tip", "theta_dot", "pull")
    assert labels(axes) == [r"$\mathrm{tip}$ (m)", r"$\dot{\theta}$ (rad/s)", r"$\mathrm{pull}$"]
    assert np.array_equal(axes[0].get_lines()[0].get_ydata(), run.outputs["tip"])
    with pytest.raises(KeyError, match="did you mean 'tip'"):
        run.plot("tipp")


def test_phase_portraits_follow_the_curves(run) -> None:
    axes = run.plot("theta", phase=["theta", ("x", "theta")])
    assert len(axes) == 3
    assert np.array_equal(axes[1].get_lines()[0].get_xydata().T, [run.theta, run.theta_dot])
    assert (axes[2].get_xlabel(), axes[2].get_ylabel()) == ("$x$ (m)", r"$\theta$ (rad)")
    single = run.plot(phase="theta")
    assert np.array_equal(single.get_lines()[0].get_ydata(), run.theta_dot)
    with pytest.raises(ValueError, match="'force' is no coordinate"):
        run.plot(phase="force")


def test_axes_can_be_passed_and_are_returned(run, pyplot: Any) -> None:
    _, own_axes = pyplot.subplots(2)
    assert all(a is b for a, b in zip(run.plot("x", "theta", ax=own_axes), own_axes, strict=True))
    assert run.plot("x", "theta", ax=own_axes[0], color="red", linewidth=3) is own_axes[0]
    assert [a.get_color() for a in own_axes[0].get_lines()[1:]] == ["red", "red"]
    initial_count = len(pyplot.get_fignums())
    with pytest.raises(ValueError, match="ax: 2 for 4 panels"):
        run.plot(ax=own_axes)
    with pytest.raises(ValueError, match="axes: give ax="):
        run.plot("x", axes=own_axes)
    assert len(pyplot.get_fignums()) == initial_count


def test_style_is_that_of_the_user(run, pyplot: Any) -> None:
    with pyplot.rc_context({"lines.linewidth": 4.5, "axes.prop_cycle": pyplot.cycler(color=["k"])}):
        (line,) = run.plot("x").get_lines()
    assert line.get_linewidth() == 4.5 and line.get_color() == "k"


def test_compared_runs_share_the_colours_of_their_columns(driven: ModuleType, run) -> None:
    other = driven.simulate(duration=1.0, u=lambda t, q, qd: [-q[0]], control_period=0.05)
    axes = run.plot("x", "force", other=other, labels=["held", "law_1"])
    for a, name in zip(axes, ("x", "force"), strict=True):
        first, second = a.get_lines()
        assert np.array_equal(second.get_ydata(), other[name])
        assert first.get_color() == second.get_color() and second.get_linestyle() == "--"
        texts = [text.get_text() for text in a.get_legend().get_texts()]
        assert texts == [f"{mathtext(name)}, held", f"{mathtext(name)}, law_1"]
    with pytest.raises(ValueError, match="labels: give 2"):
        run.plot("x", other=[other], labels=["one"])


def test_wrapped_angles_have_breaks_and_no_jumps(modules: Modules) -> None:
    run = modules("simple_pendulum").simulate(qd0=[9.0], duration=5.0)
    assert run.theta[-1] > 8
    (line,) = run.plot("theta", wrap=True).get_lines()
    plotted = line.get_ydata()
    assert np.nanmax(np.abs(plotted)) <= np.pi
    assert np.isnan(plotted).sum() == np.sum(np.diff(np.floor((run.theta + np.pi) / (2 * np.pi))))
    assert np.nanmax(np.abs(np.diff(plotted))) < 0.1
    portrait = run.plot(phase="theta", wrap="theta").get_lines()[0].get_xdata()
    assert np.isnan(portrait).sum() == np.isnan(plotted).sum()
    with pytest.raises(KeyError, match="'thetta'"):
        run.plot("theta", wrap=["thetta"])


INVALID_OPTIONS: list[tuple[dict[str, Any], str]] = [
    ({"period": 0}, "period: 0 is not a period: give a number greater than 0"),
    ({"period": -1.0}, "period: -1 is not a period"),
    ({"period": np.nan}, "period: nan is not a finite number"),
    ({"value": np.inf}, "value: inf is not a finite number"),
    ({"value": "x"}, "value: 'x' is not a number"),
    ({"rising": "yes"}, "rising: 'yes' is not True or False"),
    ({"rising": 1}, "rising: 1 is not True or False"),
]


def test_sections_are_accurate_to_fourth_order_in_the_row_interval(modules: Modules) -> None:
    """x = cos(t/2) falls through 1/2 at 2 pi/3 and 4 pi later."""
    spring = modules("mass_spring")
    params = {"m": 4.0, "k": 1.0}
    for every in (1, 50, 100, 200):
        run = spring.simulate([1.0], [0.0], h=0.002, duration=20.0, every=every, params=params)
        section = run.section("x", 0.5, rising=False)
        assert np.allclose(section["x"], 0.5, atol=1e-12)
        speed = np.sqrt(0.75) / 2
        # error of the cubic between its middle nodes; the fourth derivative of x is below 0.6/16
        bound = 0.5625 / 24 * 0.6 / 16 * (every * 0.002) ** 4
        error = abs(section["t"] - (2 * np.pi / 3 + 4 * np.pi * np.arange(2)))
        assert (error < bound / speed + 1e-11).all()
        assert np.allclose(section["x_dot"], -speed, atol=bound + 1e-11)
    assert len(run.section("x")["t"]) == 3 and len(run.section("x", rising=True)["t"]) == 1
    assert np.allclose(run.section("t", 1.0, period=4.0)["t"], [1, 5, 9, 13, 17])
    assert np.allclose(run.section("x", 0.5)["x"], 0.5) and not len(run.section("x", 2.0)["t"])
    with pytest.raises(ValueError, match="3 rows, where a cubic needs 4"):
        spring.simulate(steps=2).section("x")
    for options, message in INVALID_OPTIONS:
        with pytest.raises(ValueError, match=message):
            run.section("x", **options)
    points = run.plot(phase="x", section=run.section("t", period=4.0)).get_lines()[0]
    assert points.get_linestyle() == "None" and len(points.get_xdata()) == 5


def test_curves_of_one_kind_unit_and_size_share_a_panel() -> None:
    sizes = {"a": 1, "b": 2, "c": 1000, "d": 1, "e": 0}
    curves = [
        Curve(n, np.array([0, x, np.nan]), "m" * (n != "d"), "coordinates")
        for n, x in sizes.items()
    ]
    assert [[c.name for c in g] for g in grouped(curves)] == [["a", "b", "e"], ["c"], ["d"]]
    many = [Curve(f"x{k}", np.ones(2), "m", "coordinates") for k in range(30)]
    assert [len(g) for g in grouped(many)] == [8, 8, 8, 6]
    spread = [Curve(f"x{k}", np.full(2, 100.0**k), "m") for k in range(6)]
    assert [len(g) for g in grouped(spread)] == [6]


def test_wrapping() -> None:
    assert np.allclose(
        wrapped(np.array([0, 3.2, -3.2, 7.0])), [0, 3.2 - 2 * np.pi, 2 * np.pi - 3.2, 7 - 2 * np.pi]
    )
    x, y = broken(np.arange(3.0), np.array([3.0, -3.0, -2.9]), np.array([3.0, -3.0, -2.9]))
    assert np.array_equal(np.isnan(y), [False, True, False, False]) and np.isnan(x[1])


def test_rates_of_words_and_of_units() -> None:
    assert mathtext("arm", True) == r"$\mathrm{d}\,\mathrm{arm}/\mathrm{d}t$"
    assert [rate_unit(u, True) for u in ("m", "", "N m")] == ["m/s", "", "(N m)/s"]


def test_batches_are_drawn_as_fans_lines_or_ends(
    modules: Modules, tmp_path: Path, pyplot: Any
) -> None:
    module = modules.unoptimised(BATCH)
    masses = np.linspace(1, 2, 21)
    runs = module.simulate_batch(np.full((21, 1), 1.0), params={"m": masses}, steps=40)
    axes = runs.plot("x", quantiles=(0.1, 0.5, 0.9))
    (median,) = axes.get_lines()
    assert np.allclose(median.get_ydata(), np.median(runs["x"], axis=0))
    (band,) = axes.collections
    low, high = np.quantile(runs["x"], (0.1, 0.9), axis=0)
    edges = band.get_paths()[0].vertices
    assert np.isclose(edges[:, 1].max(), high.max()) and np.isclose(edges[:, 1].min(), low.min())
    assert axes.get_ylabel() == "$x$ (m)" and axes.get_xlabel() == "$t$ (s)"
    assert len(runs.plot("x", lines=5).get_lines()) == 5
    points = runs.plot("x", over="m").get_lines()[0]
    assert np.array_equal(points.get_xydata().T, [masses, runs["x"][:, -1]])
    assert np.array_equal(runs.plot("x", over=3 * masses).get_lines()[0].get_xdata(), 3 * masses)
    assert runs.plot("x", over="instance").get_xlabel() == "instance"
    with pytest.raises(ValueError, match="did you mean 'm'"):
        runs.plot("x", over="M")
    with pytest.raises(ValueError, match=r"shape \(2,\), expected \(21,\)"):
        runs.plot("x", over=[1, 2])
    runs.plot(file=tmp_path / "many.png")
    assert pyplot.imread(tmp_path / "many.png").shape[1] >= 600
    with pytest.raises(ValueError, match=r"'p\.pdf' is no column: give file='p\.pdf'"):
        runs.plot("p.pdf")
    advice = r" is of one run: many\.simulate\(runs\.q\[k, 0\], runs\.qd\[k, 0\], params=\.\.\.\)\."
    with pytest.raises(TypeError, match=rf"plot: phase={advice}plot\(phase=\.\.\.\)"):
        runs.plot(phase="x")
    for name in ("estimate", "balance", "section", "error"):
        with pytest.raises(AttributeError, match=f"{name}{advice}[bes]"):
            getattr(runs, name)


BATCH = """
eomc = 1
name = "many"
[coordinates]
x = { unit = "m", start = 1.0 }
[parameters]
m = { value = 1.0, unit = "kg" }
[energy]
kinetic = "m*x_dot**2/2"
potential = "x**2/2"
[run]
h = 0.05
duration = 2.0
batch = true
"""


def test_end_values_of_stopped_instances_are_their_last_valid_rows(modules: Modules) -> None:
    runs = modules.unoptimised(BATCH).simulate_batch(np.ones((2, 1)), steps=10)
    runs.q[1, 4:] = np.nan
    y = runs.plot("x", over="instance").get_lines()[0].get_ydata()
    assert np.array_equal(y, [runs.q[0, -1, 0], runs.q[1, 3, 0]])


@pytest.mark.slow
def test_notebook_shows_end_verdict_and_picture(driven: ModuleType, pyplot: Any) -> None:
    run = driven.simulate(duration=0.5)
    page = run._repr_html_()
    assert "status: ok" in page and f"{run.q[-1, 1]:.9g} rad" in page
    assert page.count('src="data:image/png;base64,') == 1 and "http" not in page
    error = run.estimate()
    assert f"estimated error at the end {max(error.q[-1].max(), error.qd[-1].max()):.1g}" in html(
        run
    )
    run.error = dataclasses.replace(error, verdict="steps < motion")
    assert "not resolved: steps &lt; motion" in html(run)
    assert not pyplot.get_fignums()


def image(page: str) -> np.ndarray:
    from matplotlib import pyplot

    """The picture of a run in a notebook."""
    data = page.split("data:image/png;base64,")[1].split('"')[0]
    return np.asarray(pyplot.imread(io.BytesIO(base64.b64decode(data)), format="png"))


@pytest.mark.slow
def test_notebook_shows_the_mechanism_if_there_is_one(modules: Modules, monkeypatch) -> None:
    run = modules("cartpole").simulate(duration=0.5)
    page = run._repr_html_()
    assert 'alt="over time: x, theta; and the mechanism"' in page
    complete = image(page)
    mechanism = complete[:, complete.shape[1] // 2 :, :3]
    grey = np.abs(mechanism - 0.3).max(axis=2) < 0.05  # the cart and the pole
    assert grey.sum() > 100
    monkeypatch.setattr(run.model, "source", None)
    curves_only = run._repr_html_()
    assert (
        'alt="over time: x, theta"' in curves_only
        and image(curves_only).shape[1] < complete.shape[1]
    )


def test_notebook_shows_only_curves_of_scenes_without_a_picture(modules: Modules) -> None:
    page = modules.unoptimised(BATCH).simulate(duration=0.5)._repr_html_()
    assert 'alt="over time: x"' in page


def test_notebook_escapes_free_text(modules: Modules, monkeypatch) -> None:
    run = modules("mass_spring").simulate(steps=5)
    model = run.model
    info = replace(model.info, title="<script>$x$\x1b", units={"x": '"><b>'})
    monkeypatch.setattr(model, "info", info)
    page = html(run)
    assert "&lt;script&gt;$x$\\x1b" in page and "<script>" not in page and "<b>&" not in page[20:]
    assert "&quot;&gt;&lt;b&gt;" in page


def test_missing_matplotlib_is_reported_with_advice(modules: Modules) -> None:
    """Run in a separate process: matplotlib cannot be unloaded."""
    folder = modules("mass_spring").__path__[0]
    code = """
import importlib.abc, sys
class No(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name.split(".")[0] in ("matplotlib", "eomc"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, No())
import mass_spring
run = mass_spring.simulate(steps=5)
run.section("x")
try:
    run.plot()
except ModuleNotFoundError as fault:
    print(fault)
"""
    path = Path(folder).parent
    process = subprocess.run([sys.executable, "-c", code], cwd=path, capture_output=True, text=True)
    assert "plot: matplotlib is not installed: pip install matplotlib" in process.stdout, (
        process.stderr
    )
