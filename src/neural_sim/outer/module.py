"""The psi loop of Eq. 1 as a LightningModule: render, train the detector, hypergradient, step psi; and again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.detector.cached import CachedSet
from neural_sim.gradient.base import Losses, ObjectImages, Probes
from neural_sim.gradient.estimators import Estimator
from neural_sim.gradient.hypergradient import Hypergradient, InnerProblem, hypergradient
from neural_sim.outer.binding import bound_losses, object_images
from neural_sim.outer.certificate import certify
from neural_sim.outer.checked import CheckedSteps
from neural_sim.outer.inner import InnerLoop, timed
from neural_sim.outer.loop import OuterLoop
from neural_sim.outer.probing import ProbeSet
from neural_sim.outer.retrained import Check, as_double, binned_problem, check
from neural_sim.outer.steps import FreeSteps, Steps
from neural_sim.outer.unrolling import through_training
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.synthesis.scene import RenderedObject, join
from neural_sim.types import LabelledImages


class SimulatorModule(OuterLoop):
    """psi moved by the hypergradient, with a certificate for every step."""

    def __init__(
        self,
        inner: InnerLoop,
        psi: Float[Tensor, "objects K"],
        estimator: Estimator,
        solver: AdjointSolver,
    ) -> None:
        super().__init__(inner, psi, inner.settings.iterations)
        self.estimator, self.solver = estimator, solver
        wanted, names = inner.settings.learned, self.scene.names
        self._learned = [i for i, name in enumerate(names) if wanted is None or name in wanted]
        self._names = [names[label] for label in self._learned]
        self.steps = self._begin()
        self._probes: ProbeSet | None = None
        self._adjoint: Tensor | None = None
        # A generator of its own, so that being certified does not change a run.
        self._check_generator = torch.Generator().manual_seed(inner.generator.initial_seed() + 1)
        self._recording = self.settings.unrolled.recording if self.settings.adjoint == "unrolled" else None
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
        with timed(seconds, "render", self.inner.device):
            rendered = self.inner.draw(self.psi)
            images = join(rendered)
        last = self.settings.steps == "checked" and len(self.records) + 1 == self.rounds
        with timed(seconds, "probes", self.inner.device):
            if not last:
                self._draw_probes()
        with timed(seconds, "features", self.inner.device):
            cached = CachedSet.of(self.inner.detector, self.inner.backbone, images)
        with timed(seconds, "train", self.inner.device):
            # The warm start has trained on this psi already, on more images and for longer than an iteration would.
            arrived = not self.records and not self.settings.train_first
            training_loss = self.inner.loss(cached) if arrived else self.inner.train(cached, self._recording)
        with timed(seconds, "judge", self.inner.device):
            scores = self.inner.scores()
            verdicts = self.steps.judge(scores)
        if last:
            self.record(self.psi, images, training_loss, seconds, scores=scores, verdicts=verdicts)
            self._go_to(self.steps.reported)
            return
        with timed(seconds, "hypergradient", self.inner.device):
            result = self._hypergradient(rendered, images, cached)
        seconds |= {f"hypergradient_{phase}": spent for phase, spent in result.seconds.items()}
        with timed(seconds, "certify", self.inner.device):
            check = self._check(result)
        p_values, factors = self.steps.observe(result), self.scene.distribution.names
        trust, otherwise = self.settings.trust, self.settings.on_untrusted
        certificate = certify(result, p_values, self._names, factors, check, trust, otherwise)
        norms = [float(result.psi_gradients[name].norm()) for name in self.scene.names]
        self.record(
            self.psi, images, training_loss, seconds, certificate, norms, _products(result), scores, verdicts
        )
        self._stopped = certificate.stopped
        psi = self.steps.next(certificate)
        if not self.steps.moved:
            self.inner.renew()  # the same training again would say nothing new
        self._go_to(psi)

    def _go_to(self, psi: Float[Tensor, "learned K"]) -> None:
        self.psi.data[self._learned] = psi
        self.trajectory.append(self.psi.detach().clone())

    def on_train_batch_start(self, batch: int, batch_idx: int) -> int | None:
        return -1 if self._stopped else None

    def _hypergradient(
        self, rendered: list[RenderedObject], images: LabelledImages, cached: CachedSet
    ) -> Hypergradient:
        trainable = self.inner.trainable
        count = len(images)
        weights = torch.full((count,), 1.0 / count)
        wanted = self.settings.curvature_images
        subset = (
            torch.randperm(count, generator=self.inner.generator)[:wanted] if 0 < wanted < count else None
        )
        device = self.inner.device
        inner = InnerProblem(
            trainable, cached.losses, weights.to(device),
            proximal=self.inner.detector.proximal, anchor=self.inner.warm_start,
            subset=None if subset is None else subset.to(device),
        )  # fmt: skip
        probed = self._probes
        held = object_images(self.scene, rendered, self.psi, weights)
        if self.settings.adjoint == "unrolled":
            learned = {self.scene.names[label]: held[self.scene.names[label]] for label in self._learned}
            return self._with_fixed(
                through_training(self.inner, inner, self.estimator, cached, images.labels, learned, probed)
            )
        losses = bound_losses(cached, self.inner.backbone, images.labels, probed.cached if probed else None)
        estimates = {
            name: self._bind(losses, held[name], probed.probes[label] if probed else {})
            for label, name in enumerate(self.scene.names)
            if label in self._learned
        }
        result = hypergradient(
            inner,
            self.inner.objective.terms(),
            estimates,
            self.solver,
            self.inner.generator,
            self._adjoint,
        )
        self._adjoint = result.solution.value
        return self._with_fixed(result)

    def _with_fixed(self, result: Hypergradient) -> Hypergradient:
        """Zeros for objects whose psi is fixed, for which nothing was computed."""
        zeros = {name: torch.zeros(self.psi.shape[1]) for name in self.scene.names}
        return replace(
            result,
            psi_gradients={**zeros, **result.psi_gradients},
            standard_errors={**zeros, **result.standard_errors},
        )

    def _bind(self, losses: Losses, held: ObjectImages, probes: dict[str, Probes]) -> Callable:
        trainable = self.inner.trainable
        return lambda vector: self.estimator.estimate(losses, trainable, vector, held, probes)

    def _draw_probes(self) -> None:
        """New probes, or a part of them, so that what is peculiar to some does not push psi the same way for ever."""
        every = self.estimator.probes_per_bin
        if not every:
            return
        if self._probes is None:
            self._probes = self._every_bin(every, self.inner.generator, self._learned)
            return
        part = max(1, round(self.settings.refresh * every))
        fresh = self._every_bin(part, self.inner.generator, self._learned)
        self._probes = fresh if part == every else self._probes.renewed(fresh, len(self.records))

    def _every_bin(self, per_bin: int, generator: torch.Generator, objects: Sequence[int]) -> ProbeSet:
        """``per_bin`` images of every bin of every factor of the objects, with their features."""
        source, inner = self.inner.pool or self.scene, self.inner
        probed = ProbeSet.draw(
            source, self.scene, inner.detector, inner.backbone, per_bin, self.psi, generator, objects
        )
        inner.images += len(probed.cached)
        return probed

    def _check(self, result: Hypergradient) -> Check | None:
        """Every ``certify_every`` steps, one object's gradient of one factor against a retrained problem, in turn.

        That problem is the one of this step's probes, with the proximal term whose exact derivative the step's solve
        took: its damping, held at the parameters of this step, beside the detector's own. Estimators without probes
        get images drawn for the purpose.
        """
        every, per_bin = self.settings.certify_every, self.settings.certify_per_bin
        done = len(self.records) + 1
        if every == 0 or done % every or not self.scene.distribution.binned:
            return None
        probed = self._probes
        objects = range(len(self.scene.names))
        if probed is None or probed.per_bin < per_bin or len(self._learned) < len(objects):
            probed = self._every_bin(per_bin, self._check_generator, objects)
        distribution = self.scene.distribution
        turn, place = divmod(done // every - 1, len(self._learned))
        label = self._learned[place]
        factor = distribution.binned[turn % len(distribution.binned)]
        trainable = self.inner.trainable
        pulls = [(self.inner.detector.proximal, self.inner.warm_start), (result.damping.value, trainable)]
        ordered = [part[factor.name] for part in probed.probes]
        problem = binned_problem(probed.cached, ordered, per_bin, pulls, factor.log_probabilities)
        validation = self.inner.objective.double().terms()
        psi = distribution.split(self.psi.detach())[factor.name]
        gradient = distribution.split(result.psi_gradients[self.scene.names[label]])[factor.name]
        return check(problem, validation, psi, label, as_double(trainable), gradient)


def _products(result: Hypergradient) -> int:
    """Hessian products of the solve and of the damping before it."""
    spectrum = result.damping.spectrum
    return result.solution.products + (spectrum.products if spectrum else 0)
