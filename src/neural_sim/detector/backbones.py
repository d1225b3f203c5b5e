"""Backbones: images to feature maps at fixed strides."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torchvision.models import get_model, get_model_weights, resnet
from torchvision.ops import FrozenBatchNorm2d

from neural_sim.detector.settings import SAVED

logger = logging.getLogger(__name__)

ACTIVATIONS: dict[str, Callable[[], nn.Module]] = {"silu": nn.SiLU, "relu": nn.ReLU}
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


def group_norm(channels: int) -> nn.GroupNorm:
    """Groups of 8 channels: the batch plays no part, so that an image's loss is its own."""
    return nn.GroupNorm(max(1, channels // 8), channels)


def set_activation(module: nn.Module, activation: str) -> None:
    """Replace every ReLU below ``module``, never in place: function transforms replay the graph."""
    for name, child in module.named_children():
        if isinstance(child, nn.ReLU):
            setattr(module, name, ACTIVATIONS[activation]())
        else:
            set_activation(child, activation)


class ResidualBlock(nn.Module):
    """Two convolutions beside the identity; width and size stay."""

    def __init__(self, channels: int, activation: str) -> None:
        super().__init__()
        act = ACTIVATIONS[activation]
        self.body = nn.Sequential(
            nn.Conv2d(channels, channels, 3, padding=1, bias=False),
            group_norm(channels),
            act(),
            nn.Conv2d(channels, channels, 3, padding=1, bias=False),
            group_norm(channels),
        )
        self.activation = act()

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        return self.activation(x + self.body(x))


@dataclass(frozen=True)
class Plan:
    """Shape of a ``StridedBackbone``: output channels of its four stages, and which end in a residual block."""

    widths: tuple[int, int, int, int]
    residual: tuple[bool, bool, bool, bool]


PLANS = {
    "tiny": Plan((16, 32, 64, 96), (False, False, True, True)),  # 0.3 M parameters
    "micro": Plan((4, 8, 8, 8), (False, False, False, False)),  # 1,604 parameters
}


class StridedBackbone(nn.Module):
    """Four convolutions of stride 2; maps at strides 8 and 16 may be asked for."""

    def __init__(self, plan: Plan, strides: tuple[int, ...], activation: str) -> None:
        super().__init__()
        self.channels = {8: plan.widths[2], 16: plan.widths[3]}
        self.strides = strides
        self.stages = nn.ModuleList()
        before = 3
        for after, residual in zip(plan.widths, plan.residual, strict=True):
            layers: list[nn.Module] = [
                nn.Conv2d(before, after, 3, stride=2, padding=1, bias=False),
                group_norm(after),
                ACTIVATIONS[activation](),
            ]
            if residual:
                layers.append(ResidualBlock(after, activation))
            self.stages.append(nn.Sequential(*layers))
            before = after

    def forward(self, x: Float[Tensor, "n 3 h w"]) -> tuple[Tensor, ...]:
        maps = {}
        for level, stage in enumerate(self.stages):
            x = stage(x)
            maps[2 ** (level + 1)] = x
        return tuple(maps[stride] for stride in self.strides)


class ResNetBackbone(nn.Module):
    """A torchvision ResNet without its classifier.

    With weights its batch normalisation is frozen; without, group normalisation stands in its place, because
    a frozen normalisation that has seen no data normalises nothing.
    """

    def __init__(
        self, architecture: str, strides: tuple[int, ...], activation: str, weights: str | None
    ) -> None:
        super().__init__()
        builder = {"resnet18": resnet.resnet18, "resnet50": resnet.resnet50}[architecture]
        body = builder(norm_layer=group_norm if weights is None else FrozenBatchNorm2d)
        del body.fc
        if weights not in (None, SAVED):
            body.load_state_dict(load_weights(architecture, weights), strict=False)
        # Weights were trained with ReLU and keep it.
        set_activation(body, activation if weights is None else "relu")
        widening = 4 if architecture == "resnet50" else 1
        self.channels = {4: 64 * widening, 8: 128 * widening, 16: 256 * widening, 32: 512 * widening}
        self.strides = strides
        self.body = body

    def forward(self, x: Float[Tensor, "n 3 h w"]) -> tuple[Tensor, ...]:
        body = self.body
        x = body.maxpool(body.relu(body.bn1(body.conv1(x))))
        maps = {}
        for stride, layer in zip(
            (4, 8, 16, 32), (body.layer1, body.layer2, body.layer3, body.layer4), strict=True
        ):
            x = layer(x)
            maps[stride] = x
        return tuple(maps[stride] for stride in self.strides)


def load_weights(architecture: str, weights: str) -> dict[str, Tensor]:
    """State dictionary of a torchvision ResNet, without the classifier and counters.

    ``weights`` is the path of a file holding such a state dictionary, else one of torchvision's weight names
    (``DEFAULT``, ``IMAGENET1K_V1``, ...), which torchvision downloads or takes from its cache.

    Raises:
        ValueError: where neither a file nor a weight name is meant, or the file's tensors do not fit.
    """
    if Path(weights).is_file():
        state = torch.load(weights, map_location="cpu", weights_only=True)
    else:
        names = list(get_model_weights(architecture).__members__)
        if weights not in (*names, "DEFAULT"):
            raise ValueError(f"detector.backbone.weights: want a file or one of {names}, got {weights!r}")
        state = get_model(architecture, weights=weights).state_dict()
    state = {k: v for k, v in state.items() if not k.startswith("fc.") and "num_batches" not in k}
    template = get_model(architecture).state_dict()
    wanted = {k: v.shape for k, v in template.items() if not k.startswith("fc.") and "num_batches" not in k}
    wrong = sorted(
        k for k in wanted.keys() | state.keys() if k not in state or state[k].shape != wanted.get(k)
    )
    if wrong:
        raise ValueError(
            f"detector.backbone.weights: {weights} does not fit {architecture}, first at {wrong[:3]}"
        )
    return state


def build_backbone(
    architecture: str, strides: tuple[int, ...], activation: str, weights: str | None
) -> StridedBackbone | ResNetBackbone:
    """The backbone by name, with ``channels`` (stride -> width) and a tuple of maps as output.

    Raises:
        ValueError: for weights that do not exist or do not fit.
    """
    if architecture in PLANS:
        if weights is not None:
            raise ValueError(
                f"detector.backbone.weights: {architecture} has no published weights, got {weights!r}, want null"
            )
        return StridedBackbone(PLANS[architecture], strides, activation)
    return ResNetBackbone(architecture, strides, activation, weights)
