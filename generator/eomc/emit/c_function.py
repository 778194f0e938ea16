"""C functions as values, and the few kinds of statement that a program becomes.

A function prints its prototype, its definition and a call; which of its arguments it does not read
it knows by itself. With c_expression.py the only Python that holds C syntax.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from eomc.emit.c_expression import Block, broken

WIDTH = 100  # of a line


@dataclass(frozen=True)
class CArgument:
    """One argument, `const double q[CARTPOLE_NQ]`: its type, its name, its extent if it has one."""

    type: str
    name: str
    extent: str = ""

    @property
    def declaration(self) -> str:
        """As it stands in a prototype."""
        gap = "" if self.type.endswith("*") else " "
        return f"{self.type}{gap}{self.name}" + (f"[{self.extent}]" if self.extent else "")


def given(type: str, name: str, extent: str = "") -> CArgument:
    """An array that a function reads; without an extent a pointer to it, which may be NULL."""
    return CArgument(f"const {type}" if extent else f"const {type} *", name, extent)


def filled(type: str, name: str, extent: str = "") -> CArgument:
    """An array that a function writes."""
    return CArgument(type if extent else f"{type} *", name, extent)


@dataclass(frozen=True)
class CFunction:
    """A C function.

    body: its statements, a blank line between blocks; empty where a template has them. reads: the
    names of the arguments that the body reads. doc: the comment above it, by paragraphs.
    """

    name: str
    result: str
    arguments: tuple[CArgument, ...]
    body: tuple[Block, ...] = ()
    reads: frozenset[str] = frozenset()
    qualifier: str = ""
    doc: tuple[str, ...] = ()

    @property
    def prototype(self) -> str:
        """Result, name and arguments, in one line."""
        listed = ", ".join(a.declaration for a in self.arguments) or "void"
        words = (self.qualifier, self.result, f"{self.name}({listed})")
        return " ".join(w for w in words if w)

    @property
    def comment(self) -> str:
        """The doc as a comment, in one line where it fits."""
        if len(whole := " ".join(self.doc)) <= WIDTH - 6:
            return f"/* {whole} */"
        lines = [line for part in self.doc for line in textwrap.wrap(part, WIDTH - 3)]
        return "\n".join(["/*", *(f" * {line}" for line in lines), " */"])

    @property
    def unused(self) -> tuple[str, ...]:
        """The arguments that the body does not read."""
        return tuple(a.name for a in self.arguments if a.name not in self.reads)

    @property
    def inside(self) -> str:
        """The body, indented, behind the arguments that it does not read."""
        unread = Block("", tuple(f"(void){name};" for name in self.unused))
        return "\n\n".join(block_text(b) for b in (unread, *self.body) if b.lines)

    @property
    def definition(self) -> str:
        """Prototype and body, the comment above it where it is static."""
        head = [self.comment] if self.doc and self.qualifier else []
        return "\n".join([*head, self.prototype, "{", self.inside, "}"])

    def call(self, **passed: str) -> str:
        """A call with other expressions in the place of some arguments; no semicolon."""
        return f"{self.name}({', '.join(passed.get(a.name, a.name) for a in self.arguments)})"


def static(name: str, result: str, *arguments: CArgument) -> CFunction:
    """A function of the file's own, whose body a template has."""
    return CFunction(name, result, arguments, qualifier="static")


def block_text(block: Block) -> str:
    """The statements of a block, indented, under its comment."""
    lines = [f"/* {block.comment} */"] if block.comment else []
    return "\n".join(f"    {line}" for line in (*lines, *block.lines))


# --- statements -----------------------------------------------------------------------------------


def constant(type: str, name: str, value: str) -> str:
    """A local that keeps its value."""
    return f"const {type} {name} = {value};"


def local(type: str, name: str) -> str:
    """A local without a value."""
    return f"{type} {name};"


def assign(place: str, value: str) -> str:
    """place = value."""
    return f"{place} = {value};"


def do(call: str) -> str:
    """A call as a statement."""
    return f"{call};"


def result(value: str) -> str:
    """Return a value."""
    return f"return {value};"


def note(conditions: Iterable[str]) -> tuple[str, ...]:
    """Conditions into a mask."""
    return tuple(f"failed |= {text};" for text in conditions)


def unless(conditions: Iterable[str], value: str) -> tuple[str, ...]:
    """Return `value` where one of the conditions holds; nothing where there are none."""
    text = " || ".join(conditions)
    return (f"if ({text})", f"    return {value};") if text else ()


def otherwise_signal(array: str, call: str) -> tuple[str, ...]:
    """u set to the scene's own signals where it is NULL."""
    return ("if (!u) {", f"    {call};", f"    u = {array};", "}")


def listed(type: str, name: str, extent: str, values: Sequence[str]) -> str:
    """An array of these values."""
    return f"const {type} {name}[{extent}] = {{ {', '.join(values)} }};"


def member(of: str, name: str) -> str:
    """A member behind a pointer."""
    return f"{of}->{name}"


def cast(type: str, name: str) -> str:
    """A pointer as one to another type, to be read."""
    return f"(const {type} *){name}"


def struct(type: str, real: str, members: Sequence[str]) -> str:
    """A struct of numbers."""
    return f"typedef struct {{\n    {real} {', '.join(members)};\n}} {type};"


def copied(to: str, array: str, first: int, count: str) -> tuple[str, ...]:
    """Numbers of an array from `first` on into another, in a loop."""
    place = f"{first} + k" if first else "k"
    return (f"for (int k = 0; k < {count}; k++)", f"    {to}[k] = {array}[{place}];")


def in_braces(rows: Iterable[Sequence[str]]) -> tuple[str, ...]:
    """The rows of a matrix as initialisers."""
    return tuple("{ " + ", ".join(row) + " }," for row in rows)


def narrowed(text: str) -> str:
    """The finished text with its long comments broken: one behind code goes above it."""
    lines, out, inside = text.split("\n")[::-1], list[str](), False
    while lines:
        line = lines.pop()
        code, opened, said = line.partition("/*")
        margin = " " * (len(line) - len(line.lstrip(" ")))
        if len(line) > WIDTH and "Generated by" not in line:
            if not inside and code.strip() and said.endswith("*/") and _apart(code.lstrip()):
                lines += [code.rstrip(), f"{margin}/*{said}"]
                continue
            if inside or (opened and not code.strip()):
                line, rest = _cut(line)
                mark = f"{margin}* " if inside else f"{margin} * "
                if lines and not rest.endswith((".", "*/")) and lines[-1].startswith(mark):
                    rest += " " + lines.pop().removeprefix(mark)
                lines += [mark + rest] if rest else []
        inside = line.rfind("/*") > line.rfind("*/") or (inside and "*/" not in line)
        out.append(line)
    return "\n".join(out)


def _apart(code: str) -> bool:
    """Whether a comment may stand above this code."""
    return not code.startswith(("#", "}", "else"))


def _cut(line: str) -> tuple[str, str]:
    """A line of a comment and what goes into the next, with its end."""
    at = line.rfind(" ", 0, min(WIDTH + 1, len(line.removesuffix(" */"))))
    begins = len(line) - len(line.lstrip(" /*"))
    return (line[:at], line[at + 1 :]) if at >= begins else (line, "")


def laid_out(text: str) -> str:
    """The finished text with its long lines broken; directives stay."""
    out: list[str] = []
    for line in narrowed(text).split("\n"):
        inside = line.lstrip(" ")
        if len(line) <= WIDTH or inside.startswith(("* ", "/*", "#")) or line.endswith("*/"):
            out.append(line)
            continue
        width = len(line) - len(inside)
        head, opened, rest = inside.partition("(")
        if opened and ", " not in inside[: WIDTH - width] and len(head) < WIDTH - width:
            out.append(" " * width + head + opened)
            parts = [" " * 4 + part.lstrip() for part in broken(rest, WIDTH - width - 4)]
        else:
            parts = list(broken(inside, WIDTH - width))
        out += [" " * width + part.rstrip() for part in parts]
    return "\n".join(out)
