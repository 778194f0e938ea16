"""Amalgamation: numerical methods from csrc/solver become part of a model's one C source.

The library has neutral names: functions begin with `eom_`, constants with `EOM_`, and numbers have
the type `real`. The amalgamation copies the definitions that a model needs, resolves the features,
and renames. The order is that of the files and, within a file, that of its definitions.

- `#if EOM_X`, `#if !EOM_X`, `#else` and `#endif`, alone on a line, select lines by the feature X.
- A paragraph between blank lines is one definition, with the comment above it. Definitions of
  static functions and tables that nothing uses are left out. Paragraphs that define neither, such
  as types and enumerations, stay; a file of which no definition is used is left out with them.
- The first comment of a file describes the file and is not copied.
- A call of a function of the model that only calls another one becomes a call of that one.
- Arguments that a static function does not use are left out of it and of its calls.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

from eomc.base import resources
from eomc.emit.common.c_expression import Real
from eomc.emit.common.c_function import CArgument, CFunction

COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)
NAME = re.compile(r"\b((?:eom|EOM)_\w+)( ?)")
MODEL_ARGUMENT = re.compile(r",\s+(?:const eom_model \*)?m(?=[,)])|\n *\(void\)m;")
MODEL_NAME = re.compile(r"const eom_model \*m(?=[,)])|(?<=[ (*)])m(?=[,);])")
NUMBER = re.compile(r"\(real\)(\d+(?:\.\d+)?(?:e-?\d+)?)")
DEFINITION = re.compile(
    r"static (?:inline )?(?:const )?\w+ (?:\*(?:const )?)?(eom_\w+)(?:[(\[]| =)"
)

FUNCTION = re.compile(r"^static .*?\b(\w+)\([^{}]*\)\n\{\n", re.MULTILINE)


@dataclass(frozen=True)
class Names:
    """Names of the library in a model's C source.

    Attributes
    ----------
    exact
        Text that replaces a whole name, such as "DBL_EPSILON" for `EOM_EPS`.
    prefixes
        Text that replaces the beginning of other names, such as "ball_" for "eom_". The longest
        beginning applies.
    real
        The C type of numbers.
    model
        The argument that replaces the library's `m`, which has the arguments of accelerations
        besides the state and time; None if there are none.
    forwards
        Functions of the model that only call another function, with all of their statements being
        this call. Calls of them become calls of the other function.
    """

    exact: Mapping[str, str]
    prefixes: Mapping[str, str]
    real: Real
    model: CArgument | None
    forwards: tuple[CFunction, ...] = ()

    def apply(self, text: str) -> str:
        """Return C text of the library with the model's names and type of numbers."""
        suffix = self.real.suffix
        if (model := self.model) is None:
            text = MODEL_ARGUMENT.sub("", text)
        elif model.name != "m":
            text = MODEL_NAME.sub(lambda m: model.name if m[0] == "m" else model.declaration, text)
        text = NUMBER.sub(rf"\g<1>{suffix}", text)
        text = re.sub(r"\breal\b", self.real.name, NAME.sub(self._replace, text))
        for f in self.forwards:
            text = replace_calls(text, f.name, f.call_with)
        return text

    def _replace(self, match: re.Match[str]) -> str:
        """Return the name that a name of the library has in the model's source.

        The space after a name is left out with a name that becomes empty.
        """
        name, space = match.groups()
        if name in self.exact:
            return self.exact[name] and self.exact[name] + space
        head = max(filter(name.startswith, self.prefixes), key=len)
        return self.prefixes[head] + name.removeprefix(head) + space


def amalgamate(
    files: Sequence[str],
    roots: Iterable[str],
    names: Names,
    features: Mapping[str, bool],
    tables: Sequence[str] = (),
) -> tuple[str, ...]:
    """Return the definitions of the library that a model needs, under the model's names.

    Parameters
    ----------
    files
        Names of files in csrc/solver, in the order in which C needs their definitions.
    roots
        Names of the library's functions that the model's code calls, or the calls themselves.
    names
        The names in the model's source.
    features
        Whether each feature of the library, such as "EVENTS", is present.
    tables
        Definitions of coefficients, under the library's names. They precede the files.
    """
    selection = frozenset(features.items())
    groups = [tables, *(definitions(file, selection) for file in files)]
    needed = reachable([part for group in groups for part in group], roots)
    chosen: list[str] = []
    for group in groups:
        names_of_group = {name for part in group if (name := defined_name(part))}
        if not names_of_group or names_of_group & needed:
            chosen += [part for part in group if defined_name(part) in needed | {""}]
    used = {names.apply(name) for root in roots for name in _used(root)}
    return without_unused_arguments([names.apply(part) for part in chosen], used)


@cache
def definitions(file: str, features: frozenset[tuple[str, bool]]) -> Sequence[str]:
    """Return the definitions of a file in csrc/solver, without those of absent features."""
    return paragraphs(select(resources.text("csrc", f"solver/{file}"), dict(features)))[1:]


def select(text: str, features: Mapping[str, bool]) -> str:
    """Return the text of a file without the lines of features that are absent.

    Raises ValueError for a directive of another form, and KeyError for an unknown feature.
    """
    lines: list[str] = []
    stack: list[bool] = []
    for number, line in enumerate(text.splitlines(), 1):
        if condition := re.fullmatch(r"#if (!?)EOM_(\w+)", line):
            stack.append(features[condition[2]] != bool(condition[1]))
        elif line == "#else" and stack:
            stack[-1] = not stack[-1]
        elif line == "#endif" and stack:
            stack.pop()
        elif re.match(r"\s*#", line):
            raise ValueError(f"line {number}: only #if EOM_X, #if !EOM_X, #else and #endif: {line}")
        elif all(stack):
            lines.append(line)
    if stack:
        raise ValueError("an #if has no #endif")
    return "\n".join(lines)


def paragraphs(text: str) -> list[str]:
    """Return the definitions at the top level of C text, each with the comment above it."""
    result: list[str] = []
    current: list[str] = []
    depth = 0
    for line in [*text.splitlines(), ""]:
        if depth == 0 and not line.strip():
            result += ["\n".join(current)] if current else []
            current = []
            continue
        current.append(line)
        code = COMMENT.sub("", line)
        depth += code.count("{") - code.count("}") + code.count("/*") - code.count("*/")
    return result


@cache
def defined_name(paragraph: str) -> str:
    """Return the name of the static function or table that a paragraph defines, or ""."""
    match = DEFINITION.match(COMMENT.sub("", paragraph).strip())
    return match[1] if match else ""


def reachable(parts: Sequence[str], roots: Iterable[str]) -> set[str]:
    """Return the names of the definitions that the roots use, directly or through others."""
    by_name = {name: part for part in parts if (name := defined_name(part))}
    pending = [name for root in roots for name in _used(root)]
    needed: set[str] = set()
    while pending:
        name = pending.pop()
        if name in by_name and name not in needed:
            needed.add(name)
            pending += _used(by_name[name])
    return needed


def replace_calls(text: str, name: str, replace: Callable[[list[str]], str]) -> str:
    """Return C text in which calls of a function, and its prototype, are replaced.

    replace: function that returns the new text of a call with these arguments.
    """
    start = 0
    while match := re.compile(rf"\b{name}\(").search(text, start):
        arguments, end = _split(text, match.start())
        new = replace([replace_calls(a, name, replace) for a in arguments])
        text, start = text[: match.start()] + new + text[end:], match.start() + len(new)
    return text


def _split(text: str, start: int) -> tuple[list[str], int]:
    """Return the arguments of a call whose name begins at `start`, and where its text ends."""
    begin = text.index("(", start) + 1
    arguments, depth = [], 0
    for i in range(begin, len(text)):
        if depth == 0 and text[i] in ",)":
            arguments.append(text[begin:i].strip())
            begin = i + 1
            if text[i] == ")":
                return arguments, begin
        depth += (text[i] in "([{") - (text[i] in ")]}")
    raise ValueError(f"a call has no end: {text[start:]}")


def without_unused_arguments(parts: Sequence[str], roots: Iterable[str]) -> tuple[str, ...]:
    """Return C definitions without the arguments that functions do not use.

    The roots, which other code calls, keep all of their arguments.
    """
    result, called = list(parts), set(roots)
    heads = {k: FUNCTION.search(part) for k, part in enumerate(parts)}
    places = {m[1]: k for k, m in heads.items() if m}
    pending = list(places)
    while pending:
        name = pending.pop()
        head, body = result[places[name]].split("\n{\n", 1)
        words = [a.split("*")[-1].split()[-1] for a in _split(head, head.index(f"{name}("))[0]]
        code = COMMENT.sub("", re.sub(r"\(void\)\w+;", "", body))
        unused = {k for k, word in enumerate(words) if not re.search(rf"\b{word}\b", code)}
        if not unused:
            continue
        for k in unused:
            body = re.sub(rf" *\(void\){words[k]};\n\n?", "", body)
        if name in called:
            body = "".join(f"    (void){words[k]};\n" for k in sorted(unused)) + "\n" + body
        result[places[name]] = head + "\n{\n" + body
        if name in called:
            continue

        def shorten(arguments: list[str], name: str = name, unused: set[int] = unused) -> str:
            return f"{name}({', '.join(a for k, a in enumerate(arguments) if k not in unused)})"

        shortened = [replace_calls(part, name, shorten) for part in result]
        pending += [n for n, k in places.items() if shortened[k] != result[k] and n not in pending]
        result = shortened
    return tuple(result)


@cache
def _used(text: str) -> frozenset[str]:
    """Return the library's names in C text."""
    return frozenset(match[1] for match in NAME.finditer(COMMENT.sub("", text)))
