"""Logits by boxes and the weights of several guesses, against direct searches and known posteriors."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from scipy.special import log_softmax

from neural_sim.baseline.label_shift import calibration
from neural_sim.baseline.label_shift.calibration import BoxReader, calibrate
from neural_sim.baseline.label_shift.mixture import Cells


def boxes_of(seed=0, boxes=60):
    """Boxes whose size says the bin of the one factor, whose shape that of the other, with noise."""
    generator = torch.Generator().manual_seed(seed)
    cells = torch.randint(6, (boxes,), generator=generator)
    size, shape = Cells((3, 2)).bins(cells)
    numbers = torch.randn(boxes, 3, generator=generator) + torch.stack([2.0 * size, 1.5 * shape, 0 * size], 1)
    return numbers, cells


def test_a_factor_is_read_by_the_most_probable_regression_on_boxes_and_their_products():
    numbers, cells = boxes_of()
    bins = Cells((3, 2)).bins(cells)[0]
    found = BoxReader.fitted(numbers, bins, Cells((3,)), ridge=2.0)
    x = ((numbers - numbers.mean(0)) / numbers.std(0)).double().numpy()
    pairs = [x[:, i] * x[:, j] for i in range(3) for j in range(i, 3)]
    terms = np.column_stack([np.ones(60), x, *pairs])

    def loss(at):
        weights = at.reshape(-1, 3)
        right = log_softmax(terms @ weights, -1)[np.arange(60), bins.numpy()]
        return np.square(weights[1:]).sum() - right.sum()

    best = minimize(loss, np.zeros(30), method="BFGS", options={"gtol": 1e-6}).x.reshape(-1, 3)
    wanted = np.exp(log_softmax(terms @ best, -1))
    np.testing.assert_allclose(found(numbers).softmax(-1), wanted, atol=1e-4)


def test_logits_of_combinations_are_the_sums_of_their_bins_logits():
    numbers, cells = boxes_of()
    both = Cells((3, 2))
    whole = BoxReader.fitted(numbers, cells, both)(numbers).unflatten(1, both.sizes)
    for axis, own in enumerate(both.bins(cells)):
        alone = BoxReader.fitted(numbers, own, Cells((both.sizes[axis],)))(numbers)
        log_p = (whole.logsumexp(2 - axis)).log_softmax(-1)
        torch.testing.assert_close(log_p, alone.log_softmax(-1))


def test_a_box_beyond_all_that_were_seen_counts_as_the_farthest_of_them():
    numbers, cells = boxes_of()
    reader = BoxReader.fitted(numbers, cells, Cells((3, 2)))
    torch.testing.assert_close(reader(numbers.amax(0)[None] + 50.0), reader(numbers.amax(0)[None]))


def test_boxes_that_are_all_the_same_say_nothing():
    """As those of whole images."""
    reader = BoxReader.fitted(torch.ones(8, 5), torch.arange(8) % 4, Cells((4,)))
    torch.testing.assert_close(
        reader(torch.ones(2, 5)).softmax(-1), torch.full((2, 4), 0.25, dtype=torch.float64)
    )


def known_posteriors(seed=0, renders=400):
    """Exact logits of four bins, logits that say nothing, and the bins."""
    generator = torch.Generator().manual_seed(seed)
    bins = torch.arange(renders) % 4
    noise = torch.randn(2, renders, 4, generator=generator, dtype=torch.float64)
    x = 1.5 * torch.eye(4, dtype=torch.float64)[bins] + noise[0]
    return 1.5 * x, noise[1], bins


def test_what_says_nothing_gets_no_weight_and_what_is_too_sure_is_held_back():
    exact, nothing, bins = known_posteriors()
    found = calibrate(torch.stack([3.0 * exact, nothing]), bins)
    assert float(found.weights[0, 0]) == pytest.approx(1 / 3, rel=0.15)
    assert float(found.weights[0, 1]) < 0.15
    q = found(torch.stack([3.0 * exact, nothing]))[0]
    assert float((q - exact.softmax(-1)).abs().mean()) < 0.02


def test_two_guesses_say_more_than_either():
    """Their weights are found together: the posterior of independent noise is that of the sum."""
    (one, _, bins), (other, _, _) = known_posteriors(0), known_posteriors(1)
    q = calibrate(torch.stack([one, other]), bins)(torch.stack([one, other]))[0]
    assert float((q - (one + other).softmax(-1)).abs().mean()) < 0.02


@pytest.mark.parametrize("repeated", [False, True])
def test_weights_and_biases_are_the_minimum_that_a_direct_search_finds(repeated):
    exact, nothing, bins = known_posteriors(renders=40)
    guesses = torch.stack([2.0 * exact, nothing + 0.3 * exact])
    counts = torch.tensor([2.0, 0.0, 1.0, 3.0]).repeat(10) if repeated else torch.ones(40)
    found = calibrate(guesses, bins, counts[None] if repeated else None, ridge=0.7)

    def loss(at):
        log_q = log_softmax(np.tensordot(np.exp(at[:2]), guesses.numpy(), 1) + at[2:], -1)
        right = log_q[np.arange(40), bins.numpy()]
        return 0.7 * np.square(at[2:]).sum() - float((counts.numpy() * right).sum())

    best = minimize(loss, np.zeros(6), method="BFGS", options={"gtol": 1e-8}).x
    np.testing.assert_allclose(found.weights.flatten(), np.exp(best[:2]), atol=1e-3)
    np.testing.assert_allclose(found.bias.flatten(), best[2:] - best[2:].mean(), atol=1e-3)


def test_a_search_that_diverges_is_repeated_within_bounds(monkeypatch):
    """A search over twenty bootstrap samples took a step to infinity on pose_gap, seed 103."""
    generator = torch.Generator().manual_seed(0)
    cells = torch.randint(3, (30,), generator=generator)
    right = torch.eye(3, dtype=torch.float64)[cells]
    guesses = torch.stack([right, 2.0 * right]) + torch.randn(2, 30, 3, generator=generator).double()
    found = calibrate(guesses, cells)

    def diverged(variables, loss):
        for variable in variables:
            variable.data.fill_(torch.inf)

    monkeypatch.setattr(calibration, "_minimised", diverged)
    again = calibrate(guesses, cells)
    torch.testing.assert_close(again(guesses), found(guesses), atol=1e-3, rtol=0.0)
    certain = calibrate(100.0 * right[None], cells)
    assert (
        bool(certain.weights.isfinite().all()) and float(certain(100.0 * right[None]).amax(-1).min()) > 0.99
    )
