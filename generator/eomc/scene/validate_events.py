"""Checks of [[event]]: names, formulas and assignments of a jump."""

from __future__ import annotations

import re
from collections.abc import Iterator

from eomc.base import names, texts
from eomc.scene.formulas import Formula, suggest
from eomc.scene.scene import Event
from eomc.scene.schema import Document, EventTable
from eomc.scene.scope import Checker

COMPARISON = re.compile(r"\s*([^<>=!]+?)\s*(?:[<>]=?|==)\s*([^<>=!]+?)\s*")
INPUT_REMEDY = ": write '{name}*on' where it acts, with a parameter on = 1, and set that to 0"
CONSTANT_REMEDY = ", and does not change in a run: make it a parameter"


def check_events(check: Checker, doc: Document) -> Iterator[Event]:
    """Check the [[event]] tables of a document and yield the events.

    Errors are reported to `check`; faulty entries may be left out.
    """
    names_so_far: set[str] = set()
    for k, entry in doc.event.items():
        if why := names.fault(entry.name):
            check.report(("event", k, "name"), why, text=entry.name)
        elif entry.name in names_so_far:
            why = f"'{entry.name}' is an event already: rename one of the two"
            check.report(("event", k, "name"), why, text=entry.name)
        names_so_far.add(entry.name)
        path = ("event", k, "when")
        if path in check.repaired:  # reported already
            continue
        if isinstance(entry.when, str) and (match := COMPARISON.fullmatch(entry.when)):
            less = match[2] if re.fullmatch(r"[\w.]+", match[2]) else f"({match[2]})"
            check.report(
                path, f'it happens where a formula crosses zero: write "{match[1]} - {less}"'
            )
            continue
        when = check.formula(path, entry.when)
        jump = tuple(_jump(check, doc, k, entry))
        if when and not any(when.names()):
            check.report(
                ("event", k, "when"), "never crosses zero: it has no names", text=when.text
            )
        elif when:
            yield Event(entry.name, when, entry.direction, entry.action, jump, entry.note)


def _jump(
    check: Checker, doc: Document, k: str, entry: EventTable
) -> Iterator[tuple[str, Formula]]:
    """Yield (name, formula) for each coordinate, velocity or parameter that a jump sets."""
    state = [name for c in doc.coordinates for name in (c, f"{c}_dot")]
    state += doc.parameters
    assignments = entry.model_extra or {}
    for name, value in assignments.items():
        path = ("event", k, name)
        if name not in state:
            remedy = suggest(name, [*state, *EventTable.model_fields])
            if name in doc.inputs:
                remedy = INPUT_REMEDY.format(name=name)
            elif name in doc.constants:
                remedy = CONSTANT_REMEDY
            remedy = remedy or f": a jump sets {texts.listed(state, 9)}"
            check.report(path, f"'{name}' is no coordinate, velocity or parameter{remedy}")
        elif isinstance(value, bool) or not isinstance(value, (int, float, str)):
            check.report(path, "must be a number or a formula in quotes")
        elif formula := check.formula(path, float(value) if isinstance(value, int) else value):
            yield name, formula
    if entry.action == "jump" and not assignments:
        check.report(("event", k, "action"), f'a jump sets something: add {state[1]} = "..."')
    first = next((name for name in assignments if name in state), "")
    if first and entry.action != "jump":
        check.report(("event", k, first), f"only a jump sets '{first}': add action = \"jump\"")
