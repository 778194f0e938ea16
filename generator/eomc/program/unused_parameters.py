"""Parameters that occur in energies or forces but in no equation of motion."""

from __future__ import annotations

from sympy import Add, Expr, Symbol, expand

from eomc.base.errors import Problem
from eomc.model.symbols import dot, needed
from eomc.model.system import System
from eomc.program.program import Program
from eomc.scene.scene import Scene

ENERGIES = frozenset({"kinetic_energy", "potential_energy", "energy", "jacobi", "power"})
OUTPUTS = frozenset({"outputs", "output_slopes", "output_sensitivity"})
SCENE_KEYS = {  # scene key of each expression
    "kinetic": "kinetic", "potential": "potential", "linear_potential": "potential",
    "dissipation": "dissipation",
}  # fmt: skip


def parameters(program: Program) -> list[Problem]:
    """Return a warning for each parameter that has no effect on the motion, such as M in M x_dot/2.

    Parameters that are used elsewhere, as in an output, an initial value or a body, are not
    reported.
    """
    s = program.system
    excluded = ENERGIES | OUTPUTS if s.scene else ENERGIES  # a scene says which outputs name it
    used = {x for f in program.functions.values() if f.name not in excluded for x in f.uses}
    problems = []
    for p in s.parameters:
        key = "" if p.name in used else _key_of(s, p.symbol)
        if key:
            message = f"'{p.name}' reaches no equation of motion: {_reason(s, p.symbol)}"
            problems.append(s.problem(key, message, "warning"))
    return problems


def _key_of(system: System, parameter: Symbol) -> str:
    """Return the key where a parameter first occurs; "" if it occurs outside of energies and
    forces.
    """
    if system.scene:
        roots = _tables(system.scene, parameter.name)
        first = system.scene.used.get(parameter.name, [()])[0]
        return ".".join(first) if roots and roots <= {"energy", "forces"} else ""
    drawn = system.picture_scene and parameter.name in system.picture_scene.used
    places = (
        f"energy.{key}"
        for name, key in SCENE_KEYS.items()
        if _has(system, getattr(system, name), parameter)
    )
    return "" if drawn else next(places, "")


def _tables(scene: Scene, name: str) -> set[str]:
    """Return the tables in which a name occurs, directly or through definitions."""
    paths, queue = set[tuple[str, ...]](), [name]
    while queue:
        new = {*scene.used.get(queue.pop(), ())} - paths
        paths |= new
        queue += [path[1] for path in new if path[0] == "definitions"]
    return {path[0] for path in paths} - {"definitions"}


def _has(system: System, expression: Expr, name: Symbol) -> bool:
    """Return True if an expression contains a symbol, directly or through definitions."""
    expressions = (expression, *(e for _, e in needed(system.definitions, [expression])))
    return any(name in e.free_symbols for e in expressions)


def _reason(system: System, parameter: Symbol) -> str:
    """Return the reason why no equation contains the parameter, and the remedy."""
    for term in Add.make_args(expand(system.kinetic)):
        if _has(system, term, parameter):
            rates = {*system.qd} & term.free_symbols | term.atoms(dot)
            if rates:
                rate = min(map(str, rates))
                return f"the kinetic energy has it with {rate}, but not its square; write {rate}**2"
    return (
        "what it adds to energies or forces cancels, or depends on no coordinate or velocity; "
        "remove it, or use it"
    )
