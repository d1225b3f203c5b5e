"""The base class of all outer loops, the loop of methods with rewards, and ``learn_psi``, which runs a loop."""

from __future__ import annotations

import logging
import time
import warnings
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from statistics import fmean
from time import perf_counter
from typing import Any

import lightning.pytorch as pl
import torch
from jaxtyping import Float
from torch import Tensor, nn
from typing_extensions import override

from neural_sim.baseline.base import RewardMethod
from neural_sim.baseline.label_shift.evidence import FactorEstimate
from neural_sim.checkpoint import Checkpoint
from neural_sim.detector.trajectory import Recording
from neural_sim.devices import placed, trainer_on
from neural_sim.gradient.hypergradient import Hypergradient
from neural_sim.outer.certificate import Certificate, line
from neural_sim.outer.inner import InnerLoop, Numbers, Trained, timed
from neural_sim.outer.progress import iteration_line
from neural_sim.outer.records import Cost, IterationRecord, LearnedPsi, Outcome

logger = logging.getLogger(__name__)


class OuterLoop(pl.LightningModule):
    """A loop over psi [objects, K], with all factors of p_psi joined.

    One Lightning training step is one of ``rounds`` outer iterations.

    ``inner`` draws an iteration's images and trains the detector on them with the random ``numbers``; ``theta`` has
    the parameters of the last training, from which the next may continue. A subclass's ``training_step`` calls
    ``record``, sets psi, and appends to ``trajectory`` the psi that the method would return at this point. ``shown`` is
    the estimate from the target's boxes, if one was made.
    """

    def __init__(
        self, inner: InnerLoop, psi: Float[Tensor, "objects K"], rounds: int, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.inner, self.scene, self.settings, self.rounds = inner, inner.scene, inner.settings, rounds
        self.theta, self.numbers = inner.params, Numbers(generator)
        self.psi = nn.Parameter(psi.detach().clone().double(), requires_grad=False)
        self.records: list[IterationRecord] = []
        self.trajectory = [self.psi.detach().clone()]
        self.shown: tuple[FactorEstimate, ...] = ()
        self.on_record: Callable[[IterationRecord], object] = lambda record: None
        self.checkpoint: Checkpoint | None = None
        self._cost, self._seconds = Cost(), {"pool": inner.preparation.seconds}
        self._cpu = time.process_time() - inner.preparation.cpu_seconds
        self._since, self._durations = perf_counter(), list[float]()

    @override
    def configure_optimizers(self) -> None:
        return None

    def train_dataloader(self) -> range:
        """Return the numbers of the remaining iterations, which need no data."""
        return range(len(self.records), self.rounds)

    @property
    def ended(self) -> bool:
        """Whether no iteration is left."""
        return len(self.records) == self.rounds

    @override
    def on_train_batch_end(self, *step: Any) -> None:
        """Write the checkpoint and call ``on_record``; the processor time of both is not charged to the method."""
        begun = time.process_time()
        if self.checkpoint is not None:
            self.checkpoint.offer(self.state)
        self.on_record(self.records[-1])
        self._cpu += time.process_time() - begun

    def state(self) -> dict[str, Any]:
        """Return everything that an iteration passes on to the next, such as psi, records and random numbers.

        What follows from the loop's inputs, such as its pool, is left out.
        """
        return {
            "psi": self.psi.data,
            "records": self.records,
            "trajectory": self.trajectory,
            "shown": self.shown,
            "theta": placed(self.theta, torch.device("cpu")),
            "index": self.numbers.index,
            "generator": self.numbers.generator.get_state(),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from the ``state`` of a loop with the same inputs; this loop must not have started."""
        self.psi.data = state["psi"]
        self.records, self.trajectory, self.shown = state["records"], state["trajectory"], state["shown"]
        self.theta = placed(state["theta"], self.inner.device)
        self.numbers = replace(self.numbers, index=state["index"])
        self.numbers.generator.set_state(state["generator"])
        self._seconds, self._cpu = {}, time.process_time()

    def renew(self) -> None:
        """Switch to the next set of common random numbers."""
        self.numbers = self.numbers.renewed()

    def train_on(self, psi: Float[Tensor, "objects K"], recording: Recording | None = None) -> Trained:
        """Train on images at psi, and add the cost to the iteration's."""
        return self.charged(self.inner.train(psi, self.numbers, self.theta, recording))

    def charged(self, trained: Trained) -> Trained:
        """Keep a training's parameters as ``theta``, and add its cost to the iteration's."""
        self.theta = trained.theta
        self.charge(trained.cost)
        for phase, spent in trained.seconds.items():
            self._seconds[phase] = self._seconds.get(phase, 0.0) + spent
        return trained

    def charge(self, cost: Cost) -> None:
        """Add a cost to the iteration's."""
        self._cost = self._cost + cost

    def timed(self, phase: str) -> AbstractContextManager[None]:
        """Add the time spent in the block to the phase's seconds in this iteration."""
        return timed(self._seconds, phase, self.inner.device)

    def record(
        self,
        trained: Trained,
        scores: Float[Tensor, "classes"] | None = None,
        outcome: Outcome | None = None,
        certificate: Certificate | None = None,
        gradient: Hypergradient | None = None,
    ) -> IterationRecord:
        """Record an iteration, before the step of psi.

        Args:
            trained: the iteration's last training.
            scores: scores of the classes, before the step.
            outcome: what happened to the previous steps.
            certificate: certificate of the iteration's derivative.
            gradient: the derivative.
        """
        outcome = outcome or Outcome()
        p_by_factor, cpu = self.scene.distribution.probabilities(trained.psi), time.process_time()
        present = trained.rendered.images.present
        last = IterationRecord(
            probabilities={name: p.tolist() for name, p in p_by_factor.items()},
            entropies={
                name: (-torch.special.xlogy(p, p).sum(-1)).tolist() for name, p in p_by_factor.items()
            },
            gradient_norms=self._lengths({} if gradient is None else gradient.gradients),
            gradient_errors=self._lengths({} if gradient is None else gradient.errors),
            validation_loss=trained.validation_loss,
            training_loss=trained.loss,
            certificate=certificate,
            images=self._cost.images,
            detector_steps=self._cost.detector_steps,
            products=self._cost.products,
            images_without_box=int((~present.any(-1)).sum()),
            scores=[] if scores is None else scores.tolist(),
            verdicts=dict(outcome.verdicts),
            seconds=self._seconds,
            cpu_seconds=cpu - self._cpu,
            taken_back=dict(outcome.taken_back),
        )
        self.records.append(last)
        self._cost, self._seconds, self._cpu = Cost(), {}, cpu
        now = perf_counter()
        self._durations.append(now - self._since)
        self._since = now
        left = None if self.ended else fmean(self._durations) * (self.rounds - len(self.records))
        logger.info(iteration_line(self.records, self.rounds, self._durations[-1], left))
        if certificate is not None:
            logger.debug(line(certificate, len(self.records), self.rounds, last.validation_loss))
        return last

    def _lengths(self, values: Mapping[str, Tensor]) -> list[float]:
        """Return the norm of each object's value, in the order of the scene's objects."""
        return [float(values[name].norm()) for name in self.scene.names] if values else []


class RewardLoop(OuterLoop):
    """The outer loop of methods that see only a reward: draw, train, reward. One Lightning training step is one round.

    The reward is minus L_val, which still varies where AP is zero.
    """

    def __init__(
        self,
        inner: InnerLoop,
        psi: Float[Tensor, "objects K"],
        method: RewardMethod,
        generator: torch.Generator,
    ) -> None:
        super().__init__(inner, psi, method.rounds * inner.settings.iterations, generator)
        self.search = method.begin(inner.scene.distribution, self.psi.detach(), generator)

    @override
    def training_step(self, batch: int, batch_idx: int) -> None:
        trained = self.train_on(self.search.ask())
        with self.timed("reward"):
            reward = -trained.validation_loss
        self.record(trained)
        self.search.tell(reward)
        self.psi.data = self.search.psi.clone()
        self.trajectory.append(self.psi.detach().clone())

    @override
    def state(self) -> dict[str, Any]:
        return {**super().state(), "search": self.search.state()}

    @override
    def restore(self, state: Mapping[str, Any]) -> None:
        super().restore(state)
        self.search.restore(state["search"])


def learn_psi(
    module: OuterLoop,
    on_record: Callable[[IterationRecord], object] | None = None,
    checkpoint: Checkpoint | None = None,
) -> LearnedPsi:
    """Run the loop to its end with a Lightning Trainer that writes nothing.

    Args:
        module: the loop, not yet run.
        on_record: called with the record of each iteration when it ends.
        checkpoint: where to resume from, and where to save the state after an iteration.
    """
    if on_record is not None:
        module.on_record = on_record
    module.checkpoint = checkpoint
    state = None if checkpoint is None else checkpoint.read()
    if state is not None:
        module.restore(state)
        logger.info(
            "psi loop: resuming an interrupted run after round %d/%d", len(module.records), module.rounds
        )
        for record in module.records:
            module.on_record(record)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module="lightning")
        if not module.ended:
            # psi and its records are a few numbers, which stay on the CPU whatever the run's device is.
            trainer_on(torch.device("cpu")).fit(module)
    return LearnedPsi(torch.stack(module.trajectory), module.records, shown=module.shown)
