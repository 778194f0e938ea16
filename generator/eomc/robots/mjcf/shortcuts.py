"""MJCF's actuator shortcuts <motor>, <position>, ... as attributes of <general>."""

from __future__ import annotations

import math
from collections.abc import Mapping

from eomc.robots import xml

MEASURES = (
    "kp",
    "kv",
    "dampratio",
    "timeconst",
    "area",
    "diameter",
)  # numeric attributes of shortcuts


def shortcut(kind: str, inherited: Mapping[str, str], own: Mapping[str, str]) -> dict[str, str]:
    """Return the attributes of <general> that an actuator shortcut such as <position> sets.

    Parameters
    ----------
    kind : str
        Name of the shortcut.
    inherited, own
        Attributes of its default class, and of the element. Missing numbers are inherited, except
        from a class with another shortcut or without a constant gain.

    Returns
    -------
    dict
        The attributes. A shortcut whose force is not affine in its input has `kind` as gaintype and
        biastype.
    """
    same = inherited.get(" law") == kind
    if not same and (" law" in inherited or inherited.get("gaintype", "fixed") != "fixed"):
        inherited = {}
    gain = (*inherited.get("gainprm", "1").split(), "0", "0", "0")
    bias = (*inherited.get("biasprm", "").split(), "0", "0", "0")
    affine = {"gaintype": "fixed", "biastype": "affine"}
    if kind == "motor":
        return {"gaintype": "fixed", "biastype": "none", "dyntype": "none", "gainprm": "1"}
    if kind in ("position", "intvelocity"):
        kp = own.get("kp", gain[0])
        kv = _minus(own["kv"]) if "kv" in own else own.get("dampratio", bias[2])
        attributes = affine | {"gainprm": kp, "biasprm": f"0 {_minus(kp)} {kv}"}
        attributes["dyntype"] = inherited.get("dyntype", "none") if same else "none"
        if "timeconst" in own:
            attributes["dyntype"] = "filterexact" if _value(own["timeconst"]) else "none"
        integrates = {"dyntype": "integrator", "actlimited": "true"}
        return attributes | (integrates if kind == "intvelocity" else {})
    if kind == "velocity":
        kv = own.get("kv", gain[0])
        return affine | {"dyntype": "none", "gainprm": kv, "biasprm": f"0 0 {_minus(kv)}"}
    if kind == "damper":
        types = {"gaintype": "affine", "biastype": "none", "dyntype": "none", "ctrllimited": "true"}
        rate = _minus(own["kv"]) if "kv" in own else gain[2]
        return types | {"gainprm": f"0 0 {rate}"}
    if kind == "cylinder":
        area = own.get("area", gain[0])
        if "diameter" in own:
            area = repr(math.pi / 4 * _value(own["diameter"]) ** 2)
        own_bias = own.get("bias", "").split()
        bias_text = " ".join([*own_bias, *bias[len(own_bias) :]][:3])
        return affine | {"dyntype": "filter", "gainprm": area, "biasprm": bias_text}
    return {"gaintype": kind, "biastype": kind}


def _value(text: str) -> float:
    """Return a number; 0 for a fault, which is reported where the attribute is read."""
    try:
        return xml.number(text)
    except ValueError:
        return 0.0


def _minus(text: str) -> str:
    return repr(-_value(text))
