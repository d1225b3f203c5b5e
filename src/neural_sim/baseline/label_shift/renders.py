"""Crops of renders with known scene parameters, from a pool of all bins that is rendered once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.baseline.label_shift.crops import Crops, crops_of
from neural_sim.baseline.label_shift.mixture import Cells
from neural_sim.baseline.label_shift.network import Known
from neural_sim.synthesis.pool import PooledSubject, pool_of
from neural_sim.synthesis.scene import Scene

PIXELS = 2**24
"""Largest number of pixels of the renders in images that are composed together. What a seed draws depends on it."""


def pool_for(scene: Scene, per_bin: int, generator: torch.Generator) -> Scene:
    """Return the scene itself if its renders are pooled, otherwise a pool of renders of all its bins and lights."""
    if all(isinstance(subject, PooledSubject) for subject in scene.subjects):
        return scene
    return pool_of(scene, per_bin, generator, lights=scene.distribution.lights > 0)


def parted(pool: Scene, held_out: float) -> tuple[Scene, Scene]:
    """Divide the renders of every cell into those for training and those held out."""
    sides: tuple[list[PooledSubject], list[PooledSubject]] = ([], [])
    for subject in pool.subjects:
        assert isinstance(subject, PooledSubject)
        count = min(max(1, round(held_out * subject.per_cell)), subject.per_cell - 1)
        if count < 1:
            raise ValueError(
                f"label_shift: want at least two renders of every combination of bins, got {subject.per_cell}"
            )
        sides[0].append(subject.part(slice(count, None)))
        sides[1].append(subject.part(slice(count)))
    return replace(pool, subjects=tuple(sides[0])), replace(pool, subjects=tuple(sides[1]))


@dataclass(frozen=True)
class _Bank:
    """Backgrounds that are drawn once, then chosen and mirrored at random.

    Drawing a background takes three times as long as the rest of an image, and a classifier needs varied backgrounds
    for every bin, but not a new one for every image.
    """

    images: Float[Tensor, "n 3 height width"]

    def draw(
        self, n: int, height: int, width: int, generator: torch.Generator, device: torch.device | str = "cpu"
    ) -> Float[Tensor, "n 3 height width"]:
        """See ``Background``; only the bank's own size is available."""
        images = self.images[torch.randint(len(self.images), (n,), generator=generator)]
        for axis in (2, 3):
            mirrored = torch.rand((n, 1, 1, 1), generator=generator) < 0.5
            images = torch.where(mirrored, images.flip(axis), images)
        return images.to(device)


def with_bank(scene: Scene, backgrounds: int, generator: torch.Generator) -> Scene:
    """Return the scene with a fixed stock of ``backgrounds`` backgrounds, which are drawn now."""
    own, camera = scene.synthesizer, scene.camera
    images = own.background.draw(backgrounds, camera.height, camera.width, generator)
    return replace(scene, synthesizer=replace(own, background=_Bank(images)))


def known_crops(part: Scene, compositions: int, generator: torch.Generator, whole: bool) -> Known:
    """Compose images with all bins equally frequent, and cut out their boxes.

    Images are composed in batches (``PIXELS``) and discarded once their boxes are cut out, which bounds the memory.
    """
    distribution, subject = part.distribution, part.subjects[0]
    assert isinstance(subject, PooledSubject)
    psi = distribution.uniform_of([subject.name for subject in part.subjects])
    renders = len(part.subjects) * part.synthesizer.count.mean * part.camera.width * part.camera.height
    size = max(1, int(PIXELS / renders))
    parts: list[Known] = []
    for start in [*range(0, len(subject), size)] * compositions:
        count = min(size, len(subject) - start)
        drawn = part.training_set(psi, count, generator)
        crops = crops_of(drawn.images.to("cpu"), whole)
        place = torch.full((len(part.subjects), len(drawn)), -1)
        for label, rows in enumerate(drawn.rows):
            place[label, rows] = torch.arange(len(rows))
        index = place[crops.labels, crops.rows]
        chosen = torch.zeros(len(crops), len(distribution.binned), dtype=torch.long)
        weights = torch.zeros(len(crops), distribution.lights)
        for label, own in enumerate(drawn.objects):
            mine = crops.labels == label
            chosen[mine] = own.draw.bins[index[mine]]
            if own.draw.weights is not None:
                weights[mine] = own.draw.weights[index[mine]].float()
        cell = Cells(tuple(f.bins for f in distribution.binned)).index(chosen)
        parts.append(Known(crops, cell, weights))
    return Known(
        Crops.concatenate([p.crops for p in parts]),
        torch.cat([p.cells for p in parts]),
        torch.cat([p.weights for p in parts]),
    )
