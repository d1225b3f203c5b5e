"""The mean of several trainings' derivatives, against closed forms, and its test against chance."""

import pytest
import torch
from scipy import stats

from neural_sim.outer.evidence import Average
from neural_sim.parameter.bins import closing

DOUBLE = torch.float64


def normal(generator, *shape):
    return torch.randn(shape, generator=generator, dtype=DOUBLE)


def test_a_noisy_direction_counts_by_its_variance_and_an_earlier_place_by_the_momentum():
    good = torch.tensor([[3.0, -1.0, -1.0, -1.0]], dtype=DOUBLE)
    wild = torch.tensor([[-90.0, 90.0, 0.0, 0.0]], dtype=DOUBLE)
    average = Average.zeros(good, 0.5).joined(good, torch.full_like(good, 0.01))
    average = average.moved(torch.tensor([True])).joined(wild, torch.full_like(good, 1e4))
    # Inverse-variance weights in closed form.
    a, b = 0.5 / 0.01, 1e-4
    torch.testing.assert_close(average.value, (a * good + b * wild) / (a + b))
    variance = (a**2 * 0.01 + b**2 * 1e4) / (a + b) ** 2
    torch.testing.assert_close(average.variance, torch.full_like(good, variance))


def test_a_derivative_that_is_not_finite_counts_for_nothing():
    good = torch.tensor([[3.0, -1.0, -1.0, -1.0], [0.0, 1.0, 0.0, -1.0]], dtype=DOUBLE)
    bad = good.clone()
    bad[0, 2] = torch.nan
    ones = torch.ones_like(good)
    average = Average.zeros(good).joined(good, ones).joined(bad, ones)
    torch.testing.assert_close(average.value, good)
    torch.testing.assert_close(average.variance, ones * torch.tensor([[1.0], [0.5]], dtype=DOUBLE))
    none = Average.zeros(good)
    assert float(none.value.abs().max()) == 0.0 and none.p_values.tolist() == [1.0, 1.0]
    unknown = none.joined(good, torch.full_like(good, torch.inf))
    for empty in (none, unknown):
        assert bool((empty.variance == torch.inf).all()) and empty.p_values.tolist() == [1.0, 1.0]


def test_p_values_are_those_of_the_chi_square_and_uniform_under_noise():
    generator = torch.Generator().manual_seed(0)
    spread = torch.tensor([0.5, 1.0, 2.0, 1.0], dtype=DOUBLE)
    noise = normal(generator, 4000, 4) * spread
    average = Average.zeros(noise).joined(noise, spread.square().expand_as(noise))
    centre = (noise / spread**2).sum(1, keepdim=True) / (1 / spread**2).sum()
    wanted = stats.chi2.sf(((noise - centre) ** 2 / spread**2).sum(1).numpy(), 3)
    torch.testing.assert_close(average.p_values, torch.from_numpy(wanted))
    # A binomial's standard deviation at 4,000 draws is 0.0034.
    assert float((average.p_values <= 0.05).double().mean()) == pytest.approx(0.05, abs=4 * 0.0034)


def centred(values):
    return values - values.mean(-1, keepdim=True)


def test_the_scatter_between_trainings_is_told_from_that_of_images():
    """Of many objects, each with three derivatives at one psi, centred as steps take them."""
    generator = torch.Generator().manual_seed(0)
    images, trainings = 0.3, 0.8
    truth = centred(normal(generator, 500, 8))
    average = Average.zeros(truth)
    for _ in range(3):
        noise = (images**2 + trainings**2) ** 0.5 * normal(generator, 500, 8)
        average = average.joined(truth + centred(noise), torch.full_like(truth, images**2 * 7 / 8))
    assert float(average.between.mean()) == pytest.approx(trainings**2, rel=0.05)
    error = (average.value - truth).square().mean()
    assert float(error) == pytest.approx(float(average.variance.mean()), rel=0.15)


def test_derivatives_at_two_places_say_nothing_of_the_scatter_between_trainings():
    generator = torch.Generator().manual_seed(0)
    first, second = normal(generator, 2, 1, 8)
    ones = torch.full_like(first, 0.01)
    apart = Average.zeros(first).joined(first, ones).moved(torch.tensor([True])).joined(second, ones)
    assert float(apart.between) == 0.0
    assert float(Average.zeros(first).joined(first, ones).joined(second, ones).between) > 0.0


def test_what_scatters_between_trainings_is_no_evidence():
    """Trainings disagree by three times what their images explain: the chi-square of the images alone rejects a true
    null nearly always."""
    generator = torch.Generator().manual_seed(0)
    variance = torch.full((2000, 8), 0.01, dtype=DOUBLE)
    average = Average.zeros(variance)
    for _ in range(2):
        average = average.joined(centred(0.3 * normal(generator, 2000, 8)), variance)
    assert float((average.p_values <= 0.05).double().mean()) < 0.1


def test_an_object_whose_derivatives_scatter_wildly_does_not_hide_the_others():
    """Each of six objects has a derivative three times its noise, and one of them once one of a thousand times that."""
    generator = torch.Generator().manual_seed(0)
    truth = centred(3.0 * normal(generator, 6, 8))
    variance = torch.full_like(truth, 7 / 8)
    average = Average.zeros(truth)
    for training in range(2):
        size, noise = torch.ones(6, 1, dtype=DOUBLE), centred(normal(generator, 6, 8))
        size[0] = 1000.0 if training else 1.0
        average = average.joined(size * (truth + noise), size.square() * variance)
    assert float(average.p_values[1:].max()) < 1e-3
    assert float(average.between[1:].max()) < 3.0 < float(average.between[0])


def test_objects_with_small_derivatives_are_held_to_their_own_scatter():
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([0.01, 1.0], dtype=DOUBLE).repeat(200)[:, None]
    average = Average.zeros(size.expand(400, 8))
    for _ in range(2):
        noise = size * centred(2.0 * normal(generator, 400, 8))
        average = average.joined(noise, (size**2 * 7 / 8).expand(400, 8))
    # Noise has the variance 4, of which images explain 1.
    small, large = average.between[::2].mean(), average.between[1::2].mean()
    assert float(large) == pytest.approx(3.0, rel=0.15) and float(small) == pytest.approx(3e-4, rel=0.15)


def test_closed_bins_change_nothing():
    """The mean, its variance and its test are those of the same derivatives without the closed bins."""
    generator = torch.Generator().manual_seed(0)
    closed = torch.tensor([False, True, True, False, False, True, False, True]).expand(50, 8)
    every = Average.zeros(closing(torch.zeros(50, 8, dtype=DOUBLE), closed))
    reduced = Average.zeros(torch.zeros(50, 4, dtype=DOUBLE))
    for _ in range(3):
        direction, variance = centred(normal(generator, 50, 4)), normal(generator, 50, 4).square()
        reduced = reduced.joined(direction, variance)
        wide = [torch.zeros(50, 8, dtype=DOUBLE).masked_scatter(~closed, v) for v in (direction, variance)]
        every = every.joined(*wide)
    torch.testing.assert_close(every.between, reduced.between)
    torch.testing.assert_close(every.p_values, reduced.p_values)
    assert float(reduced.between.max()) > 0.0
    for name in ("value", "variance"):
        torch.testing.assert_close(getattr(every, name)[~closed].view(50, 4), getattr(reduced, name))


def test_an_object_with_a_single_open_bin_has_no_evidence():
    closed = torch.tensor([[True, False, True]])
    average = Average.zeros(closing(torch.zeros(1, 3, dtype=DOUBLE), closed))
    for variance in (0.0, 0.1):
        average = average.joined(
            torch.zeros(1, 3, dtype=DOUBLE), torch.full((1, 3), variance).double() * ~closed
        )
        assert average.p_values.tolist() == [1.0] and average.between.tolist() == [0.0]
