"""Searches by reward: they begin at the initial psi, keep the best, and find a simple optimum."""

import pytest
import torch

from neural_sim.baseline.search import BayesOpt, RandomSearch
from neural_sim.parameter.illumination import Illumination
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


def test_the_first_trial_of_bayesian_optimisation_is_the_start_itself():
    """A dominant bin's logit lies beyond the reach, and so may a weight of a light on the affine plane."""
    biased = {"mug": {"initial": {"dominant": 2}}}
    lights = Illumination(
        3, "affine", initial=[0.1, 0.2, 0.7], biased={"mug": {"initial": [5.0, -3.5, -0.5]}}
    )
    scene = SceneDistribution.of([Pose(biased=biased), Zoom(biased=biased), lights])
    start = scene.psi("initial", ["mug", "can"])
    assert float(start[0, :8].max()) > 3.0
    search = BayesOpt(reach=3.0).begin(scene, start, torch.Generator().manual_seed(0))
    assert torch.equal(search.ask(), start)
    search.tell(1.0, [])
    assert search._study.trials[0].params == {f"psi_{i}": v for i, v in enumerate(start.flatten().tolist())}
    for _ in range(20):  # later ones keep to the reach but where the start lies beyond it
        asked = scene.split(search.ask())
        bins = torch.cat([asked["pose"], asked["zoom"]], -1)
        beyond = torch.cat([scene.split(start)[name] for name in ("pose", "zoom")], -1)
        assert (bins <= beyond.clamp_min(3.0)).all() and (bins >= beyond.clamp_max(-3.0)).all()
        torch.testing.assert_close(asked["illumination"].sum(-1), torch.ones(2, dtype=torch.float64))
        search.tell(0.0, [])
    assert torch.equal(search.psi, start)


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
