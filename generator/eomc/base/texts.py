r"""Free text at the border: titles, units, notes, names of files, names in robot files.

Free text is data. It is printed into C, Python, HTML, TOML, figures and terminals, and for each of
these there is one function here that makes it harmless. Code and docstrings hold free text as an
escaped literal or not at all. CSV, LaTeX and what is compiled are given names only: names.py lets
no others than plain ones pass, and `name` refuses those of a system made without it.

A character that could steer a terminal, break a line or reorder what is read is *hidden*. The
reader of scenes refuses it (`checked_line`); where it can't be refused it is shown escaped: \x1b.
"""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import NoReturn

# control characters, marks of writing direction, separators of lines, halves of characters,
# and the two that no file of text may hold
_DIRECTIONS = r"\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"
_SEPARATORS = r"\x85\u2028\u2029"
_HALVES = r"\ud800-\udfff\ufffe\uffff"
_HIDDEN = re.compile(rf"[\x00-\x1f\x7f-\x9f{_DIRECTIONS}{_SEPARATORS}{_HALVES}]")
_HIDDEN_IN_LINES = re.compile(_HIDDEN.pattern.replace(r"\x00-\x1f", r"\x00-\x08\x0b-\x1f"))


def checked_line(text: str) -> str:
    """Return the text of a title or unit. Raises ValueError for hidden characters."""
    if match := _HIDDEN.search(text):
        raise ValueError(_fault(text, match))
    return text


def checked_lines(text: str) -> str:
    """Return the text of a note, with line breaks and tabs allowed. Raises ValueError likewise."""
    if match := _HIDDEN_IN_LINES.search(text):
        raise ValueError(_fault(text, match))
    return text


def _fault(text: str, match: re.Match[str]) -> str:
    c = match[0]
    if c == "\n":
        return "holds a line break: write it in one line"
    kind = "a control character"
    if re.match(f"[{_DIRECTIONS}]", c):
        kind = "a mark of writing direction"
    elif re.match(f"[{_SEPARATORS}]", c):
        kind = "a separator of lines"
    elif re.match(f"[{_HALVES}]", c):
        kind = "no character"
    before = f" after '{line(text[: match.start()][-20:])}'" if match.start() else " at its start"
    remedy = "write a space" if c == "\t" else "remove it"
    if c in "\t\x08\x0c\r" and text[match.end() : match.end() + 1].isalpha():  # "\theta"
        remedy = 'a backslash in "..." begins an escape, write the text in single quotes'
    return f"holds U+{ord(c):04X}, {kind},{before}: {remedy}"


def line(text: str) -> str:
    r"""A text in one line, for a terminal or a comment of TOML; hidden characters escaped.

    >>> line("θ\x1b]0;x")
    'θ\\x1b]0;x'
    """
    return _HIDDEN.sub(_escaped, text)


def lines(text: str) -> str:
    """Return a text of several lines with hidden characters escaped."""
    return _HIDDEN_IN_LINES.sub(_escaped, text)


def _escaped(match: re.Match[str]) -> str:
    return match[0].encode("unicode_escape").decode("ascii")


def flat(text: str) -> str:
    """Return a note in one line, with white space collapsed."""
    return line(" ".join(re.split(r"[ \t\r\n]+", text.strip(" \t\r\n"))))


def listed(names: Collection[str], most: int = 12) -> str:
    """Return names as a list in one line, abbreviated if there are many."""
    shown = ", ".join([*names][:most]) or "none"
    return shown + (f" and {len(names) - most} more" if len(names) > most else "")


def plural(word: str, n: int) -> str:
    """Return the singular or plural of a word for n things."""
    return word if n == 1 else word + ("es" if word.endswith(("x", "sh")) else "s")


def comment(text: str) -> str:
    r"""Return a text for the inside of a C comment, in one line.

    It neither ends the comment nor begins another, and no line ends in a backslash or in the
    trigraph of one, which would join it to the next.

    >>> comment("*/ a ??/ b \\")
    '* / a ? ?/ b \\x5c'
    """
    text = line(text).replace("??/", "? ?/")
    text = re.sub(r"\\(?=\s|\Z)", r"\\x5c", text)
    return re.sub(r"\*(?=/)|/(?=\*)", r"\g<0> ", text)


def python(value: str | Mapping[str, str]) -> str:
    """Return a text, or texts by name, as a Python literal. Raises TypeError for other types."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{python(k)}: {python(v)}" for k, v in value.items()) + "}"
    return str.__repr__(value)


def docstring(text: str) -> str:
    """Return a text escaped for a docstring."""
    return re.sub(r'"(?="|\Z)', r"\"", lines(text).replace("\\", "\\\\"))


def html(text: str) -> str:
    """Return a text escaped for HTML, as Markup, which is not escaped again."""
    from markupsafe import escape

    return escape(line(text))


def xml(text: str) -> str:
    """Return a text escaped for an attribute of XML."""
    from markupsafe import escape

    return str(escape(line(text)))


def toml(text: str) -> str:
    """Return a text as a quoted TOML string."""
    return json.dumps(line(text), ensure_ascii=False)


def figure(text: str) -> str:
    """Return a text for a figure, with dollar signs escaped."""
    return line(text).replace("$", r"\$")


def name(text: str) -> str:
    """Return an identifier for generated code. Raises ValueError for any other text."""
    if not re.fullmatch(r"[A-Za-z_][0-9A-Za-z_]*", text):
        raise ValueError(f"{text!r} is not a plain name and can't stand in code")
    return text


def command(file: str) -> str:
    """Return a file name quoted for the shell."""
    return shlex.quote(line(file))


@dataclass(frozen=True)
class FreeText:
    """Free text on its way into a template, or texts by name.

    It can't be printed as it stands (TypeError): the template says for what, `{{ title.comment }}`.
    """

    text: str | Mapping[str, str]

    def __bool__(self) -> bool:
        return bool(self.text)

    def __str__(self) -> NoReturn:
        raise TypeError("free text is printed as .comment, .line, .xml or .python")

    def __repr__(self) -> str:
        return "FreeText(...)"  # what prints a list of them

    @property
    def line(self) -> str:
        """For a docstring, which is escaped as a whole."""
        return line(self._one())

    @property
    def comment(self) -> str:
        """For a C comment."""
        return comment(self._one())

    @property
    def xml(self) -> str:
        """For an attribute of XML."""
        return xml(self._one())

    @property
    def python(self) -> str:
        """As a Python literal."""
        return python(self.text)

    def _one(self) -> str:
        if not isinstance(self.text, str):
            raise TypeError("texts by name are printed as .python only")
        return self.text
