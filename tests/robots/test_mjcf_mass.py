"""Masses and moments of inertia of MJCF, compared with hand calculations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.mjcf import CLOSE, PI, model, refused

R, H, M = 0.1, 0.2, 3.0  # radius, half length, mass


@pytest.mark.parametrize(
    ("geom", "mass", "inertia"),
    [
        ('size="0.1"', 4e3 / 3 * PI * R**3, None),
        ('size="0.1" mass="3"', M, [0.4 * M * R**2] * 3),
        ('size="0.1" mass="3" density="7"', M, [0.4 * M * R**2] * 3),
        ('type="box" size="0.1 0.2 0.3" density="10"', 80 * 0.006, None),
        ('type="box" size="0.1 0.2 0.3" mass="3"', M, [0.13, 0.10, 0.05]),
        ('type="ellipsoid" size="0.1 0.2 0.3" mass="5"', 5.0, [0.13, 0.10, 0.05]),
        ('type="cylinder" size="0.1 0.2" density="1"', PI * R**2 * 2 * H, None),
        (
            'type="cylinder" size="0.1 0.2" mass="3"',
            M,
            [M * (3 * R**2 + 4 * H**2) / 12] * 2 + [M * R**2 / 2],
        ),
        ('type="capsule" size="0.1 0.2" density="1"', PI * R**2 * (2 * H + 4 / 3 * R), None),
        # shells: density per area
        ('size="0.1" shellinertia="true" density="1"', 4 * PI * R**2, None),
        ('size="0.1" shellinertia="true" mass="3"', M, [2 / 3 * M * R**2] * 3),
        (
            'type="cylinder" size="0.1 0.2" shellinertia="true" density="1"',
            4 * PI * R * H + 2 * PI * R**2,
            None,
        ),
        ('type="box" size="1 1 1" shellinertia="true" mass="18"', 18.0, [20.0] * 3),
    ],
)
def test_mass_and_inertia_of_a_geom(
    tmp_path: Path, geom: str, mass: float, inertia: list[float] | None
) -> None:
    (body,) = model(tmp_path, f"<body><joint/><geom {geom}/></body>").bodies
    assert body.mass == pytest.approx(mass, rel=CLOSE)
    if inertia:
        assert body.inertia[:3] == pytest.approx(inertia, rel=1e-13)
        assert body.inertia[3:] == (0, 0, 0)


def moments(shape: str, points: int = 400) -> list[float]:
    """Return Ixx and Izz of the capsule of R and H with unit mass, by summing thin slices along
    z.
    """
    z = (np.arange(points * 10) + 0.5) / (points * 10) * 2 * (H + R) - (H + R)
    beyond = np.maximum(np.abs(z) - H, 0.0)
    radius = np.sqrt(R**2 - beyond**2)
    if shape == "solid":
        weight, across = radius**2, radius**2 / 4
    else:  # the width of a sphere's strip is the thickness of the slice times R/radius
        weight, across = np.where(beyond > 0, R, radius), radius**2 / 2
    weight = weight / weight.sum()
    return [float((weight * (across + z**2)).sum()), float((weight * 2 * across).sum())]


@pytest.mark.parametrize(("shape", "shell"), [("solid", "false"), ("shell", "true")])
def test_inertia_of_a_capsule_equals_the_sum_of_its_slices(
    tmp_path: Path, shape: str, shell: str
) -> None:
    geom = f'<geom type="capsule" size="0.1 0.2" mass="1" shellinertia="{shell}"/>'
    (body,) = model(tmp_path, f"<body><joint/>{geom}</body>").bodies
    # 4000 slices: the midpoint rule leaves about 1e-6, more at the edge between tube and cap.
    assert [body.inertia[0], body.inertia[2]] == pytest.approx(moments(shape), rel=1e-4)


def test_geoms_add_up_about_their_common_centre(tmp_path: Path) -> None:
    geoms = '<geom size="0.1" mass="1" pos="0 0 1"/><geom size="0.1" mass="3" pos="0 0 -1"/>'
    (body,) = model(tmp_path, f"<body><joint/>{geoms}</body>").bodies
    own = 0.4 * 4 * 0.01
    assert body.mass == 4
    assert body.center == (0, 0, -0.5)
    steiner = 1 * 1.5**2 + 3 * 0.5**2
    assert body.inertia == pytest.approx((own + steiner, own + steiner, own, 0, 0, 0), rel=CLOSE)


def test_geoms_outside_all_planes_have_products_of_inertia(tmp_path: Path) -> None:
    places = np.array([[0.1, 0.2, 0.4], [-0.3, 0.5, 0.1], [0.2, -0.4, 0.6]])
    m = np.array([1.0, 2.0, 0.5])
    geoms = "".join(
        f'<geom size="0.1" mass="{k}" pos="{x} {y} {z}"/>'
        for k, (x, y, z) in zip(m, places, strict=True)
    )
    (body,) = model(tmp_path, f"<body><joint/>{geoms}</body>").bodies
    x, y, z = (places - m @ places / m.sum()).T
    own = 0.4 * m.sum() * 0.01
    moments = [own + m @ (a * a + b * b) for a, b in ((y, z), (x, z), (x, y))]
    products = [-m @ (a * b) for a, b in ((x, y), (x, z), (y, z))]
    assert body.inertia == pytest.approx((*moments, *products), rel=1e-13)  # some rounding errors


def test_capsule_between_two_points(tmp_path: Path) -> None:
    geom = '<geom type="capsule" size="0.1" fromto="1 0 0 1 0.4 0" mass="2"/>'
    upright = '<geom type="capsule" size="0.1 0.2" mass="2"/>'
    (a, b) = model(tmp_path, f"<body><joint/>{geom}</body><body><joint/>{upright}</body>").bodies
    assert a.center == (1, 0.2, 0)
    assert a.inertia == (b.inertia[0], b.inertia[2], b.inertia[1], 0, 0, 0)  # along y, not z


def test_fullinertia_has_the_order_of_mujoco(tmp_path: Path) -> None:
    # The frame is rotated by a quarter turn about z: x becomes y, y becomes -x.
    full = '<inertial pos="1 2 3" mass="2" fullinertia="4 5 6 0.1 0.2 0.3"/>'
    bodies = f'<body><joint/>{full}</body><body><joint/><frame euler="0 0 90">{full}</frame></body>'
    a, b = model(tmp_path, bodies).bodies
    assert (a.center, a.inertia) == ((1, 2, 3), (4, 5, 6, 0.1, 0.2, 0.3))
    assert b.center == (-2, 1, 3)
    assert b.inertia == pytest.approx((5, 4, 6, -0.1, -0.3, 0.2), rel=CLOSE)


def test_inertia_from_geoms_or_from_inertial(tmp_path: Path) -> None:
    inertial = '<inertial pos="0 0 0" mass="7" diaginertia="1 1 1"/>'
    body = f'<body><joint/>{inertial}<geom size="1" mass="2"/></body>'

    def mass(how: str) -> float:
        return model(tmp_path, body, f'<compiler inertiafromgeom="{how}"/>').bodies[0].mass

    assert [mass("auto"), mass("true"), mass("false")] == [7, 2, 7]


@pytest.mark.parametrize(
    "geoms", ['mass="0"', 'density="0"', 'mass="1e-16"', 'group="4"', 'mass="0" mesh="m"']
)
def test_inertial_applies_if_no_geom_has_mass(tmp_path: Path, geoms: str) -> None:
    inertial = '<inertial pos="0 0 .2" mass="7" diaginertia="1 1 1"/>'
    inside = f'<body><joint/>{inertial}<geom size="1" pos=".3 0 0" {geoms}/></body>'
    before = '<compiler inertiafromgeom="true" inertiagrouprange="0 3"/>'
    body = model(tmp_path, inside, before).bodies[0]
    assert (body.mass, body.center, body.inertia) == (7, (0, 0, 0.2), (1, 1, 1, 0, 0, 0))
    alone = f'<body name="b"><joint/><geom size="1" {geoms}/></body>'
    assert model(tmp_path, alone, before).bodies[0].mass < 1e-15


def test_geoms_outside_the_group_range_or_without_mass_are_ignored(tmp_path: Path) -> None:
    geoms = (
        '<geom size="1" mass="2" group="1"/><geom type="mesh" mesh="m" group="0"/>'
        '<geom type="mesh" mesh="m" mass="0" group="1"/><geom type="plane" group="1"/>'
        '<geom type="mesh" mesh="m" density="0" group="1"/>'
    )
    robot = model(tmp_path, f"<body><joint/>{geoms}</body>", '<compiler inertiagrouprange="1 3"/>')
    assert robot.bodies[0].mass == 2


def test_mesh_of_a_fixed_body_needs_no_mass(tmp_path: Path) -> None:
    mesh = '<geom type="mesh" mesh="m"/>' * 2
    moving = '<body name="b"><joint name="j"/><geom size="1" mass="2"/></body>'
    robot = model(tmp_path, f'<body name="base">{mesh}{moving}</body>')
    assert [body.mass for body in robot.bodies] == [0, 2]
    line = "masses of meshes (not opened) on bodies that stand still, taken as zero: base"
    assert line in robot.left_out
    total = '<compiler settotalmass="3"/>'
    assert "base follows from a mesh" in refused(
        tmp_path, f'<body name="base">{mesh}{moving}</body>', total
    )


def test_order_of_bounds_balance_and_total_mass(tmp_path: Path) -> None:
    inertial = '<inertial pos="0 0 0" mass="1" diaginertia="1 2 9"/>'
    body = f"<body><joint/>{inertial}</body>"
    compiler = '<compiler boundmass="3" boundinertia="2" balanceinertia="true" settotalmass="6"/>'
    (a,) = model(tmp_path, body, compiler).bodies
    assert a.mass == 6
    assert a.inertia == pytest.approx([2 * (2 + 2 + 9) / 3] * 3 + [0] * 3, rel=CLOSE)
