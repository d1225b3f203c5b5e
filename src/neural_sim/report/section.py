"""One named section of a Markdown file, rewritten between marker comments; everything else stays as it is."""

from __future__ import annotations

from pathlib import Path


def replace_section(path: Path, name: str, markdown: str) -> None:
    """Write ``markdown`` as the section ``## name`` of the file at ``path``, which is made where there is none.

    The section stands between ``<!-- begin: name -->`` and ``<!-- end: name -->``; a new one goes to the end.

    Raises:
        ValueError: where the file has one marker without the other, out of order, or more than once.
    """
    begin, end = f"<!-- begin: {name} -->", f"<!-- end: {name} -->"
    body = markdown.rstrip().lstrip("\n")  # spaces at the beginning make a code block
    block = f"{begin}\n## {name}\n\n{body}\n\n{end}\n"
    text = path.read_text() if path.exists() else ""
    counts = text.count(begin), text.count(end)
    if counts == (0, 0):
        gap = "" if not text else "\n" if text.endswith("\n") else "\n\n"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + gap + block)
        return
    first, last = text.find(begin), text.find(end)
    if counts != (1, 1) or last < first:
        raise ValueError(
            f"{path}: section {name!r} wants one begin and one end marker in order, got {counts}"
        )
    path.write_text(text[:first] + block + text[last + len(end) :].removeprefix("\n"))
