"""Learning to Simulate: its step against the policy gradient in closed form and by hand, its draws, its rewards."""

import math

import pytest
import torch

from neural_sim.baseline.lts import LearningToSimulate
from neural_sim.parameter.illumination import Illumination
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.parameter.zoom import Zoom

DOUBLE = torch.float64
SCENE = SceneDistribution.of([Pose(bins=3, floor=0.01), Zoom(bins=2, floor=0.0)])
PSI = torch.tensor([[0.3, -0.2, 0.1, 0.5, -0.4], [0.0, 0.0, 0.0, 1.0, -1.0]], dtype=DOUBLE)


def policy(seed=0, scene=SCENE, psi=PSI, **settings):
    return LearningToSimulate(**settings).begin(scene, psi, torch.Generator().manual_seed(seed))


def centred(step, scene=SCENE):
    return scene.join({name: part - part.mean(-1, keepdim=True) for name, part in scene.split(step).items()})


def run(rewards, **settings):
    """Omega before and after every reward, and the noise of every setting, of two objects of equal rewards."""
    made = policy(**settings)
    path, noise = [made.psi], []
    for value in rewards:
        noise.append((made.ask() - made.psi) / settings.get("deviation", 1.0))
        made.tell(value)
        path.append(made.psi)
    return path, noise


def test_settings_are_gaussian_about_omega_and_omega_waits_for_all_of_a_step():
    made = policy(samples=4001, deviation=0.5)
    drawn = torch.stack([made.ask() for _ in range(4000)])
    torch.testing.assert_close(drawn.mean(0), PSI, atol=0.03, rtol=0)
    torch.testing.assert_close(drawn.std(0), torch.full_like(PSI, 0.5), atol=0.03, rtol=0)
    for _ in range(4000):
        made.tell(1.0)
    assert torch.equal(made.psi, PSI)


@pytest.mark.slow
def test_the_mean_step_is_along_the_exact_gradient_of_the_policys_mean_reward():
    """Of a linear reward <a, psi>, E[R] has the gradient a by omega, whatever the deviation. The first step divides by
    the root mean square of its own advantages, which is all but constant over so many settings.
    """
    slope = centred(torch.randn(PSI.shape, generator=torch.Generator().manual_seed(9), dtype=DOUBLE))
    samples, deviation = 20000, 0.7
    made = policy(samples=samples, deviation=deviation, learning_rate=1.0)
    for _ in range(samples):
        made.tell(float((slope * made.ask()).sum()))
    size = deviation * slope.norm()  # of the reward's deviation
    expected = deviation**2 * slope / size
    torch.testing.assert_close(made.psi - PSI, expected, atol=0.03, rtol=0)


def test_two_steps_written_out():
    rewards = [1.0, 2.0, 4.0, 7.0]
    path, noise = run(rewards, samples=2, learning_rate=0.1, decay=0.5)
    assert torch.equal(path[0], path[1]) and torch.equal(path[2], path[3])
    # First b = 1.5, its own mean: advantages of 0.5 over their root mean square.
    first = centred(0.1 * (noise[1] - noise[0]) / 2.0)
    torch.testing.assert_close(path[2], path[0] + first)
    # Then 2.5 and 5.5 above the same b, over the moving mean square.
    scale = math.sqrt(0.5 * 0.25 + 0.5 * (2.5**2 + 5.5**2) / 2.0)
    second = centred(0.1 * (2.5 * noise[2] + 5.5 * noise[3]) / 2.0 / scale)
    torch.testing.assert_close(path[4], path[2] + second)


def test_equal_rewards_tell_nothing():
    path, _ = run([5.0] * 6, samples=3)
    assert all(torch.equal(path[0], each) for each in path)


def test_steps_do_not_depend_on_the_rewards_unit_or_offset():
    rewards = [0.3, 0.5, 0.2, 0.9, 0.1, 0.4]
    plain, scaled = (
        run(values, samples=2)[0][-1] for values in (rewards, [1e3 * (value + 7.0) for value in rewards])
    )
    torch.testing.assert_close(plain, scaled)


def test_a_data_set_has_one_light_on_the_constraint_and_omega_stays_on_it():
    scene = SceneDistribution.of([Pose(bins=3, floor=0.01), Illumination(anchors=3)])
    psi = torch.tensor([[0.0, 0.0, 0.0, 0.8, 0.1, 0.1]], dtype=DOUBLE)
    made = policy(3, scene, psi, samples=2, light_deviation=0.5)
    for value in (0.0, 1.0, 2.0, 0.0):
        light = scene.split(made.ask())["illumination"]
        assert bool((light >= 0.0).all()) and float(light.sum()) == pytest.approx(1.0)
        made.tell(value)
    weights = scene.split(made.psi)["illumination"]
    assert bool((weights >= 0.0).all()) and float(weights.sum()) == pytest.approx(1.0)
    spread = torch.stack([scene.split(made.ask())["illumination"] for _ in range(200)]).std(0)
    assert float(spread.min()) > 0.1  # a whole data set moves with the setting


def test_it_climbs_a_concave_reward_through_the_noise_of_trainings():
    """Two of six objects begin at the wrong bin, as in pose_gap, and trainings scatter by 0.026."""
    bandit = SceneDistribution.of([Pose(bins=8, floor=0.005)])
    start, target = (torch.full((6, 8), 0.125, dtype=DOUBLE) for _ in range(2))
    for p, bins in ((start, (6, 2)), (target, (2, 6))):
        for row, b in enumerate(bins):
            p[row] = 0.02
            p[row, b] = 0.86

    def scores(psi):
        p = bandit.factors[0].p_of(psi)
        return 1.1 * (target * p / (p + 0.1)).sum(1)

    gained = []
    for seed in range(8):
        psi = bandit.factors[0].psi_of(start)
        made, noise = policy(seed, bandit, psi), torch.Generator().manual_seed(seed + 100)
        for _ in range(20):
            own = scores(made.ask())
            own = own + 0.026 * 6**0.5 * torch.randn(6, generator=noise, dtype=DOUBLE)
            made.tell(float(own.mean()))
        gained.append(float((scores(made.psi) - scores(psi)).mean()))
    assert sum(gained) > 0.0
