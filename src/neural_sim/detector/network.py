"""The network's shape, built from torchvision's parts, and its random initial values.

Parameter values are always passed in. They are drawn here from an explicit generator, because torch's module
constructors use only the global one.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.ops import FeaturePyramidNetwork
from torchvision.ops.feature_pyramid_network import ExtraFPNBlock
from typing_extensions import override

from neural_sim.detector.backbones import ACTIVATIONS, IMAGENET_MEAN, IMAGENET_STD, group_norm, set_activation
from neural_sim.detector.settings import Anchors, Head


class NormalisedBackbone(nn.Module):
    """A backbone preceded by the normalisation of images in [0, 1]; its parameters are named ``backbone.*``."""

    def __init__(self, backbone: nn.Module) -> None:
        super().__init__()
        self.backbone = backbone

    @override
    def forward(self, images: Float[Tensor, "n 3 h w"]) -> tuple[Tensor, ...]:
        mean, std = (_channels(values, images) for values in (IMAGENET_MEAN, IMAGENET_STD))
        # A third faster on a CPU than the default layout, forwards and backwards.
        return self.backbone(((images - mean) / std).contiguous(memory_format=torch.channels_last))


def _channels(values: Sequence[float], like: Tensor) -> Float[Tensor, "3 1 1"]:
    """Return one number for each channel, created on the device of ``like`` without a copy."""
    return torch.cat([like.new_full((1, 1, 1), value) for value in values])


class CoarserLevels(ExtraFPNBlock):
    """Pyramid levels above the backbone's last map C5 (Lin et al. 2017, Sec. 4).

    P6 is a convolution of stride 2 on C5, P7 one on the activated P6, and so on. No level is smaller than one pixel.
    """

    def __init__(self, in_channels: int, channels: int, count: int, activation: str) -> None:
        super().__init__()
        widths = [in_channels] + [channels] * (count - 1)
        self.convs = nn.ModuleList(nn.Conv2d(width, channels, 3, stride=2, padding=1) for width in widths)
        self.activation = ACTIVATIONS[activation]()

    @override
    def forward(
        self, results: list[Tensor], x: list[Tensor], names: list[str]
    ) -> tuple[list[Tensor], list[str]]:
        level = x[-1]
        for number, conv in enumerate(self.convs):
            level = conv(self.activation(level) if number else level)
            results.append(level)
            names.append(f"coarser{number}")
        return results, names


class Predictor(nn.Module):
    """The feature pyramid, and the head that its levels share; parameters are named ``fpn.*`` and ``head.*``."""

    def __init__(self, fpn: FeaturePyramidNetwork, head: nn.Module) -> None:
        super().__init__()
        self.fpn = fpn
        self.head = head

    @override
    def forward(self, features: Sequence[Tensor]) -> dict[str, Tensor]:
        pyramid = self.fpn(OrderedDict((str(level), x) for level, x in enumerate(features)))
        return self.head(list(pyramid.values()))


def build_predictor(
    in_channels: list[int], levels: int, head: nn.Module, settings: Head, activation: str
) -> Predictor:
    """Build a pyramid of ``levels`` levels, with ``head`` on top of it.

    Levels in excess of ``in_channels`` are coarser than the backbone's maps.
    """
    channels, norm = settings.channels, group_norm if settings.normalisation == "group" else None
    coarser = levels - len(in_channels)
    extra = CoarserLevels(in_channels[-1], channels, coarser, activation) if coarser else None
    fpn = FeaturePyramidNetwork(in_channels, channels, extra, norm)
    predictor = Predictor(fpn, head)
    set_activation(predictor, activation)
    return predictor


def fixed_anchors(
    settings: Anchors, image_size: tuple[int, int]
) -> tuple[Float[Tensor, "anchors 4"], list[int]]:
    """Return the anchors of all levels in pixels, and the number of anchors of each level."""
    scale = 1.0 if settings.reference is None else min(image_size) / settings.reference
    sizes = tuple(tuple(scale * size for size in level) for level in settings.sizes)
    generator, strides = AnchorGenerator(sizes, (tuple(settings.ratios),) * len(sizes)), settings.strides
    # A strided convolution with padding 1 leaves ceil(size / 2) pixels, hence at least one.
    grids = [[-(-side // stride) for side in image_size] for stride in strides]
    steps = [[torch.tensor(stride), torch.tensor(stride)] for stride in strides]
    levels = generator.grid_anchors(grids, steps)
    return torch.cat(levels), [len(level) for level in levels]


def initialise(
    module: nn.Module, generator: torch.Generator, prior_probability: float | None = None
) -> dict[str, Tensor]:
    """Draw a state dictionary of ``module``: He-normal convolutions, unit normalisations, zero biases.

    In a predictor's ``head``, convolutions with a bias start at standard deviation 0.01, and the bias of the layer
    ``cls_logits`` makes it predict ``prior_probability`` (Lin et al. 2017, Sec. 4.1). Other convolutions preserve the
    variance of their input, as torchvision's do. A linear layer starts at standard deviation 0.01 (Goyal et al. 2017).
    """
    state = {name: value.detach().clone() for name, value in module.state_dict().items()}
    for name, part in module.named_modules():
        prefix = f"{name}." if name else ""
        if isinstance(part, nn.Conv2d):
            std = math.sqrt(2.0 / (part.in_channels * math.prod(part.kernel_size)))
            if part.bias is not None:
                std = 0.01 if name.startswith("head.") else std / math.sqrt(2.0)
                state[f"{prefix}bias"].zero_()
            state[f"{prefix}weight"].normal_(0.0, std, generator=generator)
            if name.endswith(".cls_logits") and prior_probability is not None:
                state[f"{prefix}bias"].fill_(-math.log((1 - prior_probability) / prior_probability))
        elif isinstance(part, nn.Linear):
            state[f"{prefix}weight"].normal_(0.0, 0.01, generator=generator)
            state[f"{prefix}bias"].zero_()
        elif isinstance(part, nn.GroupNorm):
            state[f"{prefix}weight"].fill_(1.0)
            state[f"{prefix}bias"].zero_()
    return state
