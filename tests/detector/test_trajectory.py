"""Steps as functions against torch's optimiser and written-out formulas; a recorded training is the one that ran."""

import math

import pytest
import torch

from neural_sim.detector.cached_set import CachedSet
from neural_sim.detector.training import DetectorModule, Optimisation, train_detector
from neural_sim.detector.trajectory import (
    MEGABYTE,
    AdamW,
    Recorder,
    Recording,
    Trajectory,
    pulled_back,
    segment_length,
    train,
)

DOUBLE = torch.float64
RATES = (1e-3, 1e-2, 7e-3, 2e-3)
PAIRS = [
    (AdamW(0.02), lambda p: torch.optim.AdamW(p, lr=1.0, weight_decay=0.02)),
    (AdamW(0.0, (0.8, 0.99), 1e-3), lambda p: torch.optim.AdamW(p, 1.0, (0.8, 0.99), 1e-3, 0.0)),
]


@pytest.mark.parametrize(("rule", "theirs"), PAIRS, ids=["default", "changed"])
def test_steps_are_those_of_torch(generator, rule, theirs):
    start = torch.randn(9, generator=generator, dtype=DOUBLE)
    value = torch.nn.Parameter(start.clone())
    optimiser, state = theirs([value]), rule.begin(start)
    for done, rate in enumerate(RATES):
        gradient = torch.randn(9, generator=generator, dtype=DOUBLE)
        gradient[0] = 0.0
        state = rule.step(state, gradient, rate, done)
        value.grad = gradient.clone()
        optimiser.param_groups[0]["lr"] = rate
        optimiser.step()
        torch.testing.assert_close(state[0], value.detach(), rtol=1e-13, atol=1e-15)


def test_a_weight_decay_for_each_entry_is_that_of_parameter_groups(generator):
    start, gradient = torch.randn(2, 6, generator=generator, dtype=DOUBLE)
    value = [torch.nn.Parameter(part.clone()) for part in start.split(3)]
    groups = [{"params": [value[0]], "weight_decay": 0.3}, {"params": [value[1]], "weight_decay": 0.0}]
    for part, slope in zip(value, gradient.split(3), strict=True):
        part.grad = slope.clone()
    torch.optim.AdamW(groups, lr=0.1).step()
    rule = AdamW(torch.tensor([0.3] * 3 + [0.0] * 3, dtype=DOUBLE))
    ours = rule.step(rule.begin(start), gradient, 0.1, 0)[0]
    torch.testing.assert_close(ours, torch.cat([part.detach() for part in value]), rtol=1e-13, atol=1e-15)


def test_adamws_pull_back_is_the_formula_written_out(generator):
    rate, decay, done, (fast, slow), eps = 7e-3, 0.02, 4, (0.9, 0.999), 1e-3
    theta, first, gradient, by_theta, by_first, by_second = torch.randn(
        6, 9, generator=generator, dtype=DOUBLE
    )
    second = torch.rand(9, generator=generator, dtype=DOUBLE)
    rule = AdamW(decay, (fast, slow), eps)
    earlier, along = pulled_back(
        rule, (theta, first, second), gradient, rate, done, (by_theta, by_first, by_second)
    )
    c1, c2 = 1 - fast ** (done + 1), 1 - slow ** (done + 1)
    m, v = fast * first + (1 - fast) * gradient, slow * second + (1 - slow) * gradient**2
    root = (v / c2).sqrt()
    a_m = by_first - rate * by_theta / (c1 * (root + eps))
    a_v = by_second + rate * by_theta * (m / c1) / (2 * c2 * root * (root + eps) ** 2)
    torch.testing.assert_close(along, (1 - fast) * a_m + 2 * (1 - slow) * gradient * a_v)
    torch.testing.assert_close(earlier[0], (1 - rate * decay) * by_theta)
    torch.testing.assert_close(earlier[1], fast * a_m)
    torch.testing.assert_close(earlier[2], slow * a_v)


def test_an_entry_that_never_had_a_gradient_has_a_finite_pull_back():
    """There the step is m / (c1 eps), whose derivative is -rate / eps for the gradient, and 0 for the second moment."""
    rule, zero = AdamW(0.0), torch.zeros(1, dtype=DOUBLE)
    one = torch.ones(1, dtype=DOUBLE)
    earlier, along = pulled_back(rule, rule.begin(one), zero, 1e-2, 0, (one, zero, zero))
    assert float(along) == pytest.approx(-1e-2 / 1e-8, rel=1e-12)
    assert float(earlier[2]) == 0.0


def test_a_floor_under_adamws_denominator_bounds_its_pull_back(generator):
    """Where the floor holds, a step is rate m / (c1 floor): the second moment has no effect on theta."""
    rate, done, (fast, slow) = 7e-3, 2, (0.9, 0.999)
    theta, first, gradient, by_theta = torch.randn(4, 6, generator=generator, dtype=DOUBLE)
    second, end = torch.rand(2, 6, generator=generator, dtype=DOUBLE)
    second[:3] = first[:3] = gradient[:3] = 0.0
    plain = AdamW(0.02)
    usual = (end / (1 - slow**120)).sqrt()
    rule = plain.floored((theta, first, end), 120, 1e-2, [1] * 6)
    torch.testing.assert_close(rule.floor, 1e-2 * (usual + plain.eps))
    still = torch.zeros_like(theta)
    (_, by_first, by_second), along = pulled_back(
        rule, (theta, first, second), gradient, rate, done, (by_theta, still, still)
    )
    pushed = -rate * by_theta[:3] / ((1 - fast ** (done + 1)) * rule.floor[:3])
    torch.testing.assert_close(by_first[:3], fast * pushed)
    torch.testing.assert_close(along[:3], (1 - fast) * pushed)
    assert not by_second[:3].any() and by_second[3:].all()
    _, exact = pulled_back(plain, (theta, first, second), gradient, rate, done, (by_theta, still, still))
    torch.testing.assert_close(along[3:], exact[3:])


def test_a_rule_without_a_floor_is_itself():
    state = (torch.ones(2), torch.ones(2), torch.ones(2))
    assert AdamW().floored(state, 3, 0.0, [2]) == AdamW()


def test_an_entry_without_usual_gradients_takes_the_level_of_its_tensor():
    """The root mean square of the tensor's denominators, where the entry's own is smaller."""
    end = torch.tensor([1e-14, 9.0, 16.0, 4.0], dtype=DOUBLE).square()
    state = (torch.zeros_like(end), torch.zeros_like(end), end * (1 - 0.999**50))
    rule = AdamW().floored(state, 50, 0.3, [3, 1])
    level = ((81 + 256) / 3) ** 0.5
    wanted = 0.3 * torch.tensor([level, level, 16.0, 4.0], dtype=DOUBLE)
    torch.testing.assert_close(rule.floor, wanted, rtol=1e-7, atol=0.0)


@pytest.fixture
def cached(tools, generator):
    return _cached(tools, generator, 0.0)


def _cached(tools, generator, proximal):
    detector = tools.detector(proximal=proximal)
    params = tools.noisy(detector.init(generator), generator)
    backbone, _ = detector.split(params)
    return detector, params, CachedSet.of(detector, backbone, tools.images(8))


def _recorded(cached, recording, anchor=None, **changes):
    detector, params, images = cached
    settings = {"epochs": 3, "batch_size": 3, "learning_rate": 1e-2, "weight_decay": 0.1} | changes
    generator = torch.Generator().manual_seed(5)
    return train_detector(detector, params, images, generator, Optimisation(**settings), anchor, recording)


def _mean_gradient(cached, proximal=0.0, anchor=None):
    detector, params, images = cached
    like = detector.split(params)[1]

    def at(theta, rows):
        leaves, first = {}, 0
        for name, value in like.items():
            leaves[name] = theta[first : first + value.numel()].view_as(value).clone().requires_grad_()
            first += value.numel()
        loss = images.losses(leaves, rows).mean()
        if proximal:
            loss = loss + 0.5 * proximal * sum((leaves[n] - anchor[n]).square().sum() for n in leaves)
        return torch.cat([g.reshape(-1) for g in torch.autograd.grad(loss, list(leaves.values()))])

    return at


@pytest.mark.parametrize("proximal", [0.0, 2.0])
def test_a_recorded_training_is_the_one_that_was_run(tools, generator, proximal):
    cached = detector, params, _ = _cached(tools, generator, proximal)
    anchor = {name: value + 0.1 for name, value in detector.split(params)[1].items()}
    recording = Recording()
    trained, history = _recorded(cached, recording, anchor)
    plain, other = _recorded(cached, None, anchor)
    assert all(torch.equal(trained[name], plain[name]) for name in trained) and history == other
    trajectory = history.trajectory
    assert other.trajectory is None and len(trajectory) == history.steps == 9
    for epoch in range(3):
        rows = torch.cat(trajectory.rows[3 * epoch : 3 * epoch + 3])
        assert torch.equal(rows.sort().values, torch.arange(8))
    end = torch.cat([value.reshape(-1) for value in detector.split(trained)[1].values()])
    assert torch.equal(trajectory.end, end)
    gradient_at = _mean_gradient(cached, proximal, anchor)
    for segment in trajectory.segments():
        replayed = trajectory.replayed(segment, gradient_at)
        for step, (state, gradient) in zip(segment, replayed, strict=True):
            torch.testing.assert_close(
                gradient, gradient_at(state[0], trajectory.rows[step]), rtol=1e-10, atol=1e-12
            )
        (state, gradient), last = replayed[-1], segment[-1]
        after = trajectory.rule.step(state, gradient, trajectory.rates[last], last)
        expected = trajectory.checkpoints.get(segment.stop, (end,))
        for ours, theirs in zip(after, expected, strict=False):
            torch.testing.assert_close(ours, theirs, rtol=1e-10, atol=1e-12)


def test_the_rates_are_those_of_warm_up_and_cosine_decay(cached):
    _, history = _recorded(cached, Recording(), warmup_fraction=0.3)
    cosine = [0.5 * (1.0 + math.cos(math.pi * step / 6.0)) for step in range(6)]
    assert history.trajectory.rates == pytest.approx([1e-2 * rate for rate in (1 / 3, 2 / 3, 1.0, *cosine)])


def test_states_alone_are_kept_where_gradients_do_not_fit(cached):
    """Nine steps: three states at a time, and three of a segment with their gradients; vectors of 8 n bytes."""
    detector, params, _ = cached
    vector = 8 * sum(value.numel() for value in detector.split(params)[1].values())
    least = ((3 + 3) * 3 + 3) * vector / MEGABYTE
    whole, few = (
        _recorded(cached, Recording(max_memory_mb=most))[1].trajectory
        for most in (least + 9 * vector / MEGABYTE, least)
    )
    assert sorted(whole.checkpoints) == sorted(few.checkpoints) == [0, 3, 6]
    assert len(whole.gradients) == 9 and not few.gradients
    gradient_at = _mean_gradient(cached)
    for segment in whole.segments():
        pairs = zip(whole.replayed(segment, gradient_at), few.replayed(segment, gradient_at), strict=True)
        for (state, gradient), (again, computed) in pairs:
            torch.testing.assert_close(gradient, computed, rtol=1e-10, atol=1e-12)
            torch.testing.assert_close(state[0], again[0], rtol=1e-10, atol=1e-12)
    with pytest.raises(ValueError, match=r"^outer\.adjoint\.max_memory_mb: 9 steps take"):
        _recorded(cached, Recording(max_memory_mb=0.9 * least))


def test_training_without_a_trainer_steps_down_a_quadratic():
    """One step by hand: against the gradient of theta^2 / 2 by the rate, and theta shrinks by the decay."""
    start, rows = torch.tensor([2.0], dtype=DOUBLE), (torch.tensor([0]),)
    made = train(AdamW(0.1), start, rows, (0.1,), lambda theta, _: theta)
    assert float(made.end) == pytest.approx(2.0 * 0.99 - 0.1, rel=1e-7)
    assert len(made) == 1 and set(made.checkpoints) == {0}


def test_few_states_are_kept():
    for steps in range(1, 200):
        length = segment_length(steps)
        assert length * length >= steps and -(-steps // length) + length <= 2 * steps**0.5 + 2


def test_what_was_not_recorded_or_has_no_gradient_is_refused(cached):
    detector, params, _ = cached
    backbone, learned = detector.split(params)
    silent, asked = (
        DetectorModule(detector, learned, backbone, Optimisation(3), 3, recording=recording)
        for recording in (None, Recording())
    )
    with pytest.raises(ValueError, match="want a recording"):
        silent.trajectory([])
    with pytest.raises(ValueError, match=r"\['fpn.* have no gradient, so the step cannot be recorded"):
        asked.on_before_optimizer_step(asked.configure_optimizers()["optimizer"])


def test_an_empty_trajectory_is_refused():
    theta = torch.zeros(1)
    state = AdamW().begin(theta)
    with pytest.raises(ValueError, match="learning rate for each"):
        Trajectory(AdamW(), (), (), {0: state}, {}, theta)
    with pytest.raises(ValueError, match="checkpoints"):
        Trajectory(AdamW(), (torch.zeros(1, dtype=torch.long),), (0.1,), {}, {}, theta)
    with pytest.raises(ValueError, match="checkpoints"):
        Trajectory(AdamW(), (torch.zeros(1, dtype=torch.long),), (0.1,), {1: state}, {}, theta)
    recorder = Recorder(Recording(), AdamW(), 1, theta)
    recorder.step(lambda: state, lambda: theta, 0.1)
    assert recorder.trajectory((torch.zeros(1, dtype=torch.long),), theta).rates == (0.1,)
