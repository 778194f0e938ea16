"""Report tables that scenes do not have, and move their entries into the intended tables."""

from __future__ import annotations

from typing import Any

from eomc.scene import messages
from eomc.scene.scope import Checker


def repair(tree: dict[str, Any], check: Checker) -> None:
    """Report unknown tables that newcomers often write, and remove them from the tree of a scene.

    If an unknown table probably stands for a valid one, its entries are moved to the valid table,
    so that they can be checked. check: object that collects the errors.
    """
    for name in [n for n, entry in tree.items() if isinstance(entry, (dict, list))]:
        if match := messages.merge_array(name, tree[name]):
            table, entries = match
            check.report((name,), messages.one_table_message(name, table))
            check.repaired |= {(table,), *((table, key) for key in entries)}
            del tree[name]
            existing = tree.get(table)
            tree[table] = {**entries, **(existing if isinstance(existing, dict) else {})}
            check.places.rename((name,), (table,))
        elif name in messages.TABLES:
            check.report((name,), f"there is no [{name}] in a scene: {messages.TABLES[name]}")
            del tree[name]
            if messages.TABLES[name] == messages.ENERGY:
                tree.setdefault("energy", {"kinetic": "0"})
                check.repaired.add(("energy",))
