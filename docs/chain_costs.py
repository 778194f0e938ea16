"""What planar chains cost: the time to derive them and the operations of one acceleration.

    python docs/chain_costs.py 1 2 5 10 20
    python docs/chain_costs.py --written-out 2 5

A chain of n links hangs from a pivot: link k has the length l_k, its end carries the mass m_k, and
q_k is its angle against the link before. flops are additions, multiplications and divisions,
sines and what hangs on parameters alone left out. With --written-out, D, C and g are derived
besides as one expression each, shared by sympy.cse, and their operations counted; that takes
seconds at five links and much longer beyond.
"""

from __future__ import annotations

import argparse
import time

import sympy

from eomc.derive import lagrange
from eomc.model.system import System, from_scene
from eomc.program import program
from eomc.scene import read as scene
from eomc.verify import symbolic


def chain(links: int) -> System:
    """A hanging chain of `links` point masses in relative angles, as a scene says it."""
    numbers = range(1, links + 1)
    lines = ["eomc = 1", f'name = "chain_{links}"', "[coordinates]"]
    lines += [f'q{k} = {{ unit = "rad", start = 0.1 }}' for k in numbers]
    lines += ["[parameters]", "g = 9.81", *(f"m{k} = 1.0\nl{k} = 1.0" for k in numbers)]
    lines += ["[definitions]"]
    for k in numbers:
        a, x, y = (f"{name}{k - 1} + " if k > 1 else "" for name in "axy")
        lines += [f'a{k} = "{a}q{k}"', f'x{k} = "{x}l{k}*sin(a{k})"']
        lines += [f'y{k} = "{y}-l{k}*cos(a{k})"']
    kinetic = " + ".join(f"m{k}*(dot(x{k})**2 + dot(y{k})**2)/2" for k in numbers)
    potential = " + ".join(f"m{k}*g*y{k}" for k in numbers)
    lines += ["[energy]", f'kinetic = "{kinetic}"', f'potential = "{potential}"']
    return from_scene(scene.parse("\n".join(lines)))


def written_out(system: System) -> int:
    """Operations of D, C and g as expressions, after sympy.cse."""
    plain = symbolic.derive(system)
    early = {p.symbol for p in system.parameters}
    shared, ends = sympy.cse([*plain.D, *plain.C, *plain.g])
    total = 0
    for name, expr in [*shared, *((None, end) for end in ends)]:
        if expr.free_symbols <= early:
            early |= {name}
            continue
        for part in sympy.preorder_traversal(expr):
            if part.is_Add or part.is_Mul:
                total += len(part.args) - 1 - (-1 in part.args)
            elif part.is_Pow and part.exp.is_Integer:
                total += abs(int(part.exp)) - int(bool(part.exp > 0))
    return total


def main() -> None:
    """A line for each chain."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("links", nargs="*", type=int, default=[1, 2, 5, 10, 20])
    parser.add_argument("--written-out", action="store_true", help="count expressions besides")
    options = parser.parse_args()
    head = "links  derive  to program  acceleration  sincos  route         D   bias"
    print(head + ("  D, C, g written out" if options.written_out else ""))
    for links in options.links:
        system = chain(links)
        begun = time.perf_counter()
        equations = lagrange.derive(system)
        derived = time.perf_counter()
        made = program.build(equations)
        ended = time.perf_counter()
        a = made["acceleration"]
        line = f"{links:5}  {derived - begun:4.1f} s  {ended - derived:8.1f} s  "
        line += f"{a.cost.flops:6} flops  {a.cost.sincos:6}  {a.route:9}"
        line += f"{made['D'].cost.flops:6} {made['bias'].cost.flops:6}"
        print(line + (f"  {written_out(system):6} flops" if options.written_out else ""))


if __name__ == "__main__":
    main()
