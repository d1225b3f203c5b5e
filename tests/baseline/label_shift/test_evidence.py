"""What is said of an estimate, how it is stored, and which features are strange."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from scipy.stats import chi2, mannwhitneyu

from neural_sim.baseline.label_shift.evidence import (
    FactorEstimate,
    Span,
    Strangeness,
    estimates_of,
    part_farther,
)

MOVES = FactorEstimate(
    "mug", "pose", 40, (0.25,) * 4, (0.45, 0.05, 0.45, 0.05), (0.4, 0.0, 0.4, 0.0), (0.5, 0.1, 0.5, 0.1),
    ((1, 3), (2,), (4,)), 0.005, 0.05, 0.9, "moves",
)  # fmt: skip


def test_an_estimate_comes_back_from_json():
    stored = json.loads(json.dumps([dataclasses.asdict(MOVES)]))
    assert estimates_of(stored) == (MOVES,)


def test_doubts_are_the_mean_total_variations_of_the_draws():
    p = torch.tensor([0.5, 0.5]).double()
    drawn = torch.tensor([[0.5, 0.5], [0.8, 0.2], [0.1, 0.9]]).double()
    span = Span.of(p, drawn, torch.tensor([0.0, 1.0]).double(), 0.9)
    assert (span.doubt, span.apart) == pytest.approx(((0.0 + 0.3 + 0.4) / 3, (0.5 + 0.8 + 0.1) / 3))


def test_a_sentence_names_groups_with_the_interval_of_their_sum():
    assert MOVES.sentence == "your target shows the mug in pose bins 1/3 (0.80 to 1.00)"


@pytest.mark.parametrize(
    "finding, said",
    [
        ("stays", "psi stays, because it may be right already (p = 0.005)"),
        ("uncertain", "may be off by 0.40 in total variation), so psi stays"),
        ("too few boxes", "too few boxes (40) to estimate its pose"),
        ("fits no render", "do not look like its renders (a box is stranger than a held-out render in 5%"),
        ("not told apart", "from renders (90% of held-out ones are recognised, 0% by chance), so psi stays"),
    ],
)
def test_a_sentence_says_why_psi_does_not_move(finding, said):
    assert said in dataclasses.replace(MOVES, finding=finding, doubt=0.4).sentence


def test_boxes_of_near_duplicates_are_named_where_there_are_too_few_others():
    few = dataclasses.replace(MOVES, finding="too few boxes", boxes=3, repeated=12)
    assert (
        few.sentence == "mug: too few boxes (3, and 12 in images that look like theirs) to estimate its pose"
    )


def test_an_estimate_that_is_only_nearer_says_how_far_off_both_may_be():
    nearer = dataclasses.replace(MOVES, finding="nearer", doubt=0.4, apart=0.86)
    assert nearer.sentence == (
        "your target shows the mug in pose bins 1/3 (0.80 to 1.00); the estimate may be off by 0.40 in total "
        "variation, but psi is off by 0.86"
    )


def test_lights_are_not_called_bins():
    lit = dataclasses.replace(MOVES, factor="illumination", groups=((1,), (2,), (3,), (4,)), lights=True)
    assert lit.sentence == "your target shows the mug under light 1 (0.40 to 0.50), light 3 (0.40 to 0.50)"
    assert estimates_of([dataclasses.asdict(lit)]) == (lit,)
    unread = dataclasses.replace(lit, finding="not told apart", accuracy=-0.1).sentence
    assert "(weights explain 0% of the variance of guesses on held-out ones), so psi stays" in unread


def test_a_search_that_did_not_end_is_said():
    flat = dataclasses.replace(MOVES, finding="not told apart", converged=False)
    assert "the likelihood is flat" in flat.sentence


def test_strangeness_is_the_distance_in_standard_deviations_to_the_nearest_cell():
    generator = torch.Generator().manual_seed(0)
    cells = torch.arange(2).repeat(4000)
    features = torch.randn(8000, 3, generator=generator, dtype=torch.float64) + 20.0 * cells[:, None]
    dark = torch.zeros(8000, 0, dtype=torch.float64)
    distances = Strangeness.of(features, cells, dark, shrinkage=0.0)(features, dark)
    np.testing.assert_allclose(distances.quantile(0.95), chi2(3).ppf(0.95), rtol=0.05)


def test_what_a_light_explains_is_not_strange():
    generator = torch.Generator().manual_seed(1)
    weights = torch.rand(4000, 2, generator=generator, dtype=torch.float64)
    cells, own = torch.zeros(4000, dtype=torch.long), torch.tensor([[5.0, 0.0], [0.0, -3.0]]).double()
    noise = torch.randn(4000, 2, generator=generator, dtype=torch.float64)
    strangeness = Strangeness.of(weights @ own + noise, cells, weights, shrinkage=0.0)
    one = torch.tensor([0.9, 0.1], dtype=torch.float64)  # all boxes under one light
    lit = strangeness(one @ own + noise, one)
    np.testing.assert_allclose(lit.quantile(0.95), chi2(2).ppf(0.95), rtol=0.07)


def test_the_part_that_is_farther_is_that_of_all_pairs_by_their_frequency():
    generator = torch.Generator().manual_seed(0)
    seen, known = torch.rand(30, generator=generator), torch.rand(40, generator=generator)
    even = torch.ones(40, dtype=torch.float64)
    pairs = mannwhitneyu(seen.numpy(), known.numpy()).statistic / (30 * 40)
    assert part_farther(seen, known, even) == pytest.approx(pairs)
    assert part_farther(known, known, even) == pytest.approx(0.5)
    assert part_farther(known[:1], known, torch.eye(40, dtype=torch.float64)[0]) == pytest.approx(0.5)
    assert part_farther(seen + 1.0, known, even) == 1.0
    assert part_farther(seen[:0], known, even) == 0.5
