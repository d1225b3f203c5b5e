"""Stages that make the images of an experiment: views, fields, the scene and target sets; and the configured psi."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.devices import device_of
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.stages.experiment import Experiment
from neural_sim.stages.field import FieldStage
from neural_sim.stages.quality import QualityStage
from neural_sim.stages.scene import FieldSubjectStage, SceneStage
from neural_sim.stages.symmetry import SymmetryStage
from neural_sim.stages.target_sets import TargetSetsStage
from neural_sim.stages.views import Objects, ViewsStage
from neural_sim.types import PinholeCamera

Psi = Float[Tensor, "objects K"]
THUMBNAIL = 96
"""Side in pixels of the picture of a bin."""


@dataclass(frozen=True)
class Images:
    """The stages of an experiment that make images, and the configured distributions.

    Raises:
        ValueError: a setting names an object that the source lacks.
    """

    experiment: Experiment

    def __post_init__(self) -> None:
        imaging, loop = self.experiment.imaging, self.experiment.loop
        unknown = {*imaging.distribution.biased, *(loop.outer.learned or ())} - set(self.names)
        if unknown:
            raise ValueError(
                f"parameter.*.biased or outer.learned: want some of {list(self.names)}, got {sorted(unknown)}"
            )

    @cached_property
    def objects(self) -> Objects:
        """The objects."""
        return Objects.of(self.experiment.imaging.objects, self.experiment.imaging.views)

    @property
    def names(self) -> tuple[str, ...]:
        """The objects' names, in the order of their class labels."""
        return self.objects.names

    @cached_property
    def device(self) -> torch.device:
        """The device of fields and detectors."""
        return device_of(self.experiment.run.accelerator)

    @property
    def camera(self) -> PinholeCamera:
        """The camera of synthesised images and of rendered target images."""
        return self.experiment.imaging.camera

    @cached_property
    def radii(self) -> tuple[float, ...] | None:
        """The radii of the objects in metres; None if distances are in radii, since objects need not be read then."""
        distribution = self.experiment.imaging.distribution
        return None if distribution.distance_unit == "radii" else distribution.radii(self.objects.radii)

    @cached_property
    def views(self) -> tuple[ViewsStage, ...]:
        """Every object's views."""
        settings = self.experiment.imaging.views
        return tuple(self.objects.stage(name, settings) for name in self.names)

    @cached_property
    def fields(self) -> tuple[FieldStage, ...]:
        """Every object's field."""
        recipe = self.experiment.imaging.field
        return tuple(FieldStage(views, recipe, self.device) for views in self.views)

    @cached_property
    def qualities(self) -> tuple[QualityStage, ...]:
        """Scores and pictures of every object's field."""
        imaging, radii = self.experiment.imaging, self.radii or (None,) * len(self.fields)
        camera, distribution = imaging.views.camera(THUMBNAIL), imaging.distribution
        return tuple(
            QualityStage(field, imaging.renderer, radius, camera, distribution.drawn, distribution)
            for field, radius in zip(self.fields, radii, strict=True)
        )

    @cached_property
    def scene(self) -> SceneStage:
        """The scene that training images are synthesised from."""
        imaging = self.experiment.imaging
        return SceneStage(
            self.subjects(self.fields, imaging.renderer), self.camera, imaging.synthesis,
            imaging.distribution.drawn, imaging.distribution,
        )  # fmt: skip

    def subjects(
        self, fields: tuple[FieldStage, ...], renderer: NerfRenderer
    ) -> tuple[FieldSubjectStage, ...]:
        """Return the subjects of the scene for given fields."""
        radii = self.radii or (None,) * len(fields)
        return tuple(
            FieldSubjectStage(field, renderer, radius) for field, radius in zip(fields, radii, strict=True)
        )

    @cached_property
    def targets(self) -> TargetSetsStage:
        """The target sets."""
        imaging = self.experiment.imaging
        rendered = self.fields if self.renders_target else ()
        return TargetSetsStage(
            imaging.target, self.objects.digests, imaging.distribution, imaging.synthesis, self.camera,
            imaging.views.rig, self.experiment.run.seed, self._in_place_of_meshes(*rendered), self.objects,
        )  # fmt: skip

    @property
    def renders_target(self) -> bool:
        """True if target images are rendered; otherwise they are photographs."""
        return self.experiment.imaging.target.renders

    def symmetry(self, name: str, angle: str) -> SymmetryStage:
        """Return the groups of bins of an angle in which an object looks the same."""
        imaging = self.experiment.imaging
        camera = imaging.views.camera(48)
        fields = self._in_place_of_meshes(self.fields[self.names.index(name)])
        return SymmetryStage(
            name, self.objects.digests[name], angle, imaging.distribution, camera, fields, self.objects
        )

    def _in_place_of_meshes(self, *fields: FieldStage) -> tuple[FieldStage, ...]:
        return () if self.objects.has_meshes else fields

    def psi(self, which: Literal["initial", "target"]) -> Psi:
        """Return the configured psi of all objects."""
        return self.experiment.imaging.distribution.psi(which, list(self.names))

    @property
    def uniform(self) -> Psi:
        """The psi with equal probabilities for all bins that are not left out."""
        return self.experiment.imaging.distribution.uniform_of(self.names)

    @property
    def target_psi(self) -> Psi | None:
        """The target's psi, None if unknown.

        For photographs it is known only if a target distribution is configured explicitly; the default, uniform, says
        nothing about them.
        """
        known = self.renders_target or self.experiment.imaging.distribution.states_target
        return self.psi("target") if known else None

    def stated_psi(self, which: Literal["initial", "target"], key: str) -> Psi:
        """Return the initial psi or the target's; ``key`` is the configuration key that asks for it.

        Raises:
            ValueError: the target's psi is unknown.
        """
        psi = self.psi("initial") if which == "initial" else self.target_psi
        if psi is None:
            raise ValueError(
                f"{key}=target: the target's distribution is unknown, because its images are photographs and no "
                "parameter.*.target says what they show"
            )
        return psi
