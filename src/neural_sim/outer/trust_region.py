"""A step of psi as long as its trust radius.

It goes to the p nearest to p + t direction, whose distance from p is the radius: bins that are as good as each other
gain as much as each other. (Along logits, a bin gains in proportion to its p, and what is likely already takes nearly
all.) A bin keeps a fraction of its p: the score is concave in the number of a bin's images, so that the derivative,
which is linear, says little about having none of them.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.parameter.factor import Factor

HALVINGS = 50
# Of p + t direction, whose largest component is 1: bins that differ by a thousandth are told apart.
FARTHEST = 1e3


def within(
    factor: Factor,
    psi: Float[Tensor, "objects k"],
    direction: Float[Tensor, "objects k"],
    radius: Float[Tensor, "objects"],
    keep: float,
) -> Float[Tensor, "objects k"]:
    """Psi whose p is moved along ``direction`` until half the absolute change of p (for bins, the total variation)
    reaches ``radius``, or as far as it goes within ``FARTHEST`` if each bin keeps the fraction ``keep`` of its p; by
    bisection.
    """
    before = factor.p_of(psi)
    size = direction.abs().amax(1, keepdim=True)
    longest = direction * (FARTHEST / torch.where(size > 0.0, size, 1.0))

    def moved(part: Tensor) -> Tensor:
        return factor.moved(psi, part[:, None] * longest, keep)

    def inside(part: Tensor) -> Tensor:
        return 0.5 * (factor.p_of(moved(part)) - before).abs().sum(1) <= radius

    low, high = torch.zeros_like(radius), torch.ones_like(radius)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        within_reach = inside(middle)
        low, high = torch.where(within_reach, middle, low), torch.where(within_reach, high, middle)
    still = (radius <= 0.0) | (size[:, 0] == 0.0)
    return torch.where(still[:, None], psi, moved(torch.where(inside(high), high, low)))
