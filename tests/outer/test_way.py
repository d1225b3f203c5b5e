"""The psi that is returned: scores of an object's way against independent references, and what choosing it gains."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from neural_sim.outer.way import TakenBack, Way, fitted_scores


def most_probable(scores, variance, weight, large=3.0):
    """The minimum of the sum in the module's text, by a general method in float64 from the means."""
    counts = np.array([len(each) for each in scores])

    def cost(m):
        errors = sum(((np.array(each) - m[v]) ** 2).sum() for v, each in enumerate(scores))
        far = large**2 * variance
        return errors + weight * (far * np.log1p(np.diff(m) ** 2 / far)).sum()

    start = np.array([sum(each) for each in scores]) / counts
    return minimize(lambda m: 1e4 * cost(m), start, method="BFGS", options={"gtol": 1e-9}).x


@pytest.mark.parametrize(
    "scores",
    [
        [(0.41, 0.44), (0.5,), (0.47, 0.49), (0.52, 0.49, 0.5), (0.43,)],
        [(0.2, 0.22), (0.5, 0.52, 0.51), (0.45, 0.46)],
        [(0.3,)],
    ],
    ids=["steps", "jump", "start"],
)
def test_scores_are_the_most_probable_ones(scores):
    found = fitted_scores(scores, 0.018**2)
    np.testing.assert_allclose(found.numpy(), most_probable(scores, 0.018**2, 4.0), rtol=0, atol=1e-5)


def test_without_scatter_the_means_decide_and_with_much_all_are_worth_the_same():
    scores = [(0.4, 0.6), (0.7,), (0.2,)]
    torch.testing.assert_close(fitted_scores(scores, 0.0), torch.tensor([0.5, 0.7, 0.2]).double())
    alike = fitted_scores(scores, 1e6, weight=1e8)
    torch.testing.assert_close(alike, torch.full((3,), 1.9 / 4).double(), atol=1e-6, rtol=0)


@pytest.mark.parametrize("scores", [[], [(0.1,), ()]])
def test_a_psi_without_a_score_is_refused(scores):
    with pytest.raises(ValueError, match="fitted_scores"):
        fitted_scores(scores, 0.01)


def walked(rows):
    """A way of objects by name: each list has the scores at one psi after the other, whose numbers are psi."""
    way = Way.begin(list(rows), torch.zeros(len(rows), 1))
    for name, stays in rows.items():
        for number, scores in enumerate(stays):
            way = way.moved(name, torch.full((1,), float(number))) if number else way
            for score in scores:
                way = way.seen(name, score)
    return way


def test_a_loss_that_shows_over_several_trainings_is_taken_back_object_by_object():
    way = walked({"a": [(0.3, 0.31), (0.5, 0.52, 0.51), (0.45, 0.46)], "b": [(0.2, 0.22), (0.3, 0.29)]})
    best = way.best()
    assert list(best) == ["a"]
    stay, back = best["a"]
    assert float(stay.psi) == 1.0 and (back.kept, back.accepted) == (1, 2)
    values = fitted_scores([(0.3, 0.31), (0.5, 0.52, 0.51), (0.45, 0.46)], way.variance)
    assert back == TakenBack(1, 2, float(values[1] - values[2])) and back.gain > 0.0


def test_a_settled_object_cannot_go_back():
    way = walked({"a": [(0.5, 0.52, 0.51), (0.45, 0.46)], "b": [(0.5, 0.52), (0.3, 0.29)]})
    assert set(way.best()) == {"a", "b"} and set(way.settled(["a"]).best()) == {"b"}
    (here,) = way.settled(["a"]).stays["a"]
    assert float(here.psi) == 1.0 and here.scores == (0.45, 0.46)


def test_the_last_psi_is_kept_where_it_is_as_good_or_scores_are_unknown():
    assert walked({"a": [(0.5, 0.5), (0.5,)], "b": [(0.9,), (math.nan,)]}).best() == {}
    assert walked({"a": [(0.9,), (0.1,)]}).best() == {}  # how far trainings scatter is not known


def test_the_variance_of_trainings_is_pooled_over_objects_and_psi():
    way = walked({"a": [(0.1, 0.3), (0.5,)], "b": [(1.0, 1.1, 1.2), (math.nan, 2.0)]})
    squares = np.var([0.1, 0.3]) * 2 + np.var([1.0, 1.1, 1.2]) * 3
    assert way.variance == pytest.approx(squares / 3)
    assert walked({"a": [(0.1,)]}).variance is None


def noisy_way(generator, gains, scatter, objects=6):
    """Trainings at every psi on the way, one that judged it and one whose derivative was taken; and what is true."""
    names, truth = [f"{i}" for i in range(objects)], np.zeros(objects)
    way, worth = Way.begin(names, torch.zeros(objects, 1)), [truth]
    for number in range(len(gains)):
        if number:
            truth = truth + gains[number] + 0.01 * generator.normal(size=objects)
            worth.append(truth)
        for i, name in enumerate(names):
            way = way.moved(name, torch.full((1,), float(number))) if number else way
            for _ in range(1 if number == len(gains) - 1 else 2):
                way = way.seen(name, float(truth[i] + scatter * generator.normal()))
    return way, np.array(worth)


@pytest.mark.parametrize(
    ("gains", "better"),
    [
        # Steps that gain: hardly anything to take back.
        pytest.param([0.0, 0.05, 0.03, 0.02, 0.015, 0.01, 0.005], 0.0, marks=pytest.mark.slow),
        ([0.0] * 7, 0.005),  # coin tosses
        ([0.0, 0.2, 0.03, 0.01, -0.015, -0.015, -0.015], 0.03),  # losses that single trainings do not show
    ],
    ids=["gains", "chance", "losses"],
)
def test_the_psi_that_is_returned_is_on_average_no_worse_than_the_last(gains, better):
    """Trainings scatter by 0.018, so that two of them differ by 0.026, as measured."""
    generator, change = np.random.default_rng(0), []
    for _ in range(60):
        way, worth = noisy_way(generator, gains, 0.018)
        best = way.best()
        for i, name in enumerate(way.stays):
            place = best[name][1].kept if name in best else len(gains) - 1
            change.append(worth[place, i] - worth[-1, i])
    error = np.std(change) / math.sqrt(len(change))
    assert np.mean(change) > better - error and error < 0.002
