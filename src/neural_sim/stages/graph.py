"""The graph of an experiment's stages."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

from neural_sim.baseline.base import HypergradientLoop
from neural_sim.baseline.label_shift.settings import LabelShift
from neural_sim.detector.real import Real
from neural_sim.detector.training import Training
from neural_sim.outer.records import IterationRecord, LearnedPsi
from neural_sim.stages.detector import DetectorStage, PhotographsStage, TrainedStage
from neural_sim.stages.evaluate import ScoresStage
from neural_sim.stages.images import Images, Psi
from neural_sim.stages.pool import PoolStage
from neural_sim.stages.psi import HypergradientParts, PsiStage
from neural_sim.stages.scene import PictureSubjectStage
from neural_sim.stages.shown import ShownStage
from neural_sim.stages.symmetry import SymmetryStage


@dataclass(frozen=True)
class Graph(Images):
    """The stages of an experiment: images, and the detectors, psi and scores made from them.

    Args:
        experiment: the experiment.
        on_record: called at the end of each iteration of the psi loop, with its record.

    Raises:
        ValueError: a setting names an object that the source lacks, or asks to train on photographs of a target that
            has none for training.
    """

    on_record: Callable[[IterationRecord], object] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        real = self.experiment.training.real
        if real.used and not self.experiment.imaging.target.trains:
            raise ValueError(
                f"training.real.mode={real.mode} needs labelled photographs: set target.train_fraction (for a target "
                "of photographs) or target.train_per_object (for a rendered one)"
            )

    @cached_property
    def warm_start(self) -> DetectorStage:
        """The detector whose backbone the trainings of the psi loop use.

        If it is trained on the initial distribution, for as many epochs as scored detectors, and these are not
        fine-tuned, it is also the detector scored as ``ns``.
        """
        x = self.experiment
        if x.training.warm_start == "initial":
            return self.of_initial
        return self._detector(self.uniform, x.training.warm_epochs, "warm_start", "the uniform distribution")

    @cached_property
    def of_initial(self) -> DetectorStage:
        """The detector of the initial distribution, trained like the warm start."""
        epochs = self.experiment.training.warm_epochs
        return self._detector(self.psi("initial"), epochs, "warm_start", "the initial distribution")

    @cached_property
    def _training(self) -> Training:
        """The training settings as they enter the keys of detectors, without differences that have no effect.

        The distribution of the warm start is left out, because psi says what a detector is trained on. If the target
        knows how many photographs it has, a fraction of them is replaced by their number.
        """
        x, real = self.experiment, self.experiment.training.real
        if real.used and (count := x.imaging.target.training_count(x.run.seed)) is not None:
            real = real.of(count)
        return replace(x.training, warm_start="initial", real=real)

    def _detector(
        self, psi: Psi, epochs: int, phase: str, called: str, photographs: bool = True
    ) -> DetectorStage:
        """Return a detector trained on a distribution, and on photographs if the training combines both."""
        x, training = self.experiment, self._training
        combined = photographs and training.real.combined
        if not combined:  # so that its key is the same as in a run without photographs
            training = replace(training, real=Real())
        probabilities = x.imaging.distribution.digest_of(psi)
        return DetectorStage(
            self.scene, x.detector, training, epochs, probabilities, x.run.seed, psi, phase, called, self.device,
            self.targets if combined else None,
        )  # fmt: skip

    def _on_photographs(self, start: DetectorStage | None) -> PhotographsStage:
        """Return ``start`` fine-tuned on photographs or, if it is None, a detector trained on photographs alone.

        The latter takes as many steps as a detector trained on synthetic images.
        """
        x, training, real = self.experiment, self._training, self._training.real
        steps = -(-training.images_per_object * len(self.names) // training.batch_size)
        epochs = training.cold_epochs
        if start is None:  # with settings, and so a key, that do not depend on the mode
            own = Real("combined", real.count, real.fraction, fewer=real.fewer)
            training = replace(training, real=own)
        else:
            epochs, steps = 1, max(1, round(real.finetune * steps * epochs))
        return PhotographsStage(
            start, self.targets, self.camera, self.names, x.detector, training, epochs, steps, x.run.seed, self.device
        )  # fmt: skip

    def _on_views(self) -> DetectorStage:
        """Return a detector trained on the views that the fields are fitted to."""
        radii = self.radii or (1.0,) * len(self.views)
        pictures = tuple(
            PictureSubjectStage(views, self.camera, radius, self.device)
            for views, radius in zip(self.views, radii, strict=True)
        )
        uniform = self.synthetic(self.uniform, "the fields' own views")
        return replace(uniform, scene=self.scene.showing(pictures))

    @property
    def _label_shift(self) -> LabelShift:
        x = self.experiment
        if isinstance(x.loop.method, LabelShift):
            return x.loop.method
        return LabelShift(per_bin=x.loop.outer.pool_per_bin or LabelShift.per_bin)

    @cached_property
    def pool(self) -> PoolStage:
        """Renders of all bins, for the images of the psi loop and for the classifier of the target's boxes."""
        x = self.experiment
        return PoolStage(self.scene, self._label_shift.per_bin, x.run.seed)

    @cached_property
    def shown(self) -> ShownStage:
        """The psi estimated from the target's boxes, with the method's settings if the method is label shift."""
        x, settings = self.experiment, self._label_shift
        return ShownStage(
            self.pool, self.targets, self._symmetries, x.imaging.distribution, settings, self.psi("initial"),
            x.score == "accuracy", x.run.seed,
        )  # fmt: skip

    @property
    def _symmetries(self) -> tuple[SymmetryStage, ...]:
        """Groups of bins that look the same, for every object and angle."""
        binned = self.experiment.imaging.distribution.binned
        angles = [factor.name for factor in binned if factor.coordinate in ("phi", "rho")]
        return tuple(self.symmetry(name, angle) for name in self.names for angle in angles)

    @property
    def read_warm_start(self) -> tuple[DetectorStage, ...]:
        """The warm start, in a tuple; empty for label shift, which does not need it."""
        return () if isinstance(self.experiment.loop.method, LabelShift) else (self.warm_start,)

    @cached_property
    def learned(self) -> PsiStage:
        """The psi that the method learns."""
        x = self.experiment
        follows = isinstance(x.loop.method, HypergradientLoop)
        parts = HypergradientParts(x.loop.gradient, x.loop.solver) if follows else None
        reads = follows and isinstance(x.loop.outer.first_step, LabelShift)
        return PsiStage(
            self.warm_start, self.targets, self.pool, x.imaging.distribution, x.loop.method, parts, x.loop.outer,
            self.psi("initial"), x.run.seed, self.shown if isinstance(x.loop.method, LabelShift) else None,
            self._symmetries if reads else (), self.on_record,
        )  # fmt: skip

    def synthetic(self, psi: Psi, called: str) -> DetectorStage:
        """Return the detector trained on images of a distribution, without photographs."""
        return self._detector(
            psi, self.experiment.training.cold_epochs, "evaluate", called, photographs=False
        )

    def trained_on(self, psi: Psi, called: str) -> TrainedStage:
        """Return the detector that is scored for a distribution.

        It is also trained or fine-tuned on photographs if ``training.real`` says so.
        """
        real = self.experiment.training.real
        if real.used and real.mode == "pretrain":
            return self._on_photographs(self.synthetic(psi, called))
        return self._detector(psi, self.experiment.training.cold_epochs, "evaluate", called)

    def scores(self, psi: Psi, called: str, part: Literal["val", "test"] = "test") -> ScoresStage:
        """Return the scores of the detector trained on a distribution."""
        return ScoresStage(self.trained_on(psi, called), self.targets, part)

    def compared(self, learned: LearnedPsi) -> dict[str, ScoresStage]:
        """Return the scores that a run reports, by name.

        They belong to detectors trained on the initial distribution (``ns``), the ``learned`` one and, if known, the
        target's own (``matched``). If photographs are used in training, there are also detectors trained on the learned
        distribution without them (``synthetic_only``), on photographs alone (``real_only``) and on the views that
        fields are fitted to (``views_only``).
        """
        psis = {"ns": self.psi("initial"), "learned": learned.last, "matched": self.target_psi}
        rows = {called: self.scores(psi, called) for called, psi in psis.items() if psi is not None}
        if self.experiment.training.real.used:
            rows["synthetic_only"] = ScoresStage(self.synthetic(learned.last, "learned"), self.targets)
            rows["real_only"] = ScoresStage(self._on_photographs(None), self.targets)
            rows["views_only"] = ScoresStage(self._on_views(), self.targets)
        return rows

    def on_the_way(self, learned: LearnedPsi) -> dict[int, Psi]:
        """Return psi by number of iterations: at the start, at the fractions in ``score_at``, and at the end."""
        last = len(learned.trajectory) - 1
        asked = {0, last, *(math.floor(part * last + 0.5) for part in self.experiment.run.score_at)}
        return {iteration: learned.trajectory[iteration] for iteration in sorted(asked)}

    def validation(self, learned: LearnedPsi) -> ScoresStage:
        """Return the validation scores of the detector that is scored as ``learned``."""
        return self.scores(learned.last, "learned", "val")

    def evaluated(self, learned: LearnedPsi) -> list[ScoresStage]:
        """Return all scores that a run computes."""
        on_the_way = [
            self.scores(psi, f"psi after {i} iterations") for i, psi in self.on_the_way(learned).items()
        ]
        return [*self.compared(learned).values(), *on_the_way, self.validation(learned)]
