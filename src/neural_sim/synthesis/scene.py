"""From scene parameters to labelled images: draw, render and compose subjects. Every pass can be replayed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.parameter.product import HARD, Draws, SceneDistribution
from neural_sim.synthesis.assembly import RenderedImages, RenderedObject, Shared, one_each
from neural_sim.synthesis.layout import Layout, draw_layout, own_labels
from neural_sim.synthesis.subjects import FieldSubject, RenderedSubject, Subject
from neural_sim.synthesis.synthesizer import Nuisance, Synthesizer
from neural_sim.types import LabelledImages, PinholeCamera, SceneDraw

CHUNK = 64
"""Number of images of one object that are rendered and composed together, which bounds the memory. It is not a setting,
because what a seed draws depends on it."""


@dataclass(frozen=True)
class Scene:
    """Objects, and how labelled images of them are made.

    Args:
        subjects: the objects, in the order of their class labels.
        camera: camera of the images.
        synthesizer: composes subjects with each other and with a background.
        distribution: p_psi, from which scene parameters are drawn.

    Raises:
        ValueError: distances are in metres, and a subject's size is unknown or the camera would enter it.
    """

    subjects: tuple[Subject, ...]
    camera: PinholeCamera
    synthesizer: Synthesizer
    distribution: SceneDistribution

    def __post_init__(self) -> None:
        able = [subject for subject in self.subjects if isinstance(subject, RenderedSubject)]
        self.distribution.radii({subject.name: subject.radius for subject in able})

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the objects, in the order of their class labels."""
        return tuple(subject.name for subject in self.subjects)

    @property
    def radii(self) -> tuple[float, ...]:
        """The objects' radii in the unit of distances; 1 if that is the radius, or if an object has only pictures."""
        metres = self.distribution.distance_unit == "metres"
        return tuple(
            subject.radius if metres and isinstance(subject, RenderedSubject) and subject.radius else 1.0
            for subject in self.subjects
        )

    @property
    def device(self) -> torch.device:
        """Device of the images."""
        return self.subjects[0].device

    @property
    def rendered(self) -> tuple[RenderedSubject, ...]:
        """The subjects, all of which can be rendered from every pose.

        Raises:
            ValueError: a subject has only pictures.
        """
        return tuple(_able(subject) for subject in self.subjects)

    @property
    def fields(self) -> tuple[FieldSubject, ...]:
        """The subjects, all of which are fields.

        Raises:
            ValueError: a subject is not a field.
        """
        found = tuple(subject for subject in self.subjects if isinstance(subject, FieldSubject))
        if len(found) < len(self.subjects):
            others = [subject.name for subject in self.subjects if not isinstance(subject, FieldSubject)]
            raise ValueError(f"scene: want fields, got other subjects for {others}")
        return found

    # --- one object alone ---

    def render(self, label: int, draw: SceneDraw) -> RenderedObject:
        """Render object ``label`` alone at given scene parameters, without derivatives.

        Raises:
            ValueError: the object has only pictures.
        """
        return _able(self.subjects[label]).render(self.camera, self.distribution, draw)

    def draw(
        self, label: int, psi: Float[Tensor, "K"], count: int, generator: torch.Generator, how: Draws = HARD
    ) -> RenderedObject:
        """Draw object ``label`` alone ``count`` times from p_psi, in the way that an estimator needs."""
        return self.subjects[label].draw(self.camera, self.distribution, psi, count, generator, how)

    # --- images ---

    def training_set(
        self,
        psi: Float[Tensor, "objects K"],
        count: int,
        generator: torch.Generator,
        how: Draws = HARD,
    ) -> RenderedImages:
        """Draw ``count`` images of every object from p_psi."""
        if self.synthesizer.several:
            return self._of_several(psi, count, generator, how)
        objects, nuisances = [], []
        for label in range(len(self.subjects)):
            objects.append(self.draw(label, psi[label], count, generator, how))
            nuisances.append(self._nuisance(count, generator))
        return one_each(objects, nuisances, range(len(self.subjects)), self.synthesizer)

    def _of_several(
        self, psi: Float[Tensor, "objects K"], count: int, generator: torch.Generator, how: Draws
    ) -> RenderedImages:
        classes = len(self.subjects)
        layout = draw_layout(own_labels([count] * classes), classes, self.synthesizer.count, generator)
        return self._around(layout, psi, generator, how).composed()

    def _around(
        self,
        layout: Layout,
        psi: Float[Tensor, "objects K"],
        generator: torch.Generator,
        how: Draws,
        known: Mapping[int, RenderedObject] | None = None,
    ) -> Shared:
        """Draw images of the layout, every object from its own p_psi, except classes with ``known`` renders."""
        nuisance = self._nuisance(len(layout), generator, layout.labels.shape[1])
        known = known or {}
        objects = [
            known[label]
            if label in known
            else self.draw(label, psi[label], len(layout.places(label)[0]), generator, how)
            for label in range(len(self.subjects))
        ]
        return Shared.of(objects, layout, nuisance, self.synthesizer)

    def images(
        self, draws: Sequence[SceneDraw], generator: torch.Generator, layout: Layout | None = None
    ) -> LabelledImages:
        """Render images at given scene parameters, without derivatives.

        Args:
            draws: scene parameters of every object's images.
            generator: source of backgrounds and of whatever else p_psi does not determine.
            layout: which objects share an image; an object's draws then belong to the images that show it, in their
                order. None: one object in each image, object by object.

        Raises:
            ValueError: the number of draws differs from that of the objects, or is zero.
        """
        if len(draws) != len(self.subjects) or not draws:
            raise ValueError(
                f"scene: want one draw per object, got {len(draws)} draws for {len(self.subjects)} objects"
            )
        if layout is not None:
            nuisance = self._nuisance(len(layout), generator, layout.labels.shape[1])
            objects = [self.render(label, draw) for label, draw in enumerate(draws)]
            return Shared.of(objects, layout, nuisance, self.synthesizer).composed().images
        parts = []
        for label, draw in enumerate(draws):
            for start in range(0, len(draw), CHUNK):
                part = self.render(label, draw.select(slice(start, start + CHUNK)))
                nuisance = self._nuisance(len(part), generator)
                parts.append(one_each([part], [nuisance], [label], self.synthesizer).images)
        return LabelledImages.concatenate(parts)

    def probes(
        self,
        label: int,
        factor: str,
        per_bin: int,
        psi: Float[Tensor, "objects K"],
        generator: torch.Generator,
    ) -> tuple[LabelledImages, SceneDraw]:
        """Draw ``per_bin`` images of every bin of a factor of one object, in the order of its bins.

        Everything else is as in a training image that shows the object, and is the same in all bins: its other factors
        come from its p_psi, other objects from theirs, with the same backgrounds.

        Returns:
            The images, and the object's scene parameters in each.
        """
        subject, synthesizer = self.subjects[label], self.synthesizer
        part = subject.probe(self.camera, self.distribution, factor, per_bin, psi[label], generator)
        scenes = torch.arange(per_bin).repeat(len(part) // per_bin)
        if not synthesizer.several:
            nuisance = self._nuisance(per_bin, generator).select(scenes)
            return one_each([part], [nuisance], [label], synthesizer).images, part.draw
        own = torch.full((per_bin,), label)
        layout = draw_layout(own, len(self.subjects), synthesizer.count, generator, present=True)
        known = {label: part.select(torch.arange(per_bin))}
        around = self._around(layout, psi, generator, HARD, known)
        return around.repeated(scenes, label, part).composed().images, part.draw

    def _nuisance(self, count: int, generator: torch.Generator, objects: int | None = None) -> Nuisance:
        return self.synthesizer.draw_nuisance(count, self.camera, generator, self.device, objects)


def _able(subject: Subject) -> RenderedSubject:
    if not isinstance(subject, RenderedSubject):
        raise ValueError(
            f"{subject.name}: has only stored pictures, cannot be rendered at given scene parameters"
        )
    return subject
