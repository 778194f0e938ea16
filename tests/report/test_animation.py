"""The page of a motion is one file without network access; films and their requirements."""

import base64
import itertools
import json
import os
import re
from types import SimpleNamespace

import numpy as np
import pytest
from report.pictures import SCENES, chain, humanoid, motion, scene, system
from support import trajectories

from eomc.base.errors import EomcError
from eomc.report import animation
from eomc.report.drawing import Timeline, choose_instances, draw_mechanism, find_system
from eomc.report.plot import html_name

EVIL = "</script><img src=x onerror=alert(1)>"


def page(model, title="", **how):
    return animation.page([Timeline(system(model, title), motion(model, **how))])


def data(text):
    (content,) = re.findall(r'<script id="data" type="application/json">(.*?)</script>', text)
    return json.loads(content)


def values(packed, shape=(-1,)):
    levels = np.frombuffer(base64.b64decode(packed["data"]), dtype="<i2").astype(float)
    return packed["middle"] + levels.reshape(shape) * packed["scale"]


def times(run_data):
    """Return the times of the rows of a run on a page."""
    return np.frombuffer(base64.b64decode(run_data["rows"]), dtype="<f8")


def test_page_needs_no_network():
    text = page(scene("cartpole"))
    assert "default-src 'none'" in text
    assert not re.findall(r"https?:|//[a-z]+\.|@import|url\(|\bsrc=|\bhref=|<link|fetch\(", text)


def test_titles_are_escaped():
    text = animation.page(
        [Timeline(system(scene("cartpole"), EVIL), motion(scene("cartpole")))] * 2
    )
    assert "<img" not in text and text.count("</script>") == 2
    assert "&lt;img" in text
    assert "<img" not in page(scene("cartpole"), title=EVIL)


def test_names_in_the_data_are_escaped():
    run = motion(scene("cartpole"))
    odd = system(scene("cartpole"))
    odd.coordinates = [SimpleNamespace(name="x", unit=EVIL), SimpleNamespace(name="y", unit="a<b")]
    text = animation.page([Timeline(odd, run)])
    assert "<img" not in text and data(text)


def test_positions_agree_with_the_run_to_the_stated_resolution():
    model = scene("cartpole")
    run = motion(model)
    run_data = data(animation.page([Timeline(system(model), run)]))["runs"][0]
    shown = draw_mechanism(system(model), run.t, run.q)
    d = run_data["drawing"]
    moving = values(d["moving"], (len(run.t), d["count"], 2))
    (box,) = [m for m in d["marks"] if m[0] == "box"]
    (own,) = [m for m in shown.marks if m.kind == "box"]
    assert np.abs(moving[:, box[1:]] - shown.points[:, own.points]).max() <= d["moving"]["scale"]
    assert d["moving"]["scale"] < 1e-4
    assert np.array_equal(times(run_data), run.t)
    _, (theta,), (energy,) = run_data["panels"]
    assert np.abs(values(theta) - run.q[:, 1]).max() <= theta["scale"] and energy["scale"] == 1


def test_fixed_points_are_written_once():
    d = data(page(scene("kepler_orbit")))["runs"][0]["drawing"]
    assert d["fixed"] == [[0, 0]] and d["count"] == 1


@pytest.mark.parametrize("model", [chain, humanoid])
def test_page_of_ten_seconds_is_smaller_than_a_megabyte(model):
    text = page(model(), seconds=10.0, rows=10_001)
    assert len(text) < 1_000_000
    run_data = data(text)["runs"][0]
    assert run_data["smooth"] and len(times(run_data)) >= 500


def test_page_states_the_thinning_of_long_runs():
    text = page(chain(), seconds=100.0, rows=100_001)
    assert len(text) < 1_000_000
    count = len(times(data(text)["runs"][0]))
    assert f"{count} rows, {(count - 1) / 100:.3g} a second" in text


def test_playback_is_in_real_time_unless_the_run_is_too_short_or_long():
    for seconds, speed in ((10, 1), (0.01, 0.01), (3600, 100)):
        assert data(page(scene("cartpole"), seconds=seconds))["speed"] == speed


def test_run_of_one_row_and_non_finite_values():
    text = page(scene("cartpole"), rows=1)
    assert len(times(data(text)["runs"][0])) == 1
    packed = animation._quantize(np.array([1.0, np.nan, 3.0]))
    assert np.frombuffer(base64.b64decode(packed["data"]), "<i2").tolist() == [
        -32767,
        -32768,
        32767,
    ]


def test_scene_without_a_drawing_has_curves():
    drawing_input = system(scene("cartpole"))
    drawing_input.scene, drawing_input.definitions = None, ()
    text = animation.page([Timeline(drawing_input, motion(scene("cartpole")))])
    assert 'class="stage"' not in text and text.count('class="panel"') == 3


def test_many_coordinates_share_panels_by_unit():
    text = page(humanoid())
    assert text.count('class="panel"') == 3  # m, rad, J
    assert text.count('class="name"') == 37


def test_names_are_typeset():
    assert html_name("theta_1", rate=True) == "θ\u0307<sub>1</sub>"
    assert html_name("arm_1", rate=True) == "arm\u02d9<sub>1</sub>"
    assert html_name("wrist_1_joint", rate=True) == "wrist 1 joint\u02d9"
    assert html_name("m_c") == "m<sub>c</sub>" and html_name("arm") == "arm"
    with pytest.raises(ValueError, match="plain name"):
        html_name("<b>")


# --- of a built module ------------------------------------------------------------------------


def test_loaded_module_has_its_scene(modules, tmp_path):
    run = modules("cartpole").simulate(duration=1.0, params={"l": 1.0})
    assert find_system(run).with_parameters({}).parameters[2].value == 1.0
    result = run.animate(tmp_path / "a.html", run, title="Two")
    text = (tmp_path / "a.html").read_text()
    assert text == result.page and "<h1>Two</h1>" in text and text.count('class="stage"') == 2
    assert "srcdoc=" in result._repr_html_() and "<script" not in result._repr_html_()


def test_run_without_its_scene_gives_a_remedy(modules, tmp_path, monkeypatch):
    run = modules("cartpole").simulate(duration=0.1)
    monkeypatch.setattr(run.model, "source", None, raising=False)
    with pytest.raises(EomcError, match=r"cartpole: .* load it with eomc.load, or give scene=PATH"):
        run.animate()
    assert run.animate(scene="scenes/cartpole.toml").page
    with pytest.raises(EomcError, match="is not the scene that cartpole was built from"):
        run.animate(scene="scenes/chain.toml")


def test_run_without_eomc_gives_a_remedy(modules, monkeypatch):
    from importlib import import_module

    run = modules("cartpole").simulate(duration=0.1)
    shown = import_module(type(run).__module__.replace(".trajectory", ".package"))

    def raise_import_error(name):
        raise ModuleNotFoundError(name, name="eomc")

    monkeypatch.setattr(shown, "import_module", raise_import_error)
    with pytest.raises(ImportError, match=r"pip install \."):
        run.animate()


def test_unsuitable_suffixes_and_folders_are_reported(tmp_path):
    runs = [SimpleNamespace()]
    with pytest.raises(EomcError, match=r"as \.html, \.gif or \.mp4"):
        animation.animate(runs, tmp_path / "a.avi")
    with pytest.raises(EomcError, match="can't be written"):
        animation.Animation("").save(tmp_path / "nowhere" / "a.html")


# --- of a batch -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def batch():
    """Return ten poles of different lengths; one of them stops half way."""
    runs = trajectories.module("cartpole").simulate_batch(
        steps=400, params={"l": np.linspace(1.0, 3.0, 10)}
    )
    runs.q[9, 200:], runs.qd[9, 200:], runs.status_codes[9] = np.nan, np.nan, 1
    return runs


def rows_of(batch, text):
    """Return the rows of a batch that a page shows."""
    shown = times(data(text)["runs"][0])
    return np.rint(np.interp(shown, batch.t, np.arange(len(batch.t)))).astype(int)


def test_instances_of_a_batch_are_overlaid(batch, tmp_path):
    result = batch.animate(tmp_path / "b.html", instances=[0, 4, 9])
    text = (tmp_path / "b.html").read_text()
    assert text == result.page and text.count('class="stage"') == 1
    assert "0: l = 1 m" in text and "9: l = 3 m, singular" in text
    d = data(text)["runs"][0]["drawing"]
    assert {*d["whose"]} == {0, 1, 2} and len(d["whose"]) == len(d["marks"])
    assert [(name, instance) for name, _, instance in d["paths"]] == [("0", 0), ("4", 1), ("9", 2)]
    moving, rows = values(d["moving"], (-1, d["count"], 2)), rows_of(batch, text)
    fifth = find_system(batch).with_parameters({"l": batch.request.p[4, 2]})
    drawing = draw_mechanism(fifth, batch.t[rows], batch.q[4, rows])
    (own,) = [k for name, k, _ in d["paths"] if name == "4"]
    path = drawing.points[:, drawing.paths[0].point]
    assert np.abs(moving[:, own] - path).max() <= d["moving"]["scale"]


def test_stopped_instance_is_at_rest_and_its_curve_ends(batch):
    run_data = data(batch.animate(instances=[9], names=["theta"]).page)["runs"][0]
    d = run_data["drawing"]
    moving = values(d["moving"], (-1, d["count"], 2))
    half = len(moving) // 2 + 1
    assert np.ptp(moving[half:], axis=0).max() == 0 < np.ptp(moving[: half - 1], axis=0).max()
    ((curve,),) = run_data["panels"]
    levels = np.frombuffer(base64.b64decode(curve["data"]), dtype="<i2")
    assert (levels[half:] == -32768).all() and (levels[: half - 1] != -32768).all()


def test_curves_of_a_batch_agree_with_its_instances(batch):
    text = batch.animate(names=["theta", "theta_dot"]).page
    theta, rate = data(text)["runs"][0]["panels"]
    shown = [0, 1, 3, 5, 7, 9]  # six, evenly spaced
    for packed, k in zip(rate, shown, strict=True):
        own = batch.qd[k, rows_of(batch, text), 1]
        known = np.isfinite(own)
        assert np.abs(values(packed) - own)[known].max() <= packed["scale"]
    assert len(theta) == 6


@pytest.mark.parametrize("wrong", [0, -1, True, 1.5, "all", [], [[1]], [0, 10], [-1]])
def test_unknown_instances_are_refused(batch, wrong):
    with pytest.raises(EomcError, match="instances: give how many, or a list of some from 0 to 9"):
        batch.animate(instances=wrong)


def test_too_many_instances_and_unknown_curves_are_refused():
    with pytest.raises(EomcError, match="at most 24 can be told apart, here 25"):
        choose_instances(100, 25)
    assert choose_instances(3, 24) == [0, 1, 2] and choose_instances(3, np.array([2, 2])) == [2]


def test_unknown_curves_of_a_batch_are_refused(batch):
    with pytest.raises(KeyError, match="'thete' is not one of t, x, theta"):
        batch.animate(names=["thete"])


@pytest.mark.slow
def test_adaptive_batch_is_animated_at_its_times(modules):
    text = (SCENES / "cartpole.toml").read_text().replace('"cartpole"', '"fitted_poles"')
    many = modules.unoptimised(text.replace("[run]\n", "[run]\nbatch = true\ntolerance = 1e-6\n"))
    lengths = np.linspace(1.0, 2.0, 3)
    runs = many.simulate_batch(params={"l": lengths}, times=np.arange(61) / 60, tol=1e-6)
    run_data = data(runs.animate(instances=[2, 0]).page)["runs"][0]
    assert np.array_equal(times(run_data), runs.t)
    (first, _) = run_data["panels"][1]
    assert np.abs(values(first) - runs.q[2, :, 1]).max() <= first["scale"]


def test_batch_is_written_as_a_film(batch, tmp_path):
    pytest.importorskip("matplotlib")
    image = pytest.importorskip("PIL.Image")
    short = batch.select([0, 5])
    short.q, short.qd = short.q[:, :11], short.qd[:, :11]
    short.animate(tmp_path / "b.gif")
    with image.open(tmp_path / "b.gif") as image_file:
        counted = image_file.convert("RGB").getcolors(1 << 20)
    assert max(counted)[1] == (255, 255, 255)
    colours = {c for _, c in counted}
    assert any(r < 40 and b > 150 for r, _, b in colours)  # the first is blue
    assert any(r > 180 and b < 60 for r, _, b in colours)  # the second is orange


# --- films ------------------------------------------------------------------------------------


def film(model, file, **how):
    from eomc.report import animation

    animation.write_film([Timeline(system(model), motion(model, **how))], file, None)


@pytest.mark.slow
def test_gif_has_a_frame_for_each_instant(tmp_path):
    pytest.importorskip("matplotlib")
    image = pytest.importorskip("PIL.Image")
    film(scene("simple_pendulum"), tmp_path / "a.gif", seconds=0.2)
    with image.open(tmp_path / "a.gif") as image_file:
        assert image_file.n_frames == 6 and image_file.info["duration"] == 40  # ms
        pictures = []
        for k in range(6):
            image_file.seek(k)
            pictures.append(np.asarray(image_file.convert("L"), int)[60:])  # below the title
    changes = [np.abs(a - b).sum() for a, b in itertools.pairwise(pictures)]
    assert min(changes) > max(changes) / 3  # it moves between all frames


def test_film_draws_fixed_parts_once_and_fits_all_in_view(monkeypatch):
    matplotlib = pytest.importorskip("matplotlib")
    from eomc.report.animation import Pictures

    drawn, draw = [], matplotlib.axis.Axis.draw
    monkeypatch.setattr(
        matplotlib.axis.Axis, "draw", lambda self, r: drawn.append(self) or draw(self, r)
    )
    timeline = Timeline(system(scene("suspension")), motion(scene("suspension"), seconds=0.5))
    rows = np.arange(0, len(timeline.t), len(timeline.t) // 8)
    pictures = Pictures([timeline], [timeline.drawing(rows)], timeline.t[rows], None)
    shown = [pictures.picture(k) for k in (*range(len(rows)), 0)]
    assert len(drawn) == 2  # an axis to the right, one upwards
    assert (shown[0] == shown[-1]).all() and (shown[0] != shown[1]).any()
    (axes,), (moving,) = pictures.figure.axes, pictures.moving
    low, high = axes.viewLim.get_points()
    lines = np.concatenate([line for each in moving.shapes for line in each])
    assert (low < lines).all() and (lines < high).all()


@pytest.mark.skipif(os.name == "nt", reason="a script of sh stands for ffmpeg")
def test_mp4_writer_receives_a_frame_for_each_instant(tmp_path, monkeypatch):
    matplotlib = pytest.importorskip("matplotlib")
    program = tmp_path / "ffmpeg"
    program.write_text('#!/bin/sh\nfor last; do :; done\ncat > "$last"\n')
    program.chmod(0o755)
    monkeypatch.setitem(matplotlib.rcParams, "animation.ffmpeg_path", str(program))
    film(scene("simple_pendulum"), tmp_path / "a.mp4", seconds=0.04)
    pictures = np.fromfile(tmp_path / "a.mp4", np.uint8).reshape(3, 480, 480, 4)
    assert (pictures[:, 0, 0] == 255).all() and (pictures[1] != pictures[2]).any()


def test_failed_films_report_the_reason(tmp_path, monkeypatch):
    animations = pytest.importorskip("matplotlib.animation")
    monkeypatch.setattr(animations.FFMpegWriter, "isAvailable", classmethod(lambda _: False))
    with pytest.raises(EomcError, match=r"ffmpeg: install it, or write \.gif"):
        film(scene("cartpole"), tmp_path / "a.mp4")
    with pytest.raises(EomcError, match="25001 pictures, and a film has at most 1500"):
        film(scene("cartpole"), tmp_path / "a.gif", seconds=1000.0)
    bare = system(scene("cartpole"))
    bare.scene, bare.definitions = None, ()
    from eomc.report.animation import write_film

    with pytest.raises(EomcError, match="says nothing about its shape"):
        write_film([Timeline(bare, motion(scene("cartpole")))], tmp_path / "a.gif", None)


def test_film_without_matplotlib_gives_a_remedy(tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "matplotlib.animation", None)
    with pytest.raises(EomcError, match="films need matplotlib"):
        film(scene("cartpole"), tmp_path / "a.gif")


def test_pages_need_no_matplotlib(monkeypatch):
    import sys

    for name in [n for n in sys.modules if n.startswith("matplotlib")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert page(scene("cartpole"))


BOUNCING = """eomc = 1
name = "bouncing"
[coordinates]
y = { unit = "m", start = 1.0 }
x = { unit = "m", start = "X0", rate = 0.5 }
[parameters]
X0 = 2e6
[inputs]
wind = { unit = "N" }
[energy]
kinetic = "(x_dot**2 + y_dot**2)/2"
potential = "9.81*y"
[forces]
x = "wind"
[[event]]
name = "impact"
when = "y"
direction = "falling"
action = "jump"
y_dot = "-0.8*y_dot"
[picture]
points = { ball = ["x - X0", "y"] }
dots = ["ball"]
[run]
tolerance = 1e-9
h = 0.01
duration = 2.0
"""


@pytest.fixture(scope="module")
def ball(modules):
    return modules.unoptimised(BOUNCING)


@pytest.mark.slow
def test_adaptive_runs_are_interpolated_with_both_rows_of_a_jump(ball):
    run = ball.simulate(tol=1e-9, duration=2.0)
    run_data = data(run.animate().page)["runs"][0]
    rows, impacts = times(run_data), run.events["impact"].t
    assert len(run.t) < 50 and len(rows) >= 600 and run_data["smooth"]
    even = np.diff(np.unique(rows))
    assert even.max() < 1 / 60
    for t in impacts:
        assert np.count_nonzero(rows == t) == 2
    ((y,), (x,), *_) = run_data["panels"]
    first = np.searchsorted(rows, impacts[0], side="right")
    exact = 1 - 9.81 * rows[:first] ** 2 / 2
    assert np.abs(values(y)[:first] - exact).max() <= y["scale"] + 1e-9
    assert np.abs(values(x) - (2e6 + 0.5 * rows)).max() <= x["scale"] + 1e-9


def test_zero_order_hold_inputs_are_drawn_as_stairs(ball):
    table = np.arange(20.0)[:, None] % 3
    stepwise_run = ball.simulate(h=0.01, duration=1.0, u=table, control_period=0.05)
    own = ball.simulate(h=0.01, duration=1.0)
    for run, stairs in ((stepwise_run, True), (own, False)):
        panels = data(run.animate().page)["runs"][0]["panels"]
        (wind,) = panels[2]
        assert wind["stairs"] is stairs and not panels[0][0]["stairs"]


def test_notebook_shows_the_page_in_full_height(ball):
    shown = ball.simulate(h=0.01, duration=0.1).animate()._repr_html_()
    height = float(re.search(r"height:([0-9.]+)em", shown)[1])
    assert height >= animation.PANEL_HEIGHT * 4 and "scrollHeight" in shown


@pytest.mark.parametrize("how", [{"h": 0.01}, {"tol": 1e-9}])
def test_picture_at_a_time_is_an_array_of_pixels(ball, how):
    run = ball.simulate(duration=1.0, **how)
    image = run.render(0.333)
    assert image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] == 3
    assert image.std() > 0
    several = run.render([0.0, 0.333])
    assert np.array_equal(several[1], image) or np.abs(several[1].astype(int) - image).mean() < 2
    assert not np.array_equal(several[0], several[1])
    with pytest.raises(ValueError, match="the run goes from 0 s to 1 s"):
        run.render(2.0)
