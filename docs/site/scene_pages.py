"""Text of generated parts of the site, as Markdown: scene keys, the gallery, C functions."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import eomc
from eomc.base import resources
from eomc.base.errors import EomcError
from eomc.model.system import System
from eomc.report import equations, typeset
from eomc.report.plot import write_figure
from eomc.scene import schema, value_types
from eomc.scene.schema import Key
from eomc.scene.value_types import ValueType

# --- keys of a scene ------------------------------------------------------------------------------


def describe_keys() -> str:
    """Return a section for the top of a scene and for each table, and one for types of values."""
    names = schema.keys(schema.Document)
    own = {name: key for name, key in names.items() if key.type and not key.container}
    parts = ["## Top of the file\n", *_table(schema.Document, own)]
    for name, key in names.items():
        if name in own:
            continue
        head = f"[[{name}]]" if key.container == "array" else f"[{name}]"
        parts += [f"\n## `{head}`\n", f"{key.about} {_requirement(key)}\n"]
        if key.type:
            parts.append(f"Each entry is a {key.type.name}{_in_unit(key)}.")
        else:
            parts += _table(key.table, schema.keys(key.table))
        if key.short:
            parts.append(f"\n`x = 1.0` is short for `x = {{ {key.first} = 1.0 }}`.")
    parts += ["\n## Types of values\n", "| type | a value is |", "|---|---|"]
    public = (t for name, t in vars(value_types).items() if not name.startswith("_"))
    types = {t.name: t for t in public if isinstance(t, ValueType)}
    parts += [f"| {t.name} | {t.words} |" for t in types.values()]
    return "\n".join(parts)


def _requirement(key: Key) -> str:
    if not key.missing:
        return ""
    return f"Required, unless the scene has `[[{key.unless}]]`." if key.unless else "Required."


def _in_unit(key: Key) -> str:
    return f", in {key.unit}" if key.unit else ""


def _table(model: type, keys: dict[str, Key]) -> Iterator[str]:
    defaults = {f.metadata["key"].name or f.name: f.default for f in fields(model) if f.metadata}
    yield from ("| key | type | default | unit | meaning |", "|---|---|---|---|---|")
    for name, key in keys.items():
        assert key.type
        shown = _default(key, defaults[name])
        yield f"| `{name}` | {key.type.name} | {shown} | {key.unit} | {key.about} |"


def _default(key: Key, default: object) -> str:
    if key.missing and not key.unless:
        return "required"
    if key.default_text:
        return key.default_text
    if isinstance(default, bool):
        return str(default).lower()
    if isinstance(default, str) and default:
        return f'"{default}"'
    return f"{default:g}" if isinstance(default, float) else "none"


# --- gallery --------------------------------------------------------------------------------------


def describe_scenes(modules: Path, pictures: Path) -> str:
    """Return a section for each scene that comes with eomc.

    modules: folder for built modules. pictures: folder for pictures of the site, made if needed.
    """
    pictures.mkdir(parents=True, exist_ok=True)
    return "\n".join(
        describe_scene(file, modules, pictures / f"{name}.svg")
        for name, file in resources.scenes().items()
    )


def describe_scene(file: Path, modules: Path, picture: Path) -> str:
    """Return the section of a scene; its picture is drawn if the scene is newer."""
    system = eomc.read(file)
    if not picture.exists() or picture.stat().st_mtime < file.stat().st_mtime:
        write_figure(system, eomc.load(file, modules).simulate(), picture)
    commands = f"eomc run scenes/{file.name} --plot {picture.name}\neomc show scenes/{file.name}"
    source = f"../_images/gallery/{picture.name}"
    image = f'<p><img src="{source}" alt="Motion of the scene {system.name}"></p>'
    scene = file.read_text(encoding="utf-8").rstrip()
    return f"""
## {system.title}

{system.note}

{_html(image)}

{_html(_equations(system))}

```sh
{commands}
```

{_html(f"<details><summary><code>scenes/{file.name}</code></summary>")}

```toml
{scene}
```

{_html("</details>")}
"""


def _html(text: str) -> str:
    return f"```{{raw}} html\n{text}\n```"


def _equations(system: System) -> str:
    """Return the equations of motion as HTML, or a sentence if they are too long."""
    try:
        lines = typeset.write_mathml(equations.derive(system).set_out.groups[0])
    except EomcError:
        return f"<p>The equations are long: <code>eomc show scenes/{system.name}.toml</code>.</p>"
    return "\n".join(f'<p class="formula">{formula}</p>' for _, formula in lines)


# --- C --------------------------------------------------------------------------------------------

# a comment, and the prototype that it describes
PROTOTYPE = re.compile(r"/\*((?:[^*]|\*(?!/))*)\*/\n((?:\w+ )+\*?(\w+)\([^;]*\));")


def describe_c_functions(file: Path) -> str:
    """Return the functions of the header of a scene with their comments, and the whole header."""
    scene = eomc.read(file)
    header = eomc.sources(scene).files[f"{scene.name}.h"]
    parts = ["## Functions\n"]
    for comment, prototype, _ in PROTOTYPE.findall(header):
        words = " ".join(line.strip().removeprefix("* ").strip("*") for line in comment.split("\n"))
        signature = " ".join(prototype.split())
        parts.append(f"```{{c:function}} {signature}\n\n{_escaped(words.strip())}\n```\n")
    parts.append(f"## The whole header\n\n```c\n{header}```")
    return "\n".join(parts)


def _escaped(words: str) -> str:
    return re.sub(r"([*_`\[\]<>$|])", r"\\\1", words)
