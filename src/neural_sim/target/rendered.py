"""The target set of a controlled experiment: the objects themselves, rendered at the target distribution."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor
from typing_extensions import override

from neural_sim.cameras import cameras_of, orbit
from neural_sim.parameter.product import SceneDistribution
from neural_sim.randomness import stream
from neural_sim.ranges import NonNegativeInt, PositiveInt, validated
from neural_sim.renderer.lighting import Lighting
from neural_sim.renderer.rig import LightRig
from neural_sim.renderer.subject import Subject
from neural_sim.synthesis.assembly import RenderedObject, Shared
from neural_sim.synthesis.layout import Layout, draw_layout, own_labels
from neural_sim.synthesis.training_set import Synthesizer, images_without_boxes
from neural_sim.target.base import Target
from neural_sim.types import LabelledImages, PinholeCamera, SceneDraw

_log = logging.getLogger(__name__)

# Views rendered and composed together, which bounds the memory. Part of what a seed means, so not a setting.
CHUNK = 64


@validated
@dataclass(frozen=True)
class RenderedTarget(Target):
    """Images rendered at the target distribution, each part with random numbers of its own.

    Args:
        val_per_object: images of each object to learn psi on.
        test_per_object: images of each object to score.
        test_per_biased_object: the same for objects that some parameter's ``biased`` names, whose scores are compared.
        train_per_object: images that stand for labelled photographs in training (``training.real``); 0: none do.
    """

    renders: ClassVar[bool] = True
    val_per_object: PositiveInt = 50
    test_per_object: PositiveInt = 100
    test_per_biased_object: PositiveInt = 200
    train_per_object: NonNegativeInt = 0

    @property
    @override
    def trains(self) -> bool:
        return self.train_per_object > 0

    @override
    def sets(
        self,
        objects: Mapping[str, Subject],
        distribution: SceneDistribution,
        camera: PinholeCamera,
        synthesizer: Synthesizer,
        seed: int,
        rig: LightRig | None = None,
    ) -> dict[str, LabelledImages]:
        biased, target = set(distribution.biased), distribution.psi("target", list(objects)).float()
        radii = distribution.radii({name: item.radius for name, item in objects.items()})
        parts = {}
        for name in ("val", "test", "train") if self.trains else ("val", "test"):
            generator = stream(seed, f"target {name}")
            counts = [self._count(name, item.name in biased) for item in objects.values()]
            layout = None
            if synthesizer.several:
                layout = draw_layout(own_labels(counts), len(objects), synthesizer.count, generator)
                counts = [len(layout.places(label)[0]) for label in range(len(objects))]
            draws = []
            for label, (count, psi) in enumerate(zip(counts, target, strict=True)):
                drawn = distribution.hard(psi, distribution.draw_noise(count, generator))
                draws.append(drawn if radii is None else replace(drawn, radius=radii[label]))
            items = list(objects.values())
            parts[name] = render_target(items, draws, camera, synthesizer, generator, rig, layout)
        return parts

    def _count(self, part: str, biased: bool) -> int:
        """Return the number of an object's images; with several objects an image, of those drawn for this one."""
        if part != "test":
            return self.val_per_object if part == "val" else self.train_per_object
        return self.test_per_biased_object if biased else self.test_per_object


def render_target(
    objects: Sequence[Subject],
    draws: Sequence[SceneDraw],
    camera: PinholeCamera,
    synthesizer: Synthesizer,
    generator: torch.Generator,
    rig: LightRig | None = None,
    layout: Layout | None = None,
) -> LabelledImages:
    """Images of every object at its draw, object by object; labels are positions in ``objects``.

    With a ``layout`` the images are its own, of several objects each; an object's draws are those of the images that
    show it, in their order. Draws that weigh lights weigh those of ``rig``. Float32 on the CPU. Images without a box
    are counted in the log.

    Raises:
        ValueError: another number of draws than of objects, or none.
    """
    if len(objects) != len(draws) or not objects:
        raise ValueError(
            f"render_target: want one draw per object, got {len(draws)} draws for {len(objects)} objects"
        )
    if layout is None:
        images = _one_each(objects, draws, camera, synthesizer, generator, rig)
    else:
        images = _of_several(objects, draws, camera, synthesizer, generator, rig, layout)
    missing = images_without_boxes(images)
    if missing:
        _log.info("target: %d of %d rendered images hold no box", missing, len(images))
    return images


def _one_each(
    objects: Sequence[Subject],
    draws: Sequence[SceneDraw],
    camera: PinholeCamera,
    synthesizer: Synthesizer,
    generator: torch.Generator,
    rig: LightRig | None,
) -> LabelledImages:
    parts = []
    for label, (item, draw) in enumerate(zip(objects, draws, strict=True)):
        for start in range(0, len(draw), CHUNK):
            here = draw.select(slice(start, start + CHUNK))
            rgb, opacity = _premultiplied(item, camera, here, rig)
            nuisance = synthesizer.draw_nuisance(len(here), camera, generator)
            parts.append(synthesizer.compose(rgb, opacity, nuisance, label, _label(here)))
    return LabelledImages.concatenate(parts)


def _of_several(
    objects: Sequence[Subject],
    draws: Sequence[SceneDraw],
    camera: PinholeCamera,
    synthesizer: Synthesizer,
    generator: torch.Generator,
    rig: LightRig | None,
    layout: Layout,
) -> LabelledImages:
    nuisance = synthesizer.draw_nuisance(len(layout), camera, generator, objects=layout.labels.shape[1])
    rendered = [
        RenderedObject(draw, *_premultiplied(item, camera, draw, rig))
        for item, draw in zip(objects, draws, strict=True)
    ]
    bins = [_label(draw) for draw in draws]
    return Shared.of(rendered, layout, nuisance, bins, synthesizer).composed().images


def _label(draw: SceneDraw) -> Int[Tensor, "n"]:
    """The first binned factor's bin, -1 where nothing is binned."""
    return draw.bins[:, 0] if draw.bins.shape[1] else torch.full((len(draw),), -1)


def _lighting(draw: SceneDraw, rig: LightRig | None) -> Lighting | None:
    """The light of an object's images, which they share; None: the renderer's own."""
    if draw.weights is None:
        return None
    if rig is None or bool((draw.weights != draw.weights[0]).any()):
        raise ValueError("render_target: want a rig and one light for all of an object's images")
    return rig.lighting(draw.weights[0])


def _premultiplied(
    item: Subject,
    camera: PinholeCamera,
    draw: SceneDraw,
    rig: LightRig | None,
) -> tuple[Float[Tensor, "n h w 3"], Float[Tensor, "n h w"]]:
    with torch.no_grad():
        poses = orbit(draw.phi, draw.rho, draw.distance, radius=draw.radius)
        lighting = _lighting(draw, rig)
        taken = cameras_of(camera, draw.magnification)
        rgba = torch.cat([item.render(own, poses[rows], lighting) for own, rows in taken])
    return rgba[..., :3] * rgba[..., 3:], rgba[..., 3]
