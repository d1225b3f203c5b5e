"""The mixed second derivative of the training loss, contracted with v first (paper, Tool 2).

Contracting first leaves one number for each image, its score ``s_i = <dl_i/dtheta, v>``, and one array of the images'
size, ``d/dx sum_i w_i s_i``; the m x d matrix of Eq. 3 is never formed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, cast, get_args

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.gradient.base import ImageLoss, IndexedLoss, Params
from neural_sim.solver.hvp import difference_length
from neural_sim.solver.operator import flatten

Mode = Literal["forward", "central_difference"]
LossesOf = Callable[[Params], Tensor]
"""Losses of fixed images as a function of the parameters."""


def scores(
    losses: IndexedLoss,
    params: Params,
    vector: Params,
    index: Int[Tensor, "n"],
    chunk_size: int = 32,
    mode: Mode = "forward",
) -> Float[Tensor, "n"]:
    """Compute ``s_i = <dl_i/dtheta, v>`` of the images in ``index``, with ``chunk_size`` of them in memory at a time.

    ``forward``: one Jacobian-vector product gives a chunk's scores, exactly, at the cost of about four evaluations of
    its losses. ``central_difference``: two evaluations, at ``theta +- h v``, with an error of relative order eps^(2/3).

    Raises:
        ValueError: an unknown mode, or a ``chunk_size`` below 1.
    """
    _check(mode, chunk_size)
    along = _ALONG[mode]
    if not len(index):
        return next(iter(params.values())).new_zeros(0)
    index = index.to(_device(params))
    parts = [along(_at_rows(losses, rows), params, vector) for rows in torch.split(index, chunk_size)]
    return torch.cat(parts).detach()


def image_cotangents(
    loss_of: ImageLoss,
    params: Params,
    vector: Params,
    images: Float[Tensor, "n 3 h w"],
    index: Int[Tensor, "n"],
    weights: Float[Tensor, "n"],
    chunk_size: int = 16,
) -> Float[Tensor, "n 3 h w"]:
    """Compute ``d/dx <d(sum_i w_i l_i)/dtheta, v>``: the images' cotangents (v times the first factor of Eq. 3).

    The inner derivative, by theta, is taken in forward mode; the outer one, by the images, in reverse mode.

    Raises:
        ValueError: a ``chunk_size`` below 1.
    """
    _check("forward", chunk_size)
    if not len(index):
        return torch.zeros_like(images)
    index, weights = index.to(_device(params)), weights.to(_device(params))
    parts: list[Tensor] = []
    chunks = zip(*(torch.split(values, chunk_size) for values in (index, weights, images)), strict=True)
    for rows, weight, chunk in chunks:
        leaf = chunk.detach().requires_grad_()

        def losses(at: Params, leaf: Tensor = leaf, rows: Tensor = rows) -> Tensor:
            return loss_of(at, leaf, rows)

        with torch.enable_grad():
            score = _forward_scores(losses, params, vector)
            (part,) = torch.autograd.grad(score @ weight.to(score), (leaf,), materialize_grads=True)
        parts.append(part)
    return torch.cat(parts).detach()


def _at_rows(losses: IndexedLoss, rows: Int[Tensor, "n"]) -> LossesOf:
    return lambda params: losses(params, rows)


def _forward_scores(losses: LossesOf, params: Params, vector: Params) -> Float[Tensor, "n"]:
    fixed = {name: tensor.detach() for name, tensor in params.items()}
    ahead = {name: vector[name].detach() for name in fixed}
    return cast(Tensor, torch.func.jvp(losses, (fixed,), (ahead,))[1])


def _differenced_scores(losses: LossesOf, params: Params, vector: Params) -> Float[Tensor, "n"]:
    fixed = {name: tensor.detach() for name, tensor in params.items()}
    ahead = {name: vector[name].detach() for name in fixed}
    length = difference_length(flatten(fixed), flatten(ahead))
    if length == 0.0:
        return torch.zeros_like(losses(fixed))
    above, below = (
        {name: tensor + h * ahead[name] for name, tensor in fixed.items()} for h in (length, -length)
    )
    return (losses(above) - losses(below)) * (0.5 / length)


_ALONG = {"forward": _forward_scores, "central_difference": _differenced_scores}


def _device(params: Params) -> torch.device:
    """Find the device of the losses, to which rows and weights are moved from the CPU once."""
    return next(iter(params.values())).device


def _check(mode: str, chunk_size: int) -> None:
    if mode not in get_args(Mode):
        raise ValueError(f"gradient: mode must be one of {get_args(Mode)}, got {mode!r}")
    if chunk_size < 1:
        raise ValueError(f"gradient: chunk_size must be at least 1, got {chunk_size}")
