"""Random valid scenes, determined by their number.

A scene has one to four coordinates, energies or bodies, definitions, `dot`, time, inputs with
signals, friction, names that C and Python nearly refuse, and any applicable methods. A wide scene
also has some of: outputs, limits of inputs, adaptive steps, events, points, forces at bodies,
frames, inverse dynamics, momentum, derivatives of steps, constraints and closed loops.
"""

from __future__ import annotations

import json
import math
import random
import re
from collections.abc import Sequence
from dataclasses import dataclass, field

from eomc.base import names

# Single letters of C and SymPy, names similar to keywords, names in the generated code.
AWKWARD = """I E S N O Q C D J K L P R T U V beta gamma zeta Lambda lam lambda1 lambda_1 e i j k l
m n o p q r s u v w x y z a b c d f g h If Or And Not Mod Max Min Abs Pow Add Symbol Integer pi2 oo
zoo nan1 inf np math self out params index values y0_1 Int Double float1 double_1 int_1 for_1 in1
None1 True1 or1 status memory steps count run step tau bias power energy theta phi psi alpha mu nu
xi omega sigma q1 q2 qd qdd w1 w2 d_theta sin_theta cos_x theta1 x1 x_2 xdot ddot prepare defaults
signal jacobi acceleration trouble lane method batch real result first last start sincos1 sin1 cos1
exp1 log1 sqrt1 abs1 M_total mass_1 length stiffness l_0 Theta Phi Omega alpha_beta""".split()

EXPLICIT, IMPLICIT = ("rk4", "dp8", "euler"), ("gauss4", "gauss6", "gauss8", "gauss16")
STEPPERS = (*EXPLICIT, "verlet", *IMPLICIT)


@dataclass
class _Tables:
    """A growing scene: the lines of each table."""

    coordinates: list[str] = field(default_factory=list)
    parameters: list[str] = field(default_factory=list)
    constants: list[str] = field(default_factory=list)
    inputs: list[str] = field(default_factory=list)
    definitions: list[str] = field(default_factory=list)
    energy: list[str] = field(default_factory=list)
    forces: dict[str, list[str]] = field(default_factory=dict)
    run: list[str] = field(default_factory=list)


class Author:
    """Writes one scene.

    static: D is constant and forces depend on positions and time only, so that every method is
    applicable. corners: discontinuities or kinks, which implicit methods refuse.
    """

    def __init__(self, seed: int) -> None:
        self.random = r = random.Random(f"scene {seed}")
        self.tables = _Tables()
        self.names = [n for n in AWKWARD if names.fault(n) is None]
        r.shuffle(self.names)
        self.static, self.timed = r.random() < 0.25, r.random() < 0.3
        self.corners = False
        self.q: list[str] = []
        self.u: list[str] = []
        self.points: list[str] = []

    def chance(self, part: float) -> bool:
        return self.random.random() < part

    def name(self) -> str:
        return self.names.pop()

    def number(self, low: float, high: float) -> str:
        """Return a number as people write it: a few digits, a fraction, an integer."""
        x = self.random.uniform(low, high)
        kinds = [f"{x:.3g}", f"{x:.2g}", repr(x), f"{max(1, round(3 * x))}/3"]
        return self.random.choice(kinds) if low > 0 else f"{x:.3g}"

    def value(self, low: float, high: float) -> str:
        """Return a parameter in most cases, otherwise a constant or a number."""
        text, kind = self.number(low, high), self.random.random()
        if kind > 0.75:
            return f"({text})"
        name, quoted = self.name(), f'"{text}"' if "/" in text else text
        if kind > 0.65:
            self.tables.constants.append(f"{name} = {quoted}")
        elif self.chance(0.2):
            self.tables.parameters.append(
                f'{name} = {{ value = {quoted}, unit = "1", note = "n" }}'
            )
        else:
            self.tables.parameters.append(f"{name} = {quoted}")
        return name

    def one(self, options: Sequence[str]) -> str:
        return self.random.choice(options)

    def coordinate(self) -> str:
        name = self.name()
        parts = [f'unit = "{self.one(["rad", "m", "m", "1"])}"'] if self.chance(0.7) else []
        start = self.one([self.number(-1, 1), '"pi/6"', "0", '"1/3"', "0.5"])
        parts.append(f"start = {start}")
        if self.chance(0.6):
            parts.append(f"rate = {self.number(-1, 1)}")
        self.tables.coordinates.append(f"{name} = {{ {', '.join(parts)} }}")
        self.q.append(name)
        return name

    def inputs(self) -> None:
        for _ in range(self.random.choice([0, 0, 1, 1, 2])):
            name, x = self.name(), self.one(self.q)
            signals = ["0.5*sin(2*t)", "cos(t)/2 + t/10", "0.3", "exp(-t)", f"sin({x})/4"]
            if not self.static:
                signals.append(f"-{x}_dot/5 - {x}/7")
            text = self.one(signals)
            signal = f'signal = "{text}"' if self.chance(0.8) else 'unit = "N"'
            self.tables.inputs.append(f"{name} = {{ {signal} }}")
            self.u.append(name)

    def position(self) -> str:
        """Add a definition of positions, possibly of time."""
        x, y = self.one(self.q), self.one(self.q)
        a, b = self.value(0.3, 1.5), self.number(0.2, 1)
        forms = [
            f"{a}*sin({x})", f"{a}*cos({x}) + {y}", f"{x} - {a}*sin({y})", f"{x}*cos({y})",
            f"{x}*sin({y})", f"{a}*{x} + {b}*{y}**2/4", f"{a}*sin({x} + {y})", f"atan({x})*{a}",
            f"{a}*tanh({x}/2)", f"sqrt(1 + {x}**2)*{a}", f"{a}*sin({x})*cos({y})",
            f"exp(-{x}**2)*{a}", f"{a}*log(2 + {x}**2) + {y}", f"{a}*atan2({x}, 3 + {y}**2)",
            f"sinh({x}/5)*{a}", f"{a}*(1 + {x}**2)**0.75", f"{x}/(2 + {y}**2)*{a}",
        ]  # fmt: skip
        text = self.one(forms)
        if self.points and self.chance(0.4):
            text += f" + {self.one(self.points)}/2"
        if self.timed and self.chance(0.6):
            text += self.one([" + 0.1*cos(3*t)", " + t/20", " + sin(5*t)/20"])
        name = self.name()
        self.tables.definitions.append(f'{name} = "{text}"')
        self.points.append(name)
        return name

    def kinetic(self) -> str:
        masses = [self.value(0.5, 3) for _ in self.q]
        terms = [f"{m}*{x}_dot**2/2" for m, x in zip(masses, self.q, strict=True)]
        x, y = self.one(self.q), self.one(self.q)
        if self.static:
            if x != y and self.chance(0.5):
                terms.append(f"0.2*{x}_dot*{y}_dot")
            return " + ".join(terms)
        for _ in range(self.random.choice([0, 1, 1, 2])):
            terms.append(f"{self.value(0.3, 2)}*dot({self.position()})**2/2")
        if self.chance(0.3):
            terms.append(f"{self.value(0.2, 1)}*(2 + sin({x}))*{y}_dot**2/4")
        if self.chance(0.15):
            terms.append(f"{self.value(0.2, 1)}*sin({x})*{y}_dot")
        if self.chance(0.15):
            terms.append(f"{self.value(0.2, 1)}*cos({x})**2/3")
        if self.timed and self.chance(0.3):
            terms.append(f"t*{y}_dot/10")
        return " + ".join(terms)

    def potential(self) -> str:
        terms = []
        for x in self.q:
            k = self.value(0.5, 20) if self.chance(0.9) else self.value(2e3, 2e4)
            forms = [
                f"{k}*{x}**2/2", f"{k}*(1 - cos({x}))", f"-{k}*cos({x})", f"{k}*{x}**4/4",
                f"{k}*sqrt(1 + {x}**2)", f"{k}*log(1 + {x}**2)", f"{k}*cosh({x}/2)", f"{k}*{x}",
                f"-{k}*exp(-{x}**2)", f"{k}*tanh({x})**2", f"{k}*({x} - 1/4)**2/2",
                f"{k}*{x}*atan({x})", f"{k}*abs({x})**3/3", f"{k}*max(-{x}, 0)**2/2",
            ]  # fmt: skip
            form = self.one(forms[:12]) if self.chance(0.93) else self.one(forms[12:])
            self.corners |= "abs" in form or "max" in form
            terms.append(form)
        x, y = self.one(self.q), self.one(self.q)
        if self.chance(0.4):
            terms.append(self.one([f"{x}*{y}/10", f"sin({x} - {y})/3", f"({x} - {y})**2/2"]))
        if self.points and self.chance(0.6):
            terms.append(f"{self.value(1, 10)}*{self.one(self.points)}")
        if self.timed and self.chance(0.4):
            terms.append(f"{x}*sin(2*t)/5")
        return " + ".join(terms) if self.chance(0.93) else "0"

    def friction(self) -> None:
        """Add friction along some coordinates, by dissipation or as a force; smooth or not."""
        dissipation = []
        for x in self.q:
            if self.chance(0.5):
                continue
            c, v = self.value(0.05, 0.8), f"{x}_dot"
            width = self.one(["0.01", "0.1", "0.5", self.value(0.02, 1)])
            if self.chance(0.5):
                dissipation.append(
                    self.one(
                        [f"{c}*{v}**2/2", f"{c}*{v}*tanh({v}/{width})", f"{c}*{v}**4/4",
                         f"{c}*(1 + {x}**2)*{v}**2/2", f"{c}*log(cosh({v}))"]
                    )
                )  # fmt: skip
                continue
            forms = [
                f"-{c}*{v}",
                f"-{c}*tanh({v}/{width})",
                f"-{c}*{v}**3",
                f"-{c}*atan({v}/{width})",
            ]
            if self.chance(0.1):
                forms = [f"-{c}*sign({v})", f"-{c}*{v}*abs({v})", f"-{c}*{v}*heaviside({x})"]
                self.corners = True
            self.force(x, self.one(forms))
        if dissipation:
            self.tables.energy.append(f'dissipation = "{" + ".join(dissipation)}"')

    def force(self, x: str, text: str) -> None:
        self.tables.forces.setdefault(x, []).append(text)

    def drive(self) -> None:
        for name in self.u:
            x, y = self.one(self.q), self.one(self.q)
            self.force(x, self.one([name, f"2*{name}", f"{name}*cos({y})", f"{name}/(1 + {y}**2)"]))
        if self.timed and self.chance(0.5):
            self.force(self.one(self.q), self.one(["sin(3*t)", "t/10", "cos(t)*exp(-t/5)"]))
        if not self.static and self.chance(0.15):
            x, y = self.one(self.q), self.one(self.q)
            self.force(x, self.one([f"0.1*{y}_dot*{x}", f"sin({y}_dot)/5", f"{x}*{y}/9"]))

    def settings(self) -> None:
        r, run = self.random, self.tables.run
        batch = self.chance(0.15)
        can = [*EXPLICIT, *["verlet"] * self.static]
        if not (batch or self.corners):
            can += IMPLICIT
        r.shuffle(can)
        methods = can[: r.choice([1, 2, 2, 3, len(can)])]
        if self.chance(0.6):
            methods = ["rk4", *(m for m in methods if m != "rk4")]
        listed = ", ".join(f'"{m}"' for m in methods)
        if methods != ["rk4"] or self.chance(0.5):
            run.append(f"method = [{listed}]" if len(methods) > 1 else f"method = {listed}")
        run.append(f"h = {self.one(['0.001', '0.005', '0.01', '0.02', '0.004'])}")
        run.append(f"duration = {self.one(['0.5', '1.0', '2.0', '5.0', '10.0'])}")
        if batch:
            run.append("batch = true")
        if self.chance(0.1):
            run.append('real = "float"')
        if self.chance(0.25) and not self.corners:
            run.append(f"linearize = {self.one(['true', *map(json.dumps, SLOPES)])}")

    def energies(self) -> str:
        for _ in range(self.random.choice([1, 1, 2, 2, 3, 4])):
            self.coordinate()
        self.inputs()
        self.tables.energy.append(f'kinetic = "{self.kinetic()}"')
        self.tables.energy.append(f'potential = "{self.potential()}"')
        if not self.static:
            self.friction()
        self.drive()
        self.settings()
        return self.text([])

    def bodies(self) -> str:
        """Return a chain or tree of bodies on joints, planar or spatial."""
        plane, count, out = self.chance(0.6), self.random.choice([1, 2, 2, 3]), []
        self.static = False
        occupied: list[str] = []
        for k in range(count):
            x, lines = self.coordinate(), []
            turning = self.chance(0.7)
            lines = [f'name = "b{k}"', f'joint = "{"revolute" if turning else "prismatic"}"']
            lines.append(f'coordinates = "{x}"')
            if k and self.chance(0.8):
                lines.append(f'parent = "b{self.random.randrange(k)}"')
                lines.append(f"offset = {self.vector(plane)}")
            if not turning or not plane:
                axes = ["[1, 0]", "[0, 1]", "[3, 4]"] if plane else ["[1, 0, 0]", "[0, 0, 1]"]
                axes += [] if plane else ["[0, 1, 0]", "[1, 2, 2]"]
                lines.append(f"axis = {self.one(axes)}")
            inertia = self.value(0.1, 0.8)
            lines.append(f'mass = "{self.value(0.5, 3)}"')
            lines.append(f"center = {self.vector(plane)}")
            lines.append(
                f'inertia = "{inertia}"' if plane else f'inertia = ["{inertia}", 0.4, 0.5]'
            )
            lines += self.drag(x)
            out += ["[[body]]", *lines]
            occupied.append(x)
        for x in occupied:
            if self.chance(0.4):
                out += ["[[spring]]", f'coordinate = "{x}"', f'stiffness = "{self.value(1, 60)}"']
        self.inputs()
        self.drive()
        self.settings()
        gravity = self.one(['"-9.81"', "-9.81", "0", '"-49/5"'])
        return self.text(out, f"gravity = [0, {gravity if plane else f'0, {gravity}'}]")

    def drag(self, x: str) -> list[str]:
        lines = []
        if self.chance(0.3):
            lines.append(f'damping = "{self.value(0.05, 1)}"')
        if self.chance(0.4):
            lines.append(f"friction = {self.one(['0.1', '0.02', '0.5'])}")
            if self.chance(0.4):
                lines.append(f"friction_width = {self.one(['0.05', '0.2'])}")
        if self.chance(0.1):
            lines.append(f'actuator = "-{x}/3"')
        return lines

    def vector(self, plane: bool) -> str:
        entries = [self.one(["0", "0.5", '"1/3"', "-0.4", "0.3"]) for _ in range(2 if plane else 3)]
        return f"[{', '.join(entries)}]"

    def text(self, more: Sequence[str], above: str = "") -> str:
        t, out = self.tables, ["eomc = 1", 'name = "random_scene"', *filter(None, [above])]
        out += ["[coordinates]", *t.coordinates]
        for heading in ("parameters", "constants", "inputs", "definitions", "energy"):
            if lines := getattr(t, heading):
                out += [f"[{heading}]", *lines]
        if t.forces:
            out += ["[forces]", *(f'{x} = "{" + ".join(e)}"' for x, e in t.forces.items())]
        return "\n".join([*out, *more, "[run]", *t.run]) + "\n"


def scene_text(seed: int) -> str:
    """Return the scene of that number as TOML: valid and reproducible."""
    author = Author(seed)
    return author.bodies() if author.chance(0.25) else author.energies()


SLOPES = ("products", "parameters")
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
