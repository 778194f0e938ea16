"""Random valid scenes with features that `scene_author` omits, determined by their number.

Outputs, limits of inputs, adaptive steps, events, points, forces at bodies, frames, inverse
dynamics, momentum, derivatives of steps, constraints and closed loops: each in some of the scenes.
"""

from __future__ import annotations

import math
import random
import re
from collections.abc import Sequence

from scene_author import Author

TOLERANCES = ["1e-4", "1e-6", "1e-9", "1e-9", "1e-12"]
WISHES = {"linearize": 0.3, "inverse_dynamics": 0.25, "discretize": 0.15}


class _Wide(Author):
    """Writes one scene. rows: names of constraints; more: arrays of tables at the end."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.random = random.Random(f"wide scene {seed}")
        self.rows: list[str] = []
        self.outputs: list[str] = []
        self.arrays: list[str] = []
        self.frames: list[str] = []
        self.held = False  # jumps would have to satisfy the constraints
        self.jumped = random.Random(f"jumped parameters {seed}")

    # --- additions to scenes of both kinds -----

    def limits(self) -> None:
        """Add limits of some inputs."""
        lines = self.tables.inputs
        for k, line in enumerate(lines):
            if not self.static and self.chance(0.3):
                most = self.value(0.1, 0.6)
                ends = self.one([f'["-{most}", "{most}"]', "[0, inf]", f'[-inf, "{most}"]'])
                lines[k] = line.replace(" }", f", limits = {ends} }}")
                self.corners = True

    def free_name(self) -> str:
        """Return a name that is not a column of every run."""
        return next(n for n in iter(self.name, "") if n not in ("energy", "power"))

    def add_outputs(self) -> None:
        """Add outputs."""
        for _ in range(self.random.choice([0, 1, 2, 3])):
            x, y = self.one(self.q), self.one(self.q)
            forms = [
                f"{x}_ddot + sin({y})", f"{x}*{y}_dot - t", "energy - kinetic_energy",
                f"{self.number(0.2, 2)}*{x}_ddot*{y}_dot", f"sqrt(1 + {x}_dot**2)",
                f"dot(dot({x}*{y}))", f"atan2({x}, 2 + {y}**2)", "potential_energy/2",
            ]  # fmt: skip
            if self.points:
                p = self.one(self.points)
                forms += [f"dot(dot({p}))", f"dot({p})**2 + {p}", f"{p}*{x}_ddot"]
            if self.u:
                forms.append(f"{self.one(self.u)}*{x}_dot")
            text = self.one(forms)
            unit = f'{{ formula = "{text}", unit = "N" }}' if self.chance(0.3) else f'"{text}"'
            name = self.free_name()
            self.outputs.append(f"{name} = {unit}")

    def adaptive(self) -> None:
        """Add a tolerance and events."""
        if self.chance(0.6):
            run = self.tables.run
            single = any('"float"' in line for line in run)
            run.append(f"tolerance = {self.one(['1e-3', '1e-4'] if single else TOLERANCES)}")
        for _ in range(self.random.choice([0, 0, 1, 2])):
            x, y = self.one(self.q), self.one(self.q)
            when = self.one(
                [x, f"{x}_dot", f"{x} - {self.number(-1, 1)}", f"{x}*{y} - 0.3", f"sin({x}) - 0.4",
                 f"t - {self.number(0.05, 0.4)}", f"{x}_dot + {y}/2"]
            )  # fmt: skip
            lines = ["[[event]]", f'name = "{self.name()}"', f'when = "{when}"']
            if self.chance(0.6):
                lines.append(f'direction = "{self.one(["rising", "falling", "both"])}"')
            action = self.one(["record", "record", "stop", "jump"])
            if action != "record" or self.chance(0.3):
                lines.append(f'action = "{action}"')
            if action == "jump":
                lines.append(f'{x}_dot = "{self.one([f"-{x}_dot/2", f"{x}_dot + 0.1", "0"])}"')
                if self.chance(0.3) and not self.held:
                    lines.append(f'{x} = "{x} + 0.05"')
                lines += self.jump_of_parameter(x)
            self.arrays += lines

    def jump_of_parameter(self, x: str) -> list[str]:
        """Return the line that sets a parameter that neither constraints nor limits use."""
        text = "\n".join([*self.rows, *(u for u in self.tables.inputs if "limits" in u)])
        named = (line.split(" = ")[0] for line in self.tables.parameters)
        free = [p for p in named if not re.search(rf"\b{p}\b", text)]
        if not free or self.jumped.random() < 0.5:
            return []
        p = self.jumped.choice(free)
        to = [f"1.1*{p}", f"{p}*(1 + sin({x})**2/10)", f"{p} + 0.05*{x}_dot**2", "0.7"]
        return [f'{p} = "{self.jumped.choice(to)}"']

    def optional_functions(self) -> None:
        """Request optional functions."""
        run = self.tables.run
        for name, part in WISHES.items():
            if name == "inverse_dynamics" or not self.corners:
                if self.chance(part) and not any(line.startswith(name) for line in run):
                    run.append(f"{name} = true")
        if self.frames:
            if self.chance(0.5):
                named = self.random.sample(self.frames, self.random.randint(1, len(self.frames)))
                text = ", ".join(f'"{name}"' for name in named)
                run.append(f"frames = {self.one(['true', f'[{text}]'])}")
            if self.chance(0.3):
                run.append("momentum = true")

    def constrained(self) -> None:
        """Add a new coordinate for each constraint, so that constraints never contradict."""
        others = list(self.q)
        for _ in range(self.random.choice([1, 1, 2])):
            x, y = self.one(others), self.one(others)
            name = self.name()
            self.tables.coordinates.append(f'{name} = {{ unit = "m", guess = true }}')
            self.q.append(name)
            a = self.value(0.3, 1.2)
            self.tables.energy[0] = self.tables.energy[0][:-1] + f' + 0.4*{name}_dot**2"'
            forms = [
                f"{name} - {a}*sin({x})", f"{name} - {a}*{x} + {y}/3", f"{name} - {x}*{y}/2 - {a}",
                f"{name} + {name}**3/3 - {a}*{x}", f"{a}*{name} - cos({x}) + 0.1*sin(2*t)",
                f"{name} - {a}*atan({x}) - {y}**2/4", f"{name}_dot - {a}*sin({y})*{x}_dot",
            ]  # fmt: skip
            self.rows.append(f'{self.free_name()} = "{self.one(forms)}"')
        self.held = True

    # --- scenes

    def energies(self) -> str:
        for _ in range(self.random.choice([1, 2, 2, 3])):
            self.coordinate()
        self.inputs()
        self.tables.energy.append(f'kinetic = "{self.kinetic()}"')
        self.tables.energy.append(f'potential = "{self.potential()}"')
        if self.chance(0.35):
            self.static = False  # accelerations then depend on velocities
            self.constrained()
        return self.ended([])

    def bodies(self) -> str:
        """Return a chain of bodies with points and forces, possibly closed by a loop."""
        plane, count = self.chance(0.6), self.random.choice([1, 2, 3, 3])
        self.static = False
        close = self.chance(0.4) and count > (2 if plane else 1)
        out: list[str] = []
        for k in range(count):
            out += self.body(k, plane, close)
            self.frames.append(f"b{k}")
        last = f"b{count - 1}"
        for k in range(self.random.choice([0, 1, 1, 2])):
            on = self.one(self.frames)
            out += [
                "[[point]]",
                f'name = "p{k}"',
                f'body = "{on}"',
                f"place = {self.vector(plane)}",
            ]
            self.frames.append(f"p{k}")
            self.points.append(f"p{k}_{self.one(['x', 'y'])}")
        self.inputs()
        for _ in range(self.random.choice([0, 1, 1])):
            size = 2 if plane else 3
            push = [self.one(["0", '"sin(3*t)"', '"0.4"', f'"-{self.one(self.q)}_dot/5"',
                              *(f'"{u}"' for u in self.u)]) for _ in range(size)]  # fmt: skip
            out += [
                "[[force]]",
                f'body = "{self.one(self.frames)}"',
                f"force = [{', '.join(push)}]",
            ]
            if self.chance(0.4):
                out.append(f'frame = "{self.one(["world", "body"])}"')
        if close:
            self.held = True
            out += self.loop(last, plane)
        if self.chance(0.4):
            out += ["[[spring]]", f'coordinate = "{self.one(self.q)}"',
                    f'stiffness = "{self.value(1, 40)}"']  # fmt: skip
        gravity = self.one(["-9.81", "0", '"-49/5"'])
        return self.ended(out, f"gravity = [0, {gravity if plane else f'0, {gravity}'}]")

    def body(self, k: int, plane: bool, close: bool) -> list[str]:
        # if a loop is closed, all initial values may change
        x = self.name()
        start = self.number(0.2, 1.1)
        guess = ", guess = true" if close else ""
        rate = "" if close else f", rate = {self.number(-1, 1)}"
        self.tables.coordinates.append(f'{x} = {{ unit = "rad", start = "{start}"{rate}{guess} }}')
        self.q.append(x)
        lines = ["[[body]]", f'name = "b{k}"', 'joint = "revolute"', f'coordinates = "{x}"']
        if k:
            lines += [f'parent = "b{k - 1}"', f"offset = [0.{self.random.choice('579')}, 0"]
            lines[-1] += "]" if plane else ", 0.1]"
        if not plane:
            lines.append(f"axis = {self.one(['[0, 0, 1]', '[0, 1, 0]', '[1, 2, 2]'])}")
        inertia = self.value(0.1, 0.8)
        lines += [f'mass = "{self.value(0.5, 3)}"', f"center = {self.vector(plane)}"]
        lines.append(f'inertia = "{inertia}"' if plane else f'inertia = ["{inertia}", 0.4, 0.5]')
        return lines + ([f'damping = "{self.value(0.05, 1)}"'] if self.chance(0.3) else [])

    def loop(self, last: str, plane: bool) -> list[str]:
        """Return a loop that can be closed from nearly all initial values."""
        lines = ["[[loop]]", 'name = "closed"']
        if len(self.q) > 1 and self.chance(0.3):
            x, y = self.random.sample(self.q, 2)
            return [*lines, 'joint = "gear"', f'coordinates = ["{x}", "{y}"]', "ratio = 2"]
        lines.append(f'bodies = ["{last}", "world"]')
        tip, ground = ("[0.5, 0]", "[0.9, 0.2]") if plane else ("[0.5, 0, 0]", "[0.4, 0.3, 0.2]")
        if plane and self.chance(0.6):
            return [*lines, 'joint = "revolute"', f"points = [{tip}, {ground}]"]
        far = round(math.hypot(0.7, 0.4), 3)
        return [*lines, 'joint = "distance"', f"points = [{tip}, {ground}]", f"length = {far}"]

    def ended(self, more: Sequence[str], above: str = "") -> str:
        """Append the options of all scenes."""
        if self.random.random() < 0.5 and not self.static:
            self.friction()
        self.limits()
        self.drive()
        self.settings()
        self.add_outputs()
        self.adaptive()
        self.optional_functions()
        rows = ["[constraints]", *self.rows] if self.rows else []
        outputs = ["[outputs]", *self.outputs] if self.outputs else []
        return self.text([*rows, *outputs, *more, *self.arrays], above)


def wide_text(seed: int) -> str:
    """Return the scene of that number as TOML: valid and reproducible."""
    author = _Wide(seed)
    return author.bodies() if author.chance(0.5) else author.energies()
