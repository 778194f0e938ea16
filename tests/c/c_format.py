"""The format of handwritten C: that of clang-format, with products written without spaces.

clang-format puts spaces around every binary operator, and breaks lists of enumerators, chained
conditional expressions and loops after a macro. These are therefore replaced by names before it
formats a file, and restored afterwards.

    python tests/c/c_format.py    # formats the files
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
COMMENT = re.compile(r"(/\*.*?\*/)", re.DOTALL)
# Cyrillic letters, which are letters of C names but do not occur in the files
PRODUCTS = {"*": "ж", "/": "з", "%": "и"}
NUMBER, POINT, CAST, COMMA, LOOP = "м", "п", "realк", "л", "for (б"
CONDITIONAL = {" ? ": " && в && ", " : ": " && г && "}


def files() -> Iterator[Path]:
    """Yield the files that have this format."""
    for folder in ("csrc/solver", "tests/c/solver"):
        yield from sorted((ROOT / folder).glob("*.[ch]"))


def format_c(text: str, clang_format: str) -> str:
    """Return the text of a C file as formatted by the program `clang_format`."""
    process = subprocess.run(
        [clang_format, f"--style=file:{ROOT / '.clang-format'}", "--assume-filename=x.c"],
        input=_hide(text), capture_output=True, text=True, check=True, encoding="utf-8",
    )  # fmt: skip
    return _restore(process.stdout)


def _hide(text: str) -> str:
    """Return C text in which names stand for what clang-format would not keep."""
    parts = COMMENT.split(text)
    return "".join(p if p.startswith("/*") else _hide_code(p) for p in parts)


def _hide_code(text: str) -> str:
    """Return C text without comments, with these names."""
    text = re.sub(r"(?<=[\w)\]]) ([*/]) (?=[\w(&])", r"\1", text)
    text = re.sub(r"\(real\)(?=[A-Za-z_(])", CAST, text)
    for operator, name in CONDITIONAL.items():
        text = text.replace(operator, name)
    text = re.sub(
        r"(?<![\w.])\d[\d.]*(?=[*/%]\w)", lambda m: NUMBER + m[0].replace(".", POINT), text
    )
    text = re.sub(r"(?<=[\w)\]])([*/%])(?=[\w(&])", lambda m: PRODUCTS[m[1]], text)
    one_line = r"(?m)^( *(?:typedef )?enum \{)(.*\})"
    text = re.sub(one_line, lambda m: m[1] + m[2].replace(", ", COMMA), text)
    return text.replace("EOM_LANES for (", LOOP)


def _restore(text: str) -> str:
    """Return C text in which these names are replaced by what they stand for."""
    text = text.replace(LOOP, "EOM_LANES for (").replace(COMMA, ", ")
    for operator, name in PRODUCTS.items():
        text = re.sub(f" ?{name} ?", operator, text)
    text = text.replace(NUMBER, "").replace(POINT, ".")
    for operator, name in CONDITIONAL.items():
        text = text.replace(name, operator)
    return text.replace(CAST, "(real)")


if __name__ == "__main__":
    import sys

    for file in files():
        before = file.read_text(encoding="utf-8")
        after = format_c(before, str(Path(sys.executable).parent / "clang-format"))
        file.write_text(after, encoding="utf-8")
