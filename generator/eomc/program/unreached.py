"""Parameters that energies and forces have, and no equation of motion."""

from __future__ import annotations

from sympy import Add, Expr, Symbol, expand

from eomc.base.errors import Problem
from eomc.model.symbols import dot, needed
from eomc.model.system import System
from eomc.program.program import Program
from eomc.scene.scene import Scene

ENERGIES = frozenset({"kinetic_energy", "potential_energy", "energy", "jacobi", "power"})
OUTPUTS = frozenset({"outputs", "output_slopes", "output_sensitivity"})
OF_MOTION = {  # the key of each expression
    "kinetic": "kinetic", "potential": "potential", "linear_potential": "potential",
    "dissipation": "dissipation",
}  # fmt: skip


def parameters(program: Program) -> list[Problem]:
    """A warning of each parameter without which the scene would move alike, such as M in M x_dot/2.

    What something else has too, such as an output, a start or a body, is of use.
    """
    s = program.system
    beside = ENERGIES | OUTPUTS if s.scene else ENERGIES  # a scene says which outputs name it
    read = {x for f in program.functions.values() if f.name not in beside for x in f.uses}
    found = []
    for p in s.parameters:
        key = "" if p.name in read else _place(s, p.symbol)
        if key:
            message = f"'{p.name}' reaches no equation of motion: {_why(s, p.symbol)}"
            found.append(s.problem(key, message, "warning"))
    return found


def _place(system: System, parameter: Symbol) -> str:
    """The key where it stands first; "" where something beside energies and forces has it."""
    if system.scene:
        roots = _tables(system.scene, parameter.name)
        first = system.scene.used.get(parameter.name, [()])[0]
        return ".".join(first) if roots and roots <= {"energy", "forces"} else ""
    drawn = system.pictured and parameter.name in system.pictured.used
    places = (
        f"energy.{key}"
        for name, key in OF_MOTION.items()
        if _has(system, getattr(system, name), parameter)
    )
    return "" if drawn else next(places, "")


def _tables(scene: Scene, name: str) -> set[str]:
    """The tables in which a name stands, itself or by a definition that has it."""
    found, queue = set[tuple[str, ...]](), [name]
    while queue:
        new = {*scene.used.get(queue.pop(), ())} - found
        found |= new
        queue += [path[1] for path in new if path[0] == "definitions"]
    return {path[0] for path in found} - {"definitions"}


def _has(system: System, expression: Expr, name: Symbol) -> bool:
    whole = (expression, *(e for _, e in needed(system.definitions, [expression])))
    return any(name in e.free_symbols for e in whole)


def _why(system: System, parameter: Symbol) -> str:
    """Why no equation has it, and the remedy."""
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
