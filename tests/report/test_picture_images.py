"""Compare pictures with accepted ones: python tests/report/test_picture_images.py writes them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from report.pictures import motion, scene, system

from eomc.report import plot
from eomc.report.drawing import draw_mechanism

pytest.importorskip("matplotlib")
Image = pytest.importorskip("PIL.Image")

GOLDEN = Path(__file__).parent / "images"
NAMES = """acrobot anymal arm ball_beam bead_on_hoop cartpole chain crane furuta_pendulum
heavy_top slung_load satellite spring_pendulum suspension tumbling_box ur5""".split()
SIZE, BLOCK = 192, 8  # pixels
TOLERANCE = 25  # of 255, for the mean of a block: versions of matplotlib smooth lines differently


def render_image(drawing):
    """Render the last instant and the paths without axes and texts; return (SIZE, SIZE)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    flat = plot.project_points(drawing)
    figure = Figure(figsize=(2, 2), dpi=SIZE / 2)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    for path in drawing.paths:
        axes.plot(*flat[:, path.point].T, linewidth=1.0)
    plot.draw_marks(axes, drawing, flat[-1])
    axes.update_datalim(flat.reshape(-1, 2))
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_axis_off()
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[:, :, :3].mean(axis=2)


def drawing_of(name):
    model = scene(name)
    run = motion(model)
    return draw_mechanism(system(model), run.t, run.q)


def block_difference(one, other):
    blocks = (one - other).reshape(SIZE // BLOCK, BLOCK, SIZE // BLOCK, BLOCK).mean(axis=(1, 3))
    return float(np.abs(blocks).max())


@pytest.mark.parametrize("name", NAMES)
def test_picture_agrees_with_the_accepted_one(name):
    with Image.open(GOLDEN / f"{name}.png") as accepted:
        assert (
            block_difference(
                render_image(drawing_of(name)), np.asarray(accepted.convert("L"), dtype=float)
            )
            < TOLERANCE
        )


def test_comparison_detects_a_missing_mark():
    drawing = drawing_of("cartpole")
    image = render_image(drawing)
    for mark in drawing.marks:
        reduced = replace(drawing, marks=tuple(m for m in drawing.marks if m is not mark))
        assert block_difference(image, render_image(reduced)) > TOLERANCE, mark.kind


if __name__ == "__main__":
    GOLDEN.mkdir(exist_ok=True)
    for name in NAMES:
        image = Image.fromarray(render_image(drawing_of(name)).astype(np.uint8)).quantize(16)
        image.save(GOLDEN / f"{name}.png", optimize=True)
