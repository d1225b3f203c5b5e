"""Fill the page of keys from ``conf/`` when the site is built; a hook of mkdocs."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "src"))

from neural_sim.commandline import Key, Layout  # noqa: E402
from neural_sim.documents import markdown_table  # noqa: E402

BEGIN, END = "<!-- keys -->", "<!-- end of keys -->"
OTHERS = ("experiment", "hydra", "variant")
"""Groups whose files set keys of others, and so have none of their own."""


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace what stands between the marks by a table of keys for each part of the configuration."""
    before, begin, rest = markdown.partition(BEGIN)
    return before + tables() + rest.partition(END)[2] if begin else markdown


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
