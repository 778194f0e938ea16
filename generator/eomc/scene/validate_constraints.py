"""Checks of [constraints]: names, and formulas that are zero along every motion."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from eomc.base import names, texts
from eomc.scene.assembly import Assembly
from eomc.scene.formulas import FormulaError
from eomc.scene.scene import Constraint
from eomc.scene.schema import BodyTable, Document
from eomc.scene.scope import INPUT, Checker, Path

_MULTIPLIER = r"lambda(_\w+)?|(\w+_)?(multiplier|reaction)s?"


def check_constraints(check: Checker, doc: Document) -> Iterator[Constraint]:
    """Check the table [constraints] of a document and yield its constraint equations.

    Errors are reported to `check`; faulty entries may be left out.
    """
    for name, entry in doc.constraints.items():
        if why := row_name_fault(check, doc, name):
            end = "" if names.fault(name) else ": give the constraint a name of its own"
            check.report(("constraints", name), why + end)
        path = ("constraints", name, "formula")
        if isinstance(entry.formula, str) and (why := _equation_remedy(entry.formula)):
            check.report(path, why, text=entry.formula)
            continue
        formula = check.formula(path, entry.formula)
        if formula is None or path in check.repaired:  # reported already
            continue
        if INPUT in check.kinds_of(formula.tree):
            check.report(
                path,
                "a constraint can't depend on inputs, whose rates nobody knows: let them act "
                "through [forces], or write the motion wanted as a function of t",
                check.where(formula, INPUT),
                formula.text,
            )
        check.check_smooth(path, formula)
        yield Constraint(name, entry.unit, formula, entry.note)


def _equation_remedy(text: str) -> str:
    """Return what to write in place of an equation; "" if the text is not an equation."""
    sides = [side.strip() for side in text.replace("==", "=").split("=")]
    if len(sides) != 2 or not all(sides):
        return ""
    left, right = sides
    if right == "0":
        return f"a constraint is what is zero, without '= 0': write {left}"
    right = right if re.fullmatch(r"[\w.*/()]+", right) else f"({right})"
    return f"a constraint is what is zero: write {left} - {right}"


def row_name_fault(check: Checker, doc: Document, name: str) -> str:
    """Return the reason why a constraint equation can't be called `name`, or "" if it can.

    A name is refused if it is not valid or if the scene uses it already.
    """
    taken = {n: f"stands in [{table}]" for n, table in check.tables.items()}
    taken |= dict.fromkeys(doc.outputs, "stands in [outputs]")
    taken |= {f"{c}_dot": f"is the velocity of '{c}'" for c in doc.coordinates}
    taken |= {f"{c}_ddot": f"is the acceleration of '{c}'" for c in doc.coordinates}
    taken |= dict.fromkeys(check.centers - {*check.tables}, "is where a body or point is")
    taken |= {"energy": "is K + P"}
    if why := names.fault(name):
        return why
    return f"'{name}' {taken[name]} already" if name in taken else ""


def force_names(doc: Document, assembly: Assembly | None) -> list[str]:
    """Return the names by which outputs refer to constraint forces.

    They are the Lagrange multipliers, such as lambda_rod, also those of friction that sticks, and
    the components of the reactions of loops, such as hinge_force_x.
    """
    plane, loops = (assembly.plane, assembly.loops) if assembly else (True, ())
    rows = [*doc.constraints, *(row for loop in loops for row in loop.rows(plane).values())]
    if doc.run.friction == "stick":
        with_friction = {
            n for b in doc.body.values() if b.friction is not None for n in _coordinates_of(b)
        }
        with_friction |= {name for name, c in doc.coordinates.items() if c.friction is not None}
        rows += [f"{name}_sticks" for name in doc.coordinates if name in with_friction]
    reactions = [name for loop in loops for name in loop.reactions(plane)]
    return [*(f"lambda_{row}" for row in rows), *reactions]


def _coordinates_of(body: BodyTable) -> tuple[str, ...]:
    return body.coordinates or ()


def reports_unknown_multiplier(
    check: Checker, doc: Document, path: Path, text: float | str, known: Sequence[str]
) -> bool:
    """Check that the formula of an output calls multipliers and reactions by known names.

    path: keys of the output in the scene. text: its formula. known: the names of all multipliers
    and reactions. Returns True, after reporting an error, if the formula uses another name for one.
    """
    rows = {name.removeprefix("lambda_") for name in known}
    rows |= {entry.name for entry in doc.loop.values()}
    if not rows or not isinstance(text, str):
        return False
    for word in re.finditer(r"(?<![\w.])[A-Za-z_]\w*", text):
        named = word[0] in rows or re.fullmatch(_MULTIPLIER, word[0])
        if named and word[0] not in check.kinds:
            matching = [name for name in known if word[0] in rows and word[0] in name]
            message = (
                f"'{word[0]}' can't be used here: multipliers and reactions are called "
                f"{texts.listed(matching or known, 6)}"
            )
            check.report(path, message, FormulaError(message, word.start(), len(word[0])), text)
            return True
    return False


def check_guesses(check: Checker, doc: Document) -> None:
    """Report a warning for each key `guess` in a scene without constraint equations.

    There it has no effect: it marks initial values that may be changed to satisfy constraints.
    """
    if not (doc.constraints or doc.loop):
        for name, entry in doc.coordinates.items():
            if entry.guess:
                check.report(
                    ("coordinates", name, "guess"),
                    "changes nothing: a guess is what [constraints] or a [[loop]] may move, and "
                    "there are none",
                    severity="warning",
                )
