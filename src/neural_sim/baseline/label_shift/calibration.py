"""Guesses of a crop's bins, by a network, by the size of the box alone and by comparison, and their posterior.

A network trained on few renders memorises them: with four bins of distance, it recognised half of the held-out renders,
while the size of the box alone sufficed to recognise nine in ten. A quadratic logistic regression therefore reads the
box, templates are compared with it for poses (``comparison``), and held-out renders determine how much to trust each
guess (Wolpert 1992): posteriors are the softmax of sum_i a_i z_i + b, with weights a_i >= 0 for the logits z_i of each
guess and a bias b for each combination of bins.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.optimize import minimize
from torch import Tensor, nn
from torch.nn.functional import cross_entropy

from neural_sim.baseline.label_shift.mixture import Cells

LARGEST = 10.0
"""Largest bias, and largest logarithm of a weight, where the search for them without bounds diverges."""


@dataclass(frozen=True)
class BoxReader:
    """Logistic regressions of each factor's bins on the numbers that describe one object's boxes, and their products.

    Attributes:
        low: smallest value of each number in the fit; smaller values are raised to it, because squares extrapolate
            badly.
        high: largest value of each number in the fit; larger values are lowered to it.
        centre: means of the numbers.
        spread: their standard deviations; 1 for numbers that do not vary.
        weights: for each factor, the coefficients of a constant, of the numbers and of their products.
        cells: the combinations of bins.
    """

    low: Float[Tensor, "d"]
    high: Float[Tensor, "d"]
    centre: Float[Tensor, "d"]
    spread: Float[Tensor, "d"]
    weights: tuple[Float[Tensor, "terms _"], ...]
    cells: Cells

    @staticmethod
    def fitted(
        numbers: Float[Tensor, "n d"], known: Int[Tensor, "n"], cells: Cells, ridge: float = 1.0
    ) -> BoxReader:
        """Fit to boxes of renders whose cells are ``known``, with a penalty of ``ridge`` / 2 times the squared weights.

        The weights of constants are not penalised.
        """
        numbers = numbers.double()
        centre, spread = numbers.mean(0), numbers.std(0)
        spread = torch.where(spread > 1e-6, spread, torch.ones_like(spread))
        terms = _terms((numbers - centre) / spread)
        bins = zip(cells.bins(known), cells.sizes, strict=True)
        weights = tuple(_regressed(terms, own, k, ridge) for own, k in bins)
        return BoxReader(numbers.amin(0), numbers.amax(0), centre, spread, weights, cells)

    def __call__(self, numbers: Float[Tensor, "n d"]) -> Float[Tensor, "n cells"]:
        """Return logits of the cells, each the sum of its bins' logits."""
        numbers = numbers.double().clamp(self.low, self.high)
        terms = _terms((numbers - self.centre) / self.spread)
        parts = [terms @ weights for weights in self.weights]
        whole = parts[0]
        for own in parts[1:]:
            whole = (whole[:, :, None] + own[:, None, :]).flatten(1)
        return whole


def _terms(numbers: Float[Tensor, "n d"]) -> Float[Tensor, "n terms"]:
    rows, columns = torch.triu_indices(numbers.shape[1], numbers.shape[1])
    products = numbers[:, rows] * numbers[:, columns]
    return torch.cat([numbers.new_ones(len(numbers), 1), numbers, products], 1)


def _regressed(
    terms: Float[Tensor, "n terms"], bins: Int[Tensor, "n"], size: int, ridge: float
) -> Float[Tensor, "terms size"]:
    weights = torch.zeros(terms.shape[1], size, dtype=torch.float64, requires_grad=True)
    return _minimised(
        [weights],
        lambda: (
            cross_entropy(terms @ weights, bins, reduction="sum") + 0.5 * ridge * weights[1:].square().sum()
        ),
    )[0]


@dataclass(frozen=True)
class Calibration:
    """Weights of the guesses' logits, and biases, fitted to each of several samples of the held-out renders."""

    weights: Float[Tensor, "samples guesses 1 1"]
    bias: Float[Tensor, "samples 1 cells"]

    def __call__(self, guesses: Float[Tensor, "guesses n cells"]) -> Float[Tensor, "samples n cells"]:
        """Return calibrated posteriors."""
        return ((self.weights * guesses).sum(1) + self.bias).softmax(-1)


def calibrate(
    guesses: Float[Tensor, "guesses n cells"],
    cells: Int[Tensor, "n"],
    samples: Float[Tensor, "samples n"] | None = None,
    ridge: float = 1.0,
) -> Calibration:
    """Find the weights and the biases that make held-out posteriors calibrated (Alexandari et al. 2020, BCTS).

    Args:
        guesses: logits of held-out renders of one object.
        cells: the renders' true cells.
        samples: for each of several samples, how often it contains each render; None: one sample, with each once.
        ridge: factor of the penalty on squared biases, which keeps biases that rest on few renders near 0.
    """
    counts = guesses.new_ones(1, len(cells)) if samples is None else samples.to(guesses)
    shape = (len(counts), len(guesses), 1, 1)
    log_weights = guesses.new_full(shape, 1.0 / len(guesses)).log().requires_grad_()
    bias = guesses.new_zeros(len(counts), 1, guesses.shape[-1]).requires_grad_()

    def loss() -> Tensor:
        found = ((log_weights.exp() * guesses).sum(1) + bias).log_softmax(-1)
        right = found.gather(-1, cells.expand(len(counts), -1)[..., None])[..., 0]
        return ridge * bias.square().sum() - (counts * right).sum()

    start = float(loss().detach())
    _minimised([log_weights, bias], loss)
    if not float(loss().detach()) <= start:  # a line search may step so far that nothing is finite any more
        with torch.no_grad():
            log_weights.fill_(-math.log(len(guesses)))
            bias.zero_()
        _minimised_within([log_weights, bias], loss, LARGEST)
    return Calibration(log_weights.detach().exp(), bias.detach() - bias.detach().mean(-1, keepdim=True))


def _minimised(variables: Sequence[Tensor], loss: Callable[[], Tensor]) -> list[Tensor]:
    """Minimise a smooth loss, changing the variables in place; return their final values."""
    optimiser = torch.optim.LBFGS(list(variables), max_iter=100, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimiser.zero_grad()
        value = loss()
        value.backward()
        return value

    optimiser.step(closure)
    return [variable.detach() for variable in variables]


def _minimised_within(variables: Sequence[Tensor], loss: Callable[[], Tensor], largest: float) -> None:
    """Minimise a smooth loss as ``_minimised`` does, but more slowly, with no variable beyond +- ``largest``."""

    def placed(values: np.ndarray) -> None:
        with torch.no_grad():
            nn.utils.vector_to_parameters(torch.from_numpy(values), variables)

    def evaluated(values: np.ndarray) -> tuple[float, np.ndarray]:
        placed(values)
        value = loss()
        slopes = torch.autograd.grad(value, variables)
        return float(value.detach()), torch.cat([slope.flatten() for slope in slopes]).numpy()

    start = torch.cat([variable.detach().flatten() for variable in variables]).numpy()
    bounds = [(-largest, largest)] * len(start)
    placed(minimize(evaluated, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 500}).x)
