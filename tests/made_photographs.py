"""Made photographs in one folder per class."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf
from PIL import Image

from neural_sim.configuration import conf_directory
from neural_sim.objects.procedural import Procedural


def photographs_by_class(root: Path, names: Sequence[str] = (), count: int = 8) -> Path:
    """``count`` photographs of each of these classes, the embedded objects' unless they are given: noise with a block
    of the class's colour."""
    random = np.random.default_rng(5)
    for number, name in enumerate(names or Procedural().names()):
        colour = random.integers(40, 255, 3, np.uint8)
        (root / name).mkdir(parents=True)
        for photo in range(count):
            picture = random.integers(0, 255, (60, 80, 3), np.uint8)
            left, top = (int(v) for v in random.integers(4, 28, 2))
            picture[top : top + 26, left : left + 30 + number] = colour
            Image.fromarray(picture).save(root / name / f"{photo:04d}.png")
    return root


def objectnet(root: Path) -> Path:
    """Photographs of the folders that the experiment of that name lists, and of another."""
    classes = OmegaConf.load(conf_directory() / "experiment" / "objectnet.yaml").target.classes
    return photographs_by_class(root, [*classes, "squeegee"])
