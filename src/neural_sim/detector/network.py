"""The network's shape, from torchvision's parts; its parameters' values always come in from outside."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.retinanet import RetinaNetHead
from torchvision.ops import FeaturePyramidNetwork

from neural_sim.detector.backbones import IMAGENET_MEAN, IMAGENET_STD, group_norm, set_activation


class NormalisedBackbone(nn.Module):
    """Images in [0, 1] to feature maps; parameters ``backbone.*``."""

    def __init__(self, backbone: nn.Module) -> None:
        super().__init__()
        self.backbone = backbone

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> tuple[Tensor, ...]:
        mean, std = (_channels(values, images) for values in (IMAGENET_MEAN, IMAGENET_STD))
        # A third faster on a CPU than the default layout, in both directions.
        return self.backbone(((images - mean) / std).contiguous(memory_format=torch.channels_last))


def _channels(values: Sequence[float], like: Tensor) -> Float[Tensor, "3 1 1"]:
    """A number for each channel, made where ``like`` is instead of copied there."""
    return torch.cat([like.new_full((1, 1, 1), value) for value in values])


class Predictor(nn.Module):
    """The feature pyramid and the head shared by its levels; parameters ``fpn.*`` and ``head.*``."""

    def __init__(self, fpn: FeaturePyramidNetwork, head: RetinaNetHead) -> None:
        super().__init__()
        self.fpn = fpn
        self.head = head

    def forward(self, features: Sequence[Tensor]) -> dict[str, Tensor]:
        pyramid = self.fpn(OrderedDict((str(level), x) for level, x in enumerate(features)))
        return self.head(list(pyramid.values()))


def build_predictor(
    in_channels: list[int],
    channels: int,
    anchors: list[int],
    num_classes: int,
    head_convs: int,
    activation: str,
) -> Predictor:
    """The pyramid and head, group-normalised; ``anchors`` are the anchors per location of each level.

    Raises:
        ValueError: where levels differ in anchors per location: they share one head.
    """
    if len(set(anchors)) != 1:
        raise ValueError(f"detector.anchor_sizes: want equally many sizes on every level, got {anchors}")
    fpn = FeaturePyramidNetwork(in_channels, channels, norm_layer=group_norm)
    head = RetinaNetHead(channels, anchors[0], num_classes, norm_layer=group_norm)
    for branch in (head.classification_head, head.regression_head):
        branch.conv = branch.conv[:head_convs]
    predictor = Predictor(fpn, head)
    set_activation(predictor, activation)
    return predictor


def fixed_anchors(
    generator: AnchorGenerator, image_size: tuple[int, int], strides: tuple[int, ...]
) -> tuple[Float[Tensor, "anchors 4"], list[int]]:
    """Anchors of all levels in pixels, and how many each level has; the image size is fixed, so they are too."""
    # A strided convolution of padding 1 leaves ceil(size / 2) pixels.
    grids = [[-(-side // stride) for side in image_size] for stride in strides]
    steps = [[torch.tensor(stride), torch.tensor(stride)] for stride in strides]
    levels = generator.grid_anchors(grids, steps)
    return torch.cat(levels), [len(level) for level in levels]
