"""Errors of [picture] are located, and a picture does not affect the equations."""

from pathlib import Path

import pytest

from eomc.base.errors import SceneError
from eomc.scene.read import parse

CART = (Path(__file__).parents[2] / "scenes" / "cartpole.toml").read_text(encoding="utf-8")
BODIES = (Path(__file__).parents[2] / "scenes" / "cartpole_bodies.toml").read_text(encoding="utf-8")
BARE = CART[: CART.index("[picture]")]
POINTS = 'points = { tip = ["x - l*sin(theta)", "l*cos(theta)"] }'


def test_points_are_named_or_explicit():
    text = f'{BARE}[picture]\n{POINTS}\nlines = [[["x", 0], "tip"]]\npaths = ["tip"]\naxes = "xz"\n'
    picture = parse(text).picture
    line, path = picture.shapes
    assert [line.kind, path.kind] == ["line", "path"] and picture.axes == "xz"
    assert [place.name for place in line.places] == ["", "tip"]
    assert line.places[1] == path.places[0]
    assert [f.text for f in line.places[1].at] == ["x - l*sin(theta)", "l*cos(theta)", "0"]


def test_boxes_and_circles_have_sizes_and_may_be_rotated():
    text = f'{BARE}[picture]\ncircles = [{{ at = ["x", 0], radius = "l/9", rotation = "x" }}]\n'
    (circle,) = parse(text).picture.shapes
    assert [f.text for f in circle.size] == ["l/9"]
    assert [(t.axis, t.angle.text) for t in circle.rotation] == [("z", "x")]


def test_bodies_and_points_are_positions():
    shapes = parse(BODIES).picture.shapes
    assert [(p.name, p.at) for p in shapes[0].places] == [("pole", None), ("tip", None)]


def test_scene_without_a_picture_has_none():
    assert parse(BARE).picture is None


def test_definition_used_only_by_the_picture_is_not_warned_of():
    scene_with_picture = parse(
        BARE.replace("[energy]", 'far = "x + 1"\n[energy]') + '[picture]\ndots = [["far", 0]]'
    )
    assert not scene_with_picture.warnings


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ("lines = 3", "each through two points or more, here 3"),
        ('lines = [["cart"]]', "through two points or more"),
        ('lines = [["crt", [0, 0]]]', "'crt' is no point: add it to"),
        (f'{POINTS}\ndots = ["tpi"]', "'tpi' is no point; did you mean 'tip'"),
        ('dots = [["x_dot", 0]]', "can't depend on velocities: it shows where things are"),
        ('dots = [["dot(x)", 0]]', "can't depend on velocities"),
        ('dots = [["z", 0]]', "'z' is not declared"),
        ("points = 3", "must be a table, such as"),
        ("dots = [[0, 1], [0, 1, 2]]", "two entries in a plane scene, as the others here, here 3"),
        ("dots = [[0]]", "two entries in the plane and three in space, here 1"),
        ("boxes = [{ at = [0, 0], size = [1] }]", "in the plane has two edges, here 1"),
        ("boxes = [{ at = [0, 0, 0], size = [1, 2] }]", "in space has three edges, here 2"),
        ("boxes = [{ at = [0, 0], radius = 1 }]", "a list of tables with at, size"),
        ("circles = [{ at = [0, 0], radius = -1 }]", "is -1, and can't be negative"),
        ('circles = [{ at = [0, 0], radius = "x" }]', "'radius' is made of numbers, constants"),
        (
            'circles = [{ at = [0, 0], radius = 1, rotation = [["x", 1]] }]',
            "a plane scene turns about z only",
        ),
        ("circles = [{ at = [0, 0, 0], radius = 1, rotation = 1 }]", "a rotation names its axis"),
        ("circle = []", "unknown key 'circle'; did you mean 'circles'"),
        ("springs = [[[0, 0], [1, 0], [2, 0]]]", "each from a point to another, here "),
        ('dots = [[0, 0]]\naxes = "zx"', "unknown axes 'zx': known are xy, xz, yz"),
        ('dots = [[0, 0, 0]]\naxes = "xz"', "for pictures in the plane: remove it"),
        ('axes = "xz"', "draws nothing: add dots, lines"),
        ('points = { world = [0, 0] }\ndots = ["world"]', "the frame that does not move"),
        ('points = { "a b" = [0, 0] }\ndots = ["a b"]', "a b"),
    ],
)
def test_errors_are_reported_once_at_their_line(lines, words):
    with pytest.raises(SceneError, match=words) as error:
        parse(f"{BARE}[picture]\n{lines}\n")
    assert len(error.value.problems) == 1
    assert error.value.problems[0].line > BARE.count("\n")


def test_point_is_not_accepted_as_a_body():
    with pytest.raises(SceneError, match="'cart' is a body or point already"):
        parse(BODIES.replace("[picture]", "[picture]\npoints = { cart = [0, 0] }"))


def test_picture_cannot_depend_on_inputs():
    text = BARE.replace("[definitions]", '[inputs]\nF = 1\n[definitions]\ny_f = "F"\n', 1)
    with pytest.raises(SceneError, match="can't depend on inputs"):
        parse(text.replace("F = 1", "F = { signal = 1 }") + '[picture]\ndots = [["y_f", 0]]\n')
