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
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

# control characters, marks of writing direction, separators of lines, halves of characters,
# and the two that no file of text may hold
_DIRECTIONS = r"\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"
_SEPARATORS = r"\x85\u2028\u2029"
_HALVES = r"\ud800-\udfff\ufffe\uffff"
_HIDDEN = re.compile(rf"[\x00-\x1f\x7f-\x9f{_DIRECTIONS}{_SEPARATORS}{_HALVES}]")
_HIDDEN_IN_LINES = re.compile(_HIDDEN.pattern.replace(r"\x00-\x1f", r"\x00-\x08\x0b-\x1f"))


def checked_line(text: str) -> str:
    """Check that a title or unit is one line without hidden characters; return it unchanged.

    Raises ValueError if `text` has a control character (line breaks and tabs are control
    characters), a mark of writing direction or a line separator.
    """
    if match := _HIDDEN.search(text):
        raise ValueError(_fault(text, match))
    return text


def checked_lines(text: str) -> str:
    """Check that a note has no hidden characters; return it unchanged.

    Line breaks and tabs are permitted. Raises ValueError if `text` has another control character, a
    mark of writing direction or a line separator.
    """
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
    r"""Return `text` with control characters and other hidden characters escaped, as one line.

    The result is safe to print to a terminal and into a comment of a TOML file.

    >>> line("θ\x1b]0;x")
    'θ\\x1b]0;x'
    """
    return _HIDDEN.sub(_escape, text)


def lines(text: str) -> str:
    """Return `text` with hidden characters escaped, except for line breaks and tabs."""
    return _HIDDEN_IN_LINES.sub(_escape, text)


def _escape(match: re.Match[str]) -> str:
    return match[0].encode("unicode_escape").decode("ascii")


def flat(text: str) -> str:
    """Return `text` as one line: white space collapsed to spaces, hidden characters escaped."""
    return line(" ".join(re.split(r"[ \t\r\n]+", text.strip(" \t\r\n"))))


def listed(names: Collection[str], most: int = 12) -> str:
    """Return names separated by commas; "none" if there are none.

    Only the first `most` names are written out, followed by "and <number> more".
    """
    shown = ", ".join([*names][:most]) or "none"
    return shown + (f" and {len(names) - most} more" if len(names) > most else "")


def plural(word: str, n: int) -> str:
    """Return the noun `word` in the singular if n is 1, else in the plural ("-s" or "-es")."""
    return word if n == 1 else word + ("es" if word.endswith(("x", "sh")) else "s")


def comment(text: str) -> str:
    r"""Return `text` as one line that is safe inside a C comment.

    The result neither ends the comment nor begins another. It does not end in a backslash or in
    the trigraph of a backslash, which would join the line to the next one.

    >>> comment("*/ a ??/ b \\")
    '* / a ? ?/ b \\x5c'
    """
    text = line(text).replace("??/", "? ?/")
    text = re.sub(r"\\(?=\s|\Z)", r"\\x5c", text)
    return re.sub(r"\*(?=/)|/(?=\*)", r"\g<0> ", text)


def python(value: Any) -> str:
    """Return Python source code of a literal whose value is the given string, number or container.

    Containers are dicts, lists and tuples. Raises TypeError for values of other types.
    """
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{python(k)}: {python(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(python, value)) + "]"
    if isinstance(value, tuple):
        return "(" + ", ".join(map(python, value)) + ("," if len(value) == 1 else "") + ")"
    return repr(value) if isinstance(value, bool | int | float) else str.__repr__(value)


def docstring(text: str) -> str:
    """Return `text` escaped for a Python docstring, to be inserted between triple quotes.

    Backslashes, quotes and hidden characters are escaped.
    """
    return re.sub(r'"(?="|\Z)', r"\"", lines(text).replace("\\", "\\\\"))


def html(text: str) -> str:
    """Return `text` as one line that is escaped for HTML.

    The result is a markupsafe.Markup, which Jinja templates do not escape again.
    """
    from markupsafe import escape

    return escape(line(text))


def xml(text: str) -> str:
    """Return `text` as one line that is escaped for the value of an XML attribute."""
    from markupsafe import escape

    return str(escape(line(text)))


def toml(value: Any) -> str:
    """Return a string, a number, or a dict or sequence of these as a TOML value in one line.

    Of a number, it is the shortest text that reads back as the number.
    """
    if isinstance(value, str):
        return json.dumps(line(value), ensure_ascii=False)
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{key} = {toml(entry)}' for key, entry in value.items())} }}"
    if isinstance(value, Sequence):
        return f"[{', '.join(map(toml, value))}]"
    if isinstance(value, bool | int):
        return str(value).lower()
    short = repr(float(value)).removesuffix(".0")
    return "0" if short == "-0" else short


def figure(text: str) -> str:
    """Return `text` as one line for a Matplotlib figure.

    Dollar signs, which would begin a formula, are escaped.
    """
    return line(text).replace("$", r"\$")


def name(text: str) -> str:
    """Return `text` unchanged if it is an identifier (ASCII letters, digits, underscores).

    Raises ValueError otherwise; generated code contains such names unescaped.
    """
    if not re.fullmatch(r"[A-Za-z_][0-9A-Za-z_]*", text):
        raise ValueError(f"{text!r} is not a plain name and can't stand in code")
    return text


def command(file: str) -> str:
    """Return a file name as one line that is quoted for a command of the shell."""
    return shlex.quote(line(file))


@dataclass(frozen=True)
class FreeText:
    """Free text for a Jinja template: a string that a user wrote, or a container of such strings.

    The text must be escaped for the language that surrounds it. A template therefore prints one of
    the properties, such as `{{ title.comment }}` in a C comment. Printing the object itself raises
    TypeError.
    """

    text: Any

    def __bool__(self) -> bool:
        return bool(self.text)

    def __str__(self) -> NoReturn:
        raise TypeError("free text is printed as .comment, .line, .xml or .python")

    def __repr__(self) -> str:
        return "FreeText(...)"  # what prints a list of them

    @property
    def line(self) -> str:
        """The text as one line, for a Python docstring.

        Quotes are not escaped, because the docstring is later escaped as a whole.
        """
        return line(self._single_text())

    @property
    def comment(self) -> str:
        """The text as one line that is escaped for a C comment."""
        return comment(self._single_text())

    @property
    def xml(self) -> str:
        """The text as one line that is escaped for the value of an XML attribute."""
        return xml(self._single_text())

    @property
    def python(self) -> str:
        """The text, or the container of texts, as the source text of a Python literal."""
        return python(self.text)

    def _single_text(self) -> str:
        if not isinstance(self.text, str):
            raise TypeError("texts by name are printed as .python only")
        return self.text
