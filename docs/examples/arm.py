"""Gravity compensation of a UR5, and the torques that balance a force at its tool.

    eomc import ur5_robot.urdf --out ur5.toml
    printf '\n[run]\nframes = ["tool0"]\ninverse_dynamics = true\n' >> ur5.toml

python docs/examples/arm.py ur5.toml
"""

import sys

import numpy as np

import eomc

np.set_printoptions(precision=4, suppress=True)
if len(sys.argv) != 2:
    sys.exit(__doc__)
arm = eomc.load(sys.argv[1])
q = np.array([0.3, -1.2, 1.5, -0.4, 0.7, 0.1])
rest = np.zeros(6)

hold = arm.inverse_dynamics(q, rest, rest)  # at rest: gravity only
u = dict(zip(arm.inputs, hold, strict=True))
print("held against gravity by", hold, "N m")
print(f"accelerations then: {np.abs(arm.acceleration(q, rest, u=u)).max():.0e} rad/s2")

tool, J = arm.pose(q, "tool0"), arm.jacobian(q, "tool0")
print("the tool is at", tool.position, "m")

# the wrench of a load of two kilograms: a force along z, no moment
pull = {"tool0": [0, 0, -20, 0, 0, 0]}
more = arm.inverse_dynamics(q, rest, rest, pull) - hold
print("for 20 N downwards at the tool, more by", more, "N m")
print(f"which is -J^T f to {np.abs(more + J.T @ pull['tool0']).max():.0e} N m")

# joint velocities that lift the tool by 0.1 m/s without rotation
v = np.linalg.solve(J, [0, 0, 0.1, 0, 0, 0])
print("velocity of the tool at these rates", arm.frame_velocity(q, v, "tool0"))
