"""Untrusted XML: its reader, values of attributes, and the elements that a robot format has.

The reader expands no entities and opens no other file.

A format is written as an outline, with a line for each element, indented by a blank a level:

    joint: name type
     origin: xyz rpy
     safety_controller: *

`*` stands for any attributes and child elements: the element is skipped as a whole, and its reader
reports it. `+` stands for any child elements; only the attributes of the element itself are
checked. `@name` stands for a group of attributes that several elements share.
"""

from __future__ import annotations

import math
import os
import re
import stat
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import ParseError

from eomc.base import texts
from eomc.base.errors import EomcError, Problem
from eomc.robots.geometry import Vector
from eomc.scene.formulas import suggest

MAX_BYTES = 20_000_000  # the largest robot files without their meshes have one or two million
LARGE = 1e100  # numbers beyond it, and sizes below 1/LARGE, overflow when they are multiplied


@dataclass(frozen=True, eq=False)
class Tag:
    """An element of an XML file.

    Attributes
    ----------
    kind : str
        Name of the element.
    attributes : dict
        Attributes by name.
    line, file
        Where the element begins.
    children : list of Tag
        Child elements.
    text : list of str
        The non-blank pieces of text between the element's tags.
    """

    kind: str
    attributes: dict[str, str]
    line: int
    file: Path
    children: list[Tag] = field(default_factory=list)
    text: list[str] = field(default_factory=list)

    def get(self, key: str, default: str = "") -> str:
        """Return the value of the attribute `key` as text, or `default` if it is missing."""
        return self.attributes.get(key, default)

    def each(self, kind: str) -> Iterator[Tag]:
        """Return an iterator over the child elements with the name `kind`."""
        return (child for child in self.children if child.kind == kind)

    def first(self, kind: str) -> Tag | None:
        """Return the first child element with the name `kind`, or None."""
        return next(self.each(kind), None)

    def all(self) -> Iterator[Tag]:
        """Yield this element and all of its descendants, in the order of the file."""
        waiting = [self]
        while waiting:
            yield (tag := waiting.pop())
            waiting += reversed(tag.children)


class _Builder:
    """Target of the XML parser that builds the tree of tags."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self.parser: Any = None
        self.root: Tag | None = None
        self.stack: list[Tag] = []
        self.prefixes: dict[str, str] = {}  # of namespaces, as the file declares them

    def start_ns(self, prefix: str, uri: str) -> None:
        """Record the prefix of an XML namespace.

        The prefix of the namespace of xacro is recorded as `xacro`, whatever it is in the file.
        """
        self.prefixes[uri] = "xacro" if uri.endswith("/xacro") else prefix

    def written(self, name: str) -> str:
        """Return the name of an element with its prefix, as in the file, from "{namespace}name"."""
        uri, _, local = name[1:].rpartition("}") if name.startswith("{") else ("", "", name)
        prefix = self.prefixes.get(uri, "xml" if uri.endswith("/XML/1998/namespace") else "")
        return f"{prefix}:{local}" if prefix else local

    def start(self, kind: str, attributes: dict[str, str]) -> None:
        mine = {self.written(key): value for key, value in attributes.items()}
        tag = Tag(self.written(kind), mine, self.parser.parser.CurrentLineNumber, self.file)
        if self.stack:
            self.stack[-1].children.append(tag)
        self.root = self.root or tag
        self.stack.append(tag)

    def end(self, kind: str) -> None:
        self.stack.pop()

    def data(self, text: str) -> None:
        if self.stack and (text := text.strip()):
            self.stack[-1].text.append(text)

    def close(self) -> Tag | None:
        return self.root


def root(file: str | os.PathLike[str]) -> Tag:
    """Return the root element of an XML file.

    Entities are not expanded. Raises EomcError with the fault and a remedy if the file is not valid
    XML or cannot be read.
    """
    from defusedxml import DefusedXmlException
    from defusedxml.ElementTree import DefusedXMLParser

    shown = texts.line(str(file))
    data = _bytes(Path(file), shown)
    if not data.strip():
        raise EomcError(f"{shown}: the file is empty")
    builder = _Builder(Path(file))
    builder.parser = DefusedXMLParser(target=builder, forbid_dtd=True)
    try:
        builder.parser.feed(data)
        element: Tag = builder.parser.close()
    except ParseError as fault:
        if b"xacro:" in data and "unbound prefix" in str(fault):
            raise EomcError(f"{shown}: {RUN_XACRO}") from None
        line, column = fault.position
        why = re.sub(r": line \d+, column \d+$", "", str(fault))
        if "declaration not at start" in why:
            why += ": remove what stands before <?xml ...?>, empty lines too"
        raise EomcError(f"{shown}:{line}:{column + 1}: not XML: {why}") from None
    except DefusedXmlException:
        raise EomcError(
            f"{shown}: it declares a document type or entities, which are not read: robot files "
            "need none, remove <!DOCTYPE ...> and write out what its entities stand for"
        ) from None
    except (ValueError, LookupError) as fault:  # of the encoding that it claims
        raise EomcError(f"{shown}: not XML: {fault}") from None
    return element


def number(word: str) -> float:
    """Return the number that a word in an XML file denotes.

    Numbers that are too small for a double become zero. Raises ValueError if the number is too
    large or not finite, and for Python's own syntax such as 1_0.
    """
    try:
        value = float("x" if "_" in word or not word.isascii() else word)
    except ValueError:
        raise ValueError(f"'{word}' is not a number") from None
    if not math.isfinite(value):
        raise ValueError(f"'{word}' is not a finite number")
    if abs(value) > LARGE:
        raise ValueError(f"'{word}' is more than {LARGE:g}, which can't be meant")
    return value if abs(value) > 1 / LARGE else 0.0


RUN_XACRO = "it holds xacro macros: run xacro first (xacro robot.urdf.xacro > robot.urdf)"


def _bytes(path: Path, shown: str) -> bytes:
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):  # a pipe would be waited for
            what = "a folder" if stat.S_ISDIR(status.st_mode) else "a pipe or device"
            raise EomcError(f"{shown}: can't be read (it is {what}, not a file)")
        if status.st_size > MAX_BYTES:
            raise EomcError(
                f"{shown}: {status.st_size} bytes are more than the {MAX_BYTES} a robot file may "
                "have"
            )
        with path.open("rb") as file:
            return file.read(MAX_BYTES)
    except FileNotFoundError:
        near = suggest(path.name, (p.name for p in path.parent.glob("*.[ux]*") if p.exists()))
        raise EomcError(f"{shown}: there is no such file{near}") from None
    except (OSError, ValueError) as fault:
        why = getattr(fault, "strerror", None) or fault
        raise EomcError(f"{shown}: can't be read ({why})") from None


# --- values of attributes, and the report ---------------------------------------------------------

SHOWN = 12  # names in one note on parts that are left out
BOOLEAN = ("false", "true")

Attributes = dict[str, str]


@dataclass
class ImportReport:
    """Errors and notes from reading a robot file.

    Attributes
    ----------
    faults : list of Problem
        Errors, all of which are reported together.
    strangers : tuple of str
        Notes on elements and attributes that the format does not define.
    left : dict
        Names of the parts that are not modelled, by kind.
    """

    faults: list[Problem] = field(default_factory=list)
    strangers: tuple[str, ...] = ()
    left: dict[str, list[str]] = field(default_factory=dict)

    def leave_out(self, kind: str, name: str = "") -> None:
        """Record that a part of the file is left out of the model.

        `kind` describes the kind of part, and `name` is its name, or "" without one.
        """
        self.left.setdefault(kind, []).append(name)

    def mark_read(self, kind: str, name: str) -> None:
        """Remove the record that the part `name` of the given kind is left out of the model."""
        those = self.left.get(kind, [])
        if name in those:
            those.remove(name)
            if not those:
                del self.left[kind]

    def notes(self) -> tuple[str, ...]:
        """Return the notes on what is left out: one for each kind of part, with number and names.

        A name that was recorded twice counts once. Notes on unknown elements come first.
        """
        lines = [*self.strangers]
        for kind, those in self.left.items():
            names = [*dict.fromkeys(name for name in those if name)]
            count = those.count("") + len(names)
            line = f"{kind} ({count})" if count > 1 else kind
            if named := names[:SHOWN]:
                more = count - len(named)
                line += f": {', '.join(named)}" + (f" and {more} more" if more else "")
            lines.append(line)
        return tuple(lines)


@dataclass(frozen=True)
class AttributeReader:
    """Access to the attributes of an element (`tag`) as numbers, words or vectors.

    Attributes may be the element's own or inherited. Faults in them are added to `report`. `label`
    names the element of which `tag` is a part; by default, messages name `tag`.
    """

    attributes: Attributes
    tag: Tag
    report: ImportReport
    label: str = ""

    def __contains__(self, key: str) -> bool:
        return key in self.attributes

    def get(self, key: str, default: str = "") -> str:
        """Return the text of an attribute, or `default` if it is missing."""
        return self.attributes.get(key, default)

    def fault(self, message: str) -> None:
        """Add an error message, with the line of the element, to the report.

        Reading continues, so that all faults are reported together.
        """
        tag, label = self.tag, self.label or _element_label(self.tag)
        self.report.faults.append(Problem(message, label, str(tag.file), tag.line))

    def numbers(self, key: str, most: int, least: int | None = None) -> tuple[float, ...] | None:
        """Return the numbers in an attribute; None if it is missing or faulty.

        There must be at most `most` and at least `least` numbers (default: `most`).
        """
        text = self.attributes.get(key)
        if text is None:
            return None
        least = most if least is None else least
        what = f'{key}="{text}"' + (f" of <{self.tag.kind}>" if self.label else "")
        macro = f"; {RUN_XACRO}" if "${" in text or "$(" in text else ""
        try:
            values = tuple(map(number, text.split()))
        except ValueError as why:
            self.fault(f"{what}: {why}{macro}")
            return None
        if not least <= len(values) <= most:
            expected = str(most) if least == most else f"{least} to {most}"
            self.fault(f"{what} has {len(values)} numbers; it takes {expected}{macro}")
            return None
        return values

    def vector(self, key: str) -> Vector | None:
        """Return the three numbers of an attribute; None if it is missing or faulty."""
        values = self.numbers(key, 3)
        return (values[0], values[1], values[2]) if values else None

    def number(self, key: str, default: float = 0.0) -> float:
        """Return the number in an attribute, or `default` if it is missing or faulty."""
        values = self.numbers(key, 1)
        return values[0] if values else default

    def linear_coefficient(self, key: str, kinds: str, name: str) -> float:
        """Return the first of up to three coefficients of a polynomial; report the others.

        `kinds` is the kind of element in the plural, and `name` that of the element.
        """
        first, *others = self.numbers(key, 3, 1) or (0.0,)
        if any(others):
            self.report.leave_out(f"{key} in the square and cube of {kinds}", name)
        return first

    def choice(self, key: str, choices: Sequence[str], default: str = "") -> str:
        """Return the word in an attribute, which must be one of `choices`.

        It is `default` if the attribute is missing or faulty; the first choice by default.
        """
        default = default or choices[0]
        word = self.get(key, default)
        if word in choices:
            return word
        self.fault(f'{key}="{word}" is not one of {", ".join(choices)}')
        return default

    def reference(self, key: str, kind: str, known: Collection[str]) -> str:
        """Return the name in an attribute, which must be one of `known`; "" after a fault.

        `kind` is the kind of element that has this name.
        """
        name = self.get(key)
        if name in known:
            return name
        missing = f'there is no {kind} "{name}"{suggest(name, known)}'
        self.fault(missing if name else f"it needs {key}")
        return ""

    def is_true(self, key: str, default: bool = False) -> bool:
        """Return True if the attribute is "true"; `default` if it is missing or faulty."""
        return self.choice(key, BOOLEAN, BOOLEAN[default]) == "true"


def _element_label(tag: Tag) -> str:
    """Return the label of an element in error messages: its kind and its name."""
    name = tag.get("name")
    return f'{tag.kind} "{name}"' if name else tag.kind


# --- formats of robot files -----------------------------------------------------------------------

MAX_ENTRIES = 40  # in one line of a report, so that a hostile file prints no book


@dataclass(frozen=True)
class ElementSchema:
    """The attributes and child elements that an element of a robot file may have.

    Attributes
    ----------
    attributes, children
        Names of the attributes; child elements by name.
    skipped : bool
        Whether the contents of the element are not checked.
    is_open : bool
        Whether any child elements may occur in it, which are not checked.
    """

    attributes: frozenset[str] = frozenset()
    children: dict[str, ElementSchema] = field(default_factory=dict)
    skipped: bool = False
    is_open: bool = False


def parse_format(outline: str, groups: Mapping[str, str]) -> ElementSchema:
    """Return the root element that an outline (see the module) describes.

    `groups` maps the name of each group to its attributes, separated by blanks.
    """
    top = ElementSchema()
    stack = [top]
    for line in outline.strip().splitlines():
        kind, _, rest = line.strip().partition(":")
        words = rest.split()
        names = [n for w in words for n in (groups[w[1:]].split() if w[0] == "@" else [w])]
        element = ElementSchema(
            frozenset(names) - {"*", "+"}, skipped="*" in names, is_open="+" in names
        )
        depth = len(line) - len(line.lstrip())
        del stack[depth + 1 :]
        stack[-1].children[kind] = element
        stack.append(element)
    (root,) = top.children.values()
    return root


def unknown_parts(root: Tag, element: ElementSchema, of: str) -> tuple[str, ...]:
    """Return descriptions of the parts of a file that its format does not define.

    The parts are elements, attributes and texts. `root` is the file's root element, and `element`
    describes what the format permits in it. `of` is the name of the format, such as "URDF". The
    contents of unknown elements are not checked.
    """
    unknown: dict[str, dict[str, list[str]]] = {}  # kind of stranger -> what it is -> its places

    def note(kind: str, what: str, place: str) -> None:
        unknown.setdefault(kind, {}).setdefault(what, []).append(place)

    waiting: list[tuple[Tag, ElementSchema, str]] = [(root, element, "")]
    while waiting:
        tag, known, around = waiting.pop()
        name = tag.get("name")
        mine = f' "{name}"' if name and known is not element else ""
        for key in tag.attributes:
            if key not in known.attributes:
                note("attributes", f"{key} of {tag.kind}", mine or around)
        if tag.text:
            note("text", f"<{tag.kind}>", mine or around)
        below_it = f" in {tag.kind}{mine or around}" if tag is not root else ""
        inner: list[tuple[Tag, ElementSchema, str]] = []
        for child in [] if known.is_open else tag.children:
            below = known.children.get(child.kind)
            if below is None:
                note("elements", f"{child.kind} in {tag.kind}", mine or around)
            elif not below.skipped:
                inner.append((child, below, below_it))
        waiting += reversed(inner)
    heads = {
        "elements": f"elements that {of} does not have",
        "attributes": f"attributes that {of} does not have",
        "text": f"text between tags, where {of} has attributes",
    }
    return tuple(f"{heads[k]}: {_listed(unknown[k])}" for k in heads if k in unknown)


def _listed(places: Mapping[str, list[str]]) -> str:
    """Return each entry with its first place, and the number of its other places."""
    entries = [
        f"{what}{where[0]}" + (f" (and {len(where) - 1} more)" if len(where) > 1 else "")
        for what, where in places.items()
    ]
    return texts.listed(entries, MAX_ENTRIES)
