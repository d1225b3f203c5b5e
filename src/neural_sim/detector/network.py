"""The network's shape, built from torchvision's parts, and its random initial values.

A backbone turns images into feature maps at fixed strides; a predictor turns these into outputs. Parameter values are
always passed in. They are drawn here from an explicit generator, because torch's module constructors use only the
global one.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torchvision.models import get_model, get_model_weights, resnet
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.ops import FeaturePyramidNetwork, FrozenBatchNorm2d
from torchvision.ops.feature_pyramid_network import ExtraFPNBlock
from typing_extensions import override

from neural_sim.detector.settings import SAVED, Anchors, Head

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
    """A sequence of modules, some of which end a stage; the maps at ``strides`` (ascending) are the backbone's output.

    ``children`` are registered under the attribute name ``under``, which becomes part of their parameter names. Those
    after the last of the strides are left out. ``ends`` maps each module that ends a stage to its stride, from fine to
    coarse. ``channels`` maps strides to numbers of channels.
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
        self._ends = {name: stride for name, stride in ends.items() if stride <= strides[-1]}
        names = list(children)
        used = names[: names.index(list(self._ends)[-1]) + 1]
        self._under, self.strides, self.channels = under, strides, dict(channels)
        self.add_module(under, nn.ModuleDict({name: children[name] for name in used}))

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
    """Build a backbone of four stages, each of stride 2; maps at strides 8 and 16 are available."""
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
        ValueError: ``weights`` is neither a file nor a name of torchvision's, the file cannot be read or downloaded, or
            it holds no state dictionary that fits.
    """
    if Path(weights).is_file():
        try:
            state = torch.load(weights, map_location="cpu", weights_only=True)
        except OSError as error:
            raise ValueError(f"detector.backbone.weights: {weights} cannot be read ({error})") from error
        except Exception as error:  # torch's reader may raise anything on a broken file
            raise ValueError(f"detector.backbone.weights: {weights} is not a torch.save file") from error
        if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
            raise ValueError(f"detector.backbone.weights: {weights} holds no state dictionary")
    else:
        names = list(get_model_weights(architecture).__members__)
        if weights not in (*names, "DEFAULT"):
            raise ValueError(f"detector.backbone.weights: want a file or one of {names}, got {weights!r}")
        try:
            state = get_model(architecture, weights=weights).state_dict()
        except OSError as error:
            raise ValueError(
                f"detector.backbone.weights: {weights} cannot be downloaded ({error}); want the path of a file"
            ) from error
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
    """Build a backbone by name.

    Raises:
        ValueError: the architecture has no published weights but ``weights`` is not None, or ``load_weights`` refuses
            them.
    """
    if architecture in PLANS:
        if weights is not None:
            raise ValueError(
                f"detector.backbone.weights: {architecture} has no published weights, got {weights!r}, want null"
            )
        return strided_backbone(PLANS[architecture], strides, activation)
    return resnet_backbone(architecture, strides, activation, weights)


class NormalisedBackbone(nn.Module):
    """A backbone preceded by the normalisation of images in [0, 1]; its parameters are named ``backbone.*``."""

    def __init__(self, backbone: nn.Module) -> None:
        super().__init__()
        self.backbone = backbone

    @override
    def forward(self, images: Float[Tensor, "n 3 h w"]) -> tuple[Tensor, ...]:
        mean, std = (_channels(values, images) for values in (IMAGENET_MEAN, IMAGENET_STD))
        # On a CPU, this layout is a third faster than the default, forwards and backwards.
        return self.backbone(((images - mean) / std).contiguous(memory_format=torch.channels_last))


def _channels(values: Sequence[float], like: Tensor) -> Float[Tensor, "3 1 1"]:
    """Return one number for each channel, made on the device of ``like`` without a copy from the host."""
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

    ``in_channels`` has the widths of the backbone's maps. Any further levels are coarser than these maps.
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
    """Draw a state dictionary of ``module``, with normalisations of scale 1 and biases of 0, except for one.

    Convolutions without a bias, which a normalisation follows, are He-normal. Those with a bias start at standard
    deviation 0.01 in a predictor's ``head`` (Lin et al. 2017, Sec. 4.1); elsewhere they preserve the variance of their
    input, as torchvision's do. The bias of the layer ``cls_logits`` makes it predict ``prior_probability``. Linear
    layers start at standard deviation 0.01 (Goyal et al. 2017).
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
