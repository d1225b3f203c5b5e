"""Stage ``field``: the radiance field of an object, fitted to its views."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from typing_extensions import override

from neural_sim.field.base import RadianceField
from neural_sim.field.quality import POOR
from neural_sim.field.recipe import FieldRecipe, field_from_state, field_state
from neural_sim.stages.stage import UNKEYED, Results, Stage
from neural_sim.stages.views import ViewsStage

EVERY = 60.0
"""Seconds between checkpoints of a fit."""


@dataclass(frozen=True)
class FittedField:
    """A field, and its scores on held-out views during the fit, with the steps and seconds at which they were taken."""

    field: RadianceField
    history: list[dict[str, Any]]

    @property
    def psnr(self) -> float | None:
        """PSNR in dB over the object's pixels in held-out views; None without held-out views."""
        value = self.history[-1]["psnr_foreground"] if self.history else float("nan")
        return None if math.isnan(value) else value

    @property
    def poor(self) -> bool:
        """True if the PSNR is too low for the field to show its object."""
        return self.psnr is not None and self.psnr < POOR


@dataclass(frozen=True)
class FieldStage(Stage[FittedField]):
    """The field that ``recipe`` fits to all views except held-out ones."""

    phase: ClassVar[str] = "field"
    kind: ClassVar[str] = "field"

    views: ViewsStage
    recipe: FieldRecipe
    device: torch.device = field(default=torch.device("cpu"), metadata=UNKEYED)

    @property
    @override
    def title(self) -> str:
        return f"field of {self.views.object}"

    def usable(self, results: Results) -> RadianceField:
        """Return the field for rendering training images.

        Raises:
            ValueError: a field fitted to photographs does not show its object, unless ``objects.poor`` allows that.
        """
        fitted = results(self)
        if fitted.poor and self.views.objects.refuses_poor:
            raise ValueError(
                f"{self.views.object}: its field has {fitted.psnr:.1f} dB on the object in held-out photographs, want "
                f"at least {POOR:g}: its renders do not show the object. stages=[field] shows the field in "
                "objects.html; objects.box, objects.masks and sharper photographs help; objects.poor=use accepts it"
            )
        return fitted.field

    @override
    def make(self, results: Results) -> FittedField:
        checkpoint = results.checkpoint(self, every=EVERY)
        views = results(self.views)
        return FittedField(*self.recipe.fit(views, self.views.held_out, self.device, checkpoint))

    @override
    def pack(self, value: FittedField) -> dict[str, Any]:
        return {"field": field_state(value.field), "history": value.history}

    @override
    def unpack(self, stored: Mapping[str, Any]) -> FittedField:
        return FittedField(field_from_state(stored["field"]).to(self.device), stored["history"])
