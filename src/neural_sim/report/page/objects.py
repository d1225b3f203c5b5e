"""objects.html, which shows the quality of fields: scores, held-out views next to renders of them, and every bin."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from neural_sim.documents import write_whole
from neural_sim.field.quality import POOR, Quality
from neural_sim.parameter.coverage import Coverage
from neural_sim.report.page import render
from neural_sim.report.page.pictures import picture

FILE = "objects.html"


@dataclass(frozen=True)
class ShownObject:
    """An object on the page.

    Args:
        name: name of the object.
        quality: scores and pictures of its field.
        real: whether its views are photographs.
        coverage: coverage of its bins by photographs, by factor; empty if all sides are known.
    """

    name: str
    quality: Quality
    real: bool
    coverage: Mapping[str, Coverage]

    @property
    def verdict(self) -> str:
        """A line that says how well the field shows the object."""
        psnr, of = self.quality.psnr, "photographs" if self.real else "views"
        if psnr is None:
            return f"not scored: no {of} are held out"
        word = "" if psnr >= POOR else f": unusable, want {POOR:g} dB"
        similar = "" if self.quality.ssim is None else f", SSIM {self.quality.ssim:.2f}"
        return f"{psnr:.1f} dB{similar} on the object in held-out {of}{word}"

    @property
    def poor(self) -> bool:
        """Whether the field does not show its object."""
        return self.quality.psnr is not None and self.quality.psnr < POOR

    @property
    def rows(self) -> list[list[str]]:
        """Held-out views as sources of images: the photograph, the view, its mask, the field's render."""
        parts = [list(part) for part in self.quality.views]
        columns = [list(self.quality.photographs), *parts] if self.quality.photographs else parts
        return [[picture(image) for image in row] for row in zip(*columns, strict=True)]

    def tiles(self) -> Iterator[tuple[str, list[tuple[str, str, bool]]]]:
        """Yield every factor with its bins: the picture, its caption, and whether photographs leave it uncovered."""
        for factor, images in self.quality.bins.items():
            known = self.coverage.get(factor)
            tiles = []
            for number, image in enumerate(images):
                open_ = known is None or known.covered[number]
                said = "" if known is None else f": {known.fractions[number]:.0%} seen"
                tiles.append((picture(image), f"{factor} {number + 1}{said}", not open_))
            yield factor, tiles


def write_objects_page(experiment: str, objects: Sequence[ShownObject], folder: Path) -> Path:
    """Write objects.html."""
    path = folder / FILE
    text = render.page("objects.html", title=f"{experiment}: objects", objects=objects, least=POOR)
    return write_whole(path, text)
