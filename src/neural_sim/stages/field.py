"""Stage ``field``: the radiance field of an object, fitted to its views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from typing_extensions import override

from neural_sim.field.base import RadianceField
from neural_sim.field.recipe import FieldRecipe, field_from_state, field_state
from neural_sim.stages.stage import UNKEYED, Results, Stage
from neural_sim.stages.views import ViewsStage


@dataclass(frozen=True)
class FittedField:
    """A field and its scores on held-out views against steps and seconds."""

    field: RadianceField
    history: list[dict[str, Any]]


@dataclass(frozen=True)
class FieldStage(Stage[FittedField]):
    """The field that ``recipe`` fits to all views but the held-out ones."""

    phase: ClassVar[str] = "field"
    kind: ClassVar[str] = "field"

    views: ViewsStage
    recipe: FieldRecipe
    device: torch.device = field(default=torch.device("cpu"), metadata=UNKEYED)

    @property
    @override
    def title(self) -> str:
        return f"field of {self.views.object}"

    @override
    def make(self, results: Results) -> FittedField:
        return FittedField(*self.recipe.fit(results(self.views), self.views.held_out, self.device))

    @override
    def pack(self, value: FittedField) -> dict[str, Any]:
        return {"field": field_state(value.field), "history": value.history}

    @override
    def unpack(self, stored: Mapping[str, Any]) -> FittedField:
        return FittedField(field_from_state(stored["field"]).to(self.device), stored["history"])
