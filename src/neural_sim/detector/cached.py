"""A labelled set under a frozen backbone: its features are computed once for all losses, products and scores."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.detector.protocol import Detector, Outputs, Parameters
from neural_sim.detector.targets import Targets
from neural_sim.types import LabelledImages


@torch.no_grad()
def cached_features(
    detector: Detector, backbone: Parameters, images: Tensor, batch_size: int = 64
) -> tuple[Tensor, ...]:
    """Feature maps of all images, computed batch by batch on the backbone's device, without a graph.

    Raises:
        ValueError: for an empty set, such as a target set of no images, whose mean loss does not exist.
    """
    if len(images) == 0:
        raise ValueError("cached_features: got no images, want at least one")
    device = next(iter(backbone.values())).device
    parts = [detector.features(backbone, chunk.to(device)) for chunk in images.split(batch_size)]
    return tuple(torch.cat(level) for level in zip(*parts, strict=True))


@dataclass(frozen=True)
class CachedSet:
    """Features of a set's images under the frozen backbone, and their targets: all the predictor's loss needs."""

    detector: Detector
    features: tuple[Tensor, ...]
    targets: Targets

    def __len__(self) -> int:
        return len(self.targets)

    @staticmethod
    def of(detector: Detector, backbone: Parameters, images: LabelledImages) -> CachedSet:
        """The set under a backbone, on whose device it is kept; the images may be elsewhere."""
        features = cached_features(detector, backbone, images.images)
        device = features[0].device
        return CachedSet(
            detector, features, detector.assign(images.boxes.to(device), images.labels.to(device))
        )

    @property
    def device(self) -> torch.device:
        """Of features and targets, and so of the rows that losses are asked for."""
        return self.targets.labels.device

    def losses(self, params: Parameters, index: Tensor) -> Float[Tensor, "n"]:
        """Losses of the images ``index``."""
        return self.detector.losses_of(self.outputs(params, index), self.targets.select(index))

    def outputs(self, params: Parameters, index: Tensor) -> Outputs:
        """The detector's outputs on the images ``index``."""
        return self.detector.outputs(params, tuple(level[index] for level in self.features))

    @property
    def inputs(self) -> tuple[Tensor, ...]:
        """What the losses are functions of where images and boxes move: features, then the targets' boxes."""
        return (*self.features, self.targets.deltas)

    def losses_from(
        self, params: Parameters, inputs: tuple[Tensor, ...], index: Tensor
    ) -> Float[Tensor, "n"]:
        """Losses of the images ``index`` from these rows of :attr:`inputs`, differentiable in them."""
        targets = Targets(self.targets.labels[index], inputs[-1])
        return self.detector.per_image_loss(params, inputs[:-1], targets)

    def select(self, index: Tensor) -> CachedSet:
        """The images ``index`` alone."""
        index = index.to(self.device)
        features = tuple(level[index] for level in self.features)
        return CachedSet(self.detector, features, self.targets.select(index))

    def replaced(self, index: Tensor, others: CachedSet) -> CachedSet:
        """The same with ``others`` in the places ``index``."""
        place = index.to(self.device)
        features = tuple(
            level.index_copy(0, place, new) for level, new in zip(self.features, others.features, strict=True)
        )
        labels = self.targets.labels.index_copy(0, place, others.targets.labels)
        deltas = self.targets.deltas.index_copy(0, place, others.targets.deltas)
        return CachedSet(self.detector, features, Targets(labels, deltas))

    def double(self) -> CachedSet:
        """The same in float64."""
        targets = Targets(self.targets.labels, self.targets.deltas.double())
        return CachedSet(self.detector, tuple(level.double() for level in self.features), targets)

    def mean_terms(self, chunk_size: int = 32) -> list[Callable[[Parameters], Tensor]]:
        """The mean loss as a sum over chunks."""
        count = len(self.targets)
        return [
            lambda params, rows=rows: self.losses(params, rows).sum() / count
            for rows in torch.arange(count, device=self.device).split(chunk_size)
        ]
