"""Small texts that would take gigabytes or hours are refused with a message or built in seconds.

Each runs in its own process, with bounds on CPU time and memory that hold on a slow machine.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable

import pytest

SECONDS = 20  # of CPU time; the slowest takes three
MEGABYTES = 1500  # of address space

WORK = """
import json, resource, sys
resource.setrlimit(resource.RLIMIT_CPU, (%d, %d))
resource.setrlimit(resource.RLIMIT_AS, (%d << 20, %d << 20))
from eomc import EomcError
from eomc.derive import lagrange
from eomc.program import program
from eomc.emit import render
from eomc.scene.read import parse
from eomc.model.system import from_scene
try:
    made = from_scene(parse(sys.stdin.buffer.read(), "growth.toml"))
    if sys.argv[1] == "built":
        render.render(program.build(lagrange.derive(made)), "_extension")
    print("ok")
except EomcError as fault:
    print(fault)
""" % (SECONDS, SECONDS + 2, MEGABYTES, MEGABYTES)  # noqa: UP031 - braces are few this way


def outcome(text: str, build: bool = False) -> str:
    """Return the error for a scene, or "ok"; fail beyond the bounds."""
    process = subprocess.run(
        [sys.executable, "-c", WORK, "built" if build else "read"],
        input=text.encode(), capture_output=True,
    )  # fmt: skip
    assert process.returncode == 0, (process.returncode, process.stderr.decode()[-500:])
    return process.stdout.decode().rstrip("\n")


BASE = """eomc = 1
name = "growth"
[coordinates]
x = { start = 0.3 }
[parameters]
m = 1.25
[definitions]
a0 = "x"
[energy]
kinetic = "m*x_dot**2/2"
potential = "x**2/2 + a0"
"""


def chain(first: str, formula: str, count: int) -> str:
    """Write definitions a0 = first, a1 = each of a0, ...: `a` is the previous one."""
    lines = [f'a0 = "{first}"']
    lines += [f'a{k} = "{formula.replace("@", f"a{k - 1}")}"' for k in range(1, count + 1)]
    text = BASE.replace('a0 = "x"', "\n".join(lines))
    return text.replace("x**2/2 + a0", f"x**2/2 + a{count}")


NESTED = {
    "sin(a)*a": ("x + 0.1", "sin(@)*@"),
    "sin*cos": ("x", "sin(@)*cos(@)"),
    "a*a": ("x", "@*@"),
    "3x squared": ("3*x", "@**2"),
    "2a*a": ("x", "@*@ + @*@"),
    "a**2 + a": ("x", "@**2 + @"),
    "a/(1 + a)": ("2 + x**2", "@/(1 + @) + x"),
    "roots": ("2 + x**2", "@**0.3 + x"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", NESTED)
def test_nested_definitions_take_seconds(name: str) -> None:
    first, formula = NESTED[name]
    assert outcome(chain(first, formula, 30), build=True) == "ok"


@pytest.mark.slow
def test_powers_of_names_take_seconds() -> None:
    assert outcome(BASE.replace('"x"', '"10**9"').replace("+ a0", "+ x**a0"), build=True) == "ok"


NUMBERS = {
    "squares": ("3", "@**2", "definitions.a10", "is not between 1e-300 and 1e300"),
    "fractions": ("3", "@/2 + 1/@", "definitions.a12", "more than 10,000 digits"),
    "roots": ("sqrt(2)/3", "@*(@ + 0.1)", "definitions.a9", "more than 10,000 digits"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", NUMBERS)
def test_huge_exact_numbers_are_refused_with_the_definition(name: str) -> None:
    first, formula, key, words = NUMBERS[name]
    reported = outcome(chain(first, formula, 30))
    assert reported.startswith("growth.toml:") and reported.count("error") == 1
    assert f"error: {key}: " in reported and words in reported


@pytest.mark.slow
def test_symbolic_exponents_are_bounded() -> None:
    text = BASE.replace('a0 = "x"', 'c = "10**9"\nk = "1.0000000001"\na0 = "x*k**c"')
    assert "error: definitions.a0: 'x*k**c' makes exact numbers of more" in outcome(text)


def many(line: Callable[[int], str], count: int) -> str:
    return "\n".join(line(k) for k in range(count))


HOSTILE: dict[str, tuple[str, str]] = {
    "unknown names": (
        BASE.replace("[energy]", many(lambda k: f'd{k} = "x + theeta{k}"', 20_000) + "\n[energy]"),
        "definitions.d0: 'theeta0' is not declared",
    ),
    "unknown keys": (
        BASE + "[run]\n" + many(lambda k: f"durration{k} = 1", 20_000), "did you mean 'duration'?",
    ),
    "keys of one line": (
        BASE.replace("1.25", "{ value = 1, " + ", ".join(f"d{k} = 1" for k in range(20_000)) + "}"),
        "unknown key",
    ),
    "dots": (BASE.replace("m = 1.25", "a" + ".a" * 100_000 + " = 1"), "more than 8 parts"),
    "dots in a header": (BASE + "[a" + ".a" * 100_000 + "]", "more than 8 parts"),
    "dots in braces": (BASE.replace("1.25", "{a" + ".a" * 100_000 + " = 1}"), "than 8 parts"),
    "quoted dots": (BASE.replace("m = 1.25", "m" + ".'a'" * 100_000 + " = 1"), "than 8 parts"),
    "rings": (
        BASE.replace("[energy]", many(lambda k: f'd{k} = "d{k ^ 1}"', 20_000) + "\n[energy]"),
        "circular definition: d0 -> d1 -> d0",
    ),
    "a long ring": (
        BASE.replace("[energy]", many(lambda k: f'd{k} = "d{(k + 1) % 20_000}"', 20_000)
                     + "\n[energy]"),
        "d8 -> d9 -> ... -> d19992",
    ),
    "a long array": (
        BASE.replace("1.25", "[\n" + ("1," * 900 + "\n") * 480 + "]"), "must be a number",
    ),
    "a long key": (BASE.replace("m = ", "m" * 900_000 + " = "), "characters: 40 are the most"),
    "a digit a million times": (BASE.replace("1.25", "1" * 900_000), "hundreds of digits"),
    "digits in a formula": (BASE.replace('"x"', f'"x*{"1" * 9000}"'), "more than 1,000 digits"),
    "digits after a point": (BASE.replace('"x"', f'"x*0.{"1" * 9000}"'), "more than 1,000 digits"),
    "10**10**10": (BASE.replace('"x"', '"10**10**10"'), "an exponent lies between -64 and 64"),
    "1e400": (BASE.replace("1.25", "1e400"), "must be a finite number"),
    "parentheses": (BASE.replace('"x"', f'"{"(" * 4000}x{")" * 4000}"'), "nested too deeply"),
    "arrays": (BASE.replace("1.25", "[" * 100_000 + "]" * 100_000), "nested too deeply"),
    "a long formula": (BASE.replace('"x"', '"x' + "+x" * 4900 + '"'), "nested too deeply"),
    "a billion entries": (
        BASE.replace("x = {", '"y[i]" = { repeat = "i = 1..1000000000" }\nx = {'),
        "repetition makes 1000000000 entries up to here, and 10000 are the most",
    ),
    "bodies": (BASE + "[[body]]\n" * 100_000, "growth.toml:10008:1: error: this is table 10,001"),
    "headers": (
        BASE + many(lambda k: f"[h{k}]", 70_000), "a scene has 10,000 at most: write alike ones",
    ),
    "keys of 16 parts": (
        BASE.replace("m = 1.25", many(lambda k: f"k{k}{'.a' * 15} = 1", 22_000)),
        "growth.toml:6:1: error: a key has more than 8 parts",
    ),
    "keys of 8 parts": (
        BASE.replace("m = 1.25", many(lambda k: f"k{k}{'.a' * 7} = 1", 22_000)), "unknown table",
    ),
    "9,000 bodies": (BASE + "[[body]]\n" * 9_000, "body.1.name: missing"),
    "100 megabytes": (BASE + "#" * 100_000_000, "more than the 1000000 bytes"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_texts_are_refused_with_a_message(name: str) -> None:
    text, words = HOSTILE[name]
    reported = outcome(text)
    assert reported.startswith("growth.toml") and words in reported
    assert len(reported) < 30_000


def test_dots_in_a_string_are_not_a_key() -> None:
    from eomc.scene.read import parse

    note = "see " + "a.b.c." * 20 + "d"
    text = BASE.replace('name = "growth"', f'name = "growth"\nnote = "{note}"\ntitle = "..."')
    assert parse(text).note == note


@pytest.mark.slow
@pytest.mark.parametrize("command", ["build", "list"])
def test_command_bounds_the_size_of_scenes(command: str, tmp_path) -> None:
    """It looks up the name of a scene before it reads the file, within the same bounds."""
    (tmp_path / "large.toml").write_text(HOSTILE["100 megabytes"][0], encoding="utf-8")
    (tmp_path / "dots.toml").write_text(HOSTILE["dots"][0], encoding="utf-8")
    code = WORK.partition("from eomc")[0] + "from eomc.cli.main import main; main()"
    files = ["."] if command == "list" else ["large.toml", "dots.toml"]
    process = subprocess.run(
        [sys.executable, "-c", code, command, *files], cwd=tmp_path, capture_output=True, text=True
    )
    assert process.returncode == (0 if command == "list" else 2), process.stderr[-500:]
    assert "Traceback" not in process.stderr
    assert json.dumps(process.stdout)
