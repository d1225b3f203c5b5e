"""Probes: stratified samples of images with a fixed number in every bin; each iteration replaces a fraction."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.detector.cached_set import CachedSet
from neural_sim.detector.losses import Targets
from neural_sim.detector.protocol import Detector, Parameters
from neural_sim.gradient.base import Probes
from neural_sim.synthesis.scene import Scene
from neural_sim.types import LabelledImages


@dataclass(frozen=True)
class ProbeSet:
    """Stratified samples: images of every bin of every factor, with their features.

    They show the objects whose derivatives are wanted. The bins of an illumination factor are its anchor lights.

    Attributes:
        probes: for each object, by factor, its rows of ``cached``, bin after bin; empty for objects left out.
        cached: the images' features.
        per_bin: number of images in every bin.
        turn: number of times that some were replaced.
    """

    probes: list[dict[str, Probes]]
    cached: CachedSet
    per_bin: int
    turn: int = 0

    @staticmethod
    def draw(
        scene: Scene,
        detector: Detector,
        backbone: Parameters,
        per_bin: int,
        psi: Float[Tensor, "objects K"],
        generator: torch.Generator,
        objects: Sequence[int],
    ) -> ProbeSet:
        """Draw probes of the given ``objects``; all factors except the stratified one are drawn from p_psi."""
        probes: list[dict[str, Probes]] = [{} for _ in scene.names]

        def drawn() -> Iterator[LabelledImages]:
            first = 0
            for label in objects:
                for factor in scene.distribution.factors:
                    images, draw = scene.probes(label, factor.name, per_bin, psi, generator)
                    index = torch.arange(first, first + len(images))
                    probes[label][factor.name] = Probes(index, factor.stratum_of(draw))
                    first += len(index)
                    yield images

        return ProbeSet(probes, CachedSet.streamed(detector, backbone, drawn()), per_bin)

    def state(self) -> dict[str, Any]:
        """Return the probes as tensors on the CPU and numbers, from which ``of`` restores them."""
        cached = self.cached
        return {
            "rows": [{name: (p.index, p.bins) for name, p in own.items()} for own in self.probes],
            "features": [level.cpu() for level in cached.features],
            "targets": [cached.targets.labels.cpu(), cached.targets.deltas.cpu()],
            "per_bin": self.per_bin,
            "turn": self.turn,
        }

    @staticmethod
    def of(state: Mapping[str, Any], detector: Detector, device: torch.device) -> ProbeSet:
        """Restore the probes of a ``state``, with their features on ``device``."""
        features = tuple(level.to(device) for level in state["features"])
        targets = Targets(*(part.to(device) for part in state["targets"]))
        probes = [{name: Probes(*rows) for name, rows in own.items()} for own in state["rows"]]
        return ProbeSet(probes, CachedSet(detector, features, targets), state["per_bin"], state["turn"])

    def renewed(self, fresh: ProbeSet) -> ProbeSet:
        """Replace ``fresh.per_bin`` probes of every bin, the ones that have been there longest.

        Raises:
            ValueError: there are more fresh probes of a bin than it has.
        """
        if fresh.per_bin > self.per_bin:
            raise ValueError(f"probes: want at most {self.per_bin} fresh ones per bin, got {fresh.per_bin}")
        places = (self.turn * fresh.per_bin + torch.arange(fresh.per_bin)) % self.per_bin
        targets, sources, probes = [], [], []
        for old, new in zip(self.probes, fresh.probes, strict=True):
            probes.append({})
            for name, part in old.items():
                rows = part.index.view(-1, self.per_bin)[:, places]
                bins = part.bins.view(-1, self.per_bin).clone()
                bins[:, places] = new[name].bins.view(-1, fresh.per_bin)
                probes[-1][name] = Probes(part.index, bins.view(-1))
                targets.append(rows.reshape(-1))
                sources.append(new[name].index)
        cached = self.cached.replaced(torch.cat(targets), fresh.cached.select(torch.cat(sources)))
        return ProbeSet(probes, cached, self.per_bin, self.turn + 1)
