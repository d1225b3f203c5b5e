"""From scene parameters to labelled images: pose, radiance field, composition. Every pass can be replayed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.cameras import orbit
from neural_sim.field.base import RadianceField
from neural_sim.parameter.pose import Pose, PoseNoise
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.synthesis.training_set import Nuisance, Synthesizer
from neural_sim.types import LabelledImages, PinholeCamera, SceneDraw


@dataclass(frozen=True)
class RenderedObject:
    """One object's images with all that made them: replaying ``noise`` and ``nuisance`` gives them again.

    ``noise`` is None for images that were not drawn from psi afresh.
    """

    images: LabelledImages
    noise: PoseNoise | None
    draw: SceneDraw
    nuisance: Nuisance
    rgb: Float[Tensor, "n h w 3"]
    opacity: Float[Tensor, "n h w"]


@dataclass(frozen=True)
class Scene:
    """The objects' fields, in the order of their class labels, and how their images are made."""

    names: tuple[str, ...]
    fields: tuple[RadianceField, ...]
    renderer: NerfRenderer
    camera: PinholeCamera
    synthesizer: Synthesizer
    pose: Pose

    def render(
        self, label: int, draw: SceneDraw, noise: PoseNoise, generator: torch.Generator
    ) -> RenderedObject:
        """Images of object ``label`` at given scene parameters, over fresh backgrounds; no derivatives."""
        with torch.no_grad():
            poses = orbit(draw.phi, draw.rho, draw.distance).float()
            rgb, opacity = self.renderer.render(self.fields[label], self.camera, poses)
            nuisance = self.synthesizer.draw_nuisance(len(draw), self.camera, generator)
            images = self.synthesizer.compose(rgb, opacity, nuisance, label, self.pose.bin_of(draw))
        return RenderedObject(images, noise, draw, nuisance, rgb, opacity)

    def draw(
        self,
        label: int,
        psi: Float[Tensor, "k"],
        count: int,
        generator: torch.Generator,
        relaxed: bool = False,
    ) -> RenderedObject:
        """``count`` images of one object from p_psi: hard samples, or the paper's relaxed ones."""
        noise = self.pose.draw_noise(count, generator)
        with torch.no_grad():
            sample = self.pose.relaxed if relaxed else self.pose.hard
            scene_draw = sample(psi.float(), noise)
        return self.render(label, scene_draw, noise, generator)

    def training_set(
        self, psi: Float[Tensor, "objects k"], count: int, generator: torch.Generator, relaxed: bool = False
    ) -> list[RenderedObject]:
        """``count`` images of every object."""
        return [self.draw(label, psi[label], count, generator, relaxed) for label in range(len(self.names))]

    def probes(self, label: int, per_bin: int, generator: torch.Generator) -> RenderedObject:
        """``per_bin`` images from every bin on purpose, in the order of the bins."""
        bins = torch.arange(self.pose.bins).repeat_interleave(per_bin)
        noise = self.pose.draw_noise(len(bins), generator)
        return self.render(label, self.pose.at_bins(bins, noise), noise, generator)


def join(parts: Sequence[RenderedObject]) -> LabelledImages:
    """All objects' images as one set, object by object."""
    return LabelledImages.concatenate([part.images for part in parts])
