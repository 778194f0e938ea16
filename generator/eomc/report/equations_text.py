"""Text and LaTeX of the equations of a system, and the costs of its generated functions.

Equations that would fill many pages are not written out. Instead, the text shows what they follow
from: the Newton-Euler recursion over the joints or the energies over their definitions, together
with the other forces and constraints.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence

import sympy
from sympy import Expr

from eomc.base.errors import EomcError
from eomc.derive import lagrange
from eomc.emit.common.templates import environment
from eomc.model.hybrid import with_constant_parameters
from eomc.model.symbols import needed_definitions
from eomc.model.system import System, t
from eomc.model.tree import Link, Tree, Vector
from eomc.program import program
from eomc.program.routes import ROUTES
from eomc.report.equations import (
    constraint_note,
    derive,
    equation_form,
    right_hand_side,
    title_line,
    write_python,
)
from eomc.report.typeset import (
    CONTINUATION,
    WIDE,
    Equation,
    Typesetter,
    align,
    section,
    shorten_fractions,
    wrap,
    write_latex,
    write_text,
)
from eomc.runtime.plot import tex

MAX_DEFINITIONS = 60  # definitions that are shown
LINES_PER_ENVIRONMENT = 40  # joints that fill a page


def write_equations(system: System, form: str = "text") -> str:
    """Derive the equations of motion of a system and return them as text.

    The Lagrangian L, the scalar equations, D, C, g and all other parts are simplified and printed
    as in a textbook. If they would fill many pages, the text instead describes how they are
    computed and how many operations this takes.

    Parameters
    ----------
    system : System
        The mechanical system.
    form : {"text", "latex", "python"}
        "text" is Unicode text for a terminal; "python" is source code with SymPy matrices.

    Returns
    -------
    str

    Raises
    ------
    EomcError
        If the form is "python" and the equations would fill many pages.
    """
    try:
        derived = derive(system)
    except EomcError:
        if form == "python":
            raise
        system = with_constant_parameters(system)
        return describe_in_latex(system) if form == "latex" else describe(system)
    if form == "python":
        return write_python(derived)
    return write_latex(derived.set_out.groups) if form == "latex" else str(derived)


# --- large systems as text ------------------------------------------------------------------------


def describe(system: System) -> str:
    """Return text that describes how the equations of a large system are formed and computed.

    The text contains the recursion over the joints or the energies, the constraints, and the
    numbers of operations of the generated functions.
    """
    write = Typesetter(system)
    parts = [
        wrap(f"{title_line(system)}: {equation_form(_has_forces(system), system)}"),
        "Written out, these equations would fill many pages. They are those of L = K - P,\n"
        f"d/dt ∂L/∂q̇ - ∂L/∂q = {right_hand_side(_has_forces(system), system)}.",
    ]
    if system.tree is not None:
        parts.append(_recursion(system.tree, write))
    listed = _list_equations(system, write)
    if listed is not None:
        parts += write_text(listed)
    elif system.constraints:
        parts.append(section("constraints", [*map(constraint_note, system.constraints)]))
    return "\n\n".join([*parts, "What computes them:", tabulate_costs(system)])


def _recursion(tree: Tree, write: Typesetter) -> str:
    """Return the Newton-Euler recursion (Featherstone, 2008, table 5.1) and the list of joints."""
    lines = [
        "outward from parent p; S is the joint's axis, v a twist, a its rate, f a wrench:",
        "    v = X v_p + S q̇",
        "    a = X a_p + S q̈ + v × S q̇",
        "inward:",
        "    f = I a + v ×* I v + the sum of Xᵀ f over its children",
        "    τ = S · f",
        "",
    ]
    for link in tree.links:
        parent = "the world" if link.parent < 0 else tree.links[link.parent].name
        ways = (link.angular, "turns about"), (link.linear, "slides along")
        how = f"{' and '.join(way for x, way in ways if x != 0)} {'xyz'[link.axis]}"
        by = str(write.text(write.sort_expression(link.q))).strip()
        lines.append(f"{link.name} on {parent}: {how} by {by if len(by) <= 40 else '...'}")
    return section(f"Newton and Euler's recursion over {len(tree.links)} elementary joints", lines)


def _list_equations(system: System, write: Typesetter) -> list[Equation] | None:
    """Return energies, forces and constraints over their definitions; None if these are too many.

    The generalized forces are Q - ∂R/∂q̇ + the sum of ∂y_k/∂q F_k.
    """
    energies = _energies(system)
    forces = [("R", system.dissipation)] if system.dissipation != 0 else []
    forces += [(f"Q_{i}", force) for i, force in enumerate(system.forces, 1) if force != 0]
    for k, pair in enumerate(system.applied, 1):
        forces += zip((f"y_{k}", f"F_{k}"), pair, strict=True)
    shown = [*(c.formula for c in system.constraints), *(e for _, e in (*forces, *energies))]
    known = needed_definitions(system.definitions, shown)
    if len(known) > MAX_DEFINITIONS:
        return None
    titles = (
        ("definitions; a dot is d/dt", known),
        ("energies, over definitions", [(sympy.Symbol(name), e) for name, e in energies]),
        ("generalized forces, τ = Q - ∂R/∂q̇ + the sum of ∂y/∂q F",
         [(sympy.Symbol(name), e) for name, e in forces]),
    )  # fmt: skip
    listed = [Equation(title, s, e, write) for title, pairs in titles for s, e in pairs]
    for c in system.constraints:
        listed.append(Equation("constraints", c.formula, sympy.S.Zero, write, constraint_note(c)))
    return listed


def _energies(system: System) -> list[tuple[str, Expr]]:
    """Return the energies (name, formula) that the recursion over the tree does not include."""
    linear = [("U", system.linear_potential)] if system.linear_potential != 0 else []
    if system.tree is None:
        return [("K", system.kinetic), ("P", system.potential), *linear]
    tree = system.tree
    remaining = (("K_prime", tree.other_kinetic), ("P_prime", tree.other_potential), *linear)
    return [(name, e) for name, e in remaining if e != 0]


# --- large systems in LaTeX -----------------------------------------------------------------------


def describe_in_latex(system: System) -> str:
    """Return LaTeX that describes how the equations of a large system are formed and computed.

    It consists of align* environments of the package amsmath.
    """
    write, tree = Typesetter(system), system.tree
    forces = [r"\tau"] * _has_forces(system) + [r"A^{\mathsf{T}} \lambda"] * bool(
        system.constraints
    )
    text = (
        environment()
        .get_template("report/recursion.tex.jinja")
        .render(
            force=" + ".join(forces) or "0",
            order=r", \; ".join(tex(c.name) for c in system.coordinates),
            is_quadratic=_is_quadratic(system),
            gravity=tree and _vector(tree.gravity, write),
            has_armature=tree and any(link.armature != 0 for link in tree.links),
            has_other_kinetic=tree and tree.other_kinetic != 0,
            has_other_potential=tree and tree.other_potential != 0,
        )
    )
    parts = [text.splitlines()]
    if tree is not None:
        links = [line for k in range(len(tree.links)) for line in _latex_link(k, tree, write)]
        parts += [
            links[k : k + LINES_PER_ENVIRONMENT]
            for k in range(0, len(links), LINES_PER_ENVIRONMENT)
        ]
    if (listed := _list_equations(system, write)) is not None:
        parts.append(_latex_forces(system))
        parts[-1] += (line for each in listed for line in each.latex_lines())
    return align(parts)


def _has_forces(system: System) -> bool:
    """True if anything acts besides potentials and constraint forces."""
    return bool(system.applied) or any(e != 0 for e in (system.dissipation, *system.forces))


def _is_quadratic(system: System) -> bool:
    """True if K is known to be homogeneous quadratic in the velocities."""
    tree = system.tree
    timed = any(e.has(t) for _, e in system.definitions)
    return tree is not None and not timed and tree.other_kinetic == 0


def _latex_link(k: int, tree: Tree, write: Typesetter) -> list[str]:
    """Return the frame of joint k, its motion, and the mass and inertia that move with it."""
    link = tree.links[k]
    parent = "the world" if link.parent < 0 else tree.links[link.parent].name
    n, axis = k + 1, "xyz"[link.axis]
    r, R = _vector(link.offset, write), _rotation(link, write)
    turn = rf"R_{{{axis}}}(s_{{{n}}})"
    e, linear = f"e_{{{axis}}}", "" if link.linear == 1 else f"{_formula(link.linear, write)} "
    if link.linear.is_Add:
        linear = rf"\left({linear}\right) "
    if link.linear != 0:
        r += f" + {R or ''} {linear}{e} s_{{{n}}}"
    if link.angular != 0:
        R = f"{R} {turn}" if R else turn
    S = f"({e if link.angular else 0}, {linear + e if link.linear else 0})"
    lines = [
        rf"  & \text{{{_escape(f'{link.name} on {parent}')}}}, "
        rf"\; k = {n}, \; p = {link.parent + 1}: \quad "
        rf"s_{{{n}}} = {_formula(link.q, write)}, \; S_{{{n}}} = {S}, \; "
        rf"R_{{{n}}} = {R or '1'}, \; r_{{{n}}} = {r}"
    ]
    if any(e != 0 for e in (link.mass, *link.moment, *link.inertia)):
        xx, yy, zz, xy, xz, yz = (_formula(e, write) for e in link.inertia)
        J = _matrix([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if (xy, xz, yz) == ("0", "0", "0"):
            J = rf"\operatorname{{diag}}\left({xx}, {yy}, {zz}\right)"
        lines.append(
            rf"{CONTINUATION}m_{{{n}}} = {_formula(link.mass, write)}, \; c_{{{n}}} = "
            rf"{_vector(link.moment, write)}, \; J_{{{n}}} = {J}"
        )
    if link.armature != 0:
        lines.append(rf"{CONTINUATION}\alpha_{{{n}}} = {_formula(link.armature, write)}")
    return lines


def _latex_forces(system: System) -> list[str]:
    """Return the line that says of what the generalized forces consist, in a list."""
    if not _has_forces(system):
        return []
    friction = r" - \frac{\partial R}{\partial \dot{q}}" * (system.dissipation != 0)
    count = range(1, len(system.applied) + 1)
    applied = "".join(rf" + \frac{{\partial y_{{{k}}}}}{{\partial q}} F_{{{k}}}" for k in count)
    return [rf"  \tau &= Q{friction}{applied}"]


def _formula(e: Expr, write: Typesetter) -> str:
    return write.latex(write.sort_expression(shorten_fractions(sympy.sympify(e))))


def _vector(v: Vector, write: Typesetter) -> str:
    return rf"\left({', '.join(_formula(e, write) for e in v)}\right)"


def _rotation(link: Link, write: Typesetter) -> str:
    """Return the rotation of the joint's frame before the joint moves; "" for the identity."""
    if sympy.Matrix(link.rotation) == sympy.eye(3):
        return ""
    return _matrix([[_formula(e, write) for e in row] for row in link.rotation])


def _matrix(rows: Sequence[Sequence[str]]) -> str:
    body = r" \\ ".join(" & ".join(row) for row in rows)
    return rf"\begin{{pmatrix}} {body} \end{{pmatrix}}"


def _escape(words: str) -> str:
    return re.sub(r"([#$%&_{}])", r"\\\1", words)


# --- costs ----------------------------------------------------------------------------------------


def write_costs(system: System) -> str:
    """Return a table, as text, of the floating-point operations of each generated function.

    A function that can be computed by several routes (algorithms) has one count for each of them.
    """
    head = f"{title_line(system)}: operations of one call, those on parameters alone left out"
    return f"{head}\n\n{tabulate_costs(system)}"


def tabulate_costs(system: System) -> str:
    """Return the table of operation counts that `write_costs` returns, without its heading."""
    lowered = program.build(lagrange.derive(system))
    lines = []
    wide = max(map(len, lowered.functions))
    routes: dict[str, None] = {}
    for name, function in lowered.functions.items():
        others = [f"{r} {c.flops}" for r, c in function.routes if r != function.route]
        others += [f"{r} {why}" for r, why in lowered.passed_over.items() if name == "acceleration"]
        lines.append(f"{name:{wide}}  {function.cost.flops:5d} flops: {function.cost}")
        if others:
            choice = f"({function.route}; {', '.join(others)})"
            lines += textwrap.wrap(choice, WIDE - wide, initial_indent=" " * (wide + 2),
                                   subsequent_indent=" " * (wide + 3))  # fmt: skip
        routes |= dict.fromkeys(r for r, _ in function.routes)
    if len(routes) > 1:
        lines += ["", "Of each function the route of least weight is taken that loses no digits:"]
        lines.append("a division weighs as 8 additions, a sine or other call as 25.")
        lines += [f"    {r:{max(map(len, routes))}}  {ROUTES[r].sentence}" for r in routes]
    return "\n".join(lines)
