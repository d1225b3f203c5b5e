"""Masks of photographs from the geometry of their scene, before their views (part of stage ``views``)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from neural_sim.objects.photos import Photos
from neural_sim.objects.pictures import SceneMaskMaker
from neural_sim.stages.pixels import from_bytes, to_bytes
from neural_sim.stages.stage import UNKEYED, Results, Stage

Computed = tuple[Float[Tensor, "_ _"], ...]


@dataclass(frozen=True)
class MasksStage(Stage[Computed]):
    """A mask for each photograph of one object. ``content`` is the digest of the capture's files and options; ``scene``
    is the source's, with its budget. Not the run's seed, so that runs share masks.
    """

    phase: ClassVar[str] = "views"
    kind: ClassVar[str] = "masks"
    keep: ClassVar[bool] = False  # read once, by the views

    object: str
    content: str
    scene: SceneMaskMaker
    source: Photos = field(metadata=UNKEYED)

    @classmethod
    def of(cls, source: Photos, name: str, content: str) -> MasksStage | None:
        """The stage of an object, None where photographs bring their masks."""
        if source.masks != "scene" or source.scene is None:
            return None
        return cls(name, content, source.scene, source)

    @property
    def title(self) -> str:
        return f"masks of {self.object}"

    def make(self, results: Results) -> Computed:
        return self.source.computed_masks(self.object)

    def pack(self, value: Computed) -> list[Tensor]:
        return [to_bytes(mask) for mask in value]

    def unpack(self, stored: list[Tensor]) -> Computed:
        return tuple(from_bytes(mask) for mask in stored)
