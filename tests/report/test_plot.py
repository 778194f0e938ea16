"""The figure of a run says what is drawn, in which unit, and shows the mechanism in the plane."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import sympy

from eomc.base.errors import EomcError
from eomc.base.names import GREEK
from eomc.model.from_scene import from_scene
from eomc.model.system import Input, Output, System, symbol
from eomc.report import plot
from eomc.report.plot import RunCurves
from eomc.runtime.labels import mathtext
from eomc.scene.read import read

pytest.importorskip("matplotlib")

SCENES = Path(__file__).parents[2] / "scenes"


def cartpole():
    made = from_scene(read(SCENES / "cartpole.toml"))
    t = np.linspace(0, 2, 201)
    q = np.column_stack([0.1 * np.sin(t), np.pi / 2 + t])
    return made, RunCurves(t, q, np.gradient(q, t, axis=0), 5 + 1e-6 * t)


def spring(n=1):
    x = [symbol(f"x_{i + 1}") for i in range(n)]
    v = [symbol(f"x_{i + 1}_dot") for i in range(n)]
    made = System.make(
        "spring",
        dict.fromkeys(x, 1.0),
        sum(w**2 for w in v) / 2,
        sum(y**2 for y in x) / 2,
        units=dict.fromkeys(x, "m"),
    )
    t = np.linspace(0, 6, 61)
    q = np.column_stack([np.cos(t)] * n)
    return made, RunCurves(t, q, np.gradient(q, t, axis=0), np.exp(-t))


def test_angles_are_wrapped_where_asked_for():
    made, run = cartpole()
    q = np.column_stack([run.q[:, 0], run.q[:, 1] + 4 * run.t])
    run = replace(run, q=q)
    for wrap in (False, True):
        cart, pole = (
            axes.lines[0].get_ydata() for axes in plot.make_figure(made, run, wrap=wrap).axes[:4:2]
        )
        assert np.array_equal(cart, q[:, 0])
        assert (np.nanmax(np.abs(pole)) <= np.pi) == wrap
        assert np.isnan(pole).any() == wrap  # no line where they jump


@pytest.mark.slow  # the quick ones: SVG below, PNG by `eomc run --plot`
@pytest.mark.parametrize(
    ("run", "suffix"),
    [(run, suffix) for run in (cartpole, spring) for suffix in plot.SUFFIXES],
)
def test_files_are_written(tmp_path, run, suffix):
    file = tmp_path / f"picture{suffix}"
    plot.write_figure(*run(), file)
    assert file.stat().st_size > 5_000


def test_inputs_and_outputs_have_panels_by_unit_and_size():
    made, run = cartpole()
    sizes = {"y_0": ("m", 1), "y_1": ("m", 2), "y_2": ("m", 500), "power": ("W", 1)}
    asked = tuple(Output(name, sympy.S.One, unit) for name, (unit, _) in sizes.items())
    drawn = {name: size * (1 + run.t) for name, (_, size) in sizes.items()}
    made = replace(made, outputs=asked, inputs=(Input("push", "N"),))
    run = replace(run, outputs=drawn, inputs={"push": 3 * run.t})
    axes = plot.make_figure(made, run).axes[4:-2]
    labels = [r"$\mathrm{push}$ (N)", "outputs (m)", "$y_{2}$ (m)", r"$\mathrm{power}$ (W)"]
    assert [a.get_ylabel() for a in axes] == labels
    lines = [line.get_ydata()[-1] for a in axes for line in a.get_lines()]
    assert lines == [6, 3, 6, 1500, 3]


def test_same_run_same_bytes(tmp_path):
    for name in ("a.svg", "b.svg"):
        plot.write_figure(*spring(), tmp_path / name)
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    assert (tmp_path / "a.svg").stat().st_size > 5_000


def test_axes_say_what_they_show():
    made = plot.make_figure(*cartpole())
    *curves, energy, plane = made.axes
    assert [a.get_ylabel() for a in curves] == [
        "$x$ (m)",
        r"$\dot{x}$ (m/s)",
        r"$\theta$ (rad)",
        r"$\dot{\theta}$ (rad/s)",
    ]
    assert energy.get_xlabel() == "$t$ (s)"
    assert energy.get_ylabel() == "$E - E(0)$ (J)"
    assert "max $|E - E(0)|$ = $2\\times10^{-6}$ J" in energy.get_title()
    assert plane.get_xlabel() == "$x$ (m)"
    assert plane.get_aspect() == 1
    assert made.get_suptitle() == "Cart-pole"
    assert plot.make_figure(*cartpole(), title="Mine").get_suptitle() == "Mine"


def test_what_only_jumps_change_has_no_velocity():
    made, run = spring(3)
    made = replace(made, discrete=("x_3",), coordinates=(
        *made.coordinates[:2], replace(made.coordinates[2], unit="")
    ))  # fmt: skip
    shown = plot.make_figure(made, run)
    kinds = [axes.get_ylabel() for axes in shown.axes]
    assert kinds == ["coordinates (m)", "velocities (m/s)", "$x_{3}$", "$E$ (J)"]


def test_one_coordinate_has_a_phase_portrait_and_lost_energy_is_drawn_as_it_is():
    *_, energy, phase = plot.make_figure(*spring()).axes
    assert (phase.get_xlabel(), phase.get_ylabel()) == ("$x_{1}$ (m)", r"$\dot{x}_{1}$ (m/s)")
    assert energy.get_ylabel() == "$E$ (J)"


def test_jacobis_integral_is_drawn_beside_the_energy_where_it_is_another():
    made, run = spring()
    energy, jacobi = run.energy, 7 + 1e-9 * np.sin(run.t)
    driven = replace(run, jacobi=jacobi)
    *_, axes, _ = plot.make_figure(made, driven).axes
    lines = {line.get_label(): line.get_ydata() for line in axes.get_lines()}
    assert np.array_equal(lines["energy, not conserved"], energy - energy[0])
    assert np.array_equal(lines["Jacobi's integral, conserved"], jacobi - jacobi[0])
    assert axes.get_ylabel() == "$E - E(0)$, $J - J(0)$ (J)" and axes.get_legend()
    assert r"Jacobi's integral: max $|J - J(0)|$ = $1\times10^{-9}$ J" in axes.get_title()
    words = "forces took 2 J; numerical error 1e-09 J"
    *_, axes, _ = plot.make_figure(made, replace(driven, balance=words)).axes
    assert "Jacobi's integral: forces took 2 J\nnumerical error" in axes.get_title()
    assert "Jacobi's integral" in {line.get_label() for line in axes.get_lines()}
    *_, axes, _ = plot.make_figure(made, replace(run, balance=words)).axes
    assert axes.get_title().endswith("; forces took 2 J\nnumerical error 1e-09 J")
    still = plot.make_figure(made, replace(driven, energy=0 * energy)).axes[-2]
    assert still.get_ylim()[1] < 1e-8  # of the energy alone it would be 1


@pytest.mark.parametrize("n", [2, 5, 9, 30])
def test_many_coordinates_share_axes_and_every_one_is_drawn(n):
    made = plot.make_figure(*spring(n))
    time = [a for a in made.axes if "plane" not in a.get_title() and "space" not in a.get_title()]
    assert len(time) <= 9
    assert sum(len(a.get_lines()) for a in time) == 2 * n + 1
    assert made.get_size_inches()[1] <= 9


@pytest.mark.parametrize(
    ("name", "printed"),
    [
        ("x", "$x$"),
        ("theta", r"$\theta$"),
        ("theta_1", r"$\theta_{1}$"),
        ("q10", "$q_{10}$"),
        ("m_c", r"$m_{\mathrm{c}}$"),
        ("arm", r"$\mathrm{arm}$"),
        ("x_p_2", r"$x_{\mathrm{p},2}$"),
    ],
)
def test_names_are_set_as_mathematics(name, printed):
    assert mathtext(name) == printed


def test_every_greek_letter_can_be_set():
    from matplotlib.mathtext import MathTextParser

    for letter in GREEK.values():
        MathTextParser("agg").parse(mathtext(f"{letter}_{letter}", rate=True))


def test_without_matplotlib_one_sentence_says_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(EomcError, match="pip install matplotlib"):
        plot.write_figure(*spring(), tmp_path / "a.png")


def test_unknown_suffixes_and_folders_are_reported(tmp_path, monkeypatch):
    from matplotlib.figure import Figure

    monkeypatch.setattr(plot, "make_figure", lambda *_: Figure())
    with pytest.raises(EomcError, match=r"\.png, \.svg, \.pdf"):
        plot.write_figure(*spring(), tmp_path / "a.jpg")
    with pytest.raises(EomcError, match="can't be written"):
        plot.write_figure(*spring(), tmp_path / "nowhere" / "a.png")


def test_a_run_of_one_sample_can_be_drawn():
    for run in (cartpole, spring):
        made, curves = run()
        first = RunCurves(curves.t[:1], curves.q[:1], curves.qd[:1], curves.energy[:1])
        plot.make_figure(made, first)
