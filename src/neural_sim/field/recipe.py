"""Fit a field to posed views: the configured recipe, its training loop, and the stored form of fields."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, cast

import lightning
import torch
from torch.utils.data import DataLoader
from typing_extensions import override

from neural_sim.checkpoint import Checkpoint
from neural_sim.devices import synchronise, trainer_on
from neural_sim.field.appearance import AppearanceField
from neural_sim.field.base import RadianceField
from neural_sim.field.grid import GridField
from neural_sim.field.mlp import MLPField
from neural_sim.field.objective import Fitting
from neural_sim.ranges import NonNegativeInt, PositiveFraction, PositiveInt, validated
from neural_sim.types import PosedViews

_log = logging.getLogger(__name__)

KINDS: dict[str, type[RadianceField]] = {
    "AppearanceField": AppearanceField,
    "GridField": GridField,
    "MLPField": MLPField,
}
TERMINATION = 1e-3
RAYS_PER_CHUNK = 1 << 15


@validated
@dataclass(frozen=True)
class FieldRecipe:
    """How to fit a field to views.

    Args:
        field: makes a new field.
        fitting: makes the fitting of a field.
        steps: budget of optimiser steps.
        final_rate: final learning rates as a fraction of the initial ones; they fall exponentially.
        seed: seed of the order of rays and of new weights, except those of ``MLPField``, which has a seed of its own;
            separate from the run's seed, so that runs share fields.
    """

    field: Callable[[], RadianceField]
    fitting: Callable[[RadianceField], Fitting]
    steps: PositiveInt = 1000
    final_rate: PositiveFraction = 0.1
    seed: NonNegativeInt = 0

    @property
    def kind(self) -> type[RadianceField] | None:
        """The class of the fields; None if another callable makes them."""
        made = getattr(self.field, "func", self.field)
        return made if isinstance(made, type) and issubclass(made, RadianceField) else None

    def fit(
        self, views: PosedViews, held_out: int, device: torch.device, checkpoint: Checkpoint | None = None
    ) -> tuple[RadianceField, list[dict[str, Any]]]:
        """Return the fitted field, and its scores on the last ``held_out`` views with their steps and seconds.

        The fit resumes from ``checkpoint`` where an earlier run left off.
        """
        placed = views.to(device)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)  # layers of a new field draw from the global generator
            fitting = self.fitting(self.field().to(device))
        fitting.checkpoint = checkpoint
        generator = torch.Generator().manual_seed(self.seed)
        return fit_field(
            placed, fitting, generator, steps=self.steps, held_out=held_out, final_rate=self.final_rate
        )


def fit_field(
    views: PosedViews,
    fitting: Fitting,
    generator: torch.Generator,
    *,
    steps: int,
    held_out: int = 0,
    final_rate: float = 0.1,
) -> tuple[RadianceField, list[dict[str, float]]]:
    """Fit ``fitting.field`` to all but the last ``held_out`` views, on which it is scored (``RadianceFieldModule``).

    Returns the field, in evaluation mode and without gradients, and its history.

    Raises:
        ValueError: no view is left to fit.
    """
    if not 0 <= held_out < len(views):
        raise ValueError(
            f"fit_field: held_out must lie in [0, {len(views)}) for {len(views)} views, got {held_out}"
        )
    count = len(views) - held_out
    index = torch.arange(len(views))
    module = RadianceFieldModule(
        fitting,
        views.select(index[:count]),
        views.select(index[count:]) if held_out else None,
        generator,
        steps,
        final_rate,
    )
    trainer_on(views.images.device).fit(module)
    return module.field.eval().requires_grad_(False), module.history


def field_state(field: RadianceField) -> dict[str, Any]:
    """Return the kind, constructor arguments and tensors (on the CPU) of a field.

    Raises:
        ValueError: an unknown kind.
    """
    kind = type(field).__name__
    if kind not in KINDS:
        raise ValueError(f"field: unknown kind {kind!r}, want one of {sorted(KINDS)}")
    state = {name: tensor.detach().cpu() for name, tensor in field.state_dict().items()}
    return {"kind": kind, "settings": field.settings(), "state": state}


def field_from_state(saved: Mapping[str, Any]) -> RadianceField:
    """Rebuild a field, in evaluation mode, from its ``field_state``.

    Raises:
        ValueError: an unknown kind.
    """
    if saved.get("kind") not in KINDS:
        raise ValueError(f"field: unknown kind {saved.get('kind')!r}, want one of {sorted(KINDS)}")
    field = KINDS[saved["kind"]](**saved["settings"])
    field.load_state_dict(saved["state"])
    return field.eval().requires_grad_(False)


@validated
class RadianceFieldModule(lightning.LightningModule):
    """Fits a field to ``views`` with Adam and scores it on ``held_out``.

    One step is one batch of rays; the learning rate falls exponentially to ``final_rate`` of its start over ``steps``.
    The held-out views are rendered after the last step; their score is the row of ``history`` {seconds, step, psnr,
    psnr_foreground, ssim} and is logged as ``field/...``. Seconds count the fitting from the start of preparation,
    without the scoring itself.
    """

    def __init__(
        self,
        fitting: Fitting,
        views: PosedViews,
        held_out: PosedViews | None,
        generator: torch.Generator,
        steps: PositiveInt,
        final_rate: PositiveFraction = 0.1,
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.fitting, self.field = fitting, fitting.field
        self.views, self.held_out, self.generator = views, held_out, generator
        self.steps, self.final_rate = steps, final_rate
        self.history: list[dict[str, float]] = []
        self._steps_done = 0
        self._begun = time.perf_counter()
        self._optimised: dict[str, Any] | None = None

    @override
    def setup(self, stage: str) -> None:
        self._begun = time.perf_counter()
        self.fitting.start(self.views, self.generator)
        state = None if self.fitting.checkpoint is None else self.fitting.checkpoint.read()
        if state is not None:
            self._restore(state)

    def _restore(self, state: Mapping[str, Any]) -> None:
        self.fitting.restore(state["fitting"])
        self.generator.set_state(state["generator"])
        self._steps_done, self._optimised = state["step"], state["optimiser"]
        self._begun = time.perf_counter() - state["seconds"]
        _log.info("field: resumes after step %d/%d of an interrupted run", self._steps_done, self.steps)

    def _state(self) -> dict[str, Any] | None:
        """Return everything that the next step needs, on the CPU; None if a fit cannot resume at this step."""
        fitting = self.fitting.state()
        optimiser = cast(torch.optim.Optimizer, self.optimizers(use_pl_optimizer=False))
        return fitting and {
            "fitting": _on_cpu(fitting),
            "optimiser": _on_cpu(optimiser.state_dict()),
            "generator": self.generator.get_state(),
            "step": self._steps_done,
            "seconds": time.perf_counter() - self._begun,
        }

    def train_dataloader(self) -> DataLoader[int]:
        """Return a loader that only counts the steps that are left, which need no data."""
        left = range(self._steps_done, self.steps)
        return DataLoader(left, batch_size=None)  # pyright: ignore[reportArgumentType]

    @override
    def configure_optimizers(self) -> torch.optim.Optimizer:
        groups = [
            {"params": parameters, "lr": rate, "initial_lr": rate}
            for parameters, rate in self.fitting.learning_rates()
        ]
        optimiser = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-8, fused=True)
        if self._optimised is not None:
            optimiser.load_state_dict(self._optimised)
        return optimiser

    @override
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
        if last and not math.isfinite(float(loss.detach())):
            raise ValueError(
                f"field: the loss is {float(loss.detach())} after {self.steps} steps: want smaller learning rates "
                "under field.fitting"
            )
        if last:
            self._score()
        elif self.fitting.checkpoint is not None:
            self.fitting.checkpoint.offer(self._state)

    def _score(self) -> None:
        if self.held_out is None:
            return
        synchronise(self.held_out.images.device)
        seconds = time.perf_counter() - self._begun
        self.field.eval()
        scores = self.fitting.score(self.held_out, TERMINATION, RAYS_PER_CHUNK)
        self.history.append({"seconds": seconds, "step": float(self._steps_done), **scores})
        self.log_dict({f"field/{name}": value for name, value in scores.items()} | {"field/seconds": seconds})


def _on_cpu(tree: Any) -> Any:
    """Copy the tensors of a state, because the next steps change them in place."""
    if isinstance(tree, torch.Tensor):
        return tree.detach().cpu().clone()
    if isinstance(tree, Mapping):
        return {key: _on_cpu(value) for key, value in tree.items()}
    return [_on_cpu(value) for value in tree] if isinstance(tree, (list, tuple)) else tree


def _replace_parameters(optimizer: torch.optim.Optimizer, groups: list[list[torch.nn.Parameter]]) -> None:
    """Point the optimiser at new tensors; moments of the unchanged ones are kept."""
    for group, parameters in zip(optimizer.param_groups, groups, strict=True):
        group["params"] = parameters
    current = {parameter for parameters in groups for parameter in parameters}
    for stale in [parameter for parameter in optimizer.state if parameter not in current]:
        del optimizer.state[stale]
