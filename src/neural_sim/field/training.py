"""Fit a field to posed views in one call; convert a field to tensors and settings for storage."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from neural_sim.devices import trainer_on
from neural_sim.field.appearance import AppearanceField
from neural_sim.field.base import RadianceField
from neural_sim.field.grid import GridField
from neural_sim.field.mlp import MLPField
from neural_sim.field.module import RadianceFieldModule
from neural_sim.field.objective import Fitting
from neural_sim.types import PosedViews

KINDS: dict[str, type[RadianceField]] = {
    "AppearanceField": AppearanceField,
    "GridField": GridField,
    "MLPField": MLPField,
}


def fit_field(
    views: PosedViews,
    fitting: Fitting,
    generator: torch.Generator,
    *,
    steps: int,
    held_out: int = 0,
    final_rate: float = 0.1,
    score_every: int = 0,
) -> tuple[RadianceField, list[dict[str, float]]]:
    """Fit ``fitting.field`` to all but the last ``held_out`` views, which score it (see ``RadianceFieldModule``).

    Returns the field, in evaluation mode and without gradients, and its history. Raises ValueError when no view is
    left to fit.
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
        score_every,
    )
    trainer_on(views.images.device).fit(module)
    return module.field.eval().requires_grad_(False), module.history


def field_state(field: RadianceField) -> dict[str, Any]:
    """Kind, constructor arguments and tensors of a field, on the CPU. Raises ``ValueError`` for an unknown kind."""
    kind = type(field).__name__
    if kind not in KINDS:
        raise ValueError(f"field: unknown kind {kind!r}, want one of {sorted(KINDS)}")
    state = {name: tensor.detach().cpu() for name, tensor in field.state_dict().items()}
    return {"kind": kind, "settings": field.settings(), "state": state}


def field_from_state(saved: Mapping[str, Any]) -> RadianceField:
    """Inverse of :func:`field_state`, in evaluation mode. Raises ``ValueError`` for an unknown kind."""
    if saved.get("kind") not in KINDS:
        raise ValueError(f"field: unknown kind {saved.get('kind')!r}, want one of {sorted(KINDS)}")
    field = KINDS[saved["kind"]](**saved["settings"])
    field.load_state_dict(saved["state"])
    return field.eval().requires_grad_(False)
