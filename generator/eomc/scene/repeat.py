"""Expand `repeat = "i = 1..n"` and `theta[i]` in the tree of a scene.

Repeated entries become separate entries, and `name[index]` becomes the name followed by the number.
The arrays of tables [[body]], [[spring]], ... become tables, with the names of bodies and points as
keys, or else numbers from 1.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from eomc.base import names
from eomc.scene import formulas
from eomc.scene.formulas import FormulaError, suggest
from eomc.scene.scope import Checker, Path, value_of
from eomc.scene.source_map import ARRAYS

_TABLES = (
    "constants", "parameters", "coordinates", "inputs", "definitions", "forces", "constraints",
)  # fmt: skip
_PLAIN = ("definitions", "forces")  # tables with formulas as entries
_WORDS = ("unit", "note", "title", "repeat")  # keys with free text
# no formulas
_NAMED = ("body", "point", "loop")  # arrays whose entries have names
_NAMES = ("name", "parent", "joint", "coordinate", "bodies", "body", "frame")
_ARRAY_ALIASES = {
    "bodies": "body", "Body": "body", "link": "body", "links": "body", "springs": "spring",
    "Spring": "spring", "dampers": "damper", "Damper": "damper", "loops": "loop", "Loop": "loop",
    "points": "point", "Point": "point", "events": "event", "Event": "event", "Events": "event",
}  # fmt: skip

_INDEXED = re.compile(r"(?<!\w)([A-Za-z_]\w*)\s*\[([^\[\]]*)\]", re.ASCII)
_TERM = r"(?:\d+|[A-Za-z_]\w*)"
_SUM = re.compile(rf"\s*[+-]?\s*{_TERM}\s*(?:[+-]\s*{_TERM}\s*)*", re.ASCII)
_REPEAT = re.compile(r"\s*([A-Za-z_]\w*)\s*=(.*?)\.\.(.*)", re.ASCII | re.DOTALL)
_WRITTEN = 'is written repeat = "i = 1..n"'


def expand(tree: dict[str, Any], check: Checker) -> bool:
    """Expand all repeated entries and indexed names of a scene, in place.

    tree: the scene as parsed from TOML, which is changed. check: object that collects the errors.
    Returns False if there were errors that prevent further checks, else True.
    """
    return _Expansion(tree, check).run()


class _Expansion:
    """Expands the repeated entries and indexed names of one scene."""

    MAX_ENTRIES = 10_000  # produced by repetition
    MAX_TEXT = 5_000_000  # characters produced by repetition

    def __init__(self, tree: dict[str, Any], check: Checker) -> None:
        self.tree = tree
        self.check = check
        self.constants: dict[str, float] = {}  # values of constants so far
        self.declared: dict[str, str] = {}
        self.entry_count = 0
        self.characters = 0
        self.sound = True

    def run(self) -> bool:
        """Expand all entries in place; return True if there were no errors."""
        for written, array_name in _ARRAY_ALIASES.items():
            if isinstance(self.tree.get(written), (dict, list)) and array_name not in self.tree:
                entries, unknown = self.tree.pop(written), f"unknown table '{written}': "
                if not _is_array(entries):
                    self._report((written,), unknown + _array_remedy(array_name, entries))
                    continue
                self.check.report((written,), f"{unknown}write [[{array_name}]]")
                self.tree[array_name] = entries
                self.check.places.rename((written,), (array_name,))
        for table in _TABLES:
            if isinstance(self.tree.get(table), dict):
                self.declared |= dict.fromkeys(self.tree[table], table)
        for table in _TABLES:
            if isinstance(self.tree.get(table), dict):
                self.tree[table] = self._expand_table(table, self.tree[table])
        for array in ARRAYS:
            if array in self.tree:
                self.tree[array] = self._expand_array(array, self.tree[array])
        for key in ("energy", "gravity"):
            if key in self.tree:
                self.tree[key] = self._expand_once((key,), self.tree[key])
        return self.sound

    def _report(
        self, path: Path, message: str, at: FormulaError | None = None, text: str = ""
    ) -> None:
        self.sound = False
        self.check.report(path, message, at, text)

    def _expand_table(self, table: str, entries: Mapping[str, Any]) -> dict[str, Any]:
        out: dict[str, Any] = {}
        for key, value in entries.items():
            path = (table, key)
            if not (isinstance(value, dict) and "repeat" in value):
                name = self._expand_once(path, key, bare=False)
                new_entries = [(name, self._expand_once(path, value))]
            else:
                if table in _PLAIN and "value" not in value:
                    self._report(path, 'missing: add value = "..." to repeat')
                    continue
                new_entries = self._repeat_entry(path, key, value)
                if table in _PLAIN:
                    new_entries = [(name, entry["value"]) for name, entry in new_entries]
            self.check.places.repeat(path, [(table, name) for name, _ in new_entries])
            for name, entry in new_entries:
                if name in out:
                    self._report(path, f"'{name}' stands here a second time: remove one of the two")
                out[name] = entry
                if table == "constants":
                    self._store_constant(name, entry)
        return out

    def _store_constant(self, name: str, entry: Any) -> None:
        """Store a constant's value; if it has none, that is reported later."""
        value = entry.get("value") if isinstance(entry, dict) else entry
        try:
            formula = formulas.parse(value if isinstance(value, str) else repr(value))
            if all(node.id in self.constants for node in formula.names()):
                self.constants[name], _ = value_of(formula, self.constants)
        except (FormulaError, KeyError):
            return

    def _expand_array(self, array: str, entries: Any) -> dict[str, Any]:
        if not _is_array(entries):
            self._report((array,), _array_remedy(array, entries))
            return {}
        out: dict[str, Any] = {}
        places = self.check.places
        for k, entry in enumerate(entries, start=1):
            written = (array, f"#{k}")
            name = entry.get("name") if array in _NAMED else None
            shown = (array, name if isinstance(name, str) and name else str(len(out) + 1))
            places.repeat(written, [shown])
            if "repeat" in entry:
                new_entries = [e for _, e in self._repeat_entry(shown, name, entry)]
            else:
                new_entries = [self._expand_once(shown, entry)]
            labels = []
            for each in new_entries:
                label = each.get("name") if array in _NAMED else None
                if not isinstance(label, str) or not label or label in out:
                    label = str(len(out) + 1)
                out[label] = each
                labels.append((array, label))
            places.repeat(written, labels)
        return out

    def _repeat_entry(self, path: Path, key: Any, entry: dict[str, Any]) -> list[tuple[str, Any]]:
        """Expand an entry with `repeat` into (name, entry) pairs."""
        key = key if isinstance(key, str) else ""
        text = entry["repeat"]
        try:
            index, first, last = self._parse_repeat(text)
        except FormulaError as fault:
            self._report((*path, "repeat"), fault.message, fault, str(text))
            return []
        without_repeat = {k: v for k, v in entry.items() if k != "repeat"}
        out = []
        for number in range(first, last + 1):
            expanded = self._expand(path, without_repeat, {index: number})
            name = self._expand(path, key, {index: number}, bare=False)
            if expanded is None or name is None:
                return []
            out.append((name, expanded))
        if len(out) > 1 and key and out[0][0] == out[-1][0]:
            self._report(path, f"each repetition needs a name of its own: write {key}[{index}]")
            return []
        return out

    def _parse_repeat(self, text: Any) -> tuple[str, int, int]:
        """Return the index of a repetition, its first and its last value. Raises FormulaError."""
        if not isinstance(text, str):
            raise FormulaError(f'must be text, such as "i = 1..n", here {text!r:.40}')
        match, width = _REPEAT.fullmatch(text), len(text)
        if not match:
            raise FormulaError(f"'{text}' is no repetition, which {_WRITTEN}", 0, width)
        index = match[1]
        if why := self._index_fault(index):
            raise FormulaError(why, match.start(1), len(index))
        try:
            first, last = (self._index_value(match[k].strip(), {}) for k in (2, 3))
        except FormulaError as fault:
            raise FormulaError(fault.message, 0, width) from None
        if last < first - 1:
            why = f"runs from {first} to {last}, and counts up only: exchange the ends"
            raise FormulaError(why, 0, width)
        self.entry_count += last - first + 1
        if self.entry_count > self.MAX_ENTRIES:
            raise FormulaError(
                f"repetition makes {self.entry_count} entries up to here, and "
                f"{self.MAX_ENTRIES} are the most: let it end sooner",
                0,
                width,
            )
        return index, first, last

    def _index_fault(self, index: str) -> str:
        if index in self.declared:
            return f"'{index}' stands in [{self.declared[index]}] too: use another index, such as k"
        if names.fault(index) or index in ("x", "y", "z", *formulas.FUNCTIONS):
            return f"'{index}' can't be an index: use another, such as i"
        return ""

    def _expand_once(self, path: Path, value: Any, bare: bool = True) -> Any:
        """Return a value outside of repetition with its indices expanded."""
        expanded = self._expand(path, value, {}, bare)
        return value if expanded is None else expanded

    def _expand(self, path: Path, value: Any, index: Mapping[str, int], bare: bool = True) -> Any:
        """Return the value with its indices expanded; None after an error, which is reported."""
        if isinstance(value, str):
            try:
                text = self._expand_text(value, index, bare)
            except FormulaError as fault:
                self._report(path, fault.message, fault, value)
                return None
            if text != value:
                self.check.places.rewrite(text, value)
            return text
        if isinstance(value, list):
            inside = [self._expand(path, each, index, bare) for each in value]
            return None if None in inside else inside
        if isinstance(value, dict):
            out = {}
            for key, each in value.items():
                expanded = each
                if key not in _WORDS:
                    expanded = self._expand((*path, key), each, index, bare and key not in _NAMES)
                if expanded is None:
                    return None
                out[key] = expanded
            return out
        return value

    def _expand_text(self, text: str, index: Mapping[str, int], bare: bool) -> str:
        """Return a formula or name with its indices expanded. Raises FormulaError."""
        if len(text) > formulas.MAX_LENGTH or not (index or "[" in text):
            return text  # too long ones are reported later

        def replace_index(match: re.Match[str]) -> str:
            name, inside = match[1], match[2]
            at, width = match.start(), len(match[0])
            try:
                number = self._index_value(inside, index)
            except FormulaError as fault:
                raise FormulaError(fault.message, at, width) from None
            if name[-1].isdigit():
                raise FormulaError(
                    f"'{match[0]}' would be {name}{number}, as others may be: a name with an index "
                    f"can't end in a digit, {name}_[{inside}] is {name}_{number}",
                    at,
                    width,
                )
            if number < 0:
                raise FormulaError(
                    f"the index of '{match[0]}' is {number}: it can't be negative", at, width
                )
            return f"{name}{number}"

        out = _INDEXED.sub(replace_index, text)
        for name, number in index.items() if bare else ():
            shown = str(number) if number >= 0 else f"({number})"
            out = re.sub(rf"(?<![\w.]){name}(?!\w)", shown, out, flags=re.ASCII)
        self.characters += len(out) if index else 0
        if self.characters > self.MAX_TEXT:
            raise FormulaError(f"repetition makes more than {self.MAX_TEXT:,} characters of text")
        return out

    def _index_value(self, text: str, index: Mapping[str, int]) -> int:
        """Return the value of an index or bound: integers, constants and the index with + and -."""
        if not _SUM.fullmatch(text):
            raise FormulaError(
                f"'{text.strip()}' is no index: it is made of whole numbers, constants, + and -"
            )
        total = 0
        for sign, term in re.findall(rf"([+-]?)\s*({_TERM})", text, re.ASCII):
            total += self._term_value(term, index) * (-1 if sign == "-" else 1)
        return total

    def _term_value(self, term: str, index: Mapping[str, int]) -> int:
        if term.isdigit():
            if len(term) > 9:
                raise FormulaError(f"{term:.12} is too large for an index")
            return int(term)
        if term in index:
            return index[term]
        if term in self.constants:
            self.check.used[term].append(("constants", term))
            value = self.constants[term]
            if not value.is_integer() or abs(value) > 1e9:
                raise FormulaError(f"'{term}' is {value:g}, and an index is a whole number")
            return int(value)
        table = self.declared.get(term)
        if table == "constants":
            raise FormulaError(f"'{term}' has no value here: move its line above this one")
        if table:
            raise FormulaError(
                f"'{term}' stands in [{table}], and what is repeated is decided when the code is "
                "made: only [constants] can count"
            )
        near = suggest(term, [*index, *self.constants])
        remedy = ": declare it in [constants]"
        if term != "n" and len(term) == 1 and not index:
            remedy += f', or add repeat = "{term} = 1..n" to the entry'
        raise FormulaError(f"'{term}' is not known in an index{near or remedy}")


def _array_remedy(array: str, entries: Any) -> str:
    """Return the message for [array] in single brackets."""
    inner = isinstance(entries, dict) and all(isinstance(e, dict) for e in entries.values())
    named = (
        f' and name = "{next(iter(entries))}"'
        if inner and entries and array in (*_NAMED, "event")
        else ""
    )
    return f"each {array} has a table of its own: write [[{array}]]{named}"


def _is_array(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(v, dict) for v in value)
