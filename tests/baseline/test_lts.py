"""Learning to Simulate: its mean step against enumeration of all training sets, and its moving average."""

import itertools

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


LATER = drawn(torch.zeros(4, 2, dtype=torch.long))
FIRST = drawn(torch.tensor([[2, 1]] * 4))


def run(rewards, **settings):
    """Steps of a policy over two objects that draws the last bins in its first round and the first ones ever after."""
    policy = LearningToSimulate(**settings).begin(SCENE, PSI.repeat(2, 1), torch.Generator())
    path = [policy.psi]
    for value in rewards:
        assert torch.equal(policy.ask(), policy.psi)
        policy.tell(value, [FIRST if len(path) == 1 else LATER] * 2)
        path.append(policy.psi)
    return path


def test_a_reward_above_the_average_makes_what_was_drawn_likelier():
    path = run([5.0, 5.0, 6.0])
    assert torch.equal(path[0], path[1]) and torch.equal(path[1], path[2])  # equal rewards tell nothing
    assert (path[3][:, 0] > path[2][:, 0]).all()
    assert (run([5.0, 4.0])[2][:, 0] < PSI[0]).all()


def test_both_of_the_first_two_rounds_move_psi():
    """A bandit of three arms whose score is a count less n p: one arm fails four times, then another wins."""
    bandit = SceneDistribution.of([Pose(bins=3, floor=0.0)])
    settings = LearningToSimulate(learning_rate=0.3, max_step=100.0)
    policy = settings.begin(bandit, PSI[None, :3], torch.Generator())
    for reward_, arm in ((0.0, 1), (1.0, 2)):
        policy.tell(reward_, [drawn(torch.full((4, 1), arm))])
    # p cancels, and a step has length 0.3 * 4 / sqrt(4): what failed is left, what won is taken up, the third stays.
    expected = PSI[None, :3] + torch.tensor([[0.0, -0.6, 0.6]], dtype=DOUBLE)
    torch.testing.assert_close(policy.psi, expected)


def test_the_first_steps_mean_is_along_the_exact_gradient():
    """Over all pairs of training sets. The step is scaled by the two rewards' own difference, so a reward of 0 or 1
    gives it the exact length, once for each round: 2 lr / sqrt(n) d E[R] / d psi."""
    bandit = SceneDistribution.of([Pose(bins=3, floor=0.0)])
    sets = [torch.tensor(arms)[:, None] for arms in itertools.product(range(3), repeat=2)]
    won = [float((arms == 2).any()) for arms in sets]
    leaf = PSI[:3].clone().requires_grad_()
    p = torch.stack([bandit.log_prob(leaf, drawn(arms)).sum().exp() for arms in sets])
    (gradient,) = torch.autograd.grad(p @ torch.tensor(won, dtype=DOUBLE), leaf)
    settings = LearningToSimulate(learning_rate=0.3, max_step=100.0)
    mean = torch.zeros(3, dtype=DOUBLE)
    for one, other in itertools.product(range(len(sets)), repeat=2):
        policy = settings.begin(bandit, PSI[None, :3], torch.Generator())
        for each in (one, other):
            policy.tell(won[each], [drawn(sets[each])])
        mean += (p[one] * p[other]).detach() * (policy.psi[0] - PSI[:3])
    torch.testing.assert_close(mean, 2 * 0.3 / 2**0.5 * gradient)


def test_steps_do_not_depend_on_the_rewards_unit_or_offset():
    rewards = [0.3, 0.5, 0.2, 0.9]
    plain, scaled = run(rewards)[-1], run([1e3 * (value + 7.0) for value in rewards])[-1]
    torch.testing.assert_close(plain, scaled)


def test_the_advantage_against_the_moving_averages_written_out():
    path = run([1.0, 2.0, 4.0], learning_rate=0.1, decay=0.5, max_step=100.0)
    slope = (score(SCENE, PSI, LATER) - score(SCENE, PSI, FIRST)) / 2.0
    first = SCENE.split(0.1 * 1.0 * slope)  # the only difference is its own measure
    moved = SCENE.join({name: part - part.mean() for name, part in first.items()})
    torch.testing.assert_close(path[2][0], path[1][0] + moved)
    # b = 1.5 after two rewards, the variance 0.5 (1 + 0.5 * 2.5^2) after the third
    advantage = 2.5 / (0.5 * (1.0 + 0.5 * 2.5**2)) ** 0.5
    slope = score(SCENE, path[2][0], LATER) / 2.0
    second = SCENE.split(0.1 * advantage * slope)
    moved = SCENE.join({name: part - part.mean() for name, part in second.items()})
    torch.testing.assert_close(path[3][0], path[2][0] + moved)


def test_no_step_exceeds_its_bound():
    path = run([0.0, 1.0, -50.0, 80.0], learning_rate=100.0, max_step=0.3)
    assert all((after - before).abs().max() <= 0.3 + 1e-12 for before, after in itertools.pairwise(path))
