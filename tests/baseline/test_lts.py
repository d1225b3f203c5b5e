"""Learning to Simulate: its mean step against enumeration of all training sets, and its moving average."""

import itertools

import pytest
import torch

from neural_sim.baseline.lts import LearningToSimulate, score
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.parameter.zoom import Zoom
from neural_sim.types import SceneDraw

DOUBLE = torch.float64
SCENE = SceneDistribution.of([Pose(bins=3, floor=0.01), Zoom(bins=2, floor=0.0)])
PSI = torch.tensor([0.3, -0.2, 0.1, 0.5, -0.4], dtype=DOUBLE)


def drawn(bins):
    """A draw of which only the bins matter."""
    still = torch.zeros(len(bins))
    return SceneDraw(still, still, still, bins)


def reward(bins):
    """Of a whole training set of two images, not a sum over them."""
    return float((bins[:, 0] == 2).sum() ** 2 - 0.5 * bins[0, 1] * bins[1, 0])


def test_the_score_of_a_training_set_gives_the_exact_gradient_of_the_mean_reward():
    cells = [torch.tensor(cell) for cell in itertools.product(range(3), range(2))]
    mean, leaf, total = torch.zeros_like(PSI), PSI.clone().requires_grad_(), 0.0
    for pair in itertools.product(cells, repeat=2):
        bins = torch.stack(pair)
        p = SCENE.log_prob(leaf, drawn(bins)).sum().exp()
        total = total + p * reward(bins)
        mean += p.detach() * reward(bins) * score(SCENE, PSI, drawn(bins))
    torch.testing.assert_close(mean, torch.autograd.grad(total, leaf)[0])


def run(rewards, **settings):
    """Steps of a policy over two objects that always draws the same bins."""
    policy = LearningToSimulate(**settings).begin(SCENE, PSI.repeat(2, 1), torch.Generator())
    draws, path = [drawn(torch.zeros(4, 2, dtype=torch.long))] * 2, [policy.psi]
    for value in rewards:
        assert torch.equal(policy.ask(), policy.psi)
        policy.tell(value, draws)
        path.append(policy.psi)
    return path


def test_the_first_reward_only_sets_the_average():
    path = run([5.0, 5.0, 6.0])
    assert torch.equal(path[0], path[1]) and torch.equal(path[1], path[2])
    assert (path[3][:, 0] > path[2][:, 0]).all()  # a reward above the average makes what was drawn likelier
    assert (run([5.0, 4.0])[2][:, 0] < PSI[0]).all()


def test_steps_do_not_depend_on_the_rewards_unit_or_offset():
    rewards = [0.3, 0.5, 0.2, 0.9]
    plain, scaled = run(rewards)[-1], run([1e3 * (value + 7.0) for value in rewards])[-1]
    torch.testing.assert_close(plain, scaled)


def test_the_advantage_against_the_moving_averages_written_out():
    path = run([1.0, 2.0, 4.0], learning_rate=0.1, decay=0.5, max_step=100.0)
    slope = score(SCENE, path[1][0], drawn(torch.zeros(4, 2, dtype=torch.long))) / 2.0
    first = SCENE.split(0.1 * 1.0 * slope)  # the only difference is its own measure
    moved = SCENE.join({name: part - part.mean() for name, part in first.items()})
    torch.testing.assert_close(path[2][0], path[1][0] + moved)
    # b = 1.5 after two rewards, the variance 0.5 (1 + 0.5 * 2.5^2) after the third
    advantage = 2.5 / (0.5 * (1.0 + 0.5 * 2.5**2)) ** 0.5
    slope = score(SCENE, path[2][0], drawn(torch.zeros(4, 2, dtype=torch.long))) / 2.0
    second = SCENE.split(0.1 * advantage * slope)
    moved = SCENE.join({name: part - part.mean() for name, part in second.items()})
    torch.testing.assert_close(path[3][0], path[2][0] + moved)


def test_no_step_exceeds_its_bound():
    path = run([0.0, 1.0, -50.0, 80.0], learning_rate=100.0, max_step=0.3)
    assert all((after - before).abs().max() <= 0.3 + 1e-12 for before, after in itertools.pairwise(path))


@pytest.mark.parametrize("bad", [{"learning_rate": 0.0}, {"max_step": -1.0}, {"decay": 1.0}, {"rounds": 0}])
def test_bad_settings_name_their_key(bad):
    with pytest.raises(ValueError, match=f"baseline.{next(iter(bad))}"):
        LearningToSimulate(**bad)
