"""The psi loop of methods with a derivative: train, differentiate, step, train to accept or reject the step."""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod

from jaxtyping import Float
from torch import Tensor

from neural_sim.detector.cached import CachedSet
from neural_sim.detector.trajectory import Recording
from neural_sim.gradient.hypergradient import Hypergradient
from neural_sim.outer.certificate import certify
from neural_sim.outer.checked import CheckedSteps
from neural_sim.outer.inner import InnerLoop, timed
from neural_sim.outer.loop import OuterLoop
from neural_sim.outer.objective import Objective
from neural_sim.outer.steps import FreeSteps, Steps, Verdict
from neural_sim.synthesis.assembly import RenderedImages

_log = logging.getLogger(__name__)


class GradientLoop(OuterLoop, ABC):
    """One training step is one outer iteration. A subclass computes the derivative in :meth:`_derivative`.

    Where steps are checked, an iteration begins with a training that accepts or rejects the last step; the last
    iteration ends with it.
    """

    def __init__(self, inner: InnerLoop, psi: Float[Tensor, "objects K"]) -> None:
        super().__init__(inner, psi, inner.settings.iterations)
        self._learned = _learned(inner)
        self._names = [self.scene.names[label] for label in self._learned]
        self.steps = self._begin()
        self._recording: Recording | None = None
        self._before = psi.new_zeros(0, 0)
        self._folds: list[Objective] = []
        self._stopped = False

    def _begin(self) -> Steps:
        psi, distribution = self.psi[self._learned], self.scene.distribution
        if self.settings.steps == "free":
            return FreeSteps(self.settings, distribution, self._names, psi)
        self.inner.common_numbers = True
        shrink = self.settings.trust.shrink
        return CheckedSteps(self.settings.checks, shrink, distribution, self._names, self._learned, psi)

    def training_step(self, batch: int, batch_idx: int) -> None:
        seconds: dict[str, float] = {}
        verdicts: dict[str, Verdict] = {}
        last = self.settings.steps == "checked" and len(self.records) + 1 == self.rounds
        if self.steps.pending or last:
            rendered, _, training_loss = self._trained(seconds)
            with timed(seconds, "judge", self.inner.device):
                scores = self.inner.scores()
                if self.steps.pending:
                    verdicts = self.steps.judge(self._before, scores)
        if last:
            by_class = scores.sum(1)
            self.record(self.psi, rendered.images, training_loss, seconds, scores=by_class, verdicts=verdicts)
            self._go_to(self.steps.reported)
            return
        self.psi.data[self._learned] = self.steps.reported
        checks, first, every = self.settings.steps == "checked", not self.records, self.settings.certify_every
        due = every > 0 and (len(self.records) + 1) % every == 0
        products = 0
        for trial in range(self.settings.checks.trainings if checks and first else 1):
            if trial or not first:
                self.inner.renew()  # what is peculiar to one training averages out of the derivatives
            rendered, result, training_loss = self._differentiated(seconds, whole=due)
            products += _products(result)
            p_values = self.steps.observe(result)
        with timed(seconds, "certify", self.inner.device):
            cosine = self._cosine(result) if due else math.nan
        factors = self.scene.distribution.names
        trust, otherwise = self.settings.trust, self.settings.on_untrusted
        certificate = certify(result, p_values, self._names, factors, cosine, trust, otherwise)
        by_class, images = self._before.sum(1), rendered.images
        after = self.steps.next(certificate)
        certificate = certificate.waiting(self.steps.waiting)
        self.record(
            self.psi, images, training_loss, seconds, certificate, result, products, by_class, verdicts
        )
        self._stopped = certificate.stopped
        self._go_to(after)

    def _differentiated(
        self, seconds: dict[str, float], whole: bool
    ) -> tuple[RenderedImages, Hypergradient, float]:
        """Images at psi, the derivative of a training on them, and its loss. ``whole``: of L_val on all images, as the
        reference of a certificate is.
        """
        with timed(seconds, "probes", self.inner.device):
            self._prepare()
        rendered, cached, training_loss = self._trained(seconds, self._recording)
        with timed(seconds, "judge", self.inner.device):
            self._before = self.inner.scores()
        self.inner.differentiated = self.inner.objective if whole else self._fold()
        with timed(seconds, "hypergradient", self.inner.device):
            result = self._derivative(rendered, cached)
        for phase, spent in result.seconds.items():
            name = f"hypergradient_{phase}"
            seconds[name] = seconds.get(name, 0.0) + spent
        return rendered, result, training_loss

    def _fold(self) -> Objective:
        """The next part of L_val. The scatter of derivatives then has that of the validation images in it."""
        if self.settings.steps != "checked" or self.settings.checks.folds == 1:
            return self.inner.objective
        if not self._folds:
            self._folds = self.inner.objective.folds(self.settings.checks.folds, self.inner.generator)
        return self._folds.pop()

    def _trained(
        self, seconds: dict[str, float], recording: Recording | None = None
    ) -> tuple[RenderedImages, CachedSet, float]:
        """Images at psi, and the loss of a training on them."""
        with timed(seconds, "render", self.inner.device):
            rendered = self.inner.draw(self.psi)
        with timed(seconds, "features", self.inner.device):
            cached = self.inner.training_set(rendered.images)
        with timed(seconds, "train", self.inner.device):
            if not self.records and not self.settings.train_first:
                # The warm start has trained at this psi, on more images and for more steps than an iteration.
                return rendered, cached, self.inner.loss(cached)
            return rendered, cached, self.inner.train(cached, recording)

    def derivative(self) -> Hypergradient:
        """The derivative at psi as an iteration takes it, by new images and a training on them; psi does not move."""
        self._prepare()
        rendered = self.inner.draw(self.psi)
        cached = self.inner.training_set(rendered.images)
        self.inner.train(cached, self._recording)
        return self._derivative(rendered, cached)

    def _go_to(self, psi: Float[Tensor, "learned K"]) -> None:
        self.psi.data[self._learned] = psi
        reported = self.psi.detach().clone()
        reported[self._learned] = self.steps.reported
        self.trajectory.append(reported)

    def on_train_batch_start(self, batch: int, batch_idx: int) -> int | None:
        return -1 if self._stopped else None

    def _prepare(self) -> None:
        """Draw what the derivative needs beside the training images."""

    @abstractmethod
    def _derivative(self, rendered: RenderedImages, cached: CachedSet) -> Hypergradient:
        """dL_val/dpsi of the learned objects, zeros for the others."""

    def _cosine(self, result: Hypergradient) -> float:
        """Cosine of the derivative with an independent reference; nan without one."""
        return math.nan


def _products(result: Hypergradient) -> int:
    """Hessian products of the solve and of the damping before it."""
    spectrum = result.damping.spectrum
    return result.solution.products + (spectrum.products if spectrum else 0)


def _learned(inner: InnerLoop) -> list[int]:
    """Classes of the objects whose psi moves: those that were asked for, else all that validation images show.

    Of an object that they do not show they measure only where it is taken for another, whatever its own best psi is.

    Raises:
        ValueError: validation images without any object.
    """
    names, wanted = inner.scene.names, inner.settings.learned
    if wanted is not None:
        return [label for label, name in enumerate(names) if name in wanted]
    if not inner.shown:
        raise ValueError(
            "the target's validation images show none of the objects, so that psi cannot be learned"
        )
    unseen = [name for label, name in enumerate(names) if label not in inner.shown]
    if unseen:
        _log.warning("psi stays as it is of objects that no validation image shows: %s", ", ".join(unseen))
    return sorted(inner.shown)
