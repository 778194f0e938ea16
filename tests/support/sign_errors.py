"""Modules with one term negated, and whether that changes their results.

Either a term of the program: in one assignment of one function (D, the acceleration, an energy, a
signal, ...) one term of a sum, a product or an argument changes its sign. Or a coefficient of a
method: an entry of its tableau, or for rk4, which is handwritten, one sign of its text. A module is
changed if a function or a step at random states differs by more than DETECTABLE, relative to its
size, from the correct module; otherwise, or if no state was finite, it counts as unchanged, because
no check can detect it.
"""

from __future__ import annotations

import random
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np

from eomc.derive import lagrange
from eomc.emit import render
from eomc.emit.render import Sources
from eomc.integrators.tableaux import METHODS, Method
from eomc.model.system import System
from eomc.program import program
from eomc.program.ir import Assignment, Call, Function, Product, Sum
from eomc.program.program import Program

DETECTABLE = 1e-7
FUNCTIONS = (
    "D C g bias tau kinetic_energy potential_energy energy jacobi power acceleration".split()
)


def negated_sources(system: System, extension: str, seed: int) -> tuple[Sources, str]:
    """Return the sources with one term negated, and a description of the term."""
    choice = random.Random(f"negate {seed}")
    program_of_system = program.build(lagrange.derive(system))
    method = choice.choice(system.run.methods)
    if choice.random() < 0.35 and system.run.real == "double":
        if method == "rk4":
            return _text(render.render(program_of_system, extension), choice)
        wrong, what = _coefficient(METHODS[method], choice)
        with _replace_method(wrong):
            return render.render(program_of_system, extension), what
    wrong_program, what = _term(program_of_system, choice)
    return render.render(wrong_program, extension), what


# --- a term of the program ------------------------------------------------------------------------


def _term(program_of_system: Program, choice: random.Random) -> tuple[Program, str]:
    """Return the program with one term negated; half of the time in the acceleration."""
    places = [
        (name, part, k)
        for name, f in program_of_system.functions.items()
        for part in ("early", "body")
        for k, a in enumerate(getattr(f, part))
        if any(True for _ in _negations(a))
    ]
    first = [place for place in places if place[0] == "acceleration"]
    if not places:
        name = choice.choice(sorted(n for n, f in program_of_system.functions.items() if f.outputs))
        f = program_of_system.functions[name]
        k = choice.randrange(len(f.outputs))
        outputs = tuple(
            replace(o, coefficient=-o.coefficient) if i == k else o for i, o in enumerate(f.outputs)
        )
        return _replace_function(
            program_of_system, replace(f, outputs=outputs)
        ), f"output {k} of {name}"
    name, part, k = choice.choice(first if first and choice.random() < 0.5 else places)
    f = program_of_system.functions[name]
    lines = list(getattr(f, part))
    where, lines[k] = choice.choice(list(_negations(lines[k])))
    changed: Function = replace(f, **{part: tuple(lines)})
    return _replace_function(program_of_system, changed), f"{where} of {lines[k].name} in {name}"


def _replace_function(program_of_system: Program, changed: Function) -> Program:
    return replace(
        program_of_system, functions={**program_of_system.functions, changed.name: changed}
    )


def _negations(a: Assignment) -> Iterator[tuple[str, Assignment]]:
    """Yield each way to negate one term of a right-hand side."""
    v = a.value
    if isinstance(v, Sum):
        for i, (x, name) in enumerate(v.terms):
            terms = (*v.terms[:i], (-x, name), *v.terms[i + 1 :])
            yield f"term {i}", replace(a, value=replace(v, terms=terms))
        if v.constant != 0:
            yield "the constant", replace(a, value=replace(v, constant=-v.constant))
    elif isinstance(v, Product):
        yield "the sign", replace(a, value=replace(v, coefficient=-v.coefficient))
    elif isinstance(v, Call) and v.function not in ("sqrt", "log", "pow"):
        for i, o in enumerate(v.args):
            args = (*v.args[:i], replace(o, coefficient=-o.coefficient), *v.args[i + 1 :])
            yield f"argument {i}", replace(a, value=replace(v, args=args))


# --- a coefficient of a method --------------------------------------------------------------------


def _coefficient(m: Method, choice: random.Random) -> tuple[Method, str]:
    """Return the method with one entry of A or b negated, and unchanged stage times."""
    fields: dict[str, list[list[Fraction]]] = {
        "a": [list(row) for row in m.a], "b": [list(m.b)], "end": [list(m.end)],
    }  # fmt: skip
    places = [
        (name, i, k)
        for name, rows in fields.items()
        for i, row in enumerate(rows)
        for k, x in enumerate(row)
        if x
    ]
    name, i, k = choice.choice(places)
    fields[name][i][k] *= -1
    new = {
        "a": tuple(map(tuple, fields["a"])), "b": tuple(fields["b"][0]),
        "end": tuple(fields["end"][0]), "nodes": m.c,
    }  # fmt: skip
    return replace(m, **new), f"{name}[{i}][{k}] of {m.name}"  # type: ignore[arg-type]


@contextmanager
def _replace_method(wrong: Method) -> Iterator[None]:
    """Use the wrong method while a source is rendered."""
    right = METHODS[wrong.name]
    METHODS[wrong.name] = wrong  # type: ignore[index]
    try:
        yield
    finally:
        METHODS[wrong.name] = right  # type: ignore[index]


_SIGN = re.compile(r"(?<=[\w)\]]) ([+-])(?==? [\w(])")


def _text(sources: Sources, choice: random.Random) -> tuple[Sources, str]:
    """Negate one `+` or `-` in the lines of rk4's step that sum states and accelerations."""
    name = f"fast/{sources.name}.c"
    text = sources.files[name]
    parts = rf"^[^\n;]*{sources.name}_rk4_(?:position|stage|end)\(.*?\n}}\n"
    spans = [part.span() for part in re.finditer(parts, text, re.M | re.S)]
    signs = [s for span in spans for s in _SIGN.finditer(text, *span) if _adds(text, s)]
    sign = choice.choice(signs)
    other = "-" if sign[1] == "+" else "+"
    wrong = text[: sign.start(1)] + other + text[sign.end(1) :]
    line = text[text.rindex("\n", 0, sign.start()) : text.index("\n", sign.end())].strip()
    return replace(sources, files={**sources.files, name: wrong}), f"a sign of rk4: {line}"


def _adds(text: str, sign: re.Match[str]) -> bool:
    """Return whether the sign is in a sum of the method itself, not of compensated rounding."""
    line = text[text.rindex("\n", 0, sign.start()) : text.index("\n", sign.end())]
    return "h_rest" not in line and "/*" not in line and "for" not in line


# --- whether it matters ---------------------------------------------------------------------------


def changes(right: Any, wrong: Any, seed: int) -> bool:
    """Return whether a function or step of the modules differs by more than DETECTABLE."""
    draw = np.random.default_rng(seed)
    q0, qd0 = right.start
    for k in range(12):
        spread = 0.0 if k == 0 else 0.7
        q = q0 + spread * draw.uniform(-1, 1, q0.shape)
        qd = qd0 + (spread or 0.1) * draw.uniform(-1, 1, q0.shape)
        t = float(draw.uniform(0, 1))
        values = (*map(_value, FUNCTIONS), _slopes, _sensitivity, _products)
        for ask in (*values, *map(_step, right.methods)):
            one, other = (_try(ask, m, q, qd, t) for m in (right, wrong))
            if one is None or not np.all(np.isfinite(one)):
                continue
            if other is None or not np.all(np.isfinite(other)):
                return True
            if np.max(np.abs(one - other)) > DETECTABLE * (np.max(np.abs(one)) + 1e-300):
                return True
    return False


Ask = Callable[[Any, Any, Any, float], Any]


def _try(ask: Ask, module: Any, q: Any, qd: Any, t: float) -> Any:
    try:
        return np.asarray(ask(module, q, qd, t), float)
    except (ArithmeticError, ValueError):  # no such value, or none was requested
        return None


def _value(name: str) -> Ask:
    place = 1 if name in ("D", "g", "potential_energy") else 2
    return lambda m, q, qd, t: getattr(m, name)(*(q, qd)[:place], t=t)


def _slopes(m: Any, q: Any, qd: Any, t: float) -> Any:
    A, B = m.linearize(q, qd, t=t)
    return np.hstack([A, B]) if B.size else A


def _sensitivity(m: Any, q: Any, qd: Any, t: float) -> Any:
    return m.sensitivity(q, qd, t=t)


def _products(m: Any, q: Any, qd: Any, t: float) -> Any:
    if "acceleration_vjp" not in dir(m):
        raise ValueError
    weights = np.arange(1.0, 1 + m.nq)
    along = [np.arange(1.0, 1 + k) for k in (m.nq, m.nq, m.nu, len(m.parameters))]
    rates = m.acceleration_jvp(q, qd, along, t=t)
    return np.concatenate([*m.acceleration_vjp(q, qd, weights, t=t), rates])


def _step(method: str) -> Ask:
    def step(m: Any, q: Any, qd: Any, t: float) -> Any:
        run = m.simulate(q, qd, steps=1, t0=t, method=method)
        if run.status != "ok":
            raise ArithmeticError(run.status)
        return np.array([run.q[-1] - q, run.qd[-1] - qd])

    return step
