"""A store of rendered maps per object and bin, over which training images are composed afresh.

While psi moves, the fields do not: an image of a bin is as good in the tenth iteration as in the first. Rendering every
bin once and drawing from that store leaves out most of the rendering of the psi loop; backgrounds and shifts are new in
each draw. Not for estimators that replay exact draws from psi (the pathwise ones).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.synthesis.scene import RenderedObject, Scene
from neural_sim.types import SceneDraw


@dataclass(frozen=True)
class ObjectPool:
    """``per_bin`` rendered maps of every bin of one object, bin after bin. RGBA premultiplied in 8 bits."""

    maps: Tensor
    draw: SceneDraw
    per_bin: int


@dataclass(frozen=True)
class ImagePool:
    """The pools of all objects, in the order of their labels."""

    scene: Scene
    objects: tuple[ObjectPool, ...]

    @staticmethod
    def render(scene: Scene, per_bin: int, generator: torch.Generator) -> ImagePool:
        """``per_bin`` poses of every bin of every object. Raises ``ValueError`` for fewer than one."""
        if per_bin < 1:
            raise ValueError(f"outer.pool_per_bin must be at least 1 for a pool, got {per_bin}")
        pools = []
        for label in range(len(scene.names)):
            part = scene.probes(label, per_bin, generator)
            maps = torch.cat([part.rgb, part.opacity[..., None]], -1)
            pools.append(ObjectPool((maps * 255).round().to(torch.uint8), part.draw, per_bin))
        return ImagePool(scene, tuple(pools))

    def draw(
        self, label: int, psi: Float[Tensor, "k"], count: int, generator: torch.Generator
    ) -> RenderedObject:
        """``count`` images of one object from p_psi, with replacement among each bin's poses."""
        noise = self.scene.pose.draw_noise(count, generator)
        bins = self.scene.pose.hard(psi.float(), noise).bins
        return self._compose(label, bins, generator)

    def every_bin(self, label: int, per_bin: int, generator: torch.Generator) -> RenderedObject:
        """``per_bin`` images of every bin on purpose, in the order of the bins."""
        return self._compose(label, torch.arange(self.scene.pose.bins).repeat_interleave(per_bin), generator)

    def _compose(self, label: int, bins: Tensor, generator: torch.Generator) -> RenderedObject:
        pool, scene = self.objects[label], self.scene
        within = torch.randint(pool.per_bin, bins.shape, generator=generator)
        index = bins * pool.per_bin + within
        maps = pool.maps[index.to(pool.maps.device)].float() / 255
        rgb, opacity = maps[..., :3], maps[..., 3]
        nuisance = scene.synthesizer.draw_nuisance(len(bins), scene.camera, generator)
        images = scene.synthesizer.compose(rgb, opacity, nuisance, label, bins)
        return RenderedObject(images, None, pool.draw.select(index), nuisance, rgb, opacity)
