"""Random initial values from an explicit generator; torch's module constructors know only the global one."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn


def initialise(
    module: nn.Module, generator: torch.Generator, prior_probability: float | None = None
) -> dict[str, Tensor]:
    """A state dictionary of ``module``: He-normal convolutions, unit normalisations, zero biases.

    Convolutions with a bias start at standard deviation 0.01 in a predictor's ``head``, and the bias of its layer
    ``cls_logits`` makes it predict ``prior_probability`` (Lin et al. 2017, Sec. 4.1); others keep the variance of their
    input, as torchvision's do. A linear layer starts at standard deviation 0.01 (Goyal et al. 2017).
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
