"""What is said of an estimate, how it is stored, and which features are strange."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from scipy.stats import chi2

from neural_sim.baseline.label_shift.evidence import FactorEstimate, Strangeness, estimates_of

MOVES = FactorEstimate(
    "mug", "pose", 40, (0.25,) * 4, (0.45, 0.05, 0.45, 0.05), (0.4, 0.0, 0.4, 0.0), (0.5, 0.1, 0.5, 0.1),
    ((1, 3), (2,), (4,)), 0.005, 0.05, 0.9, "moves",
)  # fmt: skip


def test_an_estimate_comes_back_from_json():
    stored = json.loads(json.dumps([dataclasses.asdict(MOVES)]))
    assert estimates_of(stored) == (MOVES,)


def test_a_sentence_names_groups_with_the_interval_of_their_sum():
    assert MOVES.sentence == "your target shows the mug from pose bins 1/3 (0.80 to 1.00)"


@pytest.mark.parametrize(
    "finding, said",
    [
        ("stays", "psi stays, it may be right"),
        ("too few boxes", "40 boxes are too few"),
        ("fits no render", "5% of its"),
    ],
)
def test_a_sentence_says_why_psi_does_not_move(finding, said):
    assert said in dataclasses.replace(MOVES, finding=finding).sentence


def test_strangeness_is_the_distance_in_standard_deviations_to_the_nearest_cell():
    generator = torch.Generator().manual_seed(0)
    cells = torch.arange(2).repeat(4000)
    features = torch.randn(8000, 3, generator=generator, dtype=torch.float64) + 20.0 * cells[:, None]
    strangeness = Strangeness.of(features, cells, shrinkage=0.0)
    distances = strangeness(features)
    np.testing.assert_allclose(distances.quantile(0.95), chi2(3).ppf(0.95), rtol=0.05)
    assert strangeness.part_above(0.95, features, features) == pytest.approx(0.05, abs=0.001)
    assert strangeness.part_above(0.95, features, features + 10.0) == 1.0
    assert strangeness.part_above(0.95, features, features[:0]) == 0.0
