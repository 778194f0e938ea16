"""Error of an arm's tip under PD control, with uncertain inertias and load: 100,000 draws.

python arm.py    # writes arm.zarr and arm.png here, and prints quantiles of the error
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import eomc

HERE = Path(__file__).parent
GOAL = 0.6 * np.cos(1.0) + 0.5 * np.cos(1.8), 0.6 * np.sin(1.0) + 0.5 * np.sin(1.8)


def errors(runs):
    """Return the distance of the tip from its goal at the end, and the overshoot of q1."""
    x, y = runs["tip_x"][:, -1], runs["tip_y"][:, -1]
    return {
        "tip_error": np.hypot(x - GOAL[0], y - GOAL[1]),
        "overshoot": (runs["q1"] - 1.0).max(axis=1),
    }


def about(value):
    """Return a normal distribution with a deviation of 10 %, cut off at 50 %."""
    return {"truncated_normal": [value, 0.1 * value, 0.5 * value, 1.5 * value]}


def main(n=100_000, out="arm.zarr", picture="arm.png"):
    """Run the sweep, draw a histogram of the error and print quantiles."""
    dataset = eomc.sweep(
        HERE / "two_link_arm.toml",
        draws={
            "m1": about(4.0), "m2": about(2.5), "I1": about(0.12), "I2": about(0.06),
            "load": {"uniform": [0.0, 3.0]},
        },
        n=n, sampler="sobol", every=10, outputs=errors, out=out,
    )  # fmt: skip
    for probability in (0.05, 0.5, 0.95, 0.999):
        error = float(dataset["tip_error"].quantile(probability))
        print(f"{100 * probability:5.1f} %: {1000 * error:.0f} mm")
    figure = Figure(layout="constrained")
    axes = figure.subplots()
    axes.hist(1000 * dataset["tip_error"], bins=100)
    axes.set(xlabel="error of the tip, mm", ylabel="trajectories")
    figure.savefig(picture)
    return dataset


if __name__ == "__main__":
    main()
