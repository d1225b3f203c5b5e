"""The psi loop of Eq. 1 as a LightningModule: render, train the detector, hypergradient, step psi; and again."""

from __future__ import annotations

import logging
import math
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import lightning.pytorch as pl
import torch
from jaxtyping import Float
from torch import Tensor, nn

from neural_sim.detector.cached import CachedSet
from neural_sim.detector.retinanet import Detector, Parameters
from neural_sim.detector.training import train_detector
from neural_sim.gradient.base import Losses, ObjectImages, Probes
from neural_sim.gradient.estimators import Estimator
from neural_sim.gradient.hypergradient import Hypergradient, InnerProblem, SplitLoss, hypergradient
from neural_sim.outer.binding import bound_losses, object_images
from neural_sim.outer.certificate import Certificate, certify, line
from neural_sim.outer.records import IterationRecord, LearnedPsi
from neural_sim.outer.retrained import Check, as_double, binned_problem, check
from neural_sim.parameter.update import UpdateState
from neural_sim.settings import Outer
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.synthesis.pool import ImagePool
from neural_sim.synthesis.scene import RenderedObject, Scene, join
from neural_sim.types import LabelledImages

logger = logging.getLogger(__name__)


@contextmanager
def _timed(seconds: dict[str, float], phase: str) -> Iterator[None]:
    begin = time.perf_counter()
    yield
    seconds[phase] = seconds.get(phase, 0.0) + time.perf_counter() - begin


class SimulatorModule(pl.LightningModule):
    """psi [objects, K], all factors of p_psi, moved by the hypergradient; one training step is one outer iteration.

    The detector has the backbone of ``params``, frozen; its pyramid and head train ``settings.epochs`` epochs an
    iteration on freshly drawn images. ``validation`` is the labelled target set; no step sees any other real image.
    """

    def __init__(
        self,
        scene: Scene,
        detector: Detector,
        params: Parameters,
        psi: Float[Tensor, "objects K"],
        validation: LabelledImages,
        settings: Outer,
        estimator: Estimator,
        solver: AdjointSolver,
        batch_size: int,
        weight_decay: float,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.scene, self.detector, self.theta = scene, detector, params
        self.psi = nn.Parameter(psi.detach().clone().double(), requires_grad=False)
        self.settings, self.estimator, self.solver = settings, estimator, solver
        self.batch_size, self.weight_decay, self.generator = batch_size, weight_decay, generator
        self.records: list[IterationRecord] = []
        self.best_psi, self.best_loss = self.psi.detach().clone(), math.inf
        parts = scene.distribution.split(self.psi)
        self._update_states = {name: UpdateState.zeros(part) for name, part in parts.items()}
        self._backbone, _ = detector.split(params)
        self._validation = CachedSet.of(detector, self._backbone, validation)
        self._probe_set: CachedSet | None = None
        self._probes: list[dict[str, Probes]] = [{} for _ in scene.names]
        self._pool: ImagePool | None = None
        if settings.pool_per_bin and not estimator.relaxed:
            self._pool = ImagePool.render(scene, settings.pool_per_bin, generator)
        self._adjoint: Tensor | None = None
        self._warm_start = detector.split(params)[1]
        self._start = params if settings.start == "warm" else {**detector.init(generator), **self._backbone}
        # A generator of its own, so that being certified does not change a run.
        self._check_generator = torch.Generator().manual_seed(generator.initial_seed() + 1)
        self._stopped = False

    def configure_optimizers(self) -> None:
        return None

    def train_dataloader(self) -> range:
        return range(self.settings.iterations)

    def training_step(self, batch: int, batch_idx: int) -> None:
        seconds: dict[str, float] = {}
        with _timed(seconds, "render"):
            rendered = self._draw_images()
            images = join(rendered)
        with _timed(seconds, "probes"):
            self._draw_probes()
        with _timed(seconds, "features"):
            cached = CachedSet.of(self.detector, self._backbone, images)
        with _timed(seconds, "train"):
            training_loss = self._train(cached)
        with _timed(seconds, "hypergradient"):
            result = self._hypergradient(rendered, images, cached)
        seconds |= {f"hypergradient_{phase}": spent for phase, spent in result.seconds.items()}
        with _timed(seconds, "certify"):
            check = self._check(result)
        certificate = certify(
            result, self.scene.names, check, self.settings.trust, self.settings.on_untrusted
        )
        self._record(result, certificate, images, training_loss, seconds)
        self._move(result, certificate)

    def on_train_batch_start(self, batch: int, batch_idx: int) -> int | None:
        return -1 if self._stopped else None

    def _move(self, result: Hypergradient, certificate: Certificate) -> None:
        """psi's step, or what its certificate leaves of it."""
        self._stopped = certificate.action == "stopped"
        if certificate.action in ("skipped", "stopped"):
            return
        gradient, error = (
            torch.stack([values[name] for name in self.scene.names]).to(self.psi)
            for values in (result.psi_gradients, result.standard_errors)
        )
        distribution = self.scene.distribution
        psi, slope, noise = (distribution.split(values) for values in (self.psi, gradient, error))
        moved = {}
        for factor in distribution.factors:
            name = factor.name
            log_p = factor.log_probabilities(psi[name])
            moved[name], self._update_states[name] = self.settings.update.step(
                psi[name], log_p, slope[name], noise[name], self._update_states[name]
            )
        done = (len(self.records) - 1) / max(1, self.settings.iterations - 1)
        part = 1.0 + done * (self.settings.final_step - 1.0)
        if certificate.action == "shrunk":
            part *= self.settings.trust.shrink
        self.psi.data = self.psi + part * (distribution.join(moved) - self.psi)

    def _train(self, images: CachedSet) -> float:
        if self.settings.epochs == 0:
            return math.nan
        self.theta, history = train_detector(
            self.detector,
            self.theta if self.settings.start == "previous" else self._start,
            images,
            self.generator,
            epochs=self.settings.epochs,
            batch_size=self.batch_size,
            learning_rate=self.settings.learning_rate,
            # The proximal term takes the decay's place: with both, its Hessian would not be the inner problem's.
            weight_decay=0.0 if self.detector.proximal > 0.0 else self.weight_decay,
            proximal=self.detector.proximal,
            anchor=self._warm_start,
        )
        return history.losses[-1]

    def _hypergradient(
        self, rendered: list[RenderedObject], images: LabelledImages, cached: CachedSet
    ) -> Hypergradient:
        _, trainable = self.detector.split(self.theta)
        count = len(images)
        weights = torch.full((count,), 1.0 / count)
        wanted = self.settings.curvature_images
        subset = torch.randperm(count, generator=self.generator)[:wanted] if 0 < wanted < count else None
        inner = InnerProblem(
            trainable, SplitLoss(cached.outputs, cached.losses_of), weights,
            proximal=self.detector.proximal, anchor=self._warm_start, subset=subset,
        )  # fmt: skip
        losses = bound_losses(cached, self._backbone, images.labels, self._probe_set)
        held = object_images(self.scene, rendered, self.psi, weights)
        estimates = {
            name: self._bind(losses, part, probes)
            for (name, part), probes in zip(held.items(), self._probes, strict=True)
        }
        result = hypergradient(
            inner, self._validation.mean_terms(), estimates, self.solver, self.generator, self._adjoint
        )
        self._adjoint = result.solution.value
        return result

    def _bind(self, losses: Losses, held: ObjectImages, probes: dict[str, Probes]) -> Callable:
        _, trainable = self.detector.split(self.theta)
        return lambda vector: self.estimator.estimate(losses, trainable, vector, held, probes)

    def _draw_images(self) -> list[RenderedObject]:
        count, labels = self.settings.images_per_object, range(len(self.scene.names))
        if self._pool is None:
            return self.scene.training_set(self.psi, count, self.generator, self.estimator.relaxed)
        return [self._pool.draw(label, self.psi[label], count, self.generator) for label in labels]

    def _draw_probes(self) -> None:
        """New probes each iteration, so that what is peculiar to some does not push psi the same way every time."""
        if self.estimator.probes_per_bin:
            self._probes, self._probe_set = self._every_bin(self.estimator.probes_per_bin, self.generator)

    def _every_bin(
        self, per_bin: int, generator: torch.Generator
    ) -> tuple[list[dict[str, Probes]], CachedSet]:
        """``per_bin`` images of every bin of every factor of every object, with their features."""
        source = self._pool.probes if self._pool else self.scene.probes
        drawn: list[RenderedObject] = []
        probes: list[dict[str, Probes]] = []
        first = 0
        for label in range(len(self.scene.names)):
            probes.append({})
            for column, factor in enumerate(self.scene.distribution.factors):
                part = source(label, factor.name, per_bin, self.psi[label], generator)
                index = torch.arange(first, first + len(part.images))
                probes[label][factor.name] = Probes(
                    index, self.scene.distribution.bins_of(part.draw)[:, column]
                )
                first += len(index)
                drawn.append(part)
        return probes, CachedSet.of(self.detector, self._backbone, join(drawn))

    def _check(self, result: Hypergradient) -> Check | None:
        """Every ``certify_every`` steps, one object's gradient of one factor against a retrained problem, in turn.

        That problem is the one of this step's probes, with the proximal term whose exact derivative the step's solve
        took: its damping, held at the parameters of this step, beside the detector's own. Estimators without probes
        get images drawn for the purpose.
        """
        every, per_bin = self.settings.certify_every, self.settings.certify_per_bin
        done = len(self.records) + 1
        if every == 0 or done % every:
            return None
        probes, held = self._probes, self._probe_set
        if held is None or self.estimator.probes_per_bin < per_bin:
            probes, held = self._every_bin(per_bin, self._check_generator)
        distribution = self.scene.distribution
        turn, label = divmod(done // every - 1, len(self.scene.names))
        factor = distribution.factors[turn % len(distribution.factors)]
        trainable = self.detector.split(self.theta)[1]
        pulls = [(self.detector.proximal, self._warm_start), (result.damping.value, trainable)]
        ordered = [part[factor.name] for part in probes]
        problem = binned_problem(held, ordered, per_bin, pulls, factor.log_probabilities)
        validation = self._validation.double().mean_terms()
        psi = distribution.split(self.psi.detach())[factor.name]
        gradient = distribution.split(result.psi_gradients[self.scene.names[label]])[factor.name]
        return check(problem, validation, psi, label, as_double(trainable), gradient)

    def _record(
        self,
        result: Hypergradient,
        certificate: Certificate,
        images: LabelledImages,
        training_loss: float,
        seconds: dict[str, float],
    ) -> None:
        probabilities = self.scene.distribution.probabilities(self.psi.detach())
        _, trainable = self.detector.split(self.theta)
        with torch.no_grad():
            validation_loss = float(sum(term(trainable) for term in self._validation.mean_terms()))
        if validation_loss < self.best_loss:
            self.best_loss, self.best_psi = validation_loss, self.psi.detach().clone()
        record = IterationRecord(
            probabilities={name: p.tolist() for name, p in probabilities.items()},
            entropies={
                name: (-torch.special.xlogy(p, p).sum(-1)).tolist() for name, p in probabilities.items()
            },
            gradient_norms=[float(result.psi_gradients[name].norm()) for name in self.scene.names],
            validation_loss=validation_loss,
            training_loss=training_loss,
            certificate=certificate,
            images_without_box=int((~images.present.any(-1)).sum()),
            seconds=seconds,
        )
        self.records.append(record)
        logger.info(line(certificate, len(self.records), self.settings.iterations, validation_loss))


def learn_psi(module: SimulatorModule, progress: bool) -> LearnedPsi:
    """Run the loop to its budget through a Lightning Trainer that writes nothing."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module="lightning")
        trainer = pl.Trainer(
            max_epochs=1,
            accelerator="cpu" if module.psi.device.type == "cpu" else "gpu",
            devices=1,
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=progress,
            enable_model_summary=False,
        )
        trainer.fit(module)
    return LearnedPsi(module.psi.detach().clone(), module.best_psi, module.records)
