"""Optimiser steps as pure functions of flat vectors, so that a training can be differentiated in reverse.

A state is theta followed by the optimiser's buffers. A step consists of elementwise torch operations, which autograd
can differentiate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

State = tuple[Tensor, ...]


@dataclass(frozen=True)
class AdamW:
    """Adam with decoupled weight decay (Loshchilov and Hutter 2019, Algorithm 2).

    It steps as ``torch.optim.AdamW`` does. ``weight_decay`` is one number, or one for each entry of theta. The buffers
    are the two moments. ``floor`` is a lower bound of the denominator, entry by entry.
    """

    weight_decay: float | Float[Tensor, "n"] = 1e-2
    betas: tuple[float, float] = (0.9, 0.999)
    eps: float = 1e-8
    floor: float | Float[Tensor, "n"] = 0.0

    def begin(self, theta: Float[Tensor, "n"]) -> State:
        """Return the state before the first step."""
        return theta, torch.zeros_like(theta), torch.zeros_like(theta)

    def step(self, state: State, gradient: Float[Tensor, "n"], rate: float, done: int) -> State:
        """Return the state after the next step; ``done`` steps came before it."""
        theta, first, second = state
        fast, slow = self.betas
        first = fast * first + (1.0 - fast) * gradient
        second = slow * second + (1.0 - slow) * gradient.square()
        corrected, spread = first / (1.0 - fast ** (done + 1)), second / (1.0 - slow ** (done + 1))
        denominator = (_root(spread) + self.eps).clamp_min(self.floor)
        theta = (1.0 - rate * self.weight_decay) * theta - rate * corrected / denominator
        return theta, first, second

    def floored(self, end: State, done: int, fraction: float, sizes: Sequence[int]) -> AdamW:
        """Return the rule to differentiate in place of this one, after ``done`` steps that ended in ``end``.

        It bounds the denominator from below by ``fraction`` times the larger of two numbers: the entry's denominator in
        the last step, and the root mean square of the denominators in its tensor. A ``fraction`` of 0 leaves the rule
        unchanged. ``sizes`` are the numbers of entries of theta's tensors, in order.

        While an entry's gradients are tiny (a level of the pyramid before the first batch with an object of its size),
        a step is the ratio of the moments, whatever their size, and its derivative is about 1 / |g|: thousands of times
        that of other entries. But a finite change of the batch's images produces a gradient of normal size, which moves
        the moments too, and changes the step by no more than the learning rate. The last step's second moment averages
        over the whole training and shows that normal size. If the entry's gradients stay tiny to the end (a class's
        weight on a channel that is dark in all images of the present distribution), the other entries of its tensor
        show what is normal.
        """
        if fraction == 0.0:
            return self
        usual = _root(end[2] / (1.0 - self.betas[1] ** done)) + self.eps
        levels = [part.square().mean().sqrt().expand(len(part)) for part in usual.split(list(sizes))]
        return replace(self, floor=fraction * torch.maximum(usual, torch.cat(levels)))


def pulled_back(
    rule: AdamW,
    state: State,
    gradient: Float[Tensor, "n"],
    rate: float,
    done: int,
    cotangents: Sequence[Tensor],
) -> tuple[list[Tensor], Float[Tensor, "n"]]:
    """Pull cotangents of a step's result back onto its state, and onto its gradient.

    The caller adds the dependence of the gradient on theta: the batch's Hessian times the second result.
    """
    leaves = [part.detach().requires_grad_() for part in (*state, gradient)]
    with torch.enable_grad():
        stepped = rule.step(tuple(leaves[:-1]), leaves[-1], rate, done)
    *earlier, along = torch.autograd.grad(stepped, leaves, list(cotangents), materialize_grads=True)
    return earlier, along


def _root(values: Tensor) -> Tensor:
    """Take the square root with derivative 0, not infinity, at 0, where an entry has had no gradient so far."""
    positive = values > 0.0
    return torch.where(positive, values, 1.0).sqrt() * positive
