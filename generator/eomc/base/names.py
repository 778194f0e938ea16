"""Valid names in C, C++ and Python, and replacements for invalid ones."""

from __future__ import annotations

import keyword
import re
import sys
from hashlib import sha256

MAX_LENGTH = 40

_C = """auto break case char const continue default do double else enum extern float for goto if
inline int long register restrict return short signed sizeof static struct switch typedef union
unsigned void volatile while asm typeof""".split()

_CPP = """alignas alignof and and_eq bitand bitor bool catch char16_t char32_t class co_await
co_return co_yield compl concept const_cast consteval constexpr constinit decltype delete
dynamic_cast explicit export false friend mutable namespace new noexcept not not_eq nullptr
operator or or_eq private protected public reinterpret_cast requires static_assert static_cast
template this thread_local throw true try typeid typename using virtual wchar_t xor
xor_eq""".split()

# functions and macros of math.h, and macros that compilers define without an underscore
MATHEMATICS = """acos asin atan atan2 ceil cos cosh exp fabs floor fmod frexp ldexp log log10 modf
pow sin sinh sqrt tan tanh acosh asinh atanh cbrt copysign erf erfc exp2 expm1 fdim fma fmax fmin
hypot ilogb lgamma llrint llround log1p log2 logb lrint lround nan nearbyint nextafter nexttoward
remainder remquo rint round scalbln scalbn tgamma trunc sincos fpclassify isfinite isinf isnan
isnormal signbit isgreater isgreaterequal isless islessequal islessgreater isunordered
float_t double_t linux unix i386""".split()

# scenes that would be files of a build next to theirs, and those whose functions would be macros
_FILES = frozenset("main selftest binding".split())
_MACROS = re.compile(r"U?INT(8|16|32|64|MAX)|Py_\w+|(?i:SIG|PY_?MACCONFIG|HAVE_\w+)")

_FORMULA = "abs sign heaviside dot min max pi t".split()

_WHY = {
    **dict.fromkeys(_CPP, "a C++ keyword, and the generated header serves C++ too"),
    **dict.fromkeys(keyword.kwlist, "a Python keyword"),
    **dict.fromkeys(MATHEMATICS, "taken by the C mathematics library"),
    **dict.fromkeys(_C, "a C keyword"),
    **dict.fromkeys(_FORMULA, "taken by the formula language"),
    "t": "the time",
}

_BETTER = {
    "lambda": "lambda_1 or lam",
    "double": "double_mass or two_m",
    "t": "tau_1 for a time constant, T for a temperature",
    "sin": "s_theta",
    "cos": "c_theta",
}

_LETTERS = """alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi omicron pi
rho sigma tau upsilon phi chi psi omega""".split()

GREEK = {
    **dict(zip("αβγδεζηθικλμνξοπρστυφχψω", _LETTERS, strict=True)),
    **dict(zip("ΑΒΓΔΕΖΗΘΙΚΛΜΝΞΟΠΡΣΤΥΦΧΨΩ", map(str.capitalize, _LETTERS), strict=True)),
}


def plain(name: str) -> str:
    """Convert a name, such as a Greek letter or LaTeX text, to a valid C identifier; return it.

    Greek letters are written out, LaTeX syntax is removed, "_1" is appended to reserved names, such
    as keywords and functions of C, and the end of a long name is replaced by a hash.

    >>> plain("θ₁"), plain(r"\\theta_{1}"), plain("lambda")
    ('theta_1', 'theta_1', 'lambda_1')
    """
    subscripts = str.maketrans("₀₁₂₃₄₅₆₇₈₉", "0123456789")
    text = "".join("_" + c.translate(subscripts) if c in "₀₁₂₃₄₅₆₇₈₉" else c for c in name)
    text = "".join(GREEK.get(c, c) for c in text)
    text = re.sub(r"[^0-9A-Za-z]+", "_", text)
    text = re.sub(r"_+", "_", text).strip("_")
    if not text or not text[0].isalpha():
        text = "v_" + text if text else "v"
    if len(text) > MAX_LENGTH:
        text = f"{text[: MAX_LENGTH - 9].rstrip('_')}_{sha256(text.encode()).hexdigest()[:8]}"
    return text + "_1" if text in _WHY else text


def fault(name: str) -> str | None:
    """Return the reason why `name` is not allowed in a scene, and a remedy; None if it is allowed.

    A name is allowed if it is valid in C, C++ and Python, is not part of the formula language and
    has at most 40 characters, without "__" and without "_" at either end.
    """
    if len(name) > 10 * MAX_LENGTH:
        shown = f"{name[:MAX_LENGTH]}..."
        return f"'{shown}' has {len(name)} characters: {MAX_LENGTH} are the most, for readable C"
    if name in _WHY:
        better = _BETTER.get(name, f"{name}_1")
        return f"'{name}' is {_WHY[name]}: choose another name, such as {better}"
    if not name.isascii() or not name.isidentifier():
        return f"'{name}' is not a plain name: use letters a-z, digits and '_', as in {plain(name)}"
    if name.startswith("_") or "__" in name or name.endswith("_"):
        return f"'{name}' has underscores that C keeps for itself: use {plain(name)}"
    if len(name) > MAX_LENGTH:
        return f"'{name}' has {len(name)} characters: {MAX_LENGTH} are the most, for readable C"
    return None


def module_fault(name: str) -> str | None:
    """Return the reason why `name` cannot be the name of a scene, or None if it can.

    The name of a scene is also the name of its Python module and the prefix of its C names.
    """
    if why := fault(name):
        return why
    if name in sys.stdlib_module_names or name in ("numpy", "cffi", "eomc", "sympy", "test"):
        return f"'{name}' is the name of a Python module, which it would hide: use {name}_scene"
    if name.lower() in _FILES:
        return f"'{name}' is the name of another file of a build, {name}.c: use {name}_scene"
    if name.upper() in ("F", "R", "W", "X"):
        macro = f"{name.upper()}_OK"
        return f"'{name}' would make a name {macro}, a macro of unistd.h: use {name}_scene"
    if _MACROS.fullmatch(name):
        return f"'{name}' would make names that are macros of C or Python: use {name}_scene"
    return None
