"""A target from outside the package: photographs and boxes in a table, one box a line."""

import csv
from dataclasses import dataclass
from pathlib import Path

import torch

from neural_sim.target.base import AnnotatedPhotographs
from neural_sim.target.photographs import Photograph


@dataclass(frozen=True)
class Table(AnnotatedPhotographs):
    table: str

    def __post_init__(self):
        if not self.source.is_file():
            raise ValueError(f"target.table: no such file: {self.source}")

    @property
    def source(self):
        return Path(self.table).expanduser()

    def _lines(self):
        """The lines of each photograph: file, class, x0, y0, x1, y1 in pixels."""
        by_file = {}
        with self.source.open(newline="") as file:
            for line in csv.DictReader(file):
                by_file.setdefault(line["file"], []).append(line)
        return dict(list(by_file.items())[: self.limit])

    def files(self):
        return {"": self.source, **{name: self.source.parent / name for name in self._lines()}}

    def photographs(self, objects, distribution=None):
        return [
            Photograph(
                self.source.parent / name,
                torch.tensor([objects.index(line["class"]) for line in lines]),
                torch.tensor([[float(line[key]) for key in ("x0", "y0", "x1", "y1")] for line in lines]),
                name=name,
                group=name,
            )
            for name, lines in self._lines().items()
        ]
