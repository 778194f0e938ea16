"""Names and units in the form that figures and formulas print; copied into built packages."""

from __future__ import annotations

import re

_SMALL = (
    "alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi pi rho sigma tau "
    "upsilon phi chi psi omega"
).split()
_LARGE = "Gamma Delta Theta Lambda Xi Pi Sigma Upsilon Phi Psi Omega".split()
GREEK = {word: rf"\{word}" for word in (*_SMALL, *_LARGE)} | {"omicron": "o"}
_DOTS = ("", r"\dot", r"\ddot")


def tex(name: str, dots: int = 0) -> str:
    r"""Return a name in LaTeX, such as \theta_{1} for theta1 or theta_1.

    m_c becomes m_{\mathrm{c}}, and x_prime becomes x'. Words of several letters are set upright.
    dots: 1 for the velocity of the name (one dot above it), 2 for its acceleration.

    >>> tex("theta_1", 1), tex("arm", 2)
    ('\\dot{\\theta}_{1}', '\\ddot{\\mathrm{arm}}')
    """
    head, *rest = (part for part in name.split("_") if part)
    if digits := re.fullmatch(r"([A-Za-z]+?)(\d+)", head):
        head, rest = digits[1], [digits[2], *rest]
    symbol = head if len(head) == 1 else _upright(head)
    if dots:
        symbol = f"{_DOTS[dots]}{{{symbol}}}"
    primes = "'" * rest.count("prime")
    below = ",".join(_upright(part) for part in rest if part != "prime")
    return symbol + primes + (f"_{{{below}}}" if below else "")


def of_words(name: str) -> bool:
    """Return True if a name consists of several words, such as elbow_joint.

    Otherwise it is a word, or a letter or word with subscripts, such as theta_1 or m_cart.
    """
    words = re.search(r"[a-z]{2,}\d*_.*[a-z]{2,}", name)
    return bool(words) and not {*name.split("_")} & {*GREEK, "prime"}


def _upright(word: str) -> str:
    if greek := GREEK.get(word):
        return greek
    if digits := re.fullmatch(r"([A-Za-z]+?)(\d+)", word):
        return _upright(digits[1]) + digits[2]
    return word if word.isdigit() else rf"\mathrm{{{word}}}"


def mathtext(name: str, rate: bool = False) -> str:
    r"""Return a name in mathtext, the LaTeX subset of matplotlib, for labels of figures.

    rate: return the time derivative of the name. That of a word is written d/dt, since matplotlib
    would set a dot on one of the letters. Several words are separated by spaces.

    >>> mathtext("theta_1", rate=True), mathtext("arm", rate=True)
    ('$\\dot{\\theta}_{1}$', '$\\mathrm{d}\\,\\mathrm{arm}/\\mathrm{d}t$')
    >>> mathtext("wrist_1_joint")
    '$\\mathrm{wrist\\ 1\\ joint}$'
    """
    words = name.replace("_", r"\ ")
    symbol = rf"\mathrm{{{words}}}" if of_words(name) else tex(name)
    if rate and symbol.startswith(r"\mathrm"):
        return rf"$\mathrm{{d}}\,{symbol}/\mathrm{{d}}t$"
    return f"${tex(name, 1) if rate else symbol}$"


def rate_unit(unit: str, rate: bool) -> str:
    """Return the unit of a quantity, or if `rate` the unit of its time derivative, such as "rad/s".

    Returns "" if the quantity has no unit.
    """
    if not unit or not rate:
        return unit
    return f"{unit}/s" if re.fullmatch(r"\w+", unit) else f"({unit})/s"


def with_unit(text: str, unit: str) -> str:
    """Return the text followed by its unit in parentheses, or the text alone if `unit` is ""."""
    return f"{text} ({plain(unit)})" if unit else text


def plain(text: str) -> str:
    """Return free text of a scene, such as its title, in a form that a figure prints as it is.

    The result is one line. Control characters and dollar signs are escaped, so that matplotlib
    reads no part of it as a formula.
    """
    shown = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return shown.replace("$", r"\$")
