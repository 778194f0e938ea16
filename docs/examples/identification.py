"""Identify a drive with a flexible shaft from a noisy log. The command does the same:

    eomc fit docs/examples/drive.toml drive_log.csv --plot drive_fit.png

python docs/examples/identification.py
"""

from pathlib import Path

import numpy as np

import eomc

SCENE = Path(__file__).with_name("drive.toml")
TRUTH = {"J_m": 0.012, "J_l": 0.031, "k": 8.0, "d": 0.02, "c": 0.015}
PERIOD, NOISE = 0.005, 0.002  # s, rad

# the experiment: a chirp from 0.5 to 8 Hz, angles measured every 5 ms
time = PERIOD * np.arange(800)
torque = 0.4 * np.sin(2 * np.pi * (0.5 * time + 7.5 * time**2 / 8))
drive = eomc.load(SCENE)
run = drive.simulate(u=torque[:, None], control_period=PERIOD, every=2, params=TRUTH)
noise = NOISE * np.random.default_rng(1).standard_normal((2, len(time)))
columns = [time, torque, run["motor"][:-1] + noise[0], run["load"][:-1] + noise[1]]
header = "t,torque,motor,load"
np.savetxt("drive_log.csv", np.transpose(columns), delimiter=",", header=header, comments="")

# the estimation
fit = eomc.fit(SCENE, "drive_log.csv")
print(fit)
fit.write_plot("drive_fit.png")

errors = {name: (fit.values[name] - x) / fit.standard_errors[name] for name, x in TRUTH.items()}
print("errors in standard errors:", ", ".join(f"{name} {x:.1f}" for name, x in errors.items()))
print(f"{len(fit.t)} rows, noise {fit.rms['motor']:.4f} rad (true: {NOISE})")
