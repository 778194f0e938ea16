"""Long functions are split into pieces with the same values, suitable for strict compilers."""

from __future__ import annotations

import os
import random
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from support.builds import REUSED_BUILDS
from support.cases import SCENES, fast_kit, scene_system
from support.compilation import STRICT, compiled
from support.session import EVERYTHING, Modules, needs, tiers
from sympy import S

import eomc
from eomc.derive import lagrange
from eomc.derive.tape import Stage
from eomc.emit.render import Sources, render
from eomc.model import system
from eomc.model.symbols import ALONG
from eomc.model.system import System
from eomc.program import outline, program
from eomc.program.ir import (
    Assignment,
    Call,
    Cost,
    Function,
    Operand,
    Product,
    Sum,
    evaluate,
    nearby,
    rename,
)
from eomc.program.program import Program
from eomc.scene import read as scene
from eomc.toolchain import cache
from eomc.toolchain.files import write_files

pytestmark = pytest.mark.usefixtures("quickly_compiled")

STEPS = 40


def chain(links: int) -> System:
    """Write a hanging chain of point masses in relative angles, with nested definitions."""
    lines = ["eomc = 1", f'name = "chain_{links}"', "[coordinates]"]
    lines += [f"q{k} = {{ start = 0.{k % 9 + 1} }}" for k in range(links)]
    lines += ["[parameters]", "m = 1.2", "l = 0.7", "g = 9.81", "[definitions]"]
    for k in range(links):
        a, x, y = (f"{name}{k - 1} + " if k else "" for name in "axy")
        lines += [f'a{k} = "{a}q{k}"', f'x{k} = "{x}l*sin(a{k})"', f'y{k} = "{y}-l*cos(a{k})"']
    kinetic = " + ".join(f"m*(dot(x{k})**2 + dot(y{k})**2)/2" for k in range(links))
    potential = " + ".join(f"m*g*y{k}" for k in range(links))
    lines += ["[energy]", f'kinetic = "{kinetic}"', f'potential = "{potential}"']
    return system.from_scene(scene.parse("\n".join(lines), "chain.toml"))


def build_program(system: System) -> Program:
    return program.build(lagrange.derive(system))


@pytest.fixture(scope="module")
def chain_program() -> Program:
    return build_program(chain(5))


@pytest.fixture
def in_small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nearly every function counts as long."""
    monkeypatch.setattr(outline, "LARGE", 20)
    monkeypatch.setattr(outline, "PIECE", 25)


# --- where functions are cut ---------------------------------------------------------------------


@pytest.mark.parametrize("name", ["acceleration", "C", "energy"])
@pytest.mark.parametrize("size", [1, 20, 100, 10**6])
def test_pieces_compute_the_values_of_the_whole_function(
    chain_program: Program, name: str, size: int
) -> None:
    """To the last bit, each from only the values that it declares as read."""
    whole = chain_program[name]
    state = nearby(chain_program.system, 1)
    parts = outline.split(whole, size)
    assert (len(parts) == 1) == (size == 10**6)
    crossing: dict[str, float] = {}
    values_by_output: dict[int, float] = {}
    all_regular = True
    for part in parts:
        output_operands = tuple(Operand(S.One, n) for n in part.keeps)
        open_ended = replace(part.function, outputs=(*output_operands, *part.function.outputs))
        read = {n: crossing[n] for n in part.reads}
        values, regular = evaluate(open_ended, {**state, **read})
        crossing |= dict(zip(part.keeps, values, strict=False))
        values_by_output |= dict(zip(part.outputs, values[len(output_operands) :], strict=True))
        all_regular &= regular
    expected, regular = evaluate(whole, state)
    assert [values_by_output[k] for k in range(len(expected))] == expected
    assert all_regular == regular


def test_only_values_read_later_are_passed_on(chain_program: Program) -> None:
    parts = outline.split(chain_program["acceleration"], 60)
    for k, part in enumerate(parts):
        assigned = {a.name for a in (*part.function.early, *part.function.body)}
        read_later = {n for later in parts[k + 1 :] for n in later.reads}
        assert set(part.keeps) == assigned & read_later
        assert not assigned & set(part.reads)
    total = sum(map(outline.weight, (part.function for part in parts)))
    assert total == outline.weight(chain_program["acceleration"])
    heaviest = max(outline.weight(part.function) for part in parts)
    assert heaviest <= 60 * 4 // 3 + 15


def test_sine_and_cosine_of_an_angle_are_in_one_piece(chain_program: Program) -> None:
    for size in (1, 7, 30, 90):
        where: dict[tuple[Operand, ...], set[int]] = {}
        for k, part in enumerate(outline.split(chain_program["acceleration"], size)):
            for a in part.function.body:
                if isinstance(a.value, Call) and a.value.function in ("sin", "cos"):
                    where.setdefault(a.value.args, set()).add(k)
        assert len(where) == 5
        assert all(len(places) == 1 for places in where.values())


def random_function(count: int, width: int) -> Function:
    """Return `count` products and sums, each of two of the `width` values before it."""
    pick = random.Random(1)
    names = ["x", "x_dot"]
    body = []
    for k in range(count):
        one, other = pick.choice(names[-width:]), pick.choice(names[-width:])
        value: Sum | Product = Product(S.Half, (one, other))
        if k % 2:
            value = Sum(((S.One, one), (S.NegativeOne, other)), S.Half)
        names.append(f"w{k + 1}")
        body.append(Assignment(names[-1], value, Stage.VELOCITY))
    end = Operand(S.One, names[-1])
    cost = Cost(adds=count // 2, multiplications=count // 2)
    return Function("bias", (), tuple(body), (end,), (), cost, "program", ())


def test_function_is_split_where_few_values_cross() -> None:
    """Two groups of values joined by one value are split at that value."""
    one = random_function(60, 20)
    other = rename(
        random_function(60, 20),
        {"x": "w60", "x_dot": "w60"} | {f"w{k}": f"v{k}" for k in range(61)},
    )
    both = replace(one, body=one.body + other.body, outputs=other.outputs)
    first, second = outline.split(both, 65)
    assert first.keeps == second.reads == ("w60",)


# --- what compilers say --------------------------------------------------------------------------


def write_sources(sources: Sources, folder: Path) -> str:
    folder.mkdir(exist_ok=True)
    write_files(fast_kit(sources), folder)
    return f"{sources.name}.c"


def system_with_everything(run: str, name: str = "everything") -> System:
    """Return the scene with all features, with further options under [run]."""
    text = EVERYTHING.replace("[run]", f"[run]\n{run}").replace('"everything"', f'"{name}"')
    return system.from_scene(scene.parse(text, "everything.toml"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "run",
    ["", 'method = "dp8"', 'batch = true\nmethod = ["rk4", "dp8"]', 'real = "float"\nbatch = true'],
)
def test_pieces_compile_without_warnings(in_small_pieces: None, tmp_path: Path, run: str) -> None:
    """Compile as C with gcc and clang and as C++; run the self-test.

    RK4 in doubles has its accelerations in two parts, with configurations in pairs.
    """
    sources = render(build_program(system_with_everything(run)), "_everything")
    source = write_sources(sources, tmp_path)
    paired = "float" not in run and run != 'method = "dp8"'
    parts = ("_configurations_2_two(", "_velocities_2(") if paired else ("_rates_4(",)
    assert all(part in fast_kit(sources)[source] for part in (*parts, "_C_4("))
    assert ("_rates_4_wide(" in fast_kit(sources)[source]) == ("batch" in run)
    for command in ("gcc", "clang"):
        compiled(
            needs(command),
            *STRICT,
            "-O2",
            "-I.",
            "-c",
            source,
            "selftest.c",
            "main.c",
            cwd=tmp_path,
        )
    strict = ["-std=c++11", *STRICT[1:], "-fsyntax-only"]
    compiled(needs("g++"), *strict, "-x", "c++", source, cwd=tmp_path)
    compiled(
        "cc", "-std=c99", "-O1", "-I.", "selftest.c", source, "-lm", "-o", "selftest", cwd=tmp_path
    )
    assert subprocess.run(["./selftest"], cwd=tmp_path, stdout=subprocess.DEVNULL).returncode == 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", ["1", "77"])
def test_hash_seed_does_not_affect_the_pieces(tmp_path: Path, seed: str) -> None:
    code = """
import sys
from eomc import read
from eomc.derive import lagrange
from eomc.program import outline
from eomc.program import program
from eomc.emit.render import render
outline.LARGE, outline.PIECE = 20, 25
for name in sys.argv[1:]:
    print(render(program.build(lagrange.derive(read(name))), "_x").files)
"""
    names = [str(SCENES / f"{name}.toml") for name in ("cartpole_driven", "furuta_pendulum")]
    outcomes = [
        subprocess.run(
            [sys.executable, "-c", code, *names], capture_output=True, text=True, check=True,
            env={**os.environ, "PYTHONHASHSEED": s},
        ).stdout
        for s in ("0", seed)
    ]  # fmt: skip
    assert "_acceleration_1(" in outcomes[0] and "_C_2(" in outcomes[0]
    assert outcomes[0] == outcomes[1]


@pytest.mark.slow
def test_compile_time_grows_linearly_with_the_size(tmp_path: Path) -> None:
    """Eight times the operations, in pieces, take at most sixteen times as long."""
    whole_program = build_program(eomc.read(SCENES / "mass_spring.toml"))

    def seconds(count: int) -> float:
        long = Program(
            whole_program.system,
            {**whole_program.functions, "bias": random_function(count, 60)},
            (),
            whole_program.order,
        )
        source = write_sources(render(long, "_x"), tmp_path)
        least = float("inf")
        for _ in range(3):
            start = os.times().children_user  # of the compiler only, whatever other processes run
            compiled(needs("gcc"), "-O3", "-c", source, cwd=tmp_path)
            least = min(least, os.times().children_user - start)
        return least

    nothing, small, large = seconds(1), seconds(1000), seconds(8000)
    assert large - nothing < 16 * (small - nothing)


# --- what they compute ---------------------------------------------------------------------------


@pytest.fixture
def root(request: pytest.FixtureRequest) -> Path:
    """Return the cache folder for modules of a test, valid while this file is unchanged."""
    return REUSED_BUILDS / "outline" / re.sub(r"\W+", "_", request.node.name)


def load_program(program: Program, root: Path) -> ModuleType:
    """Compile a program under `root` and load it."""
    name, source_text = program.system.name, Path(__file__).read_text(encoding="utf-8")
    key = cache.key(program.system.digest, f"{root} {source_text}")
    return cache.load(cache.build(name, key, lambda extension: render(program, extension), root))


@pytest.mark.slow
def test_system_in_pieces_moves_as_the_whole_system(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Test every function, single runs and batches; operations are fused at other places."""
    run = 'batch = true\nmethod = ["rk4", "dp8"]'
    plain = build_program(system_with_everything(run))
    whole = load_program(plain, root / "whole")
    monkeypatch.setattr(outline, "LARGE", 20)
    monkeypatch.setattr(outline, "PIECE", 25)
    cut = load_program(plain, root / "cut")
    random_state = np.random.default_rng(3)
    q0, qd0 = (x + 0.1 * random_state.standard_normal((75, 3)) for x in whole.start)
    for name in ("D", "g"):
        np.testing.assert_allclose(
            getattr(cut, name)(q0), getattr(whole, name)(q0), rtol=1e-12, atol=1e-13
        )
    for name in ("C", "bias", "tau", "energy", "power", "acceleration"):
        result, expected = (getattr(m, name)(q0, qd0) for m in (cut, whole))
        np.testing.assert_allclose(result, expected, rtol=1e-11, atol=1e-12)
    for method in ("rk4", "dp8"):
        for u in (None, [0.3, -0.2]):
            one, other = (
                m.simulate(q0[0], qd0[0], steps=STEPS, method=method, u=u) for m in (cut, whole)
            )
            np.testing.assert_allclose(one.q, other.q, rtol=0, atol=1e-11)
            many = cut.simulate_batch(q0, qd0, steps=STEPS, every=4, method=method, u=u)
            assert set(many.status) == {"ok"}
            for k in (0, 63, 74):
                alone = cut.simulate(q0[k], qd0[k], steps=STEPS, every=4, method=method, u=u)
                np.testing.assert_allclose(many.q[k], alone.q, rtol=0, atol=1e-11)
                np.testing.assert_allclose(many.qd[k], alone.qd, rtol=0, atol=1e-11)


def test_failed_instance_does_not_affect_others_in_pieces(
    in_small_pieces: None, root: Path
) -> None:
    system = eomc.read(SCENES / "kepler_orbit.toml")
    m = load_program(build_program(replace(system, run=replace(system.run, batch=True))), root)
    q0, qd0 = np.tile(m.start[0], (70, 1)), np.tile(m.start[1], (70, 1))
    batch = m.simulate_batch(q0, qd0, steps=STEPS)
    q0[41] = 0.0  # at the centre, where the force is infinite
    runs = m.simulate_batch(q0, qd0, steps=STEPS)
    assert runs.status[41] == "not finite" and runs.steps[41] == 0
    others = np.arange(70) != 41
    assert np.array_equal(runs.q[others], batch.q[others])


def test_signals_and_constant_inputs_in_a_batch_in_pieces(
    monkeypatch: pytest.MonkeyPatch, root: Path
) -> None:
    monkeypatch.setattr(outline, "LARGE", 8)
    monkeypatch.setattr(outline, "PIECE", 8)
    system = scene_system("cartpole_driven")
    m = load_program(build_program(replace(system, run=replace(system.run, batch=True))), root)
    source = root / system.name / "fast" / f"{system.name}.c"
    assert "_rates_2_wide(" in source.read_text(encoding="utf-8")
    q0, qd0 = (np.tile(x, (9, 1)) for x in m.start)
    q0[:, 1] += np.linspace(-1, 1, 9)
    for u in (None, [0.5]):
        runs = m.simulate_batch(q0, qd0, steps=STEPS, u=u)
        alone = m.simulate(q0[7], qd0[7], steps=STEPS, u=u)
        # the same operations, fused to FMA at other places
        np.testing.assert_allclose(runs.q[7], alone.q, rtol=0, atol=1e-12)


# --- matrices by columns -------------------------------------------------------------------------


def with_matrices_by_columns(program: Program) -> Program:
    """Return the program with D e and C e for a direction e in place of D and C."""
    functions = dict(program.functions)
    names = [c.name for c in program.system.coordinates]
    for name in ("D", "C"):
        whole = functions.pop(name)
        body, outputs = list(whole.body), []
        for i in range(len(names)):
            terms = []
            for j, c in enumerate(names):
                o = whole.outputs[len(names) * i + j]
                factors = (o.name, c + ALONG) if o.name else (c + ALONG,)
                product = Product(abs(o.coefficient), factors)
                body.append(Assignment(f"p_{i}_{j}", product, Stage.VELOCITY))
                terms.append((S.NegativeOne if o.coefficient.is_negative else S.One, f"p_{i}_{j}"))
            body.append(Assignment(f"row_{i}", Sum(tuple(terms)), Stage.VELOCITY))
            outputs.append(Operand(S.One, f"row_{i}"))
        functions[f"{name}_column"] = replace(
            whole, name=f"{name}_column", body=tuple(body), outputs=tuple(outputs)
        )
    return replace(program, functions=functions)


@pytest.mark.parametrize(
    "name", tiers(("cartpole", "furuta_pendulum", "kapitza_pendulum"), "cartpole")
)
@pytest.mark.parametrize("small", tiers([False, True], True))
def test_matrices_by_columns_agree_with_whole_matrices(
    name: str, small: bool, tmp_path: Path, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = build_program(eomc.read(SCENES / f"{name}.toml"))
    whole = load_program(plain, root / "whole")
    if small:
        monkeypatch.setattr(outline, "LARGE", 5)
        monkeypatch.setattr(outline, "PIECE", 8)
    sources = render(with_matrices_by_columns(plain), "_x")
    source = write_sources(sources, tmp_path)
    assert f"By {len(plain.system.q)} columns, each: " in sources.files[f"{name}.h"]
    compiled(needs("gcc"), *STRICT, "-O1", "-I.", "-c", source, "selftest.c", cwd=tmp_path)
    columns = load_program(with_matrices_by_columns(plain), root / "columns")
    states = np.random.default_rng(4).standard_normal((2, 9, len(plain.system.q)))
    for result, expected in (
        (columns.D(states[0]), whole.D(states[0])),
        (columns.C(*states), whole.C(*states)),
    ):
        np.testing.assert_allclose(result, expected, rtol=1e-13, atol=1e-13)
    values = nearby(plain.system, 2)
    exact = program.matrix(with_matrices_by_columns(plain), "C", values)
    expected, _ = evaluate(plain["C"], values)
    np.testing.assert_allclose(np.ravel(exact), expected, rtol=1e-13, atol=1e-13)


# --- names ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_parameters_with_names_of_directions_are_accepted(root: Path) -> None:
    """Entries of a direction, for D and the Jacobian, have names that no scene can have."""
    text = """
        eomc = 1
        name = "clash"
        [coordinates]
        x = { start = 1.0 }
        y = {}
        [parameters]
        NAME = 2.0
        [energy]
        kinetic = "NAME*x_dot**2/2 + (1 + x**2)*y_dot**2/2"
        [run]
        linearize = true
        """
    q, qd = [0.3, 0.4], [0.2, -0.3]
    results = []
    for name in ("x_along", "m"):
        clash_system = system.from_scene(scene.parse(text.replace("NAME", name), "clash.toml"))
        built = load_program(build_program(clash_system), root / name)
        results.append((built.D(q), built.acceleration(q, qd), *built.linearize(q, qd)[:2]))
    np.testing.assert_array_equal(results[0][0], np.diag([2.0, 1.09]))
    for one, other in zip(*results, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
def test_parameters_with_names_of_values_are_accepted(root: Path, modules: Modules) -> None:
    """w1 is a generated name inside a function that does not read the parameter."""
    text = (SCENES / "cartpole.toml").read_text(encoding="utf-8")
    awkward = re.sub(r"(?m)^g( +=)", r"w1\1", text).replace("m_p*g*y_p", "m_p*w1*y_p")
    assert awkward.count("w1") == 2
    module_of_pieces = load_program(
        build_program(system.from_scene(scene.parse(awkward, "awkward.toml"))), root
    )
    plain = modules.unoptimised(scene_system("cartpole"))
    state = ([0.1, 0.4], [0.2, -0.3])
    assert np.array_equal(module_of_pieces.acceleration(*state), plain.acceleration(*state))
    assert np.array_equal(module_of_pieces.C(*state), plain.C(*state))


@pytest.mark.parametrize("name", ["chain", "cartpole_driven"])
def test_types_are_defined_once(in_small_pieces: None, name: str) -> None:
    """The values of the configuration and those of its outlined functions are two structs."""
    system = scene_system(name)
    files = fast_kit(render(build_program(system), "_twice"))
    types = re.findall(r"^\} (\w+);", files[f"{name}.h"] + files[f"{name}.c"], re.M)
    assert len(types) == len(set(types)) > 3
