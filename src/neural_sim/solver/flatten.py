"""Dictionaries of parameters as one vector, in the dictionary's own order."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor


def flatten(params: Mapping[str, Tensor]) -> Float[Tensor, "n"]:
    """All entries in one vector; differentiable. Raises ``ValueError`` for an empty dictionary."""
    if not params:
        raise ValueError("flatten: got no parameters, want at least one")
    return torch.cat([tensor.reshape(-1) for tensor in params.values()])


def unflatten(vector: Float[Tensor, "n"], like: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The inverse of ``flatten`` for names and shapes as in ``like``; views of ``vector``, differentiable."""
    wanted = sum(tensor.numel() for tensor in like.values())
    if vector.shape != (wanted,):
        raise ValueError(
            f"unflatten: got shape {tuple(vector.shape)}, want ({wanted},) for {len(like)} parameters"
        )
    pieces = vector.split([tensor.numel() for tensor in like.values()])
    return {
        name: piece.view(tensor.shape) for (name, tensor), piece in zip(like.items(), pieces, strict=True)
    }
