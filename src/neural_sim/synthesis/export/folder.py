"""The folder of an exported data set: what it is of, what is done already, and one process at a time in it."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neural_sim.synthesis.export.files import remove_parts, write_json, write_whole
from neural_sim.synthesis.export.records import FILE, line_of, read_records

MANIFEST = "manifest.json"
LONGEST = 60
"""Characters of a value in a message."""


@dataclass(frozen=True)
class ExportFolder:
    """Images of one ``identity`` (all that they depend on but their number), which can be continued and extended."""

    root: Path
    identity: Mapping[str, Any]

    @contextmanager
    def opened(self) -> Iterator[dict[int, dict[str, Any]]]:
        """The records of the images that are there, in a folder that is ready for more.

        Raises:
            ValueError: a folder of something else, or of images with another identity; the message names the first
                difference.
        """
        self.check()
        path = self.root / MANIFEST
        if not path.is_file():
            write_json(path, {"identity": dict(self.identity), "images": []})
        remove_parts(self.root)
        yield read_records(self.root)

    def add(self, record: Mapping[str, Any]) -> None:
        """Remember an image whose files are written."""
        path = self.root / FILE
        try:
            with path.open("a", encoding="utf-8") as stream:
                stream.write(line_of(record))
        except OSError as error:
            raise ValueError(f"export.folder: {path} cannot be written: {error.strerror or error}") from error

    def finish(self, records: Sequence[Mapping[str, Any]]) -> None:
        """The manifest with every image: its file and hash, and its objects' parameters and poses. The records get in
        order, which they are not where an image was made again.
        """
        write_whole(self.root / FILE, "".join(line_of(record) for record in records))
        images = [
            {
                **{key: record[key] for key in ("number", "file", "sha256", "camera")},
                "objects": [
                    {"label": item["label"], "visibility": item["visibility"], **item["pose"]}
                    for item in record["objects"]
                ],
            }
            for record in records
        ]
        write_json(self.root / MANIFEST, {"identity": dict(self.identity), "images": images})

    def check(self) -> None:
        """Raises what :meth:`opened` raises, and writes nothing."""
        path = self.root / MANIFEST
        if self.root.exists() and not self.root.is_dir():
            raise ValueError(f"export.folder: {self.root} is a file, want a folder")
        if not path.is_file():
            if self.root.is_dir() and any(self.root.iterdir()):
                raise ValueError(
                    f"export.folder: {self.root} has files and no {MANIFEST}; want a new folder, or that of an export"
                )
            return
        try:
            known = json.loads(path.read_text(encoding="utf-8"))["identity"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"export.folder: {path} is no manifest of an export ({error!r}); want another folder"
            ) from error
        different = first_difference(known, json.loads(json.dumps(self.identity)))
        if different is not None:
            key, before, now = different
            raise ValueError(
                f"export.folder: the images of {self.root} were made with {key}={before}, now it is {now}; want the "
                "same settings, or another folder"
            )


def first_difference(before: Any, now: Any, key: str = "") -> tuple[str, str, str] | None:
    """The first key, with dots, at which two JSON trees differ, and both values, shortened; None for equal trees."""
    if isinstance(before, dict) and isinstance(now, dict):
        for name in [*before, *(name for name in now if name not in before)]:
            inner = f"{key}.{name}" if key else name
            found = first_difference(before.get(name), now.get(name), inner)
            if found is not None:
                return found
        return None
    return None if before == now else (key, _short(before), _short(now))


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."
