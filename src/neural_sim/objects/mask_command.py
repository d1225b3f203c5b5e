"""Masks from another program, which reads a folder of photographs and writes their masks to another folder."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.masks import read_mask
from neural_sim.objects.pictures import refuse_size
from neural_sim.pictures import picture_files, read_picture

PLACES = ("{images}", "{masks}")
KEY = "objects.mask_command"


@dataclass(frozen=True)
class MaskCommand:
    """A command line that writes masks, such as ``rembg p -om {images} {masks}``.

    ``{images}`` stands for a folder of photographs, as PNG without EXIF, and ``{masks}`` for an empty folder. The
    name of a mask begins with that of its photograph, without the suffix. The line is not run by a shell.

    Raises:
        ValueError: the line lacks one of the two folders, or the program is not installed.
    """

    command: str

    def __post_init__(self) -> None:
        missing = [place for place in PLACES if place not in self.command]
        if missing:
            raise ValueError(
                f"{KEY}: want {' and '.join(PLACES)} in it, got {self.command!r} without {missing[0]}"
            )
        program = self._words("", "")[0]
        if shutil.which(program) is None:
            raise ValueError(f"{KEY}: no such program: {program}")

    def masks(self, images: Sequence[Path], value: int | None = None) -> tuple[Float[Tensor, "_ _"], ...]:
        """Return the program's mask of each photograph; in label images, the object's pixels have ``value``.

        Raises:
            ValueError: the program cannot be run or fails, a photograph has no mask, or a mask cannot be read.
        """
        with tempfile.TemporaryDirectory(prefix="neural-sim-") as place:
            given, made = Path(place) / "images", Path(place) / "masks"
            given.mkdir()
            made.mkdir()
            for number, image in enumerate(images):
                read_picture(image, upright=False).convert("RGB").save(
                    given / f"{number:05d}.png", compress_level=1
                )
            self._run(given, made)
            written = picture_files(made)
            return tuple(self._mask(number, image, written, value) for number, image in enumerate(images))

    def _words(self, images: str, masks: str) -> list[str]:
        try:
            words = shlex.split(self.command)
        except ValueError as error:
            raise ValueError(f"{KEY}: {error}, got {self.command!r}") from error
        return [word.replace(PLACES[0], images).replace(PLACES[1], masks) for word in words]

    def _run(self, images: Path, masks: Path) -> None:
        words = self._words(str(images), str(masks))
        try:
            done = subprocess.run(words, capture_output=True, text=True, errors="replace", check=False)
        except OSError as error:
            raise ValueError(f"{KEY}: {words[0]} cannot be run: {error.strerror}") from error
        if done.returncode:
            said = [line for line in (done.stderr + done.stdout).splitlines() if line.strip()]
            last = said[-1].strip() if said else "no output"
            raise ValueError(f"{KEY}: {self.command!r} ended with status {done.returncode}: {last}")

    def _mask(
        self, number: int, image: Path, written: Sequence[Path], value: int | None
    ) -> Float[Tensor, "_ _"]:
        own = [path for path in written if path.name.startswith(f"{number:05d}")]
        if len(own) != 1:
            raise ValueError(
                f"{KEY}: {self.command!r} wrote {len(own)} masks named {number:05d}*, want one, for {image}; "
                f"it wrote {len(written)} pictures in all"
            )
        mask = read_mask(own[0], value)
        refuse_size(own[0], (mask.shape[1], mask.shape[0]), image, read_picture(image, upright=False).size)
        return torch.from_numpy(mask)
