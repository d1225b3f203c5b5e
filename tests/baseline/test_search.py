"""Searches by reward: they begin at the initial psi, keep the best, and find a simple optimum."""

import pytest
import torch

from neural_sim.baseline.search import BayesOpt, RandomSearch
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.parameter.zoom import Zoom

SCENE = SceneDistribution.of([Pose(bins=3, floor=0.0), Zoom(bins=2)])
PSI = torch.zeros(2, 5, dtype=torch.float64)
METHODS = [RandomSearch(), BayesOpt()]


def reward(psi):
    """Largest where both objects' poses are in the last bin."""
    return float(SCENE.probabilities(psi)["pose"][:, 2].sum())


@pytest.mark.parametrize("method", METHODS, ids=lambda m: m.name)
def test_the_best_psi_so_far_is_reported_and_the_first_is_the_start(method):
    search, best = method.begin(SCENE, PSI, torch.Generator().manual_seed(0)), -1.0
    for number in range(30):
        asked = search.ask()
        assert asked.shape == PSI.shape and torch.isfinite(asked).all()
        if number == 0:
            torch.testing.assert_close(asked, PSI)
        search.tell(reward(asked), [])
        best = max(best, reward(asked))
        assert reward(search.psi) == best
    assert best > reward(PSI) + 0.3


@pytest.mark.parametrize("method", METHODS, ids=lambda m: m.name)
def test_the_same_seed_asks_for_the_same_psi(method):
    runs = []
    for _ in range(2):
        search, asked = method.begin(SCENE, PSI, torch.Generator().manual_seed(3)), []
        for _ in range(5):
            asked.append(search.ask())
            search.tell(reward(asked[-1]), [])
        runs.append(torch.stack(asked))
    assert torch.equal(*runs)


def test_random_distributions_are_uniform_over_the_simplex():
    """Two bins: p of the first is uniform in [0, 1], mean 1/2 and variance 1/12."""
    search, p = RandomSearch().begin(SCENE, PSI, torch.Generator().manual_seed(0)), []
    search.ask()
    search.tell(0.0, [])
    for _ in range(2_000):
        p.append(SCENE.probabilities(search.ask())["zoom"][:, 0])
    p = torch.cat(p)
    assert abs(float(p.mean()) - 0.5) < 4 * (1 / 12 / len(p)) ** 0.5
    assert float(p.var()) == pytest.approx(1 / 12, rel=0.1)


@pytest.mark.parametrize("make", [lambda: RandomSearch(rounds=0), lambda: BayesOpt(reach=0.0)])
def test_bad_settings_are_refused(make):
    with pytest.raises(ValueError, match=r"baseline\.(rounds|reach)"):
        make()
