"""What functions of bodies cost beside Pinocchio's, of the Panda.

    python benchmarks/bodies.py [--rounds 41]

The scene is what `eomc import` writes, fingers locked. Beside one another: `inverse_dynamics` and
`rnea`; `frame_poses` of the seven links and `forwardKinematics`; `frame_jacobians` of the last link
and `computeJointJacobians`, which has a column for each joint too. Both run over the same fifty
states in a row in C and C++, in turns; the ratio of our time to theirs is taken within each round,
and the largest difference of the results stands beside it. The bar is 0.15.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType

import numpy as np
import robots
import work
from kernels import Array

import eomc
from eomc.derive import lagrange
from eomc.model.system import from_scene
from eomc.program import program
from eomc.scene.read import parse

STATES = 50  # whose results stay in the cache
BAR = 0.15
LINKS = [f"panda_link{k}" for k in range(1, 8)]
FRAMES = {"poses": LINKS, "jacobians": LINKS[-1:]}


def scene(frames: list[str]) -> str:
    """The Panda, with functions of these frames."""
    asked = ", ".join(f'"{name}"' for name in frames)
    text = robots.robot(work.PANDA, locked=robots.FINGERS)
    return f"{text}\n[run]\nframes = [{asked}]\ninverse_dynamics = true\n"


def module(text: str, root: Path, name: str) -> ModuleType:
    """It, compiled in a folder of its own."""
    (root / name).mkdir()
    file = root / name / "panda.toml"
    file.write_text(text, encoding="utf-8")
    return eomc.load(file, root / name / "build")


def seconds(call: Callable[[], object]) -> float:
    """Of one call, the mean of ten."""
    begun = time.perf_counter()
    for _ in range(10):
        call()
    return (time.perf_counter() - begun) / 10


def in_c(
    m: ModuleType, name: str, shape: tuple[int, ...], motion: tuple[Array, Array, Array]
) -> tuple[Callable[[], None], Array]:
    """A call of one function at all states, without what Python adds, and where results go."""
    model, n = m._model, len(motion[0])
    out = np.zeros((n, *shape))
    q, qd, qdd, to = map(model._pointer, (*motion, out))
    function, p = getattr(model._lib, name), model._at[2]
    each = model._ffi.new("row_strides *", {"u": len(m.coordinates)})  # qdd in the place of inputs
    return lambda: function(n, to, q, qd, 0.0, qdd, p, each), out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=41)
    rounds = parser.parse_args().rounds
    import simulators  # with Pinocchio, which tricks.py can do without

    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        loaded, made = simulators.pinocchio_library(root)
        random = np.random.default_rng(0)
        q, qd, qdd = random.uniform(-2, 2, (3, STATES, 7))

        def theirs(which: int, width: int) -> tuple[Callable[[], None], Array]:
            out = np.zeros((STATES, width))
            places = [x.ctypes.data for x in (q, qd, qdd, out)]
            return lambda: loaded.functions(made, which, STATES, *places), out

        ours = partial(in_c, motion=(q, qd, qdd))
        made_ours = {what: module(scene(frames), root, what) for what, frames in FRAMES.items()}
        pairs = {
            ("inverse_dynamics", "rnea"): (
                ours(made_ours["poses"], "inverse_dynamics", (7,)),
                theirs(0, 7),
                lambda x: x,
            ),
            ("frame_poses", "forwardKinematics"): (
                ours(made_ours["poses"], "frame_poses", (7, 12)),
                theirs(1, 3),
                lambda x: x[:, 6, :3],
            ),
            ("frame_jacobians", "computeJointJacobians"): (
                ours(made_ours["jacobians"], "frame_jacobians", (6, 7)),
                theirs(2, 7),
                None,
            ),
        }
        print(f"{'ours':18} {'Pinocchio':22} {'ns':>6} {'ns':>6} {'ratio':>6}   of states apart by")
        for (name, other), ((mine, found), (yours, expected), part) in pairs.items():
            mine(), yours()
            if part is None:  # theirs is of the body where the world's origin is: its z row
                at = made_ours["jacobians"].pose(q, LINKS[-1]).position
                v, w = found[:, :3], found[:, 3:]
                shift = at[:, 0, None] * w[:, 1] - at[:, 1, None] * w[:, 0]
                apart = v[:, 2] + shift - expected
            else:
                apart = part(found) - expected
            times = []
            for _ in range(rounds):
                times.append((seconds(mine), seconds(yours)))
            fast = np.median(times, axis=0) / STATES * 1e9
            ratio = float(np.median([a / b for a, b in times]))
            error = float(np.max(np.abs(apart)) / np.max(np.abs(expected)))
            bar = "" if ratio <= BAR else f"   (bar {BAR})"
            both = f"{fast[0]:6.0f} {fast[1]:6.0f} {ratio:6.3f}"
            print(f"{name:18} {other:22} {both}   {error:.1e}{bar}")
        derived = program.build(lagrange.derive(from_scene(parse(scene(LINKS), "panda.toml"))))
        for name in ("inverse_dynamics", "frame_poses", "frame_jacobians"):
            print(f"{name}: {derived[name].cost}")


if __name__ == "__main__":
    main()
