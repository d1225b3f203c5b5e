"""The stages of one experiment and how they hang together."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.baseline.base import HypergradientLoop
from neural_sim.detector.real import Real
from neural_sim.detector.training import Training
from neural_sim.devices import device_of
from neural_sim.objects.photos import Photos
from neural_sim.outer.records import IterationRecord, LearnedPsi
from neural_sim.stages.captures import Captures, PhotoViewsStage
from neural_sim.stages.detector import DetectorStage, PhotographsStage, TrainedStage
from neural_sim.stages.evaluate import ScoresStage
from neural_sim.stages.experiment import Experiment
from neural_sim.stages.field import FieldStage
from neural_sim.stages.masks import MasksStage
from neural_sim.stages.meshes import Meshes, Objects
from neural_sim.stages.other_images import ViewsDetectorStage, trained_on
from neural_sim.stages.psi import HypergradientParts, PsiStage
from neural_sim.stages.scene import SceneStage
from neural_sim.stages.symmetry import SymmetryStage
from neural_sim.stages.target_sets import TargetSetsStage
from neural_sim.stages.views import ViewsStage
from neural_sim.types import PinholeCamera

Psi = Float[Tensor, "objects K"]


@dataclass(frozen=True)
class Graph:
    """Stages by what they give. ``on_record`` is told of every iteration of the psi loop as it ends.

    Raises:
        ValueError: objects that a setting names and the source lacks.
    """

    experiment: Experiment
    on_record: Callable[[IterationRecord], object] | None = None

    def __post_init__(self) -> None:
        imaging, loop = self.experiment.imaging, self.experiment.loop
        unknown = {*imaging.distribution.biased, *(loop.outer.learned or ())} - set(self.names)
        if unknown:
            raise ValueError(
                f"biased or outer.learned names {sorted(unknown)}, objects are {list(self.names)}"
            )
        real = self.experiment.training.real
        if real.used and not imaging.target.trains:
            raise ValueError(
                f"training.real.mode={real.mode} wants labelled photographs: set target.train_fraction (of a target of "
                "photographs) or target.train_per_object (of a rendered one)"
            )

    @cached_property
    def objects(self) -> Objects:
        source, views = self.experiment.imaging.objects, self.experiment.imaging.views
        return (
            Captures(source)
            if isinstance(source, Photos)
            else Meshes(source, views.backend, views.supersample)
        )

    def _seen_as(self, *fields: FieldStage) -> tuple[FieldStage, ...]:
        """The fields, where objects have no meshes."""
        return fields if isinstance(self.objects, Captures) else ()

    @property
    def names(self) -> tuple[str, ...]:
        """Of the objects, in the order of their class labels."""
        return self.objects.names

    @cached_property
    def device(self) -> torch.device:
        return device_of(self.experiment.run.accelerator)

    @property
    def camera(self) -> PinholeCamera:
        """Of synthesised and of rendered target images."""
        return self.experiment.imaging.camera

    @cached_property
    def radii(self) -> tuple[float, ...] | None:
        """Of the objects in metres, where distances are; objects are not read where these are in radii."""
        distribution = self.experiment.imaging.distribution
        return None if distribution.distance_unit == "radii" else distribution.radii(self.objects.radii)

    # --- images ---

    @cached_property
    def views(self) -> tuple[ViewsStage, ...]:
        digests, settings = self.objects.digests, self.experiment.imaging.views
        if not isinstance(self.objects, Captures):
            return tuple(ViewsStage(name, digests[name], settings, self.objects) for name in self.names)
        source = self.objects.source
        return tuple(
            PhotoViewsStage(
                name,
                digests[name],
                settings,
                self.objects,
                MasksStage.of(source, name, digests[name]),
                source.poses,
            )
            for name in self.names
        )

    @cached_property
    def fields(self) -> tuple[FieldStage, ...]:
        recipe = self.experiment.imaging.field
        return tuple(FieldStage(views, recipe, self.device) for views in self.views)

    @cached_property
    def scene(self) -> SceneStage:
        imaging = self.experiment.imaging
        return SceneStage(
            self.names, self.fields, imaging.renderer, self.camera, imaging.synthesis,
            imaging.distribution.drawn, self.radii, imaging.distribution,
        )  # fmt: skip

    @cached_property
    def targets(self) -> TargetSetsStage:
        imaging = self.experiment.imaging
        rendered = self.fields if self.renders_target else ()
        return TargetSetsStage(
            imaging.target, self.objects.digests, imaging.distribution, imaging.synthesis, self.camera,
            imaging.views.rig, self.experiment.run.seed, self._seen_as(*rendered), self.objects,
        )  # fmt: skip

    @property
    def renders_target(self) -> bool:
        """Whether the target's images are rendered; otherwise they are photographs."""
        return self.experiment.imaging.target.renders

    def symmetry(self, name: str, angle: str) -> SymmetryStage:
        """Of an object's bins of an angle."""
        imaging = self.experiment.imaging
        camera = imaging.views.camera(48)
        fields = self._seen_as(self.fields[self.names.index(name)])
        return SymmetryStage(
            name, self.objects.digests[name], angle, imaging.distribution, camera, fields, self.objects
        )

    # --- psi and detectors ---

    def psi(self, which: Literal["initial", "target"]) -> Psi:
        """The configured psi of all objects."""
        return self.experiment.imaging.distribution.psi(which, list(self.names))

    @property
    def target_psi(self) -> Psi | None:
        """The target's psi; None where its images are photographs and no configured distribution says what they show:
        uniform, the default, would then be nobody's statement.
        """
        known = self.renders_target or self.experiment.imaging.distribution.states_target
        return self.psi("target") if known else None

    def stated_psi(self, which: Literal["initial", "target"], key: str) -> Psi:
        """The initial psi or the target's, which ``key`` of the configuration asks for.

        Raises:
            ValueError: the target's is not known.
        """
        psi = self.psi("initial") if which == "initial" else self.target_psi
        if psi is None:
            raise ValueError(
                f"{key}=target: no distribution of the target is known, because its images are photographs and no "
                "parameter.*.target says what they show"
            )
        return psi

    @cached_property
    def warm_start(self) -> DetectorStage:
        """The detector whose backbone the psi loop trains on, and that some methods begin with. Of the initial
        distribution, with equal epochs, and unless scored detectors are fine-tuned, it is also scored as ``ns``.
        """
        x = self.experiment
        if x.training.warm_start == "initial":
            return self.of_initial
        return self._detector(self._uniform, x.training.warm_epochs, "warm_start", "the uniform distribution")

    @cached_property
    def of_initial(self) -> DetectorStage:
        """A detector of the initial distribution, trained as the warm start is."""
        epochs = self.experiment.training.warm_epochs
        return self._detector(self.psi("initial"), epochs, "warm_start", "the initial distribution")

    @property
    def _uniform(self) -> Psi:
        return self.experiment.imaging.distribution.uniform.expand_as(self.psi("initial"))

    @cached_property
    def _training(self) -> Training:
        """As in the keys of detectors, which say by psi what they are trained on, whatever the warm start is of, and
        how many photographs train, whatever was asked for, where the target knows how many it has.
        """
        x, real = self.experiment, self.experiment.training.real
        if real.used and (count := x.imaging.target.training_count(x.run.seed)) is not None:
            real = real.of(count)
        return replace(x.training, warm_start="initial", real=real)

    def _detector(
        self, psi: Psi, epochs: int, phase: str, called: str, photographs: bool = True
    ) -> DetectorStage:
        """A detector trained on a distribution, and on photographs where the training combines both."""
        x, training = self.experiment, self._training
        combined = photographs and training.real.combined
        if not combined:  # so that its key is that of a run without photographs
            training = replace(training, real=Real())
        probabilities = x.imaging.distribution.digest_of(psi)
        return DetectorStage(
            self.scene, x.detector, training, epochs, probabilities, x.run.seed, psi, phase, called, self.device,
            self.targets if combined else None,
        )  # fmt: skip

    def _on_photographs(self, start: DetectorStage | None) -> PhotographsStage:
        """A detector trained on photographs, in as many steps as one on images, or fine-tuned on them."""
        x, training, real = self.experiment, self._training, self._training.real
        steps = -(-training.images_per_object * len(self.names) // training.batch_size)
        epochs = training.cold_epochs
        if start is None:  # the same for all modes
            own = Real("combined", real.count, real.fraction, fewer=real.fewer)
            training = replace(training, real=own)
        else:
            epochs, steps = 1, max(1, round(real.finetune * steps * epochs))
        return PhotographsStage(
            start, self.targets, self.camera, self.names, x.detector, training, epochs, steps, x.run.seed, self.device
        )  # fmt: skip

    def _on_views(self) -> DetectorStage:
        """A detector trained on the views that the fields are fitted to."""
        uniform = self.synthetic(self._uniform, "the fields' own views")
        return trained_on(uniform, ViewsDetectorStage, views=self.views)

    @cached_property
    def learned(self) -> PsiStage:
        """The method's psi."""
        x = self.experiment
        follows = isinstance(x.loop.method, HypergradientLoop)
        parts = HypergradientParts(x.loop.gradient, x.loop.solver) if follows else None
        return PsiStage(
            self.warm_start, self.targets, x.imaging.distribution, x.loop.method, parts, x.loop.outer,
            self.psi("initial"), x.run.seed, x.run.progress, self.on_record,
        )  # fmt: skip

    # --- scores ---

    def synthetic(self, psi: Psi, called: str) -> DetectorStage:
        """The detector of a distribution, trained without photographs."""
        return self._detector(
            psi, self.experiment.training.cold_epochs, "evaluate", called, photographs=False
        )

    def trained_on(self, psi: Psi, called: str) -> TrainedStage:
        """The detector that is scored for a distribution, trained or fine-tuned on photographs as ``training.real``
        says.
        """
        real = self.experiment.training.real
        if real.used and real.mode == "pretrain":
            return self._on_photographs(self.synthetic(psi, called))
        return self._detector(psi, self.experiment.training.cold_epochs, "evaluate", called)

    def scores(self, psi: Psi, called: str, part: Literal["val", "test"] = "test") -> ScoresStage:
        """Of the detector trained on a distribution."""
        return ScoresStage(self.trained_on(psi, called), self.targets, part)

    def compared(self, learned: LearnedPsi) -> dict[str, ScoresStage]:
        """The scores that a run reports: of the initial distribution (``ns``), the learned one, and the target's own
        (``matched``) where that is known; where photographs train too, also without them (``synthetic_only``, of the
        learned distribution), on them alone (``real_only``), and on the fields' own views (``views_only``).
        """
        psis = {"ns": self.psi("initial"), "learned": learned.last, "matched": self.target_psi}
        rows = {called: self.scores(psi, called) for called, psi in psis.items() if psi is not None}
        if self.experiment.training.real.used:
            rows["synthetic_only"] = ScoresStage(self.synthetic(learned.last, "learned"), self.targets)
            rows["real_only"] = ScoresStage(self._on_photographs(None), self.targets)
            rows["views_only"] = ScoresStage(self._on_views(), self.targets)
        return rows

    def on_the_way(self, learned: LearnedPsi) -> dict[int, Psi]:
        """Psi by iterations done: at the start, after the parts of all iterations in ``score_at``, at the end."""
        last = len(learned.trajectory) - 1
        asked = {0, last, *(math.floor(part * last + 0.5) for part in self.experiment.run.score_at)}
        return {iteration: learned.trajectory[iteration] for iteration in sorted(asked)}

    def validation(self, learned: LearnedPsi) -> ScoresStage:
        """Return the validation scores of the detector that is scored as ``learned``."""
        return self.scores(learned.last, "learned", "val")

    def evaluated(self, learned: LearnedPsi) -> list[ScoresStage]:
        """Return all scores that a run makes."""
        on_the_way = [
            self.scores(psi, f"psi after {i} iterations") for i, psi in self.on_the_way(learned).items()
        ]
        return [*self.compared(learned).values(), *on_the_way, self.validation(learned)]
