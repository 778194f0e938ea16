"""What scenes of bodies cost: time to derive and to the first step, flops of an acceleration.

    python benchmarks/robots.py              # every scene
    python benchmarks/robots.py chain10 panda

- derive + generate: from the scene's text to the C's, imports left out;
- flops: additions, multiplications and divisions of one acceleration by each route, the one that
  is taken first; sines, and what hangs on parameters alone, left out;
- compile: the C compiler on all that is generated, and the linker;
- cold: `eomc build` typed to the first step done in another process, start of Python, imports and
  everything else included.

Times are medians of three, each in a fresh process and from an empty folder. Behind each figure
stands its bar, where it has one. Robots come from example-robot-data (pip install '.[robots]').
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

HERE = Path(__file__).resolve().parent.parent
EXTRA = "pip install '.[robots]'"

ARM = """
eomc = 1
name = "arm7"
title = "Seven joints, every inertial parameter a parameter"
gravity = [0, 0, "-g"]
[constants]
n = 7
[coordinates]
"q[i]" = { repeat = "i = 1..n", unit = "rad", start = "0.1*i" }
[parameters]
g = 9.81
"m[i]" = { repeat = "i = 1..n", value = "2 - i/10" }
"cx[i]" = { repeat = "i = 1..n", value = 0.02 }
"cy[i]" = { repeat = "i = 1..n", value = -0.05 }
"cz[i]" = { repeat = "i = 1..n", value = 0.1 }
"Ixx[i]" = { repeat = "i = 1..n", value = 0.02 }
"Iyy[i]" = { repeat = "i = 1..n", value = 0.03 }
"Izz[i]" = { repeat = "i = 1..n", value = 0.015 }
"Ixy[i]" = { repeat = "i = 1..n", value = 0.001 }
"Ixz[i]" = { repeat = "i = 1..n", value = -0.002 }
"Iyz[i]" = { repeat = "i = 1..n", value = 0.0015 }
"d[i]" = { repeat = "i = 1..n", value = "0.3 - i/50" }
[[body]]
name = "link[1]"
joint = "revolute"
coordinates = "q[1]"
offset = [0, 0, "d[1]"]
mass = "m[1]"
center = ["cx[1]", "cy[1]", "cz[1]"]
inertia = ["Ixx[1]", "Iyy[1]", "Izz[1]", "Ixy[1]", "Ixz[1]", "Iyz[1]"]
[[body]]
repeat = "i = 2..n"
name = "link[i]"
parent = "link[i-1]"
joint = "revolute"
coordinates = "q[i]"
offset = [0, "d[i]", 0]
rotation = [["x", "(-1)**i*pi/2"]]
mass = "m[i]"
center = ["cx[i]", "cy[i]", "cz[i]"]
inertia = ["Ixx[i]", "Iyy[i]", "Izz[i]", "Ixy[i]", "Ixz[i]", "Iyz[i]"]
"""


class MissingError(Exception):
    """A robot's file is not there."""


@dataclass(frozen=True)
class Case:
    """A scene's text, and the bars: seconds to derive, flops, seconds to compile and cold."""

    title: str
    text: Callable[[], str]
    derive: float | None = None
    flops: int | None = None
    compile: float | None = None
    cold: float | None = None


def chain(links: int) -> str:
    """scenes/chain.toml with another number of links, hanging still from a slight bow."""
    text = (HERE / "scenes" / "chain.toml").read_text(encoding="utf-8")
    old, damping = "n = { value = 5,", 'damping     = "b"\n'
    assert old in text and text.count(damping) == 2
    text = text.replace('name     = "chain"', f'name     = "chain{links}"').replace(damping, "")
    text = "".join(line for line in text.splitlines(True) if not line.startswith("b = "))
    text = text.replace('"0.1*i"', '"0.1"')
    return text.replace(old, f"n = {{ value = {links},")


def robot(file: str, free: bool = False, locked: tuple[str, ...] = ()) -> str:
    """The scene that `eomc import` writes of a URDF of example-robot-data."""
    from eomc.robots import edit, urdf
    from eomc.robots.scene_text import scene_text

    try:
        found = [f for f in files("example-robot-data") or () if str(f).endswith(file)]
    except PackageNotFoundError:
        raise MissingError(f"example-robot-data is not there: {EXTRA}") from None
    read = edit.lock(urdf.read(str(found[0].locate())), dict.fromkeys(locked, 0.0))
    return scene_text(edit.with_base(read, free=True) if free else read)


FINGERS = ("panda_finger_joint1", "panda_finger_joint2")

CASES = {
    "arm7": Case("7-joint arm, general inertias as parameters", lambda: ARM, 2, 1650),
    "panda": Case(
        "Panda from its URDF, fingers locked",
        partial(robot, "panda_description/urdf/panda.urdf", locked=FINGERS), 2, 1500, cold=4,
    ),
    "chain5": Case("plane chain, 5 links", partial(chain, 5), cold=1.5),
    "chain10": Case("plane chain, 10 links", partial(chain, 10), 1, 1050, cold=2.5),
    "chain20": Case("plane chain, 20 links", partial(chain, 20), 2, 2300),
    "chain50": Case("plane chain, 50 links", partial(chain, 50), 5, 6000, cold=15),
    "quadruped": Case(
        "Solo 12 from its URDF, free base", partial(robot, "solo12.urdf", free=True), 10
    ),
    "humanoid": Case(
        "Talos from its URDF, 32 joints, free base",
        partial(robot, "talos_reduced.urdf", free=True), 60, compile=120,
    ),
}  # fmt: skip


def inside(path: Path, root: Path) -> None:
    """Builds the scene and prints what it took; run in a process of its own."""
    import cffi  # noqa: F401 - so that no import is timed

    import eomc
    from eomc.derive import lagrange
    from eomc.emit import render
    from eomc.emit.render import Sources
    from eomc.program import program
    from eomc.toolchain import cache

    gc.disable()  # as eomc.read and eomc.sources do
    begun = time.perf_counter()
    system = eomc.read(path)
    spent = time.perf_counter() - begun
    told: dict[str, object] = {}

    def texts(extension: str) -> Sources:
        nonlocal spent
        begun = time.perf_counter()
        derived = program.build(lagrange.derive(system))
        sources = render.render(derived, extension)
        spent += time.perf_counter() - begun
        a = derived["acceleration"]
        routes = {route: cost.flops for route, cost in a.routes}
        told.update(route=a.route, flops=a.cost.flops, sincos=a.cost.sincos, routes=routes)
        told["passed over"] = dict(derived.passed_over)
        told["ended"] = time.perf_counter()
        return sources

    made = cache.build(system.name, cache.key(system.digest), texts, root)
    compiled = time.perf_counter() - float(str(told.pop("ended")))
    manifest = json.loads((made.folder / cache.MANIFEST).read_text(encoding="utf-8"))
    print(
        json.dumps(
            {**told, "derive": spent, "compile": compiled, "coordinates": len(system.q),
             "compiler": Path(manifest["compiler"]).name}
        )
    )  # fmt: skip


# Python keeps its bytecode, as it does unless it is told not to
ENVIRONMENT = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"} | {
    "PYTHONPYCACHEPREFIX": str(HERE / "build" / "pycache")
}
FIRST_STEP = "import sys; sys.path[:0] = [sys.argv[1]]; import {} as m; m.step(*m.start, 1e-4)"


def cold(path: Path, name: str, root: str) -> float:
    """Seconds from `eomc build` to the first step."""
    build = [sys.executable, "-m", "eomc.cli.main", "build", str(path), "--quiet", "--build", root]
    begun = time.perf_counter()
    subprocess.run(build, check=True, env=ENVIRONMENT)
    first_step = [sys.executable, "-c", FIRST_STEP.format(name), root]
    subprocess.run(first_step, check=True, env=ENVIRONMENT)
    return time.perf_counter() - begun


def row(case: Case, rounds: int) -> str:
    """The scene's line of the table."""
    from eomc.scene import read as scene

    rows, colds = [], []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.toml"
        text = case.text()
        path.write_text(text, encoding="utf-8")
        name = scene.parse(text, "scene.toml").name
        for k in range(rounds):
            root = Path(folder) / f"build{k}"
            command = [sys.executable, __file__, "--inside", str(path), str(root)]
            done = subprocess.run(
                command, check=True, stdout=subprocess.PIPE, text=True, env=ENVIRONMENT
            )
            rows.append(json.loads(done.stdout))
            colds.append(cold(path, name, str(root / "cold")))
    first = rows[0]
    derive, compiled = (statistics.median(r[key] for r in rows) for key in ("derive", "compile"))
    others = {r: n for r, n in first["routes"].items() if r != first["route"]}
    routes = ", ".join([first["route"], *(f"{r} {n:,}" for r, n in others.items())])
    routes += "".join(f", {r} not tried" for r in first["passed over"])
    flops = first["flops"]
    each = flops / first["coordinates"]
    return (
        f"| {case.title} | {against(derive, case.derive)} "
        f"| {against(flops, case.flops)} ({routes}) | {first['sincos']} | {each:.0f} "
        f"| {against(compiled, case.compile)} ({first['compiler']}) "
        f"| {against(statistics.median(colds), case.cold)} |"
    )


def against(found: float, bar: float | None) -> str:
    """A figure and its bar."""
    shown = f"{found:,}" if isinstance(found, int) else f"{found:.1f} s"
    if bar is None:
        return shown
    return shown + (f" ≤ {bar:,}" if found <= bar else f", **missed** {bar:,}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help=f"some of {', '.join(CASES)}; all by default")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--inside", nargs=2, type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.inside:
        return inside(*options.inside)
    if unknown := [name for name in options.names if name not in CASES]:
        parser.error(f"{', '.join(unknown)}: there are {', '.join(CASES)}")
    print("| scene | derive + generate | flops of an acceleration | sincos | a coordinate "
          "| compile | cold to first step |")  # fmt: skip
    print("|---|---|---|---|---|---|---|", flush=True)
    for name in options.names or CASES:
        try:
            line = row(CASES[name], options.rounds)
        except MissingError as why:
            line = f"| {CASES[name].title} | {why} | | | | | |"
        print(line, flush=True)


if __name__ == "__main__":
    main()
