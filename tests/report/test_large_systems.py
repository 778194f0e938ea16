"""Long equations by abbreviations, the short form of large systems, and all LaTeX in KaTeX."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy
from report import pictures
from support.cases import SCENES
from support.session import EVERYTHING

import eomc
from eomc import pipeline
from eomc.base.errors import EomcError
from eomc.model.system import System, from_scene
from eomc.model.tree import Tree
from eomc.report import equations_text
from eomc.report.equations import Equations, derive
from eomc.report.equations_text import write_equations
from eomc.report.typeset import CONTINUATION, MAX_ENVIRONMENT_LENGTH
from eomc.scene.read import parse
from eomc.verify import symbolic

pytestmark = pytest.mark.slow
KATEX = Path(__file__).parents[2] / "build" / "katex" / "node_modules"
ALL = sorted(SCENES.glob("*.toml"))
PICTURED = ("arm", "ball_beam", "crane", "slung_load", "satellite")
# forces of every kind, a gear, a rotor, a skew prismatic joint, a spring and a row in one scene
LARGE = """
eomc = 1
name = "large"
gravity = [0, 0, "-g"]
[coordinates]
a = { start = 0.3 }
b = { start = 0.2 }
c = { start = 0.4 }
d = { start = 0.1, guess = true }
[parameters]
m = 1.3
l = 0.7
g = 9.81
[inputs]
push = {}
[[body]]
name = "arm_1"
joint = "revolute"
coordinates = "a"
axis = [1, 2, 2]
mass = "m"
center = ["l/2", 0.1, 0.2]
inertia = [0.2, 0.3, 0.4, 0.01, 0.02, 0.03]
armature = 0.05
damping = 0.1
[[body]]
name = "slide"
parent = "arm_1"
joint = "prismatic"
coordinates = "b"
axis = [0, 1, -1]
offset = ["l", 0, 0]
mass = 0.5
center = [0.1, 0, 0.2]
inertia = [0.02, 0.03, 0.04]
[[body]]
name = "wheel"
parent = "slide"
joint = "revolute"
coordinates = "2*a - c"
axis = [0, 0, 1]
offset = [0, "l", 0]
mass = 0.4
inertia = [0.02, 0.02, 0.03]
[[body]]
name = "tip"
parent = "wheel"
joint = "spherical"
coordinates = ["c", "b", "d"]
offset = [0.2, 0, 0]
mass = 0.3
center = [0, 0, 0.3]
inertia = [0.02, 0.03, 0.02]
[[force]]
body = "tip"
force = [0, "push", 0]
[energy]
potential = "3*c**2/2"
[constraints]
row = "c + d - 1/2"
"""


@cache
def large_system() -> System:
    return from_scene(parse(LARGE, "large.toml"))


@cache
def chain_equations() -> Equations:
    return eomc.equations(SCENES / "chain.toml")


def test_substituted_abbreviations_give_the_equations() -> None:
    equations = chain_equations()
    short = equations.set_out
    assert short.named and not equations.named and short is not equations
    assert short.set_out is short
    put = {}
    for name, e in short.named:
        put[name] = e.xreplace(put)
    put |= {sympy.Symbol(f"D_{i + 1}{j + 1}"): equations.D[i, j]
            for i in range(5) for j in range(5)}  # fmt: skip
    rng = np.random.default_rng(2)
    symbols = {
        s
        for e in (*equations.D, *equations.C, *equations.g, *equations.tau)
        for s in e.free_symbols
    }
    accelerations = (equations.symbols[x.name] for x in equations.system.qdd)
    symbols |= {*accelerations, *equations.kinetic.free_symbols}
    values = {s: sympy.Float(rng.uniform(0.2, 1)) for s in sorted(symbols, key=str)}
    pairs = [(equations.kinetic, short.kinetic), (equations.potential, short.potential)]
    for name in ("D", "C", "g", "tau"):
        pairs += zip(getattr(equations, name), getattr(short, name), strict=True)
    pairs += [
        (a.lhs - a.rhs, b.lhs - b.rhs) for a, b in zip(equations.scalar, short.scalar, strict=True)
    ]
    for e, abbreviated in pairs:
        whole = abbreviated.xreplace(put)
        assert not {str(s) for s in whole.free_symbols} - {str(s) for s in values}
        assert float(e.xreplace(values)) == pytest.approx(
            float(whole.xreplace(values)), rel=1e-9, abs=1e-12
        )
    sizes = [sum(e.count_ops() for e in (*x.D, *x.C)) for x in (equations, short)]
    assert 3 * sizes[1] < sizes[0]


def test_long_equations_have_definitions_of_abbreviations() -> None:
    text, latex = str(chain_equations()), chain_equations()._repr_latex_()
    assert "D₁₁⋅θ̈₁ + D₁₂⋅θ̈₂" in text and "where, here and below:\n    s₁ = " in text
    assert r"& D_{11} \ddot{\theta}_{1} + D_{12} \ddot{\theta}_{2}" in latex
    assert "  s_{1} &= 3 \\sin" in latex and "L &= K - P" in latex


def test_abbreviations_avoid_names_of_the_scene() -> None:
    text = (SCENES / "chain.toml").read_text(encoding="utf-8")
    text = re.sub(r"\bb\b", "s_3", text).replace('"m"', '"D_12"').replace("\nm =", "\nD_12 =")
    abbreviated = derive(from_scene(parse(text.replace('"m*', '"D_12*'), "chain.toml"))).set_out
    names = {str(s) for s, _ in abbreviated.named}
    assert {"h_1", "h_2"} <= names and not any(name.startswith("s") for name in names)
    rows = {str(s) for terms in abbreviated.left for _, c in terms for s in c.free_symbols}
    assert "D_13" in rows and not any(x.system.names & names for x in [abbreviated])
    first = {str(rates): c for rates, c in abbreviated.left[0]}
    assert str(first["theta2_ddot"]) != "D_12"


def test_large_system_states_its_recursion_and_cost() -> None:
    system = pipeline.read(SCENES / "bricard.toml")
    text = write_equations(system)
    assert "would fill many pages" in text and "bar2 on bar1: turns about y by q₂" in text
    assert "hinge_rv: of positions, implied by others" in text and "bar5_r32 = 0" in text
    assert re.search(r"acceleration +\d+ flops", text)
    for refused in (lambda: write_equations(system, "python"), lambda: eomc.equations(system)):
        with pytest.raises(EomcError, match="would fill many pages"):
            refused()


def test_short_form_describes_each_joint() -> None:
    latex = equations_text.describe_in_latex(large_system())
    for line in (
        r"\text{arm\_1 on the world}, \; k = 1, \; p = 0:", r"s_{3} = 2 \, a - c",
        r"\alpha_{1} = 0.05", r"S_{2} = (0, e_{", r"m_{1} = m, \; c_{1} = \left(", "P' &=",
        r"\tau &= Q - ", "R &=", r"& c + d - \frac{1}{2} = 0",
        r"C_{ij} &= \frac{1}{2} \sum_{k}",
    ):  # fmt: skip
        assert line in latex, line
    left = re.findall(r"^  ([^&]+?) &=", latex, re.MULTILINE)
    assert len(left) == len(set(left)) > 20, "each name stands for one thing"


def cross_matrix(v: Any) -> np.ndarray:
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def rotation_matrix(axis: int, angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.eye(3)
    R[i, i] = R[j, j] = c
    R[i, j], R[j, i] = -s, s
    return R


def evaluate_printed_recursion(
    system: System, tree: Tree, values: dict[Any, Any], qdd: np.ndarray
) -> tuple[np.ndarray, float, float]:
    """Evaluate D qdd + C qd + g, K and P by the lines of recursion.tex.jinja."""

    def number(e: Any) -> float:
        return float(sympy.sympify(e).subs(values))

    numbers = np.vectorize(number)
    n, gamma = len(system.q), numbers(tree.gravity)
    qd = np.array([values[s] for s in system.qd])
    X, v, a, f, body, S, slopes, poses = [], [], [], [], [], [], [], []
    K, P = 0.0, number(tree.other_potential)
    for link in tree.links:
        ds = np.array([number(sympy.diff(link.q, x)) for x in system.q])
        rate = sum(sympy.diff(link.q, x) * v for x, v in zip(system.q, system.qd, strict=True))
        curved = sum(sympy.diff(rate, x) * v for x, v in zip(system.q, system.qd, strict=True))
        s, R, e = number(link.q), np.reshape(numbers(link.rotation), (3, 3)), np.eye(3)[link.axis]
        r = numbers(link.offset) + R @ e * s * number(link.linear)
        R = R @ rotation_matrix(link.axis, s) if link.angular else R
        J = np.diag(numbers(link.inertia[:3]))
        for k, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
            J[i, j] = J[j, i] = number(link.inertia[3 + k])
        c, m = cross_matrix(numbers(link.moment)), number(link.mass)
        X.append(np.block([[R.T, np.zeros((3, 3))], [-R.T @ cross_matrix(r), R.T]]))
        body.append(np.block([[J, c], [-c, m * np.eye(3)]]))
        S.append(np.concatenate([e * number(link.angular), e * number(link.linear)]))
        up = np.zeros(6) if link.parent < 0 else v[link.parent]
        v.append(X[-1] @ up + S[-1] * (ds @ qd))
        w, u = cross_matrix(v[-1][:3]), cross_matrix(v[-1][3:])
        cross = np.block([[w, np.zeros((3, 3))], [u, w]])
        up = np.concatenate([np.zeros(3), -gamma]) if link.parent < 0 else a[link.parent]
        sdd = ds @ qdd + number(curved)
        a.append(X[-1] @ up + S[-1] * sdd + cross @ S[-1] * (ds @ qd))
        f.append(body[-1] @ a[-1] - cross.T @ body[-1] @ v[-1])
        slopes.append((ds, number(link.armature) * sdd))
        K += (v[-1] @ body[-1] @ v[-1] + number(link.armature) * (ds @ qd) ** 2) / 2
        o, turn = (np.zeros(3), np.eye(3)) if link.parent < 0 else poses[link.parent]
        poses.append((o + turn @ r, turn @ R))
        P -= gamma @ (m * poses[-1][0] + poses[-1][1] @ numbers(link.moment))
    total = np.zeros(n)
    for k in reversed(range(len(f))):
        ds, rotor = slopes[k]
        total += ds * (S[k] @ f[k] + rotor)
        if (p := tree.links[k].parent) >= 0:
            f[p] = f[p] + X[k].T @ f[k]
    total += [number(sympy.diff(tree.other_potential, x)) for x in system.q]
    return total, K, P


@pytest.mark.parametrize("name", ["large", "bricard", "chain"])
def test_printed_recursion_gives_the_equations(name: str) -> None:
    system = large_system() if name == "large" else pipeline.read(SCENES / f"{name}.toml")
    assert system.tree is not None
    rng = np.random.default_rng(5)
    q, qd, qdd = rng.uniform(0.2, 1, (3, len(system.q)))
    values = {p.symbol: p.value for p in system.parameters}
    values |= dict(zip((*system.q, *system.qd), (*q, *qd), strict=True))
    reference = symbolic.reference_for(system)
    state = {"q": q, "qd": qd, "u": np.zeros(len(system.u))}
    expected = reference.evaluate("D", **state) @ qdd + reference.evaluate("bias", **state)
    result, K, P = evaluate_printed_recursion(system, system.tree, values, qdd)
    assert np.allclose(result, expected, rtol=1e-10, atol=1e-10)
    assert pytest.approx(float(reference.evaluate("kinetic", **state)), rel=1e-10) == K
    assert pytest.approx(float(reference.evaluate("potential", q, None)), rel=1e-10) == P


@pytest.mark.skipif(
    not shutil.which("node") or not (KATEX / "katex").is_dir(),
    reason="node or KaTeX is not there: make build/katex/done",
)
@pytest.mark.parametrize("which", ["scenes", "robots"])
def test_latex_of_every_scene_compiles_in_katex(which: str, tmp_path: Path) -> None:
    """The output of `eomc show --latex` for scenes, robots and mechanisms of other tests."""
    if which == "scenes":
        systems = [pipeline.read(f) for f in ALL]
        systems += [from_scene(pictures.scene(name)) for name in PICTURED]
        systems += [large_system(), from_scene(parse(EVERYTHING, "test.toml"))]
    else:
        systems = [from_scene(pictures.scene(name)) for name in pictures.ROBOTS]
    parts = {s.name: write_equations(s, "latex").split(r"\end{align*}")[:-1] for s in systems}
    file = tmp_path / "parts.json"
    file.write_text(json.dumps(parts), encoding="utf-8")
    script = """
        const katex = require('katex'), fs = require('fs');
        const parts = JSON.parse(fs.readFileSync(process.argv[1]));
        let n = 0;
        for (const [name, bodies] of Object.entries(parts)) for (const body of bodies) {
            const text = body + '\\\\end{align*}';
            katex.renderToString(text, {displayMode: true, throwOnError: true, strict: 'error'});
            n++;
        }
        console.log(n);
    """
    process = subprocess.run(
        ["node", "-e", script, str(file)], env=os.environ | {"NODE_PATH": str(KATEX)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert process.returncode == 0, process.stderr
    assert int(process.stdout) == sum(map(len, parts.values())) > 2 * len(systems)


def test_long_equations_get_an_environment_of_their_own() -> None:
    """KaTeX accepts about a page, and the equations of this scene fill two."""
    latex = write_equations(from_scene(parse(EVERYTHING, "test.toml")), "latex")
    environments = latex.split(r"\end{align*}")[:-1]
    for text in environments:
        lines = [line for line in text.splitlines() if line.startswith("  ")]
        equations = [line for line in lines if not line.startswith(CONTINUATION)]
        assert sum(map(len, lines)) < 1.1 * MAX_ENVIRONMENT_LENGTH or len(equations) == 1
    assert r"\operatorname{expm1}" in latex
