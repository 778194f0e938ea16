"""The picture beside the curves shows exactly the contents of a drawing."""

import numpy as np
import pytest
from report.pictures import motion, scene, system

from eomc.report import plot
from eomc.report.drawing import draw_mechanism

pytest.importorskip("matplotlib")


def axes():
    from matplotlib.figure import Figure

    return Figure().add_subplot()


def draw(name, **how):
    model = scene(name)
    run = motion(model, **how)
    shown = plot.make_picture(system(model), run.t, run.q, run.qd)
    canvas = axes()
    shown.draw(canvas)
    return shown, canvas, run


def test_rods_connect_the_cart_and_the_pole():
    _, canvas, run = draw("cartpole")
    rods = [line.get_xydata() for line in canvas.get_lines() if len(line.get_xydata()) == 2]
    assert len(rods) >= 5
    assert np.allclose([np.linalg.norm(a - b) for a, b in rods], 2.0)  # l
    assert np.allclose([a[1] for a, _ in rods], 0.0)
    assert np.allclose(rods[0][0], run.q[0, 0] * np.array([1, 0]))
    assert canvas.get_xlabel() == "$x$ (m)" and canvas.get_title().startswith(
        "In the plane, t = 0 to"
    )


def test_earlier_instants_are_lighter():
    _, canvas, _ = draw("double_pendulum")
    shades = [line.get_color() for line in canvas.get_lines() if line.get_zorder() == 1]
    greys = [float(shade) for shade in shades]
    assert greys == sorted(greys, reverse=True) and len({*greys}) == plot.MAX_GHOSTS - 1


def test_space_has_three_arrows_of_a_stated_length():
    shown, canvas, _ = draw("furuta_pendulum")
    texts = [text.get_text() for text in canvas.texts]
    assert [t for t in texts if t][:3] == ["$x$", "$y$", "$z$"]
    assert any(t.endswith(" m") for t in texts) and not canvas.axison
    right, above, near = plot.view_basis(2)
    assert np.allclose(np.cross(right, above), near) and above[2] > 0.9 * np.hypot(*above[:2])
    assert np.allclose(plot.view_basis(1) @ plot.view_basis(1).T, np.eye(3))
    assert plot.view_basis(1)[1].argmax() == 1  # y points up
    assert plot.project_points(shown.drawing).shape[2] == 2


@pytest.mark.parametrize("name", ["suspension", "satellite", "crane", "heavy_top", "kepler_orbit"])
def test_every_mark_is_drawn(name):
    """There are as many lines and symbols as in the drawing at its last instant."""
    drawing = draw(name)[0].drawing
    flat = plot.project_points(drawing)[-1]
    again = axes()
    plot.draw_marks(again, drawing, flat)
    lines = sum(
        len([*plot.outline(m, flat[list(m.points)], 0.1, 0.0)])
        for m in drawing.marks
        if m.kind in plot.LINES
    )
    symbols = sum(m.kind in plot.SYMBOLS for m in drawing.marks)
    rotated = sum(m.kind == "mass" and len(m.points) == 2 for m in drawing.marks)
    assert {m.kind for m in drawing.marks} <= {*plot.LINES, *plot.SYMBOLS}
    assert len(again.get_lines()) == lines + symbols + rotated > 0


def test_dot_of_a_path_is_at_the_mechanism():
    shown, canvas, _ = draw("cartpole")
    (dot,) = [line.get_xydata()[0] for line in canvas.get_lines() if line.get_zorder() == 6]
    rods = [line.get_xydata() for line in canvas.get_lines() if line.get_zorder() == 3]
    assert any(np.allclose(rod[-1], dot) for rod in rods if len(rod) == 2)
    assert not np.allclose(
        dot, plot.project_points(shown.drawing)[-1, shown.drawing.paths[0].point]
    )


def test_single_point_is_drawn_once():
    """A mechanism of points only is drawn at the end of its path."""
    shown, canvas, _ = draw("kepler_orbit")
    flat = plot.project_points(shown.drawing)
    dots = [line.get_xydata()[0] for line in canvas.get_lines() if len(line.get_xydata()) == 1]
    at = {tuple(np.round(dot, 9)) for dot in dots}
    assert at == {tuple(np.round(x, 9)) for x in flat[-1]}


def test_spring_is_drawn_between_its_ends():
    (line,) = plot.outline(plot.Mark("spring", (0, 1)), np.array([[0.0, 0], [3, 4]]), 0.1, 0.0)
    assert np.allclose(line[[0, -1]], [[0, 0], [3, 4]])
    across = line @ np.array([-0.8, 0.6])
    assert np.isclose(np.abs(across).max(), 0.1)


def test_travelling_mechanism_is_drawn_at_its_initial_position():
    model = scene("slung_load")
    run = motion(model)
    run.q[:, 0] += 100 * run.t
    shown = plot.Mechanism(run.t, draw_mechanism(system(model), run.t, run.q))
    canvas = axes()
    shown.draw(canvas)
    assert canvas.dataLim.width < 20


def test_undefined_positions_are_omitted():
    model = scene("simple_pendulum")
    run = motion(model, rows=5)
    run.q[2] = np.nan
    canvas = axes()
    plot.Mechanism(run.t, draw_mechanism(system(model), run.t, run.q)).draw(canvas)
    assert canvas.get_lines()
