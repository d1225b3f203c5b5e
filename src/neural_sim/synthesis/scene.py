"""From scene parameters to labelled images: pose, radiance field, composition. Every pass can be replayed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.cameras import cameras_of, orbit
from neural_sim.field.base import RadianceField
from neural_sim.parameter.factor import Relaxation
from neural_sim.parameter.product import SceneDistribution, SceneNoise
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.renderer.nerf_w import NerfWRenderer
from neural_sim.synthesis.motion import light_names, moved_by, pose_rates
from neural_sim.synthesis.training_set import Nuisance, Synthesizer
from neural_sim.types import LabelledImages, Maps, PinholeCamera, SceneDraw


@dataclass(frozen=True)
class RelaxedDraws:
    """How images for the pathwise estimator are drawn.

    ``relaxation`` and ``conditional_draws`` (of ``gumbel_rao``): see :meth:`BinnedFactor.relaxed`. ``antithetic``:
    Gumbel noise in pairs from u and 1 - u. ``common_backgrounds``: the images of a pair share background and shift.
    ``tangents``: also render the maps' derivatives by the numbers that depend on psi.
    """

    relaxation: Relaxation = "gumbel_softmax"
    conditional_draws: int = 8
    antithetic: bool = False
    common_backgrounds: bool = False
    tangents: bool = False

    @property
    def group(self) -> int:
        """How many consecutive images share randomness."""
        return 2 if self.antithetic or self.common_backgrounds else 1

    def noise(
        self, distribution: SceneDistribution, count: int, generator: torch.Generator, dtype: torch.dtype
    ) -> SceneNoise:
        """Raises ``ValueError`` for a count that does not divide into pairs where pairs are asked for."""
        if count % self.group:
            raise ValueError(
                "gradient.antithetic and gradient.common_backgrounds pair images: want an even "
                f"outer.images_per_object, got {count}"
            )
        conditional = self.conditional_draws if self.relaxation == "gumbel_rao" else 0
        return distribution.draw_noise(count, generator, dtype, self.antithetic, conditional)


@dataclass(frozen=True)
class HardDraws:
    """Exact samples of p_psi. ``explore``: lights around psi's, for estimators that need a density."""

    explore: bool = False


Draws = HardDraws | RelaxedDraws
HARD = HardDraws()


@dataclass(frozen=True)
class RenderedObject:
    """One object's images, with the ``noise`` and ``nuisance`` that reproduce them.

    ``noise`` is None for images from a pool or of probes, ``relaxed`` for hard draws. ``tangents``, if rendered, are
    the maps' derivatives by the named numbers of the draw.
    """

    images: LabelledImages
    noise: SceneNoise | None
    draw: SceneDraw
    nuisance: Nuisance
    rgb: Float[Tensor, "n h w 3"]
    opacity: Float[Tensor, "n h w"]
    relaxed: RelaxedDraws | None = None
    tangents: Mapping[str, Maps] | None = None


@dataclass(frozen=True)
class Scene:
    """The objects' fields, in the order of their class labels, and how their images are made. ``radii`` are the
    objects' in metres, where distances are."""

    names: tuple[str, ...]
    fields: tuple[RadianceField, ...]
    renderer: NerfRenderer
    camera: PinholeCamera
    synthesizer: Synthesizer
    distribution: SceneDistribution
    radii: tuple[float, ...] | None = None

    def _sized(self, label: int, draw: SceneDraw) -> SceneDraw:
        return draw if self.radii is None else replace(draw, radius=self.radii[label])

    def render(
        self, label: int, draw: SceneDraw, noise: SceneNoise, generator: torch.Generator
    ) -> RenderedObject:
        """Images of object ``label`` at given scene parameters, over fresh backgrounds; no derivatives."""
        draw = self._sized(label, draw)
        maps = self._maps(label, draw)
        nuisance = self._nuisance(label, len(draw), generator)
        return self._compose(label, draw, noise, maps, nuisance)

    @torch.no_grad()
    def _maps(self, label: int, draw: SceneDraw) -> Maps:
        """Premultiplied colour and opacity at given scene parameters."""
        poses, field = self._poses(label, draw), self.fields[label]

        def rendered(camera: PinholeCamera, rows: slice) -> tuple[Tensor, Tensor]:
            if draw.weights is None:
                return self.renderer.render(field, camera, poses[rows])
            return self.lit_renderer.render(field, camera, poses[rows], weights=draw.weights[rows])

        return _joined(
            [Maps(*rendered(camera, rows)) for camera, rows in cameras_of(self.camera, draw.magnification)]
        )

    @property
    def lit_renderer(self) -> NerfWRenderer:
        """The renderer. Raises ``ValueError`` for one without lights."""
        if not isinstance(self.renderer, NerfWRenderer):
            raise ValueError(
                f"parameter=illumination wants renderer=nerf_w, got {type(self.renderer).__name__}"
            )
        return self.renderer

    def _compose(
        self, label: int, draw: SceneDraw, noise: SceneNoise | None, maps: Maps, nuisance: Nuisance
    ) -> RenderedObject:
        bins = self.distribution.label_of(draw)
        with torch.no_grad():
            images = self.synthesizer.compose(maps.rgb, maps.opacity, nuisance, label, bins)
        return RenderedObject(images, noise, draw, nuisance, maps.rgb, maps.opacity)

    def dtype(self, label: int) -> torch.dtype:
        """The type of an object's field and images."""
        return next(self.fields[label].parameters()).dtype

    def device(self, label: int) -> torch.device:
        """The device of an object's field and images; draws are on the CPU."""
        return next(self.fields[label].parameters()).device

    def _poses(self, label: int, draw: SceneDraw) -> Float[Tensor, "n 4 4"]:
        return orbit(draw.phi, draw.rho, draw.distance, radius=draw.radius).to(
            self.device(label), self.dtype(label)
        )

    def _nuisance(self, label: int, count: int, generator: torch.Generator) -> Nuisance:
        return self.synthesizer.draw_nuisance(count, self.camera, generator, self.device(label))

    def draw(
        self,
        label: int,
        psi: Float[Tensor, "K"],
        count: int,
        generator: torch.Generator,
        how: Draws = HARD,
    ) -> RenderedObject:
        """``count`` images of one object from p_psi, as the estimator wants them."""
        logits = psi.detach().to(self.dtype(label))
        if isinstance(how, RelaxedDraws):
            return self._draw_relaxed(label, logits, count, generator, how)
        noise = self.distribution.draw_noise(count, generator, self.dtype(label), explore=how.explore)
        draw = self.distribution.hard(logits, noise)
        return self.render(label, draw, noise, generator)

    def _maps_with_tangents(
        self, label: int, draw: SceneDraw, names: tuple[str, ...]
    ) -> tuple[Maps, dict[str, Maps]]:
        """The maps, and their derivatives by the named numbers of the draw and by every weight of a light."""
        poses, field = self._poses(label, draw), self.fields[label]
        rates = pose_rates(draw, names).to(poses) if names else poses.new_zeros(0, *poses.shape)
        lights = 0 if draw.weights is None else draw.weights.shape[1]
        weight_rates = torch.eye(lights, dtype=poses.dtype)[:, None].expand(-1, len(draw), -1)

        def rendered(camera: PinholeCamera, rows: slice) -> list[Maps]:
            if draw.weights is None:
                maps, moved = self.renderer.render_with_tangents(field, camera, poses[rows], rates[:, rows])
            else:
                maps, moved = self.lit_renderer.render_with_tangents(
                    field, camera, poses[rows], rates[:, rows],
                    weights=draw.weights[rows], weight_rates=weight_rates[:, rows],
                )  # fmt: skip
            return [maps, *moved]

        each = [rendered(camera, rows) for camera, rows in cameras_of(self.camera, draw.magnification)]
        maps, *moved = (_joined(parts) for parts in zip(*each, strict=True))
        return maps, dict(zip((*names, *light_names(lights)), moved, strict=True))

    def _draw_relaxed(
        self, label: int, logits: Tensor, count: int, generator: torch.Generator, relaxed: RelaxedDraws
    ) -> RenderedObject:
        noise = relaxed.noise(self.distribution, count, generator, self.dtype(label))

        def replay(psi: Tensor) -> SceneDraw:
            return self.distribution.relaxed(psi, noise, relaxed.relaxation)

        with torch.no_grad():
            draw = self._sized(label, replay(logits))
        names = moved_by(replay, logits) if relaxed.tangents else ()
        moving = names or draw.weights is not None
        maps, tangents = (
            self._maps_with_tangents(label, draw, names) if moving else (self._maps(label, draw), None)
        )
        group = 2 if relaxed.common_backgrounds else 1
        nuisance = self._nuisance(label, count // group, generator)
        if group > 1:
            nuisance = nuisance.select(torch.arange(count) // group)
        rendered = self._compose(label, draw, noise, maps, nuisance)
        return replace(rendered, relaxed=relaxed, tangents=tangents)

    def training_set(
        self,
        psi: Float[Tensor, "objects K"],
        count: int,
        generator: torch.Generator,
        how: Draws = HARD,
    ) -> list[RenderedObject]:
        """``count`` images of every object."""
        return [self.draw(label, psi[label], count, generator, how) for label in range(len(self.names))]

    def probes(
        self, label: int, factor: str, per_bin: int, psi: Float[Tensor, "K"], generator: torch.Generator
    ) -> RenderedObject:
        """``per_bin`` images of every bin of a factor, in the order of its bins; other factors from p_psi.

        For an illumination the bins are the anchor lights, all with the same ``per_bin`` poses and backgrounds.
        """
        dtype = self.dtype(label)
        draw, scenes = self.distribution.probes(factor, per_bin, psi.detach().to(dtype), generator, dtype)
        draw = self._sized(label, draw)
        nuisance = self._nuisance(label, int(scenes.max()) + 1, generator).select(scenes)
        return self._compose(label, draw, None, self._maps(label, draw), nuisance)


def _joined(parts: Sequence[Maps]) -> Maps:
    """Maps of consecutive images as one."""
    if len(parts) == 1:
        return parts[0]
    return Maps(torch.cat([part.rgb for part in parts]), torch.cat([part.opacity for part in parts]))


def join(parts: Sequence[RenderedObject]) -> LabelledImages:
    """All objects' images as one set, object by object."""
    return LabelledImages.concatenate([part.images for part in parts])
