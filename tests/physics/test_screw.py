"""A screw joint, compared with equations of motion that are derived by hand."""

from __future__ import annotations

import numpy as np
import pytest
from support.cases import scene_file

import eomc
from eomc.mechanism.mobility import compute_mobility
from eomc.scene.read import parse
from eomc.verify.check import check

pytestmark = pytest.mark.usefixtures("quickly_compiled")

# a nut on a vertical screw, with a bead that slides along a radius
NUT = """
eomc = 1
name = "nut"
gravity = [0, 0, "-g"]
[parameters]
m = 1.3
J = 0.02
c = 0.1
mu = 0.4
lead = 0.5
g = 9.81
[coordinates]
phi = { start = 0.3, rate = 2, unit = "rad" }
r = { start = 0.6, rate = -0.7, unit = "m" }
[inputs]
torque = { unit = "N m" }
[[body]]
name = "nut"
joint = "screw"
coordinates = "phi"
pitch = "lead/(2*pi)"
mass = "m"
center = ["c", 0, 0.2]
inertia = [0.03, 0.04, "J", 0, 0, 0]
actuator = "torque"
[[body]]
name = "bead"
parent = "nut"
joint = "prismatic"
axis = [1, 0, 0]
coordinates = "r"
mass = "mu"
[run]
frames = true
"""


def test_nut_on_a_vertical_screw_moves_by_the_equations_derived_by_hand() -> None:
    """With the pitch p = lead/(2 pi), the distance c of the centre of mass and M = m + mu:

    (J + m c^2 + M p^2 + mu r^2) phi_ddot + 2 mu r r_dot phi_dot + M g p = torque,
    mu (r_ddot - r phi_dot^2) = 0.
    """
    module = eomc.load(scene_file("nut", NUT))
    m, J, c, mu, lead, g = 1.3, 0.02, 0.1, 0.4, 0.5, 9.81
    p, M = lead / (2 * np.pi), m + mu
    for q, qd, torque in (((0.3, 0.6), (2.0, -0.7), 0.0), ((-4.0, 0.2), (-1.5, 3.0), 0.8)):
        (_, r), (rate, r_dot) = q, qd
        inertia = J + m * c**2 + M * p**2 + mu * r**2
        expected = [
            (torque - M * g * p - 2 * mu * r * r_dot * rate) / inertia,
            r * rate**2,
        ]
        found = module.acceleration(q, qd, u=[torque])
        np.testing.assert_allclose(found, expected, rtol=1e-13)
        energy = (inertia * rate**2 + mu * r_dot**2) / 2 + M * g * p * q[0] + m * g * 0.2
        assert module.energy(q, qd) == pytest.approx(energy, rel=1e-14)


def test_screw_passes_the_check() -> None:
    path = scene_file("nut", NUT)
    report = check(eomc.read(path), eomc.load(path), states=8)
    assert report.passed, report.table()


def test_screws_on_the_same_axis_are_one_motion_if_their_pitch_is_equal() -> None:
    for pitch, same in ((0.1, True), (-0.1, False)):
        text = NUT[: NUT.index("[[body]]")] + "".join(
            f'[[body]]\nname = "{name}"\njoint = "screw"\ncoordinates = "{q}"\npitch = {h}\n'
            f'parent = "{parent}"\nmass = 1\noffset = [0, 0, 0.3]\ncenter = [0.1, 0, 0]\n'
            for name, q, h, parent in (("a", "phi", 0.1, "world"), ("b", "r", pitch, "a"))
        )
        result = compute_mobility(parse(text.replace('torque = { unit = "N m" }', "")))
        assert result.M == 2 and result.rank == 2
        assert any("same screw" in remark for remark in result.remarks) is same
