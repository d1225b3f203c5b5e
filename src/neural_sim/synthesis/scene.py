"""From scene parameters to labelled images: pose, radiance field, composition. Every pass can be replayed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.cameras import orbit
from neural_sim.field.base import RadianceField
from neural_sim.parameter.pose import Pose, PoseNoise
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.synthesis.motion import moved_by, pose_rates
from neural_sim.synthesis.training_set import Nuisance, Synthesizer
from neural_sim.types import LabelledImages, Maps, PinholeCamera, SceneDraw


@dataclass(frozen=True)
class RelaxedDraws:
    """How images are drawn that the pathwise estimator will differentiate.

    ``tangents``: the maps' derivatives by the numbers that psi moves ride along with the render.
    """

    tangents: bool = False


@dataclass(frozen=True)
class RenderedObject:
    """One object's images with all that made them: replaying ``noise`` and ``nuisance`` gives them again.

    ``noise`` is None for images that were not drawn from psi afresh, ``relaxed`` for hard draws. ``tangents``, where the
    render carried them, are the maps' derivatives by the named numbers of the draw.
    """

    images: LabelledImages
    noise: PoseNoise | None
    draw: SceneDraw
    nuisance: Nuisance
    rgb: Float[Tensor, "n h w 3"]
    opacity: Float[Tensor, "n h w"]
    relaxed: RelaxedDraws | None = None
    tangents: Mapping[str, Maps] | None = None


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
        poses = orbit(draw.phi, draw.rho, draw.distance).to(self.dtype(label))
        rgb, opacity = self.renderer.render(self.fields[label], self.camera, poses)
        return self._compose(label, draw, noise, Maps(rgb, opacity), generator)

    def _compose(
        self, label: int, draw: SceneDraw, noise: PoseNoise, maps: Maps, generator: torch.Generator
    ) -> RenderedObject:
        with torch.no_grad():
            nuisance = self.synthesizer.draw_nuisance(len(draw), self.camera, generator)
            images = self.synthesizer.compose(maps.rgb, maps.opacity, nuisance, label, self.pose.bin_of(draw))
        return RenderedObject(images, noise, draw, nuisance, maps.rgb, maps.opacity)

    def dtype(self, label: int) -> torch.dtype:
        """That of an object's field, in which its images are made."""
        return next(self.fields[label].parameters()).dtype

    def draw(
        self,
        label: int,
        psi: Float[Tensor, "k"],
        count: int,
        generator: torch.Generator,
        relaxed: RelaxedDraws | None = None,
    ) -> RenderedObject:
        """``count`` images of one object from p_psi: hard samples, or the paper's relaxed ones."""
        noise = self.pose.draw_noise(count, generator, self.dtype(label))
        logits = psi.detach().to(self.dtype(label))
        if relaxed is None:
            return self.render(label, self.pose.hard(logits, noise), noise, generator)
        with torch.no_grad():
            draw = self.pose.relaxed(logits, noise)
        names = moved_by(lambda leaf: self.pose.relaxed(leaf, noise), logits) if relaxed.tangents else ()
        if not names:
            return replace(self.render(label, draw, noise, generator), relaxed=relaxed)
        poses, rates = orbit(draw.phi, draw.rho, draw.distance), pose_rates(draw, names)
        maps, moved = self.renderer.render_with_tangents(self.fields[label], self.camera, poses, rates)
        made = self._compose(label, draw, noise, maps, generator)
        return replace(made, relaxed=relaxed, tangents=dict(zip(names, moved, strict=True)))

    def training_set(
        self,
        psi: Float[Tensor, "objects k"],
        count: int,
        generator: torch.Generator,
        relaxed: RelaxedDraws | None = None,
    ) -> list[RenderedObject]:
        """``count`` images of every object."""
        return [self.draw(label, psi[label], count, generator, relaxed) for label in range(len(self.names))]

    def probes(self, label: int, per_bin: int, generator: torch.Generator) -> RenderedObject:
        """``per_bin`` images from every bin on purpose, in the order of the bins."""
        bins = torch.arange(self.pose.bins).repeat_interleave(per_bin)
        noise = self.pose.draw_noise(len(bins), generator, self.dtype(label))
        return self.render(label, self.pose.at_bins(bins, noise), noise, generator)


def join(parts: Sequence[RenderedObject]) -> LabelledImages:
    """All objects' images as one set, object by object."""
    return LabelledImages.concatenate([part.images for part in parts])
