"""Base of all outer loops: psi, an iteration's record, and the Trainer that runs the loop."""

from __future__ import annotations

import logging
import time
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import lightning.pytorch as pl
import torch
from jaxtyping import Float
from torch import Tensor, nn

from neural_sim.devices import trainer_on
from neural_sim.gradient.hypergradient import Hypergradient
from neural_sim.outer.certificate import Certificate, line
from neural_sim.outer.inner import InnerLoop
from neural_sim.outer.records import IterationRecord, LearnedPsi
from neural_sim.outer.steps import Verdict
from neural_sim.types import LabelledImages

logger = logging.getLogger(__name__)


class OuterLoop(pl.LightningModule):
    """psi [objects, K], all factors of p_psi; one training step is one outer iteration of ``rounds``.

    ``inner`` draws an iteration's images and trains the detector on them. A subclass's ``training_step`` ends with
    :meth:`record` and, after the step of psi, appends to ``trajectory`` the method's result if it ended there.
    """

    def __init__(self, inner: InnerLoop, psi: Float[Tensor, "objects K"], rounds: int) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.inner, self.scene, self.settings, self.rounds = inner, inner.scene, inner.settings, rounds
        self.psi = nn.Parameter(psi.detach().clone().double(), requires_grad=False)
        self.records: list[IterationRecord] = []
        self.trajectory = [self.psi.detach().clone()]
        self.on_record: Callable[[IterationRecord], object] = lambda record: None
        self._counted, self._cpu = (0, 0), inner.cpu_begun

    def configure_optimizers(self) -> None:
        return None

    def train_dataloader(self) -> range:
        return range(self.rounds)

    def on_train_batch_end(self, *step: Any) -> None:
        """Call ``on_record``, whose processor time is not counted as the method's."""
        begun = time.process_time()
        self.on_record(self.records[-1])
        self._cpu += time.process_time() - begun

    def record(
        self,
        psi: Float[Tensor, "objects K"],
        images: LabelledImages,
        training_loss: float,
        seconds: dict[str, float],
        certificate: Certificate | None = None,
        gradient: Hypergradient | None = None,
        products: int = 0,
        scores: Tensor | None = None,
        verdicts: Mapping[str, Verdict] | None = None,
    ) -> IterationRecord:
        """Record an iteration on ``images`` drawn from ``psi``, before the step."""
        p_by_factor = self.scene.distribution.probabilities(psi.detach())
        counted, cpu = (self.inner.images, self.inner.steps), time.process_time()
        if not self.records:
            seconds = {"pool": self.inner.pool_seconds, **seconds}
        self.records.append(
            IterationRecord(
                probabilities={name: p.tolist() for name, p in p_by_factor.items()},
                entropies={
                    name: (-torch.special.xlogy(p, p).sum(-1)).tolist() for name, p in p_by_factor.items()
                },
                gradient_norms=self._lengths({} if gradient is None else gradient.psi_gradients),
                gradient_errors=self._lengths({} if gradient is None else gradient.standard_errors),
                validation_loss=self.inner.validation_loss(),
                training_loss=training_loss,
                certificate=certificate,
                images=counted[0] - self._counted[0],
                detector_steps=counted[1] - self._counted[1],
                products=products,
                images_without_box=int((~images.present.any(-1)).sum()),
                scores=[] if scores is None else scores.tolist(),
                verdicts=dict(verdicts or {}),
                seconds=seconds,
                cpu_seconds=cpu - self._cpu,
            )
        )
        self._counted, self._cpu = counted, cpu
        number, last = len(self.records), self.records[-1]
        if certificate is None:
            logger.info("round %d/%d val %.4f%s", number, self.rounds, last.validation_loss, _outcomes(last))
        else:
            logger.info(line(certificate, number, self.rounds, last.validation_loss) + _outcomes(last))
        return last

    def _lengths(self, values: Mapping[str, Tensor]) -> list[float]:
        """By object, in the order of the scene's."""
        return [float(values[name].norm()) for name in self.scene.names] if values else []


def learn_psi(
    module: OuterLoop, progress: bool, on_record: Callable[[IterationRecord], object] | None = None
) -> LearnedPsi:
    """Run the loop to its end by a Lightning Trainer that writes nothing. ``on_record`` is called with the record of
    each iteration when it ends.
    """
    if on_record is not None:
        module.on_record = on_record
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module="lightning")
        # psi and its records are a few numbers: they stay on the CPU wherever images and detector are.
        trainer_on(torch.device("cpu"), progress=progress).fit(module)
    return LearnedPsi(torch.stack(module.trajectory), module.records)


def _outcomes(record: IterationRecord) -> str:
    """Accepted and rejected steps of objects, for the log."""
    text = ""
    for outcome, accepted in (("accepted", True), ("rejected", False)):
        names = [name for name, verdict in record.verdicts.items() if verdict.accepted == accepted]
        text += f"; {outcome} {', '.join(names)}" if names else ""
    return text
