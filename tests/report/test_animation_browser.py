"""The page of a motion in Chromium: smooth playback, keys and touch, and no network access."""

import io
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from report.pictures import chain, humanoid, motion, scene, system
from support import browser, trajectories

from eomc.report import animation
from eomc.report.drawing import BatchTimeline, Timeline, find_system

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(browser.MISSING), reason=browser.MISSING),
]
AXE = Path(__file__).parents[2] / "build/axe/node_modules/axe-core/axe.min.js"
SLOWEST = 500  # ms from navigation to the first frame
STAGE = "document.querySelector('canvas.stage')"


@pytest.fixture(scope="module")
def window(tmp_path_factory):
    with browser.chromium(tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.fixture
def open_page(window, tmp_path):
    """Open pages of scenes, and check afterwards that nothing was logged or requested."""
    file = tmp_path / "motion.html"

    def open_scenes(*scenes, width=1000, seconds=2.0, rows=1201, title=None, timelines=()):
        timelines = timelines or [
            Timeline(system(model), motion(model, seconds, rows)) for model in scenes
        ]
        file.write_text(animation.page(timelines, title), encoding="utf-8")
        window.open(file, width)
        window.wait("return document.documentElement.dataset.frames > 0")
        return window

    window.media(prefers_color_scheme="light", prefers_reduced_motion="no-preference")
    yield open_scenes
    assert window.logged() == []
    requests = [url for url in window.requested() if not url.startswith(("data:", "chrome"))]
    assert {*requests} == {file.as_uri()}


def stop(page, t):
    page.run("document.getElementById('play').click()")
    page.wait("return document.documentElement.dataset.playing === 'false'")
    seek(page, t)


def seek(page, part):
    """Move to a part of the motion and wait until it is drawn."""
    page.run("const s = document.getElementById('time'); s.value = arguments[0];"
             "s.dispatchEvent(new Event('input'))", round(1000 * part))  # fmt: skip
    time.sleep(0.1)


def tip(page):
    """Return where the page draws the first path's point, in pixels of the window."""
    return page.run(
        f"const c = {STAGE}, r = c.getBoundingClientRect();"
        "return [r.x + +c.dataset.x, r.y + +c.dataset.y].map(Math.round)"
    )


def pixel(page, position):
    image = pytest.importorskip("PIL.Image")
    with image.open(io.BytesIO(page.picture())) as shot:
        return shot.convert("RGB").getpixel(tuple(position))


def test_page_plays_in_real_time(open_page):
    page = open_page(scene("simple_pendulum"), seconds=10.0)
    assert page.data("playing") == "true"
    start, t = time.monotonic(), float(page.data("t"))
    time.sleep(1.0)
    progress, elapsed = float(page.data("t")) - t, time.monotonic() - start
    assert abs(progress - elapsed) < 0.3


def test_pixel_of_the_tip_moves(open_page):
    page = open_page(scene("simple_pendulum"))
    stop(page, 0.0)
    first = tip(page)
    assert pixel(page, first) == (0, 0x72, 0xB2)
    seek(page, 0.5)
    second = tip(page)
    assert np.hypot(*np.subtract(first, second)) > 20
    assert pixel(page, second) == (0, 0x72, 0xB2) and pixel(page, first) != (0, 0x72, 0xB2)


@pytest.mark.parametrize("make_scene", [chain, humanoid])
def test_sixty_frames_a_second_and_a_quick_first_frame(open_page, make_scene):
    for _ in range(3):  # other work on the machine may slow it down
        page = open_page(make_scene(), seconds=10.0, rows=10_001)
        if float(page.data("first")) < SLOWEST:
            break
    assert float(page.data("first")) < SLOWEST
    page.wait("return document.documentElement.dataset.rate > 55", 10.0)
    rate, drawn = float(page.data("rate")), float(page.data("drawn"))
    size = page.run("return document.documentElement.outerHTML.length")
    print(f"{make_scene.__name__}: first frame after {page.data('first')} ms, "
          f"{rate} frames a second, the slowest drawn in {drawn} ms; {size} bytes")  # fmt: skip
    assert drawn < 1000 / 60


def test_keys_start_playback_and_step(open_page):
    page = open_page(scene("cartpole"))
    page.keys(" ")
    page.wait("return document.documentElement.dataset.playing === 'false'")
    page.keys("\ue010")  # End
    page.wait("return +document.documentElement.dataset.t === 2")
    page.keys("\ue011")  # Home
    page.wait("return +document.documentElement.dataset.t === 0")
    page.keys("\ue014\ue014\ue012")  # right, right, left
    page.wait("return Math.abs(document.documentElement.dataset.t - 0.01) < 1e-3")
    page.keys(" ")
    page.wait("return document.documentElement.dataset.playing === 'true'")


def test_playback_stops_at_the_end_unless_it_loops(open_page):
    page = open_page(scene("cartpole"), seconds=1.0)
    page.run("document.getElementById('loop').click()")
    page.wait("return document.documentElement.dataset.playing === 'false'")
    assert float(page.data("t")) == 1.0
    page.run("document.getElementById('loop').click(); document.getElementById('play').click()")
    page.wait("return document.documentElement.dataset.frames > 90")
    assert page.data("playing") == "true"


def test_speed_can_be_chosen(open_page):
    page = open_page(scene("cartpole"), seconds=10.0)
    page.run("const s = document.getElementById('speed'); s.selectedIndex = arguments[0];"
             "s.dispatchEvent(new Event('change'))", animation.SPEEDS.index(5))  # fmt: skip
    t = float(page.data("t"))
    time.sleep(0.8)
    assert float(page.data("t")) - t > 2.5


@pytest.mark.parametrize("kind", ["mouse", "touch"])
def test_dragging_turns_space_and_wheels_zoom(open_page, kind):
    page = open_page(scene("furuta_pendulum"))
    stop(page, 0.1)
    where = [tip(page)]
    page.drag((200, 300), (320, 300), kind)
    time.sleep(0.1)
    where.append(tip(page))
    page.run(f"{STAGE}.dispatchEvent(new WheelEvent('wheel', {{deltaY: -400, cancelable: true}}))")
    time.sleep(0.1)
    where.append(tip(page))
    assert all(np.hypot(*np.subtract(a, b)) > 10 for a, b in pairwise(where))
    page.run("document.getElementById('reset').click()")
    time.sleep(0.1)
    assert tip(page) == where[0]


def test_click_on_a_curve_seeks_to_its_time(open_page):
    page = open_page(scene("cartpole"))
    position = page.run("const r = document.querySelector('canvas.panel').getBoundingClientRect();"
                  "return [r.x + 52 + (r.width - 58) / 2, r.y + 20]")  # fmt: skip
    page.drag((round(position[0]), round(position[1])), (round(position[0]), round(position[1])))
    page.wait("return Math.abs(document.documentElement.dataset.t - 1) < 0.01")


def test_runs_are_shown_side_by_side_at_one_time(open_page):
    page = open_page(scene("cartpole"), scene("double_pendulum"), seconds=2.0)
    boxes = page.run(
        "return [...document.querySelectorAll('canvas.stage')]"
        ".map(c => c.getBoundingClientRect()).map(r => [r.left, r.right, r.top])"
    )
    assert boxes[0][1] <= boxes[1][0] and boxes[0][2] == boxes[1][2]


def poles(count):
    """Return a batch of `count` cart-poles that swing from different heights."""
    module = trajectories.module("cartpole")
    q0 = np.column_stack([0.1 * np.arange(count), np.linspace(0.5, 3.0, count)])
    runs = module.simulate_batch(q0, steps=400)
    return [BatchTimeline(find_system(runs), runs, (), count)]


def test_instances_of_a_batch_move_in_their_own_colours(open_page):
    page = open_page(timelines=poles(3))
    stop(page, 0.0)
    first = tip(page)
    assert pixel(page, first) == (0, 0x72, 0xB2)
    pixel_counts = page.run(
        f"const c = {STAGE}, g = c.getContext('2d'), n = {{}};"
        "const p = g.getImageData(0, 0, c.width, c.height).data;"
        "for (let k = 0; k < p.length; k += 4) if (p[k + 3] > 250) {"
        "const h = [p[k], p[k + 1], p[k + 2]].join(); n[h] = (n[h] || 0) + 1; } return n"
    )
    for colour in ("0,114,178", "184,74,0", "0,121,90"):  # --c0, --c1, --c2
        assert pixel_counts.get(colour, 0) > 100, colour
    seek(page, 0.5)
    second = tip(page)
    assert np.hypot(*np.subtract(first, second)) > 20
    assert pixel(page, second) == (0, 0x72, 0xB2) and pixel(page, first) != (0, 0x72, 0xB2)
    keys = page.run("return [...document.querySelectorAll('.key')].map(k => k.style.background)")
    assert len({*keys}) == 3


def test_two_dozen_instances_have_own_colours_at_sixty_frames(open_page):
    page = open_page(timelines=poles(24))
    keys = page.run("return [...document.querySelectorAll('.key')].map(k => k.style.background)")
    assert len({*keys}) == 24
    page.wait("return document.documentElement.dataset.rate > 55", 10.0)
    assert float(page.data("drawn")) < 1000 / 60


@pytest.mark.parametrize("width", [400, 1000])
def test_content_fits_the_width_of_the_window(open_page, width):
    page = open_page(scene("cartpole"), width=width)
    assert page.run("return document.documentElement.scrollWidth") <= width
    small = page.run("return [...document.querySelectorAll('canvas')].map(c => c.clientWidth)")
    assert min(small) > 300
    size = page.run(
        "return parseFloat(getComputedStyle(document.querySelector('figcaption')).fontSize)"
    )
    assert size >= 13


def test_colours_follow_the_preferred_scheme(open_page):
    page = open_page(scene("simple_pendulum"))
    stop(page, 0.0)
    light = page.run("return getComputedStyle(document.body).backgroundColor")
    page.media(prefers_color_scheme="dark")
    time.sleep(0.2)
    assert page.run("return getComputedStyle(document.body).backgroundColor") != light
    assert pixel(page, tip(page)) == (0x56, 0xB4, 0xE9)


def test_playback_waits_if_reduced_motion_is_preferred(open_page, window):
    window.media(prefers_reduced_motion="reduce")
    page = open_page(scene("cartpole"))
    assert page.data("playing") == "false"


def test_every_control_has_an_accessible_name(open_page):
    page = open_page(scene("cartpole"))
    bare = page.run(
        "return [...document.querySelectorAll('canvas, button, input, select')].filter(e => "
        "!(e.getAttribute('aria-label') || e.textContent.trim() || e.closest('label'))).length"
    )
    assert bare == 0
    assert page.run("return document.getElementById('time').getAttribute('aria-valuetext')")
    assert page.run(f"return {STAGE}.getAttribute('aria-label')").startswith(
        "Cart-pole, in the plane"
    )


@pytest.mark.skipif(not AXE.is_file(), reason="axe-core is not there: make build/axe/done")
@pytest.mark.parametrize("width", [400, 1000])
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("instance_count", [0, 6, 24])
def test_axe_reports_no_violation(open_page, window, width, scheme, instance_count):
    """Labels, contrast and order, as screen readers and small screens need them."""
    window.media(prefers_color_scheme=scheme)
    page_options = {"timelines": poles(instance_count)} if instance_count else {}
    page = open_page(scene("furuta_pendulum"), width=width, **page_options)
    page.run(AXE.read_text(encoding="utf-8") + "; window.axe = axe;")
    page.run("axe.run().then(r => { window.found = r; })")
    page.wait("return window.found", 20.0)
    assert page.run("return window.found.violations.map(v => v.id)") == []
    assert page.run("return window.found.passes.length") > 20


def test_titles_are_escaped(open_page):
    page = open_page(scene("cartpole"), title="</script><img src=x onerror=document.title=1>")
    assert page.run("return document.images.length") == 0
    assert page.run("return document.querySelector('h1').textContent").startswith("</script>")
