"""The stages of one experiment and how they hang together."""

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
    """Stages by what they give: images, and the detectors, psi and scores that come of them.

    Args:
        experiment: whose stages these are.
        on_record: is called with every iteration of the psi loop as it ends.

    Raises:
        ValueError: objects that a setting names and the source lacks, or photographs that are to train and a target
            without any for it.
    """

    on_record: Callable[[IterationRecord], object] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        real = self.experiment.training.real
        if real.used and not self.experiment.imaging.target.trains:
            raise ValueError(
                f"training.real.mode={real.mode} wants labelled photographs: set target.train_fraction (of a target of "
                "photographs) or target.train_per_object (of a rendered one)"
            )

    @cached_property
    def warm_start(self) -> DetectorStage:
        """The detector whose backbone the psi loop trains on, and that some methods begin with.

        Of the initial distribution, with equal epochs, and unless scored detectors are fine-tuned, it is also scored as
        ``ns``.
        """
        x = self.experiment
        if x.training.warm_start == "initial":
            return self.of_initial
        return self._detector(self.uniform, x.training.warm_epochs, "warm_start", "the uniform distribution")

    @cached_property
    def of_initial(self) -> DetectorStage:
        """The detector of the initial distribution, trained as the warm start is."""
        epochs = self.experiment.training.warm_epochs
        return self._detector(self.psi("initial"), epochs, "warm_start", "the initial distribution")

    @cached_property
    def _training(self) -> Training:
        """The training as detectors' keys have it: without what does not change them.

        Psi says what a detector is trained on, whatever the warm start's is; and where the target knows how many
        photographs it has, their number counts, however it was asked for.
        """
        x, real = self.experiment, self.experiment.training.real
        if real.used and (count := x.imaging.target.training_count(x.run.seed)) is not None:
            real = real.of(count)
        return replace(x.training, warm_start="initial", real=real)

    def _detector(
        self, psi: Psi, epochs: int, phase: str, called: str, photographs: bool = True
    ) -> DetectorStage:
        """Return a detector trained on a distribution, and on photographs where the training combines both."""
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
        """Return a detector trained on photographs, in as many steps as one on images, or fine-tuned on them."""
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
        """Return a detector trained on the views that the fields are fitted to."""
        radii = self.radii or (1.0,) * len(self.views)
        pictures = tuple(
            PictureSubjectStage(views, self.camera, radius, self.device)
            for views, radius in zip(self.views, radii, strict=True)
        )
        uniform = self.synthetic(self.uniform, "the fields' own views")
        return replace(uniform, scene=self.scene.showing(pictures))

    @property
    def _reading(self) -> LabelShift:
        x = self.experiment
        if isinstance(x.loop.method, LabelShift):
            return x.loop.method
        return LabelShift(per_bin=x.loop.outer.pool_per_bin or LabelShift.per_bin)

    @cached_property
    def pool(self) -> PoolStage:
        """Renders of all bins, which the loop composes and the target's boxes are read by."""
        x = self.experiment
        return PoolStage(self.scene, self._reading.per_bin, x.loop.outer.quality, x.run.seed)

    @cached_property
    def shown(self) -> ShownStage:
        """What the target's boxes show, read as the method says where it reads them."""
        x, settings = self.experiment, self._reading
        return ShownStage(
            self.pool, self.targets, self._symmetries, x.imaging.distribution, settings, self.psi("initial"),
            x.score == "accuracy", x.run.seed,
        )  # fmt: skip

    @property
    def _symmetries(self) -> tuple[SymmetryStage, ...]:
        """The bins of every object and angle that look the same."""
        binned = self.experiment.imaging.distribution.binned
        angles = [factor.name for factor in binned if factor.coordinate in ("phi", "rho")]
        return tuple(self.symmetry(name, angle) for name in self.names for angle in angles)

    @property
    def read_warm_start(self) -> tuple[DetectorStage, ...]:
        """The warm start, unless the method does without."""
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
        """Return the detector of a distribution, trained without photographs."""
        return self._detector(
            psi, self.experiment.training.cold_epochs, "evaluate", called, photographs=False
        )

    def trained_on(self, psi: Psi, called: str) -> TrainedStage:
        """Return the detector that is scored for a distribution.

        Photographs train it, too, or fine-tune it, as ``training.real`` says.
        """
        real = self.experiment.training.real
        if real.used and real.mode == "pretrain":
            return self._on_photographs(self.synthetic(psi, called))
        return self._detector(psi, self.experiment.training.cold_epochs, "evaluate", called)

    def scores(self, psi: Psi, called: str, part: Literal["val", "test"] = "test") -> ScoresStage:
        """Return the scores of the detector trained on a distribution."""
        return ScoresStage(self.trained_on(psi, called), self.targets, part)

    def compared(self, learned: LearnedPsi) -> dict[str, ScoresStage]:
        """Return the scores that a run reports by their names.

        They are of the initial distribution (``ns``), the ``learned`` one, and the target's own (``matched``) where
        that is known; where photographs train too, also of the learned one without them (``synthetic_only``), of
        photographs alone (``real_only``), and of the fields' own views (``views_only``).
        """
        psis = {"ns": self.psi("initial"), "learned": learned.last, "matched": self.target_psi}
        rows = {called: self.scores(psi, called) for called, psi in psis.items() if psi is not None}
        if self.experiment.training.real.used:
            rows["synthetic_only"] = ScoresStage(self.synthetic(learned.last, "learned"), self.targets)
            rows["real_only"] = ScoresStage(self._on_photographs(None), self.targets)
            rows["views_only"] = ScoresStage(self._on_views(), self.targets)
        return rows

    def on_the_way(self, learned: LearnedPsi) -> dict[int, Psi]:
        """Return psi by iterations done: at the start, at the parts of all that ``score_at`` names, at the end."""
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
