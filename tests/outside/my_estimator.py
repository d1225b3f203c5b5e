"""An estimator from outside the package: the score function without a baseline."""

from dataclasses import dataclass

import torch

from neural_sim.gradient.base import from_contributions
from neural_sim.gradient.mixed import scores
from neural_sim.parameter.product import HardDraws


@dataclass(frozen=True)
class ScoreFunction:
    chunk_size: int = 16
    wanted = "weights"
    probes_per_bin = 0
    draws = HardDraws(explore=True)

    def estimate(self, losses, params, vector, images, probes):
        return _along(scores(losses.cached, params, vector, images.index, self.chunk_size), images)

    def accumulated(self, sums, images, probes):
        return _along(sums.images[images.index] / images.weights, images)


def _along(scored, images):
    """sum_i w_i s_i dlog p(V_i) / dpsi."""

    def log_prob(psi):
        return images.distribution.log_prob(psi, images.draw)

    slopes = torch.autograd.functional.jacobian(log_prob, images.psi)
    return from_contributions((scored * images.weights)[:, None] * slopes)
