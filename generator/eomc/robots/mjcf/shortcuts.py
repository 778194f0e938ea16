"""The shortcuts of MJCF's <general> actuator: <motor>, <position>, ... in its own attributes."""

from __future__ import annotations

import math
from collections.abc import Mapping

from eomc.robots import xml

MEASURES = ("kp", "kv", "dampratio", "timeconst", "area", "diameter")  # numbers that they have


def shortcut(kind: str, inherited: Mapping[str, str], own: Mapping[str, str]) -> dict[str, str]:
    """What a shortcut sets, over what its class gives; numbers that it has not come from there.

    A class that has another shortcut gives none, nor does one whose gain is no number. Of a kind
    whose force is no affine law of its input the types of gain and bias are the kind.
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
    """A number; 0 for a fault, which whoever reads the attribute reports."""
    try:
        return xml.number(text)
    except ValueError:
        return 0.0


def _minus(text: str) -> str:
    return repr(-_value(text))
