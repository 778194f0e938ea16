"""Tables that scenes do not have, told; what stands in them is put where it is meant."""

from __future__ import annotations

from typing import Any

from eomc.scene import messages
from eomc.scene.scope import Checker


def mend(tree: dict[str, Any], check: Checker) -> None:
    """Report tables that scenes do not have, once each; take them out, or put them in place."""
    for name in [n for n, entry in tree.items() if isinstance(entry, (dict, list))]:
        if found := messages.array(name, tree[name]):
            meant, entries = found
            check.say((name,), messages.one_table(name, meant))
            check.mended |= {(meant,), *((meant, key) for key in entries)}
            del tree[name]
            there = tree.get(meant)
            tree[meant] = {**entries, **(there if isinstance(there, dict) else {})}
            check.places.rename((name,), (meant,))
        elif name in messages.TABLES:
            check.say((name,), f"there is no [{name}] in a scene: {messages.TABLES[name]}")
            del tree[name]
            if messages.TABLES[name] == messages.ENERGY:
                tree.setdefault("energy", {"kinetic": "0"})
                check.mended.add(("energy",))
