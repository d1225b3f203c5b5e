"""A labelled set passed through a frozen backbone; its features are computed once for all losses and scores."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.detector.losses import Targets
from neural_sim.detector.protocol import Detector, Outputs, Parameters
from neural_sim.types import LabelledImages


@torch.no_grad()
def cached_features(
    detector: Detector, backbone: Parameters, images: Tensor, batch_size: int = 64
) -> tuple[Tensor, ...]:
    """Compute the features of images [n, 3, H, W] in [0, 1], one tensor [n, ...] for each level.

    They are computed batch by batch on the backbone's device (the images', if it has no parameters), without an
    autograd graph.

    Raises:
        ValueError: there are no images (for instance, an empty target set), so the mean loss is undefined.
    """
    if len(images) == 0:
        raise ValueError("cached_features: got no images, want at least one")
    device = next((value.device for value in backbone.values()), images.device)
    parts = [detector.features(backbone, chunk.to(device)) for chunk in images.split(batch_size)]
    return tuple(torch.cat(level) for level in zip(*parts, strict=True))


@dataclass(frozen=True)
class CachedSet:
    """The inputs of the predictor's loss on n images, computed by a frozen backbone.

    Attributes:
        detector: the detector.
        features: one tensor [n, ...] for each level.
        targets: the anchor targets of the images.
    """

    detector: Detector
    features: tuple[Tensor, ...]
    targets: Targets

    def __len__(self) -> int:
        return len(self.targets)

    @staticmethod
    def of(
        detector: Detector, backbone: Parameters, images: LabelledImages, batch_size: int = 64
    ) -> CachedSet:
        """Compute features and targets of ``images`` on the backbone's device; the images may be on another."""
        features = cached_features(detector, backbone, images.images, batch_size)
        device = features[0].device
        return CachedSet(
            detector, features, detector.assign(images.boxes.to(device), images.labels.to(device))
        )

    @staticmethod
    def streamed(
        detector: Detector, backbone: Parameters, sets: Iterable[LabelledImages], batch_size: int = 64
    ) -> CachedSet:
        """Compute what ``of`` returns for all ``sets`` concatenated, in the same batches.

        Only the images of one set and of an incomplete batch are in memory at a time.

        Raises:
            ValueError: there is no set.
        """
        parts: list[CachedSet] = []
        waiting: list[LabelledImages] = []
        for images in sets:
            together = LabelledImages.concatenate([*waiting, images])
            whole = len(together) // batch_size * batch_size
            if whole:
                parts.append(CachedSet.of(detector, backbone, together.select(slice(0, whole)), batch_size))
            waiting = [together.select(slice(whole, None))] if whole < len(together) else []
        if waiting or not parts:
            parts.append(CachedSet.of(detector, backbone, LabelledImages.concatenate(waiting), batch_size))
        return CachedSet.concatenate(parts)

    @staticmethod
    def concatenate(parts: Sequence[CachedSet]) -> CachedSet:
        """Join the images of all ``parts``, which must share a detector and an image size."""
        targets = Targets(
            torch.cat([part.targets.labels for part in parts]),
            torch.cat([part.targets.deltas for part in parts]),
        )
        levels = zip(*(part.features for part in parts), strict=True)
        return CachedSet(parts[0].detector, tuple(torch.cat(level) for level in levels), targets)

    @property
    def device(self) -> torch.device:
        """The device of features, targets and row indices."""
        return self.targets.labels.device

    def losses(self, params: Parameters, index: Tensor) -> Float[Tensor, "n"]:
        """Compute the losses of the images ``index``."""
        return self.detector.losses_of(self.outputs(params, index), self.targets.select(index))

    def outputs(self, params: Parameters, index: Tensor) -> Outputs:
        """Compute the detector's outputs on the images ``index``."""
        return self.detector.outputs(params, tuple(level[index] for level in self.features))

    @property
    def inputs(self) -> tuple[Tensor, ...]:
        """Inputs of the losses that depend on images and boxes: features by level, encoded boxes [n, anchors, 4]."""
        return (*self.features, self.targets.deltas)

    def losses_from(
        self, params: Parameters, inputs: tuple[Tensor, ...], index: Tensor
    ) -> Float[Tensor, "n"]:
        """Compute losses of the images ``index`` from given rows of ``inputs``, differentiable in these rows."""
        targets = Targets(self.targets.labels[index], inputs[-1])
        return self.detector.per_image_loss(params, inputs[:-1], targets)

    def select(self, index: Tensor) -> CachedSet:
        """Return the set of the images ``index`` only."""
        index = index.to(self.device)
        features = tuple(level[index] for level in self.features)
        return CachedSet(self.detector, features, self.targets.select(index))

    def replaced(self, index: Tensor, others: CachedSet) -> CachedSet:
        """Return the set with the images ``index`` replaced by ``others``."""
        place = index.to(self.device)
        features = tuple(
            level.index_copy(0, place, new) for level, new in zip(self.features, others.features, strict=True)
        )
        labels = self.targets.labels.index_copy(0, place, others.targets.labels)
        deltas = self.targets.deltas.index_copy(0, place, others.targets.deltas)
        return CachedSet(self.detector, features, Targets(labels, deltas))

    def double(self) -> CachedSet:
        """Return the set in float64."""
        targets = Targets(self.targets.labels, self.targets.deltas.double())
        return CachedSet(self.detector, tuple(level.double() for level in self.features), targets)

    def mean_terms(self, chunk_size: int = 32) -> list[Callable[[Parameters], Tensor]]:
        """Return the mean loss as a sum of terms, each of at most ``chunk_size`` images."""
        count = len(self.targets)
        return [
            lambda params, rows=rows: self.losses(params, rows).sum() / count
            for rows in torch.arange(count, device=self.device).split(chunk_size)
        ]
