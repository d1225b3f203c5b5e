"""Expectation maximisation, posterior draws and the likelihood-ratio test against closed forms and direct searches."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from scipy.stats import beta, binom

from neural_sim.baseline.label_shift.mixture import (
    MORE,
    Cells,
    Status,
    grouped,
    log_likelihood,
    maximise,
    posterior,
    ratio_test,
)

SURE = torch.eye(4, dtype=torch.float64)


def noisy(p, boxes, sharpness, seed):
    """Likelihoods of boxes drawn from ``p`` by a calibrated classifier, and the cells of the boxes."""
    generator = torch.Generator().manual_seed(seed)
    bins = torch.multinomial(p, boxes, replacement=True, generator=generator)
    # x = sharpness e_bin + noise has the likelihoods exp(sharpness x_c), so these posteriors are exact.
    x = sharpness * torch.eye(len(p), dtype=torch.float64)[bins]
    x = x + torch.randn(boxes, len(p), generator=generator, dtype=torch.float64)
    return (sharpness * x).softmax(-1), bins


def test_sure_posteriors_give_the_counts_with_the_prior():
    counts = torch.tensor([5, 0, 2, 3])
    found = maximise(SURE.repeat_interleave(counts, 0), Cells((4,)), prior=0.3)
    assert found.status is Status.CONVERGED
    torch.testing.assert_close(found.p[0], (counts + 0.3).double() / (10 + 4 * 0.3))


@pytest.mark.parametrize("prior", [0.0, 0.3])
def test_the_mixture_is_the_maximum_that_a_direct_search_finds(prior):
    likelihood, _ = noisy(torch.tensor([0.5, 0.1, 0.3, 0.1]).double(), 40, 1.0, seed=0)
    found = maximise(likelihood, Cells((4,)), prior, tolerance=1e-12, steps=20000)

    def loss(logits):
        p = np.exp(logits - logits.max())
        p = p / p.sum()
        return -np.log(likelihood.numpy() @ p).sum() - prior * np.log(p).sum()

    best = minimize(loss, np.zeros(4), method="BFGS", options={"gtol": 1e-9})
    p = np.exp(best.x - best.x.max())
    np.testing.assert_allclose(found.p[0].numpy(), p / p.sum(), atol=1e-4)


def test_a_product_is_the_maximum_among_products():
    cells, generator = Cells((2, 3)), torch.Generator().manual_seed(1)
    likelihood = torch.rand(30, 6, generator=generator, dtype=torch.float64) ** 3
    found = maximise(likelihood, cells, 0.0, tolerance=1e-12, steps=20000)

    def loss(logits):
        a, b = (np.exp(part) / np.exp(part).sum() for part in (logits[:2], logits[2:]))
        return -np.log(likelihood.numpy() @ np.outer(a, b).ravel()).sum()

    best = min((minimize(loss, start, method="BFGS") for start in np.eye(5)), key=lambda run: run.fun)
    assert float(found.log_likelihood) == pytest.approx(-best.fun, abs=1e-5)


def test_a_factor_that_is_given_stays():
    given = torch.tensor([0.9, 0.1], dtype=torch.float64)
    found = maximise(torch.rand(20, 6, dtype=torch.float64), Cells((2, 3)), 0.1, {0: given})
    torch.testing.assert_close(found.p[0], given)
    torch.testing.assert_close(found.p[1].sum(), torch.tensor(1.0, dtype=torch.float64))


def test_the_joint_has_its_margins_and_its_bins():
    cells = Cells((2, 3, 2))
    p = tuple(torch.rand(5, size, dtype=torch.float64).softmax(-1) for size in cells.sizes)
    for own, margin in zip(p, cells.margins(cells.joint(p)), strict=True):
        torch.testing.assert_close(own, margin)
    every = torch.arange(cells.count)
    torch.testing.assert_close(cells.index(torch.stack(cells.bins(every), 1)), every)


def test_merged_bins_have_the_likelihood_of_their_mixture():
    likelihood = torch.rand(7, 8, dtype=torch.float64)
    within = torch.tensor([[0.25, 0.0], [0.75, 0.0], [0.0, 1.0], [0.0, 0.0]], dtype=torch.float64)
    both = grouped(likelihood, Cells((4, 2)), [within, torch.eye(2, dtype=torch.float64)])
    table = likelihood.view(7, 4, 2)
    expected = torch.stack([0.25 * table[:, 0] + 0.75 * table[:, 1], table[:, 2]], 1).flatten(1)
    torch.testing.assert_close(both, expected)


def test_intervals_of_sure_posteriors_are_those_of_the_dirichlet_posterior():
    counts = torch.tensor([12, 0, 5, 3])
    drawn = posterior(
        SURE.repeat_interleave(counts, 0), Cells((4,)), 0.3, torch.Generator().manual_seed(0), chains=400
    )[0]
    for b, count in enumerate(counts.tolist()):
        exact = beta(count + 0.3, 20 - count + 3 * 0.3)
        for level in (0.05, 0.5, 0.95):
            assert float(drawn[:, b].quantile(level)) == pytest.approx(exact.ppf(level), abs=0.012)


def test_uncertain_likelihoods_share_the_chains():
    """Half of the samples say one bin, half the other: half of the draws have each."""
    samples = torch.stack([SURE[:1].repeat(9, 1), SURE[1:2].repeat(9, 1)])
    drawn = posterior(samples, Cells((4,)), 0.3, torch.Generator().manual_seed(0))[0]
    assert float((drawn[:, 0] > 0.5).double().mean()) == pytest.approx(0.5, abs=0.02)


def test_intervals_cover_the_truth_as_often_as_they_say():
    p, covered = torch.tensor([0.6, 0.05, 0.3, 0.05]).double(), []
    for seed in range(40):
        likelihood, _ = noisy(p, 50, 1.5, seed)
        drawn = posterior(likelihood, Cells((4,)), 0.3, torch.Generator().manual_seed(seed), chains=50)[0]
        covered.append((drawn.quantile(0.05, 0) <= p) & (p <= drawn.quantile(0.95, 0)))
    assert 0.83 < float(torch.stack(covered).double().mean()) < 0.97


def test_the_test_rejects_a_true_null_as_often_as_its_level_and_a_false_one_nearly_always():
    known = noisy(torch.full((4,), 0.25, dtype=torch.float64), 400, 1.0, seed=1000)
    null, other = (torch.tensor(p).double() for p in ([0.4, 0.3, 0.2, 0.1], [0.1, 0.1, 0.2, 0.6]))

    def p_value(p, seed):
        likelihood, _ = noisy(p, 40, 1.0, seed)
        return ratio_test(
            likelihood, Cells((4,)), {0: null}, known, 0.3, 99, torch.Generator().manual_seed(seed)
        )

    assert sum(p_value(null, seed) <= 0.05 for seed in range(60)) <= 8
    assert sum(p_value(other, seed) <= 0.05 for seed in range(10)) >= 9


def test_the_test_of_one_factor_leaves_the_others_free():
    cells, seed = Cells((2, 2)), torch.Generator().manual_seed(0)
    sure = torch.eye(4, dtype=torch.float64)
    known = sure.repeat(10, 1), torch.arange(4).repeat(10)
    boxes = sure[[0] * 10 + [2] * 10]  # the first factor is balanced, the second always in its bin 1
    even = torch.tensor([0.5, 0.5], dtype=torch.float64)
    assert ratio_test(boxes, cells, {0: even}, known, 0.3, 99, seed) > 0.3
    assert ratio_test(boxes, cells, {1: even}, known, 0.3, 99, seed) == pytest.approx(1 / (MORE * 100))


def test_a_ratio_that_no_sample_reaches_gets_more_samples_and_leaves_the_generator_as_any_other():
    """19 in 20, with an exact p-value of 4e-5: the smallest that five times as many samples can have."""
    sure, even = torch.eye(2, dtype=torch.float64), torch.tensor([0.5, 0.5], dtype=torch.float64)
    known = sure.repeat(10, 1), torch.arange(2).repeat(10)
    states = []
    for successes, smallest in ((19, 1 / 1000), (11, 0.3)):
        boxes = sure[[0] * successes + [1] * (20 - successes)]
        generator = torch.Generator().manual_seed(1)
        found = ratio_test(boxes, Cells((2,)), {0: even}, known, 0.3, 199, generator)
        assert found == pytest.approx(smallest) if successes == 19 else found > smallest
        states.append(generator.get_state())
    assert torch.equal(*states)


def test_known_boxes_stand_for_the_null_however_many_of_them_each_cell_has():
    """Sure boxes of two bins make it a binomial test of 15 in 20; nine in ten known boxes are of the first bin.

    Rounding decides whether a draw of the same counts is a tie, so the p-value lies between the two exact tails.
    """
    sure, known = torch.eye(2, dtype=torch.float64), torch.tensor([0] * 90 + [1] * 10)
    even, draws = torch.tensor([0.5, 0.5], dtype=torch.float64), 9999
    found = ratio_test(
        sure[[0] * 15 + [1] * 5], Cells((2,)), {0: even}, (sure[known], known), 0.3, draws,
        torch.Generator().manual_seed(0),
    )  # fmt: skip
    beyond, at_least = (2 * binom.sf(count, 20, 0.5) for count in (15, 14))
    assert found > beyond - 4 * math.sqrt(beyond / draws)
    assert found < at_least + 4 * math.sqrt(at_least / draws) + 1 / draws


def test_the_log_likelihood_is_that_of_every_box():
    likelihood, p = torch.tensor([[1.0, 0.0], [0.5, 0.5]]).double(), torch.tensor([0.2, 0.8]).double()
    assert float(log_likelihood(likelihood, p)) == pytest.approx(math.log(0.2) + math.log(0.5))
