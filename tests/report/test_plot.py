"""The figure of a run has labels with units, and shows the mechanism in the plane."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import sympy
from support.fake_module import FakeRun

from eomc.base.errors import EomcError
from eomc.base.names import GREEK
from eomc.model.system import Input, Output, System, from_scene, symbol
from eomc.report import plot
from eomc.runtime.plot import mathtext
from eomc.scene.read import read

pytest.importorskip("matplotlib")

SCENES = Path(__file__).parents[2] / "scenes"


def cartpole():
    system = from_scene(read(SCENES / "cartpole.toml"))
    t = np.linspace(0, 2, 201)
    q = np.column_stack([0.1 * np.sin(t), np.pi / 2 + t])
    return system, FakeRun(system, t, q, np.gradient(q, t, axis=0), 5 + 1e-6 * t)


def spring(n=1):
    x = [symbol(f"x_{i + 1}") for i in range(n)]
    v = [symbol(f"x_{i + 1}_dot") for i in range(n)]
    system = System.make(
        "spring",
        dict.fromkeys(x, 1.0),
        sum(w**2 for w in v) / 2,
        sum(y**2 for y in x) / 2,
        units=dict.fromkeys(x, "m"),
    )
    t = np.linspace(0, 6, 61)
    q = np.column_stack([np.cos(t)] * n)
    return system, FakeRun(system, t, q, np.gradient(q, t, axis=0), np.exp(-t))


def test_angles_are_wrapped_on_request():
    system, run = cartpole()
    q = np.column_stack([run.q[:, 0], run.q[:, 1] + 4 * run.t])
    run = replace(run, q=q)
    for wrap in (False, True):
        cart, pole = (
            axes.lines[0].get_ydata()
            for axes in plot.make_figure(system, run, wrap=wrap).axes[:4:2]
        )
        assert np.array_equal(cart, q[:, 0])
        assert (np.nanmax(np.abs(pole)) <= np.pi) == wrap
        assert np.isnan(pole).any() == wrap  # no line at the jumps


@pytest.mark.slow  # quick tests cover SVG below and PNG by `eomc run --plot`
@pytest.mark.parametrize(
    ("run", "suffix"),
    [(run, suffix) for run in (cartpole, spring) for suffix in plot.SUFFIXES],
)
def test_figures_are_written_to_files(tmp_path, run, suffix):
    file = tmp_path / f"picture{suffix}"
    plot.write_figure(*run(), file)
    assert file.stat().st_size > 5_000


def test_inputs_and_outputs_have_panels_by_unit_and_size():
    system, run = cartpole()
    sizes = {"y_0": ("m", 1), "y_1": ("m", 2), "y_2": ("m", 500), "power": ("W", 1)}
    outputs = tuple(Output(name, sympy.S.One, unit) for name, (unit, _) in sizes.items())
    drawn = {name: size * (1 + run.t) for name, (_, size) in sizes.items()}
    system = replace(system, outputs=outputs, inputs=(Input("push", "N"),))
    run = replace(run, system=system, others={**drawn, "push": 3 * run.t})
    axes = plot.make_figure(system, run).axes[4:-2]
    labels = [r"$\mathrm{push}$ (N)", "outputs (m)", "$y_{2}$ (m)", r"$\mathrm{power}$ (W)"]
    assert [a.get_ylabel() for a in axes] == labels
    lines = [line.get_ydata()[-1] for a in axes for line in a.get_lines()]
    assert lines == [6, 3, 6, 1500, 3]


def test_same_run_gives_the_same_bytes(tmp_path):
    for name in ("a.svg", "b.svg"):
        plot.write_figure(*spring(), tmp_path / name)
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    assert (tmp_path / "a.svg").stat().st_size > 5_000


def test_axes_have_labels_and_units():
    figure = plot.make_figure(*cartpole())
    *curves, energy, plane = figure.axes
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
    assert figure.get_suptitle() == "Cart-pole"
    assert plot.make_figure(*cartpole(), title="Mine").get_suptitle() == "Mine"


def test_discrete_coordinates_have_no_velocity():
    system, run = spring(3)
    system = replace(system, discrete=("x_3",), coordinates=(
        *system.coordinates[:2], replace(system.coordinates[2], unit="")
    ))  # fmt: skip
    shown = plot.make_figure(system, replace(run, system=system))
    kinds = [axes.get_ylabel() for axes in shown.axes]
    assert kinds == ["coordinates (m)", "velocities (m/s)", "$x_{3}$", "$E$ (J)"]


def test_run_of_one_coordinate_shows_energy_and_phase_portrait():
    *_, energy, phase = plot.make_figure(*spring()).axes
    assert (phase.get_xlabel(), phase.get_ylabel()) == ("$x_{1}$ (m)", r"$\dot{x}_{1}$ (m/s)")
    assert energy.get_ylabel() == "$E$ (J)"


def test_jacobi_integral_is_drawn_where_it_differs_from_energy():
    system, run = spring()
    energy, jacobi = run.energy, 7 + 1e-9 * np.sin(run.t)
    driven = replace(run, jacobi=jacobi)
    *_, axes, _ = plot.make_figure(system, driven).axes
    lines = {line.get_label(): line.get_ydata() for line in axes.get_lines()}
    assert np.array_equal(lines["energy, not conserved"], energy - energy[0])
    assert np.array_equal(lines["Jacobi's integral, conserved"], jacobi - jacobi[0])
    assert axes.get_ylabel() == "$E - E(0)$, $J - J(0)$ (J)" and axes.get_legend()
    assert r"Jacobi's integral: max $|J - J(0)|$ = $1\times10^{-9}$ J" in axes.get_title()
    words = "work of forces -2 J; numerical error 1e-09 J"
    *_, axes, _ = plot.make_figure(system, driven, balance=words).axes
    assert "Jacobi's integral: work of forces -2 J\nnumerical error" in axes.get_title()
    assert "Jacobi's integral" in {line.get_label() for line in axes.get_lines()}
    *_, axes, _ = plot.make_figure(system, run, balance=words).axes
    assert axes.get_title().endswith("; work of forces -2 J\nnumerical error 1e-09 J")
    axes_of_energy = plot.make_figure(system, replace(driven, energy=0 * energy)).axes[-2]
    assert axes_of_energy.get_ylim()[1] < 1e-8  # with the energy only it would be 1


@pytest.mark.parametrize("n", [2, 5, 9, 30])
def test_many_coordinates_share_axes_and_every_one_is_drawn(n):
    figure = plot.make_figure(*spring(n))
    time = [a for a in figure.axes if "plane" not in a.get_title() and "space" not in a.get_title()]
    assert len(time) <= 9
    assert sum(len(a.get_lines()) for a in time) == 2 * n + 1
    assert figure.get_size_inches()[1] <= 9


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
def test_names_are_typeset_as_mathematics(name, printed):
    assert mathtext(name) == printed


def test_every_greek_letter_is_typeset():
    from matplotlib.mathtext import MathTextParser

    for letter in GREEK.values():
        MathTextParser("agg").parse(mathtext(f"{letter}_{letter}", rate=True))


def test_missing_matplotlib_is_reported_with_a_remedy(tmp_path, monkeypatch):
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


def test_run_of_one_sample_is_drawn():
    for run in (cartpole, spring):
        system, curves = run()
        first = FakeRun(system, curves.t[:1], curves.q[:1], curves.qd[:1], curves.energy[:1])
        plot.make_figure(system, first)
