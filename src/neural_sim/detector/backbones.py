"""Backbones: images to feature maps at fixed strides."""

from __future__ import annotations

import logging
import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torchvision.models import get_model, get_model_weights, resnet
from torchvision.ops import FrozenBatchNorm2d
from typing_extensions import override

from neural_sim.detector.settings import SAVED

logger = logging.getLogger(__name__)

ACTIVATIONS: dict[str, Callable[[], nn.Module]] = {"silu": nn.SiLU, "relu": nn.ReLU}
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


def group_norm(channels: int) -> nn.GroupNorm:
    """Build a normalisation over groups of 8 channels.

    Unlike batch normalisation, it keeps an image's loss independent of the other images.
    """
    return nn.GroupNorm(max(1, channels // 8), channels)


def set_activation(module: nn.Module, activation: str) -> None:
    """Replace every ReLU in ``module`` by an ``activation`` that does not work in place.

    Function transforms replay the graph, so no input may be overwritten.
    """
    for name, child in module.named_children():
        if isinstance(child, nn.ReLU):
            setattr(module, name, ACTIVATIONS[activation]())
        else:
            set_activation(child, activation)


class ResidualBlock(nn.Module):
    """Two convolutions with a skip connection; channels and resolution stay the same."""

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

    @override
    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        return self.activation(x + self.body(x))


@dataclass(frozen=True)
class Plan:
    """Shape of a strided backbone: output channels of its four stages, and which of them end in a residual block."""

    widths: tuple[int, int, int, int]
    residual: tuple[bool, bool, bool, bool]


PLANS = {
    "tiny": Plan((16, 32, 64, 96), (False, False, True, True)),  # 0.3 M parameters
    "micro": Plan((4, 8, 8, 8), (False, False, False, False)),  # 1,604 parameters
}


class Stages(nn.Module):
    """A sequence of modules, some of which end a stage; the maps at ``strides`` are the backbone's output.

    ``children`` are registered under the attribute name ``under``, which becomes part of their parameter names.
    ``ends`` maps each module that ends a stage to its stride, from fine to coarse. ``channels`` maps strides to numbers
    of channels.
    """

    def __init__(
        self,
        under: str,
        children: Mapping[str, nn.Module],
        ends: Mapping[str, int],
        strides: tuple[int, ...],
        channels: Mapping[int, int],
    ) -> None:
        super().__init__()
        self._under, self._ends, self.strides, self.channels = under, dict(ends), strides, dict(channels)
        self.add_module(under, nn.ModuleDict(children))

    @override
    def forward(self, x: Float[Tensor, "n c h w"]) -> tuple[Tensor, ...]:
        maps = {}
        for name, child in self.get_submodule(self._under).named_children():
            x = child(x)
            if name in self._ends:
                maps[self._ends[name]] = x
        return tuple(maps[stride] for stride in self.strides)

    def divided(self, layers: int) -> tuple[Stages, LastStages]:
        """Split the backbone in two, with the last ``layers`` stages in the second part.

        Both parts share the backbone's parameters: each holds the ones it needs, under unchanged names.

        Raises:
            ValueError: ``layers`` is below 1, or not below the number of stages.
        """
        if not 0 < layers < len(self._ends):
            raise ValueError(
                f"outer.loop_layers must be at least 0 and below {len(self._ends)}, got {layers}"
            )
        names, before = (
            [n for n, _ in self.get_submodule(self._under).named_children()],
            list(self._ends)[-layers - 1],
        )
        cut, last = names.index(before) + 1, self._ends[before]
        kept = tuple(stride for stride in self.strides if stride < last)
        first = self._part(names[:cut], (*kept, last))
        rest = tuple(stride for stride in self.strides if stride > last)
        return first, LastStages(self._part(names[cut:], rest), len(kept) + (last in self.strides))

    def _part(self, names: Sequence[str], strides: tuple[int, ...]) -> Stages:
        children = self.get_submodule(self._under)
        ends = {name: self._ends[name] for name in names if name in self._ends}
        return Stages(
            self._under, {n: children.get_submodule(n) for n in names}, ends, strides, self.channels
        )


class LastStages(nn.Module):
    """The last stages of a backbone; their parameters are named ``backbone.*``.

    They run on the last of the given maps. The first ``kept`` maps pass through unchanged.
    """

    def __init__(self, stages: Stages, kept: int) -> None:
        super().__init__()
        self.backbone, self._kept = stages, kept

    @override
    def forward(self, maps: Sequence[Tensor]) -> tuple[Tensor, ...]:
        return (*maps[: self._kept], *self.backbone(maps[-1]))


def strided_backbone(plan: Plan, strides: tuple[int, ...], activation: str) -> Stages:
    """Build four convolutions of stride 2; maps at strides 8 and 16 are available."""
    stages: dict[str, nn.Module] = {}
    before = 3
    for number, (after, residual) in enumerate(zip(plan.widths, plan.residual, strict=True)):
        layers: list[nn.Module] = [
            nn.Conv2d(before, after, 3, stride=2, padding=1, bias=False),
            group_norm(after),
            ACTIVATIONS[activation](),
        ]
        if residual:
            layers.append(ResidualBlock(after, activation))
        stages[str(number)] = nn.Sequential(*layers)
        before = after
    ends = {str(number): 2 ** (number + 1) for number in range(4)}
    return Stages("stages", stages, ends, strides, {8: plan.widths[2], 16: plan.widths[3]})


def resnet_backbone(
    architecture: str, strides: tuple[int, ...], activation: str, weights: str | None
) -> Stages:
    """Build a torchvision ResNet without its classifier.

    With weights, its batch normalisation is frozen. Without weights, group normalisation replaces it, because a frozen
    normalisation that has seen no data normalises nothing.
    """
    builder = {"resnet18": resnet.resnet18, "resnet50": resnet.resnet50}[architecture]
    body = builder(norm_layer=group_norm if weights is None else FrozenBatchNorm2d)
    if weights not in (None, SAVED):
        body.load_state_dict(load_weights(architecture, weights), strict=False)
    # Pretrained weights expect the ReLU that they were trained with.
    set_activation(body, activation if weights is None else "relu")
    widening = 4 if architecture == "resnet50" else 1
    widths = {4: 64 * widening, 8: 128 * widening, 16: 256 * widening, 32: 512 * widening}
    children = {name: child for name, child in body.named_children() if name not in ("avgpool", "fc")}
    ends = {"layer1": 4, "layer2": 8, "layer3": 16, "layer4": 32}
    return Stages("body", children, ends, strides, widths)


def load_weights(architecture: str, weights: str) -> dict[str, Tensor]:
    """Load the state dictionary of a torchvision ResNet, without the classifier and counters.

    ``weights`` is the path of a file with such a state dictionary, or the name of torchvision weights
    (``DEFAULT``, ``IMAGENET1K_V1``, ...), which torchvision downloads or takes from its cache.

    Raises:
        ValueError: ``weights`` is neither a file nor a weight name, or the file's state dictionary is missing or does
            not fit.
    """
    if Path(weights).is_file():
        try:
            state = torch.load(weights, map_location="cpu", weights_only=True)
        except (pickle.UnpicklingError, RuntimeError, EOFError) as error:
            raise ValueError(f"detector.backbone.weights: {weights} is not a torch.save file") from error
        if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
            raise ValueError(f"detector.backbone.weights: {weights} holds no state dictionary")
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
) -> Stages:
    """Build a backbone by name; it returns a tuple of maps, and ``channels`` has their widths by stride.

    Raises:
        ValueError: the weights do not exist or do not fit.
    """
    if architecture in PLANS:
        if weights is not None:
            raise ValueError(
                f"detector.backbone.weights: {architecture} has no published weights, got {weights!r}, want null"
            )
        return strided_backbone(PLANS[architecture], strides, activation)
    return resnet_backbone(architecture, strides, activation, weights)
