"""Stage ``quality``: scores and pictures that show how well a field represents its object."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import torch
from typing_extensions import override

from neural_sim.alpha import over_white, premultiplied
from neural_sim.field.grid import GridField
from neural_sim.field.quality import Placed, Quality, as_views, similarity
from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.stages.field import FieldStage
from neural_sim.stages.stage import UNKEYED, Results, Stage
from neural_sim.stages.store import to_bytes
from neural_sim.synthesis.subjects import FieldSubject
from neural_sim.synthesis.thumbnails import bin_thumbnails
from neural_sim.types import PinholeCamera

SHOWN = 4
"""Largest number of held-out views on a page."""


@dataclass(frozen=True)
class QualityStage(Stage[Quality]):
    """Scores and pictures of the field of one object.

    The key covers ``drawn``, the settings that draws depend on, instead of ``distribution``; ``camera`` takes the
    pictures of bins.
    """

    phase: ClassVar[str] = "field"
    kind: ClassVar[str] = "quality"
    keep: ClassVar[bool] = False

    field: FieldStage
    renderer: NerfRenderer
    radius: float | None
    camera: PinholeCamera
    drawn: Any
    distribution: SceneDistribution = dataclasses.field(metadata=UNKEYED)

    @property
    def object(self) -> str:
        """Name of the object."""
        return self.field.views.object

    @property
    @override
    def title(self) -> str:
        return f"quality of {self.object}"

    @override
    def make(self, results: Results) -> Quality:
        fitted, views, count = results(self.field), results(self.field.views), self.field.views.held_out
        first = len(views) - count
        chosen = torch.linspace(first, len(views) - 1, min(SHOWN, count)).round().long()
        shown = views.select(chosen)
        truth = over_white(premultiplied(shown.images)).clamp(0.0, 1.0)
        rendered = over_white(as_views(fitted.field, shown.to(self.field.device)).cpu()).clamp(0.0, 1.0)
        item = FieldSubject(self.object, fitted.field, self.renderer, radius=self.radius)
        bins = {
            factor.name: to_bytes(bin_thumbnails(item, self.distribution, factor.name, self.camera))
            for factor in self.distribution.binned
        }
        objects, settings = self.field.views.objects, self.field.views.settings
        masks = () if self.field.views.masks is None else results(self.field.views.masks)
        photographs = objects.photographs(self.object, settings, masks, (chosen - first).tolist())
        return Quality(
            fitted.psnr,
            similarity(rendered, truth, shown.images[..., 3] > 0.0),
            fitted.field.occupancy.count if isinstance(fitted.field, GridField) else None,
            (to_bytes(truth), to_bytes(shown.images[..., 3:]), to_bytes(rendered)),
            tuple(to_bytes(photograph) for photograph in photographs),
            bins,
            objects.placed(self.object, settings, views),
        )

    @override
    def pack(self, value: Quality) -> dict[str, Any]:
        packed = {name: getattr(value, name) for name in ("psnr", "ssim", "cells")}
        placed = None if value.placed is None else asdict(value.placed)
        if placed is not None:
            placed |= {name: list(placed[name]) for name in ("centre", "distances")}
        return packed | {
            "views": list(value.views), "photographs": list(value.photographs), "bins": dict(value.bins),
            "placed": placed,
        }  # fmt: skip

    @override
    def unpack(self, stored: Mapping[str, Any]) -> Quality:
        placed = stored["placed"]
        if placed is not None:
            placed = Placed(tuple(placed["centre"]), placed["radius"], tuple(placed["distances"]))
        first, second, third = stored["views"]
        return Quality(
            stored["psnr"], stored["ssim"], stored["cells"], (first, second, third),
            tuple(stored["photographs"]), stored["bins"], placed,
        )  # fmt: skip
