"""Fill pages when the site is built: all keys and commands, all tables that the pages shorten; a hook of mkdocs."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "src"))

from neural_sim.commandline import Key, Layout  # noqa: E402
from neural_sim.documents import markdown_table  # noqa: E402
from neural_sim.guide import VERBS  # noqa: E402

OTHERS = ("experiment", "hydra", "variant")
"""Groups whose files set keys of others, and so have none of their own."""


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Replace what stands between the marks by tables of keys; add tables to the pages that are short of them."""
    if page.file.src_uri == "experiments.md":
        return markdown + experiments()
    if page.file.src_uri == "numerics.md":
        return markdown + numerics()
    return _filled(_filled(markdown, "keys", tables), "commands", commands)


def _filled(markdown: str, name: str, text: Callable[[], str]) -> str:
    before, begin, rest = markdown.partition(f"<!-- {name} -->")
    return before + text() + rest.partition(f"<!-- end of {name} -->")[2] if begin else markdown


def commands() -> str:
    """Return the table of commands."""
    rows = [[f"`{name}`", verb.says, f"`{' '.join(verb.words)}`" if verb.words else "the default"]
            for name, verb in VERBS.items()]  # fmt: skip
    return markdown_table(["command", "what it does", "it stands for"], rows)


def tables() -> str:
    """Return every key with its default and comment, by its first part."""
    layout = Layout((ROOT / "conf",))
    parts: dict[str, list[list[str]]] = {}
    for key, places in layout.keys.items():
        for at in _own(places, layout):
            part = key.partition(".")[0] if "." in key or not at.value else "run"
            shown = f"`{at.value}`" if at.value else ""
            if shown or at.comment:
                parts.setdefault(part, []).append([f"`{key}`", shown, at.comment, at.choice])
    head = ["key", "default", "", "of"]
    return "\n\n".join(f"### {part}\n\n{markdown_table(head, rows)}" for part, rows in parts.items())


def _own(places: list[Key], layout: Layout) -> Iterator[Key]:
    """Yield where a key is described: in config.yaml or a default choice, else in every choice that has it."""
    known = [at for at in places if not at.choice.startswith(tuple(f"{name}=" for name in OTHERS))]
    default = {"", *(f"{group}={chosen.value}" for group, chosen in layout.defaults.items())}
    first = next((at for at in known if at.choice in default), None)
    yield from [first] if first else known


def experiments() -> str:
    """Return what ``experiments.json`` has of each experiment: settings, tables and costs."""
    rows = json.loads((ROOT / "docs" / "experiments.json").read_text(encoding="utf-8"))["rows"]
    parts = ["\n## Tables"]
    for name, row in rows.items():
        cells = [entry["cells"] for entry in row["entries"]]
        head = list(dict.fromkeys(column for each in cells for column in each))
        settings = markdown_table(head, [[each.get(c, "") for c in head] for each in cells]) if cells else ""
        texts = [text for text in (settings, row["text"], row.get("costs", "")) if text]
        parts += [f"### {name.replace('_', ' ')}", *texts]
    return "\n\n".join(parts)


def numerics() -> str:
    """Return every setting that ``numerics.json`` has of each family."""
    held = json.loads((ROOT / "docs" / "numerics.json").read_text(encoding="utf-8"))
    return "\n\n".join(["\n## Tables", *(f"### {family}\n\n{text}" for family, text in held.items())])
