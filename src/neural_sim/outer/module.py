"""The psi loop of Eq. 1 as a LightningModule: render, train the detector, hypergradient, step psi; and again."""

from __future__ import annotations

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
from neural_sim.gradient.hypergradient import Hypergradient, InnerProblem, hypergradient
from neural_sim.outer.binding import bound_losses, object_images
from neural_sim.outer.records import IterationRecord, LearnedPsi
from neural_sim.parameter.update import UpdateState
from neural_sim.settings import Outer
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.synthesis.pool import ImagePool
from neural_sim.synthesis.scene import RenderedObject, Scene, join
from neural_sim.types import LabelledImages


@contextmanager
def _timed(seconds: dict[str, float], phase: str) -> Iterator[None]:
    begin = time.perf_counter()
    yield
    seconds[phase] = seconds.get(phase, 0.0) + time.perf_counter() - begin


class SimulatorModule(pl.LightningModule):
    """psi as logits [objects, k], moved by the hypergradient; one training step is one outer iteration.

    The detector goes on from ``params`` with its backbone frozen, ``settings.epochs`` epochs an iteration on freshly
    drawn images. ``validation`` is the labelled target set; no step sees any other real image.
    """

    def __init__(
        self,
        scene: Scene,
        detector: Detector,
        params: Parameters,
        psi: Float[Tensor, "objects k"],
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
        self._update_state = UpdateState.zeros(self.psi)
        self._backbone, _ = detector.split(params)
        self._validation = CachedSet.of(detector, self._backbone, validation)
        self._probe_set: CachedSet | None = None
        self._probes: dict[int, Probes] = {}
        self._pool: ImagePool | None = None
        if settings.pool_per_bin and not estimator.relaxed:
            self._pool = ImagePool.render(scene, settings.pool_per_bin, generator)
        self._adjoint: Tensor | None = None

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
        with _timed(seconds, "train"):
            training_loss = self._train(images)
        with _timed(seconds, "features"):
            cached = CachedSet.of(self.detector, self._backbone, images)
        with _timed(seconds, "hypergradient"):
            result = self._hypergradient(rendered, images, cached)
        seconds |= {f"hypergradient_{phase}": spent for phase, spent in result.seconds.items()}
        self._record(result, images, training_loss, seconds)
        gradient, error = (
            torch.stack([values[name] for name in self.scene.names]).to(self.psi)
            for values in (result.psi_gradients, result.standard_errors)
        )
        log_p = self.scene.pose.log_probabilities(self.psi)
        moved, self._update_state = self.settings.update.step(
            self.psi, log_p, gradient, error, self._update_state
        )
        self.psi.data = moved

    def _train(self, images: LabelledImages) -> float:
        if self.settings.epochs == 0:
            return math.nan
        self.theta, history = train_detector(
            self.detector,
            self.theta,
            images,
            self.generator,
            epochs=self.settings.epochs,
            batch_size=self.batch_size,
            learning_rate=self.settings.learning_rate,
            weight_decay=self.weight_decay,
            trainable_only=True,
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
        inner = InnerProblem(trainable, cached.losses, weights, subset=subset)
        losses = bound_losses(cached, self._backbone, self._probe_set)
        held = object_images(self.scene, rendered, self.psi, weights)
        estimates = {
            name: self._bind(losses, part, self._probes.get(label))
            for label, (name, part) in enumerate(held.items())
        }
        result = hypergradient(
            inner, self._validation.mean_terms(), estimates, self.solver, self.generator, self._adjoint
        )
        self._adjoint = result.solution.value
        return result

    def _bind(self, losses: Losses, held: ObjectImages, probes: Probes | None) -> Callable:
        _, trainable = self.detector.split(self.theta)
        return lambda vector: self.estimator.estimate(losses, trainable, vector, held, probes)

    def _draw_images(self) -> list[RenderedObject]:
        count, labels = self.settings.images_per_object, range(len(self.scene.names))
        if self._pool is None:
            return self.scene.training_set(self.psi, count, self.generator, self.estimator.relaxed)
        return [self._pool.draw(label, self.psi[label], count, self.generator) for label in labels]

    def _draw_probes(self) -> None:
        """New probes each iteration, so that what is peculiar to some does not push psi the same way every time."""
        per_bin = self.estimator.probes_per_bin
        if per_bin == 0:
            return
        source = self._pool.every_bin if self._pool else self.scene.probes
        drawn = [source(label, per_bin, self.generator) for label in range(len(self.scene.names))]
        each = self.scene.pose.bins * per_bin
        self._probes = {
            label: Probes(torch.arange(each) + label * each, self.scene.pose.bin_of(part.draw))
            for label, part in enumerate(drawn)
        }
        self._probe_set = CachedSet.of(self.detector, self._backbone, join(drawn))

    def _record(
        self, result: Hypergradient, images: LabelledImages, training_loss: float, seconds: dict[str, float]
    ) -> None:
        log_p = self.scene.pose.log_probabilities(self.psi.detach())
        _, trainable = self.detector.split(self.theta)
        with torch.no_grad():
            validation_loss = float(sum(term(trainable) for term in self._validation.mean_terms()))
        if validation_loss < self.best_loss:
            self.best_loss, self.best_psi = validation_loss, self.psi.detach().clone()
        spectrum = result.damping.spectrum
        noise = [float(result.signal_to_noise[name].median()) for name in self.scene.names]
        record = IterationRecord(
            probabilities=log_p.exp().tolist(),
            entropies=(-(log_p.exp() * log_p).sum(-1)).tolist(),
            gradient_norms=[float(result.psi_gradients[name].norm()) for name in self.scene.names],
            signal_to_noise=noise,
            validation_loss=validation_loss,
            training_loss=training_loss,
            stationarity=result.stationarity,
            solver_status=result.solution.status.name,
            solver_steps=result.solution.steps,
            solver_residual=result.solution.residual,
            damping=result.damping.value,
            curvature_min=spectrum.smallest if spectrum else math.nan,
            curvature_max=spectrum.largest if spectrum else math.nan,
            images_without_box=int((~images.present.any(-1)).sum()),
            seconds=seconds,
        )
        self.records.append(record)


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
