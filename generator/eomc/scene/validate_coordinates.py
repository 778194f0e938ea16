"""Checks of [coordinates]: initial values and friction."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from eomc.scene import formulas, messages
from eomc.scene.formulas import Formula
from eomc.scene.scene import Coordinate
from eomc.scene.schema import Document
from eomc.scene.scope import Checker

SUSPICIOUS_ANGLE = 7.0  # rad, more than one turn
FRICTION_WIDTH = formulas.parse("0.01")  # rad/s or m/s


def check_coordinates(
    check: Checker, doc: Document, known: Mapping[str, float]
) -> Iterator[Coordinate]:
    """Check the table [coordinates] of a document and yield its coordinates.

    known: values of constants and parameters by name. Errors are reported to `check`; faulty
    entries may be left out.
    """

    def formula(name: str, key: str, value: float | str) -> tuple[Formula | None, float]:
        path = ("coordinates", name, key)
        rule = f"a {key} is made of numbers, constants and parameters"
        checked = check.formula(path, value, known, rule)
        return checked, check.number(path, checked, known)

    free = not (doc.constraints or doc.loop)
    for name, entry in doc.coordinates.items():
        start, rate = (formula(name, key, getattr(entry, key))[0] for key in ("start", "rate"))
        if entry.unit == "rad" and isinstance(entry.start, (int, float)):
            check_turns(check, ("coordinates", name, "start"), entry.start)
        fixed_keys = () if entry.guess else entry.model_fields_set
        is_fixed, is_rate_fixed = (free or key in fixed_keys for key in ("start", "rate"))
        friction, width = None, FRICTION_WIDTH
        if entry.friction is not None:
            friction, value = formula(name, "friction", entry.friction)
            if friction and value < 0:
                path = ("coordinates", name, "friction")
                check.report(path, f"is {value:g}, and can't be negative", text=friction.text)
        if entry.friction_width is not None:
            checked, value = formula(name, "friction_width", entry.friction_width)
            width = checked or FRICTION_WIDTH
            check_width(check, ("coordinates", name), value, checked, entry.friction)
        if start and rate:
            yield Coordinate(
                name, entry.unit, start, rate, entry.note, is_fixed, is_rate_fixed, friction, width
            )


def check_turns(check: Checker, path: tuple[str, ...], angle: float) -> None:
    """Report a warning if an angle in rad is larger than one turn, since degrees may be meant.

    path: keys of the entry in the scene.
    """
    if SUSPICIOUS_ANGLE <= abs(angle) < math.inf:
        message = (
            f"{angle:.6g} rad are {abs(angle) / math.tau:.3g} turns; for degrees write "
            f"{messages.degrees_formula(f'{angle:.15g}')}"
        )
        check.report(path, message, severity="warning")


def check_width(
    check: Checker, path: tuple[str, ...], value: float, width: Formula | None, friction: object
) -> None:
    """Report an error if the entry `friction_width` is not positive or has no `friction` with it.

    The width is the velocity within which Coulomb friction is smoothed. path: keys of the
    coordinate or body. value: value of the width in rad/s or m/s. width: formula of the width.
    friction: the entry `friction`, None if it is missing.
    """
    path = (*path, "friction_width")
    if value <= 0:
        check.report(
            path,
            f"is {value:g}, and must be greater than zero: the rate within which friction is "
            "smoothed",
            text=width.text if width else None,
        )
    if friction is None:
        check.report(path, "there is no 'friction' with it: add it")
