"""Which elements and attributes a format of robot files has, and what of a file it does not have.

A format is an outline, a line for each element, indented by a blank a level:

    joint: name type
     origin: xyz rpy
     safety_controller: *

`*` stands for whatever the element holds: the reader skips it as a whole, and reports it itself.
`+` stands for any child elements, of which the attributes of the element itself are checked alone.
`@name` stands for a group of attributes that several elements share.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from eomc.base import texts
from eomc.robots.xml import Tag

MAX_ENTRIES = 40  # in one line of a report, so that a hostile file prints no book


@dataclass(frozen=True)
class Element:
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
    children: dict[str, Element] = field(default_factory=dict)
    skipped: bool = False
    is_open: bool = False


def parse(outline: str, groups: Mapping[str, str]) -> Element:
    """Return the root element described by an outline, see the module.

    `groups` maps a group's name to the attributes that several elements share.
    """
    top = Element()
    stack = [top]
    for line in outline.strip().splitlines():
        kind, _, rest = line.strip().partition(":")
        words = rest.split()
        names = [n for w in words for n in (groups[w[1:]].split() if w[0] == "@" else [w])]
        element = Element(frozenset(names) - {"*", "+"}, skipped="*" in names, is_open="+" in names)
        depth = len(line) - len(line.lstrip())
        del stack[depth + 1 :]
        stack[-1].children[kind] = element
        stack.append(element)
    (root,) = top.children.values()
    return root


def unknown_parts(root: Tag, element: Element, of: str) -> tuple[str, ...]:
    """Return descriptions of the parts of a file that its format does not define.

    The parts are elements, attributes and texts. `root` is the file's root element, and `element`
    describes what the format permits in it. `of` is the name of the format, such as "URDF". The
    contents of unknown elements are not checked.
    """
    unknown: dict[str, dict[str, list[str]]] = {}  # kind of stranger -> what it is -> its places

    def note(kind: str, what: str, place: str) -> None:
        unknown.setdefault(kind, {}).setdefault(what, []).append(place)

    waiting: list[tuple[Tag, Element, str]] = [(root, element, "")]
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
        inner: list[tuple[Tag, Element, str]] = []
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
    """Each entry with its first place, and how many there are besides."""
    entries = [
        f"{what}{where[0]}" + (f" (and {len(where) - 1} more)" if len(where) > 1 else "")
        for what, where in places.items()
    ]
    return texts.listed(entries, MAX_ENTRIES)
