"""Expand `repeat = "i = 1..n"` and `theta[i]` in the tree of a scene.

Repeated entries become separate entries, and `name[index]` becomes the name followed by the number.
The arrays of tables [[body]], [[spring]], ... become tables, with the names of bodies and points as
keys, or else numbers from 1.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from eomc.base import names
from eomc.scene import formulas, hints
from eomc.scene.formulas import Formula, FormulaError, suggest
from eomc.scene.scope import Checker, Path, value_of
from eomc.scene.toml_text import ARRAYS

TABLES = (  # whose entries may be repeated
    "constants", "parameters", "coordinates", "inputs", "definitions", "forces", "constraints",
)  # fmt: skip
_PLAIN = ("definitions", "forces")  # tables with formulas as entries
_WORDS = ("unit", "note", "title", "repeat")  # keys with free text
# no formulas
_NAMED = ("body", "point", "loop")  # arrays whose entries have names
_NAMES = ("name", "parent", "joint", "coordinate", "bodies", "body", "frame")

_INDEXED = re.compile(r"(?<!\w)([A-Za-z_]\w*)\s*\[([^\[\]]*)\]", re.ASCII)
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
        for written, array_name in hints.ARRAYS.items():
            if isinstance(self.tree.get(written), (dict, list)) and array_name not in self.tree:
                entries, unknown = self.tree.pop(written), f"unknown table '{written}': "
                if not _is_array(entries):
                    self._report((written,), unknown + _array_remedy(array_name, entries))
                    continue
                self.check.report((written,), f"{unknown}write [[{array_name}]]")
                self.tree[array_name] = entries
                self.check.places.rename((written,), (array_name,))
        for table in TABLES:
            if isinstance(self.tree.get(table), dict):
                self.declared |= dict.fromkeys(self.tree[table], table)
        for table in TABLES:
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
        """Return the value of an index or bound: a formula of constants and of the index."""
        formula = _parse_index(text)
        known = {**self.constants, **index}
        for node in formula.names():
            if node.id not in known:
                raise FormulaError(self._unknown_name(node.id, index))
            if node.id not in index:
                self.check.used[node.id].append(("constants", node.id))
        value, fault = value_of(formula, known)
        if fault:
            raise FormulaError(fault)
        if not value.is_integer() or abs(value) >= 1e10:
            rule = "and an index is a whole number of at most ten digits"
            raise FormulaError(f"'{formula.shown}' is {value:g}, {rule}")
        return int(value)

    def _unknown_name(self, name: str, index: Mapping[str, int]) -> str:
        """Return why a name can't be used in an index."""
        table = self.declared.get(name)
        if table == "constants":
            return f"'{name}' has no value here: move its line above this one"
        if table:
            return (
                f"'{name}' stands in [{table}], and what is repeated is decided when the code is "
                "made: only [constants] can count"
            )
        remedy = suggest(name, [*index, *self.constants]) or ": declare it in [constants]"
        if name != "n" and len(name) == 1 and not index and remedy.startswith(":"):
            remedy += f', or add repeat = "{name} = 1..n" to the entry'
        return f"'{name}' is not known in an index{remedy}"


@lru_cache(maxsize=1_000)  # the same text in each copy of an entry
def _parse_index(text: str) -> Formula:
    formula = formulas.parse(text)
    if any(formula.calls("dot")):
        raise FormulaError("dot(...) can't be used in an index")
    return formula


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
