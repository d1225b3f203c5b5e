"""The training loop of a radiance field."""

from __future__ import annotations

import time
from typing import Any, cast

import lightning
import torch
from torch.utils.data import DataLoader

from neural_sim.devices import synchronise
from neural_sim.field.objective import Fitting
from neural_sim.types import PosedViews

TERMINATION = 1e-3
RAYS_PER_CHUNK = 1 << 15


class RadianceFieldModule(lightning.LightningModule):
    """Fits a field to ``views`` by Adam and scores it on ``held_out``.

    One step is one batch of rays; the learning rate falls exponentially to ``final_rate`` of its start over ``steps``.
    ``score_every`` steps (0: only at the end) the held-out views are rendered; each score is a row of
    ``history`` {seconds, step, psnr, psnr_foreground, ssim} and is logged as ``field/...``. Seconds are those of
    fitting, from the start of preparation, without the scoring itself.
    """

    def __init__(
        self,
        fitting: Fitting,
        views: PosedViews,
        held_out: PosedViews | None,
        generator: torch.Generator,
        steps: int,
        final_rate: float = 0.1,
        score_every: int = 0,
    ) -> None:
        super().__init__()
        if steps < 1:
            raise ValueError(f"RadianceFieldModule: steps must be at least 1, got {steps}")
        if not 0.0 < final_rate <= 1.0:
            raise ValueError(f"RadianceFieldModule: final_rate must lie in (0, 1], got {final_rate}")
        self.automatic_optimization = False
        self.fitting, self.field = fitting, fitting.field
        self.views, self.held_out, self.generator = views, held_out, generator
        self.steps, self.final_rate, self.score_every = steps, final_rate, score_every
        self.history: list[dict[str, float]] = []
        self._steps_done = 0
        self._begun = time.perf_counter()
        self._paused = 0.0

    def setup(self, stage: str) -> None:
        self._begun = time.perf_counter()
        self.fitting.start(self.views, self.generator)

    def train_dataloader(self) -> DataLoader[int]:
        return DataLoader(range(self.steps), batch_size=None)  # pyright: ignore[reportArgumentType]

    def configure_optimizers(self) -> torch.optim.Optimizer:
        groups = [
            {"params": parameters, "lr": rate, "initial_lr": rate}
            for parameters, rate in self.fitting.learning_rates()
        ]
        return torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-8, fused=True)

    def training_step(self, batch: Any, batch_index: int) -> None:
        optimizer = cast(torch.optim.Optimizer, self.optimizers(use_pl_optimizer=False))
        loss = self.fitting.loss()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        for group in optimizer.param_groups:
            group["lr"] = group["initial_lr"] * self.final_rate ** (self._steps_done / self.steps)
        optimizer.step()
        self._steps_done += 1
        if self.fitting.advance(self._steps_done):
            _replace_parameters(optimizer, [parameters for parameters, _ in self.fitting.learning_rates()])
        last = self._steps_done == self.steps
        if last or (self.score_every and self._steps_done % self.score_every == 0):
            self._score()

    def _score(self) -> None:
        if self.held_out is None:
            return
        synchronise(self.held_out.images.device)
        now = time.perf_counter()
        self.field.eval()
        scores = self.fitting.score(self.held_out, TERMINATION, RAYS_PER_CHUNK)
        self.field.train()
        seconds = now - self._begun - self._paused
        self._paused += time.perf_counter() - now
        self.history.append({"seconds": seconds, "step": float(self._steps_done), **scores})
        self.log_dict({f"field/{name}": value for name, value in scores.items()} | {"field/seconds": seconds})


def _replace_parameters(optimizer: torch.optim.Optimizer, groups: list[list[torch.nn.Parameter]]) -> None:
    """Point the optimiser at new tensors; moments of those that stay are kept."""
    for group, parameters in zip(optimizer.param_groups, groups, strict=True):
        group["params"] = parameters
    current = {parameter for parameters in groups for parameter in parameters}
    for stale in [parameter for parameter in optimizer.state if parameter not in current]:
        del optimizer.state[stale]
