"""From scene parameters to labelled images: pose, radiance field, composition. Every pass can be replayed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.cameras import cameras_of, orbit
from neural_sim.field.base import RadianceField
from neural_sim.parameter.product import SceneDistribution, SceneNoise
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.renderer.nerf_w import NerfWRenderer
from neural_sim.synthesis.assembly import RenderedImages, RenderedObject, Shared, one_each
from neural_sim.synthesis.draws import HARD, Draws, RelaxedDraws
from neural_sim.synthesis.layout import Layout, draw_layout, own_labels
from neural_sim.synthesis.motion import light_names, moved_by, pose_rates
from neural_sim.synthesis.training_set import Nuisance, Synthesizer
from neural_sim.types import LabelledImages, Maps, PinholeCamera, SceneDraw


class Source(Protocol):
    """Draws and renders one object alone: a :class:`Scene`, or a pool of its renders."""

    def drawn(
        self, label: int, psi: Float[Tensor, "K"], count: int, generator: torch.Generator, how: Draws, /
    ) -> RenderedObject: ...

    def probed(
        self, label: int, factor: str, per_bin: int, psi: Float[Tensor, "K"], generator: torch.Generator, /
    ) -> RenderedObject: ...


@dataclass(frozen=True)
class Scene:
    """The objects' fields, in the order of their class labels, and how their images are made. ``radii`` are the
    objects' in metres, where distances are.
    """

    names: tuple[str, ...]
    fields: tuple[RadianceField, ...]
    renderer: NerfRenderer
    camera: PinholeCamera
    synthesizer: Synthesizer
    distribution: SceneDistribution
    radii: tuple[float, ...] | None = None

    def _sized(self, label: int, draw: SceneDraw) -> SceneDraw:
        return draw if self.radii is None else replace(draw, radius=self.radii[label])

    def render(self, label: int, draw: SceneDraw, noise: SceneNoise | None = None) -> RenderedObject:
        """Object ``label`` alone at given scene parameters; no derivatives."""
        draw = self._sized(label, draw)
        maps = self._maps(label, draw)
        return RenderedObject(draw, maps.rgb, maps.opacity, noise)

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

    def drawn(
        self, label: int, psi: Float[Tensor, "K"], count: int, generator: torch.Generator, how: Draws = HARD
    ) -> RenderedObject:
        """One object alone, ``count`` times from p_psi, as the estimator wants it."""
        logits = psi.detach().to(self.dtype(label))
        if isinstance(how, RelaxedDraws):
            return self._drawn_relaxed(label, logits, count, generator, how)
        noise = how.noise(self.distribution, count, generator, self.dtype(label))
        return self.render(label, self.distribution.hard(logits, noise), noise)

    def probed(
        self, label: int, factor: str, per_bin: int, psi: Float[Tensor, "K"], generator: torch.Generator
    ) -> RenderedObject:
        """One object alone, ``per_bin`` times in every bin of a factor, in the order of its bins; all else from p_psi
        and the same in all bins. For an illumination the bins are the anchor lights.
        """
        dtype = self.dtype(label)
        draw = self.distribution.probes(factor, per_bin, psi.detach().to(dtype), generator, dtype)
        return self.render(label, draw)

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

    def _drawn_relaxed(
        self, label: int, logits: Tensor, count: int, generator: torch.Generator, relaxed: RelaxedDraws
    ) -> RenderedObject:
        noise = relaxed.noise(self.distribution, count, generator, self.dtype(label))

        def replay(psi: Tensor) -> SceneDraw:
            return self.distribution.relaxed(psi, noise)

        with torch.no_grad():
            draw = self._sized(label, replay(logits))
        names = moved_by(replay, logits) if relaxed.tangents else ()
        moving = names or draw.weights is not None
        maps, tangents = (
            self._maps_with_tangents(label, draw, names) if moving else (self._maps(label, draw), None)
        )
        return RenderedObject(draw, maps.rgb, maps.opacity, noise, relaxed, tangents)

    # --- images ---

    def training_set(
        self,
        psi: Float[Tensor, "objects K"],
        count: int,
        generator: torch.Generator,
        how: Draws = HARD,
        source: Source | None = None,
    ) -> RenderedImages:
        """``count`` images of every object, which ``source`` (None: this scene) draws and renders."""
        source, labels = source or self, range(len(self.names))
        if self.synthesizer.several:
            return self._of_several(psi, count, generator, how, source)
        objects, nuisances = [], []
        for label in labels:
            objects.append(source.drawn(label, psi[label], count, generator, how))
            nuisances.append(self._nuisance(count, generator))
        return one_each(objects, nuisances, labels, self._bins(objects), self.synthesizer)

    def _of_several(
        self,
        psi: Float[Tensor, "objects K"],
        count: int,
        generator: torch.Generator,
        how: Draws,
        source: Source,
    ) -> RenderedImages:
        classes = len(self.names)
        layout = draw_layout(own_labels([count] * classes), classes, self.synthesizer.count, generator)
        return self._around(layout, psi, generator, how, source).composed()

    def _around(
        self,
        layout: Layout,
        psi: Float[Tensor, "objects K"],
        generator: torch.Generator,
        how: Draws,
        source: Source,
        known: Mapping[int, RenderedObject] | None = None,
    ) -> Shared:
        """Images of the layout, every object from its own p_psi; of ``known`` classes there are renders already."""
        nuisance = self._nuisance(len(layout), generator, layout.labels.shape[1])
        counts = [len(layout.places(label)[0]) for label in range(len(self.names))]
        known = known or {}
        objects = [
            known[label] if label in known else source.drawn(label, psi[label], shown, generator, how)
            for label, shown in enumerate(counts)
        ]
        return Shared.of(objects, layout, nuisance, self._bins(objects), self.synthesizer)

    def probes(
        self,
        label: int,
        factor: str,
        per_bin: int,
        psi: Float[Tensor, "objects K"],
        generator: torch.Generator,
        source: Source | None = None,
    ) -> tuple[LabelledImages, SceneDraw]:
        """``per_bin`` images of every bin of a factor of one object, in the order of its bins, and the object's draws.

        All else is as in an image of the training set in which the object shows, and the same in all bins: other
        factors from p_psi, other objects from theirs, backgrounds.
        """
        source = source or self
        part = source.probed(label, factor, per_bin, psi[label], generator)
        (bins,) = self._bins([part])
        scenes = torch.arange(per_bin).repeat(len(part) // per_bin)
        if not self.synthesizer.several:
            nuisance = self._nuisance(per_bin, generator).select(scenes)
            return one_each([part], [nuisance], [label], [bins], self.synthesizer).images, part.draw
        own = torch.full((per_bin,), label)
        layout = draw_layout(own, len(self.names), self.synthesizer.count, generator, present=True)
        known = {label: part.select(torch.arange(per_bin))}
        around = self._around(layout, psi, generator, HARD, source, known)
        return around.repeated(scenes, label, part, bins).composed().images, part.draw

    def _bins(self, objects: Sequence[RenderedObject]) -> list[Int[Tensor, "m"]]:
        return [self.distribution.label_of(part.draw) for part in objects]

    def _nuisance(self, count: int, generator: torch.Generator, objects: int | None = None) -> Nuisance:
        return self.synthesizer.draw_nuisance(count, self.camera, generator, self.device(0), objects)


def _joined(parts: Sequence[Maps]) -> Maps:
    """Maps of consecutive images as one."""
    if len(parts) == 1:
        return parts[0]
    return Maps(torch.cat([part.rgb for part in parts]), torch.cat([part.opacity for part in parts]))
