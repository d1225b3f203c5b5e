"""p-values against exact enumeration by scipy, their level on noise of every kind, their power on planted signals."""

import itertools

import numpy
import pytest
import scipy.stats
import torch
from torch.nn.functional import one_hot

from neural_sim.gradient.base import Losses, ObjectImages, Probes
from neural_sim.gradient.estimators import ReinforceEstimator, StratifiedEstimator
from neural_sim.gradient.pathwise import psi_contributions
from neural_sim.gradient.significance import DRAWS, SMALLEST, no_association, no_difference, zero_mean
from neural_sim.parameter.illumination import Illumination
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.types import SceneDraw

DOUBLE = torch.float64
BINS, EACH = 8, 16  # the default's
KNOWN = torch.arange(BINS).repeat_interleave(EACH)
OBJECTS, FEW, LEVEL = 2000, 99, 0.05
# One test in 10,000 may fail where the level is right.
MOST, LEAST = (scipy.stats.binom.ppf(q, OBJECTS, LEVEL) / OBJECTS for q in (1 - 1e-4, 1e-4))
UNIFORM, DOMINANT = [1 / BINS] * BINS, [0.86, *[0.02] * (BINS - 1)]
SPREAD = 2.0 ** torch.linspace(-2, 2, BINS, dtype=DOUBLE)  # standard deviations of the bins, 1 to 16


def normal(generator, *shape):
    return torch.randn(*shape, generator=generator, dtype=DOUBLE)


def student(generator, *shape):
    """Student's t with 2 degrees of freedom: no variance."""
    return normal(generator, *shape) / (normal(generator, 2, *shape).square().mean(0).sqrt())


def lognormal(generator, *shape):
    """Skewness 6."""
    return normal(generator, *shape).exp()


def rare(generator, *shape):
    """One image in ten has a score a hundred times as large as the others."""
    large = torch.rand(*shape, generator=generator) < 0.1
    return normal(generator, *shape) * torch.where(large, 10.0, 0.1)


SLOW = pytest.mark.slow
LAWS = [rare, *(pytest.param(law, marks=SLOW) for law in (normal, student, lognormal))]
SYMMETRIC = [student, *(pytest.param(law, marks=SLOW) for law in (normal, rare))]


def statistic(contributions):
    squares = (contributions**2).sum(-2)
    return (contributions.sum(-2) ** 2 / numpy.where(squares > 0.0, squares, 1.0)).sum(-1)


def near(p_value, exact):
    """Within four standard errors of a p-value from random changes."""
    return abs(p_value - exact) < 4 * (exact * (1 - exact) / DRAWS) ** 0.5 + 1 / DRAWS


@pytest.mark.parametrize("shift", [0.0, 0.5, 1.0])
def test_changed_signs_against_all_of_them(generator, shift):
    rows = (normal(generator, 9, 3) + shift).numpy()
    exact = scipy.stats.permutation_test(
        (numpy.ones(9),),
        lambda signs, axis: statistic(signs[..., None] * rows),
        permutation_type="samples", n_resamples=numpy.inf, alternative="greater", vectorized=True,
    )  # fmt: skip
    assert len(exact.null_distribution) == 2**9
    assert near(zero_mean(torch.from_numpy(rows)), exact.pvalue)


@pytest.mark.parametrize("shift", [0.0, 1.5, 4.0])
def test_permuted_scores_against_all_of_them(generator, shift):
    bins = numpy.eye(3)[[0, 0, 0, 1, 1, 1, 1, 2]]
    scores = normal(generator, 8).numpy() + shift * bins[:, 0]
    drawn = bins - bins.mean(0)

    def of(scores, axis):
        return statistic((scores - scores.mean(-1, keepdims=True))[..., None] * drawn)

    permuted = scipy.stats.permutation_test(
        (scores,),
        of,
        permutation_type="pairings",
        n_resamples=numpy.inf,
        alternative="greater",
        vectorized=True,
    )
    assert len(permuted.null_distribution) == 40320
    flipped = zero_mean(torch.from_numpy((scores - scores.mean())[:, None] * drawn))
    found = no_association(torch.from_numpy(scores), torch.from_numpy(bins))
    assert found >= flipped and near(found, max(permuted.pvalue, flipped))


@pytest.mark.parametrize("law", LAWS)
def test_known_bins_of_one_mean_pass_no_more_often_than_the_level(generator, law):
    """The default's 16 images of 8 bins: scores of any law, independent of the bins."""
    noise, bins = law(generator, OBJECTS, len(KNOWN)), one_hot(KNOWN)
    assert rate([no_association(scores, bins, FEW) for scores in noise]) <= MOST


@pytest.mark.parametrize("law", SYMMETRIC)
def test_known_bins_of_unequal_variances_pass_no_more_often_than_the_level(generator, law):
    noise, bins = law(generator, OBJECTS, len(KNOWN)) * SPREAD[KNOWN], one_hot(KNOWN)
    assert rate([no_association(scores, bins, FEW) for scores in noise]) <= MOST


@pytest.mark.parametrize("counts", [pytest.param([2] * BINS, marks=SLOW), [30, 1, 1, 1, 0, 3, 1, 8]])
def test_few_images_a_bin_pass_no_more_often_than_the_level(generator, counts):
    bins = one_hot(torch.arange(BINS).repeat_interleave(torch.tensor(counts)), BINS)
    noise = lognormal(generator, OBJECTS, len(bins))
    assert rate([no_association(scores, bins, FEW) for scores in noise]) <= MOST


@pytest.mark.parametrize(
    ("p", "law", "spread"),
    [
        pytest.param(DOMINANT, lognormal, False, marks=SLOW),
        (DOMINANT, student, True),
        *(
            pytest.param(p, law, False, marks=SLOW)
            for law in (normal, student, rare)
            for p in (UNIFORM, DOMINANT)
        ),
        pytest.param(DOMINANT, normal, True, marks=SLOW),
        pytest.param(UNIFORM, lognormal, False, marks=SLOW),
    ],
)
def test_drawn_bins_pass_no_more_often_than_the_level(generator, p, law, spread):
    """50 images that p draws, as for REINFORCE: a rare bin has an image or none, and may have the larger scores."""
    drawn = torch.multinomial(torch.tensor(p), OBJECTS * 50, True, generator=generator).view(OBJECTS, 50)
    noise = law(generator, OBJECTS, 50) * (SPREAD[drawn] if spread else 1.0)
    found = [no_association(s, one_hot(b, BINS), FEW) for s, b in zip(noise, drawn, strict=True)]
    assert rate(found) <= MOST


@pytest.mark.parametrize("shift", [0.0, 1.0, 3.0])
def test_scores_permuted_within_scenes_against_all_of_them(generator, shift):
    """Four scenes under three lights: 6^4 permutations, which scipy does not make of more than two samples."""
    scores = normal(generator, 4, 3).numpy() + shift * numpy.array([1.0, 0.0, 0.0])
    apart = scores - scores.mean(1, keepdims=True)
    orders = [apart[:, order] for order in map(list, itertools.permutations(range(3)))]
    every = numpy.array(
        [[orders[o][i] for i, o in enumerate(way)] for way in itertools.product(range(6), repeat=4)]
    )
    exact = float((statistic(every) >= statistic(apart) * (1 - 1e-9)).mean())
    flipped = zero_mean(torch.from_numpy(apart))
    found = no_difference(torch.from_numpy(scores))
    assert found >= flipped and near(found, max(exact, flipped))


@pytest.mark.parametrize(
    ("law", "spread"),
    [(lognormal, False), *(pytest.param(law, True, marks=SLOW) for law in (student, normal, rare))],
)
def test_the_same_scenes_under_every_light_pass_no_more_often_than_the_level(generator, law, spread):
    scenes = law(generator, OBJECTS, EACH, 6) * (SPREAD[:6] if spread else 1.0) + law(
        generator, OBJECTS, EACH, 1
    )
    assert rate([no_difference(scores, FEW) for scores in scenes]) <= MOST


@pytest.mark.parametrize("law", SYMMETRIC)
@pytest.mark.parametrize("temperature", [0.1, pytest.param(0.8, marks=SLOW)])
def test_relaxed_draws_without_a_derivative_pass_no_more_often_than_the_level(generator, law, temperature):
    """50 images' cotangents of the angle, independent of the draw, through the replayed Gumbel-softmax: at a low
    temperature a few draws near a tie carry nearly all of the derivative."""
    distribution = SceneDistribution.of([Pose(bins=BINS, temperature=temperature)])
    psi = normal(generator, BINS)
    noise = distribution.draw_noise(OBJECTS * 50, generator, DOUBLE)
    cotangents = {"phi": law(generator, OBJECTS * 50)}
    rows = psi_contributions(lambda psi: distribution.relaxed(psi, noise), psi, cotangents)
    largest = rows.view(OBJECTS, 50, BINS).square().amax(1).sum(-1) / rows.view(OBJECTS, -1).square().sum(-1)
    assert temperature > 0.5 or float(largest.median()) > 0.3  # an image or two carry it
    found = rate([zero_mean(part, FEW) for part in rows.view(OBJECTS, 50, BINS)])
    # Cotangents are symmetric, which makes the test exact where the draws leave enough of them.
    assert found <= MOST and (temperature < 0.5 or found >= LEAST)


def test_fewer_rows_than_can_tell_never_pass(generator):
    """m rows have 2^(m - 1) patterns of signs that differ: 5 rows cannot be significant at 0.05."""
    rows = torch.cat([5.0 + 0.01 * normal(generator, 5, BINS), torch.zeros(45, BINS, dtype=DOUBLE)])
    assert zero_mean(rows) >= 2**-5  # within its own noise of 2^-4
    assert zero_mean(torch.cat([rows, rows[:5] + 0.1])) <= LEVEL


EVERY = torch.tensor([1.0, -1.0, 0.5, -0.5, 0.0, 0.0, 0.5, -0.5], dtype=DOUBLE)
ONE = torch.eye(BINS, dtype=DOUBLE)[0] - 1 / BINS


def power_of_f(effects, per_bin):
    """Of the F test at ``per_bin`` normal scores of variance 1 a bin."""
    freedom = BINS - 1, BINS * (per_bin - 1)
    least = scipy.stats.f.ppf(1 - LEVEL, *freedom)
    return scipy.stats.ncf.sf(least, *freedom, per_bin * float(effects.square().sum()))


@pytest.mark.parametrize("effects", [EVERY, ONE], ids=["every bin", "one bin"])
@pytest.mark.parametrize("size", [0.6, pytest.param(0.3, marks=SLOW)])
def test_a_planted_signal_passes_as_often_as_the_f_test_on_three_quarters_of_the_images(
    generator, effects, size
):
    """The F test is the most powerful invariant one where variances are equal and scores normal, as they are here.
    At 0.6 standard deviations (root mean square over bins) hardly any signal is refused."""
    count, effects = OBJECTS // 4, size * effects / effects.square().mean().sqrt()
    noise = normal(generator, count, len(KNOWN)) + effects[KNOWN]
    found = rate([no_association(scores, one_hot(KNOWN), 199) for scores in noise])
    lower, upper = power_of_f(effects, 12), power_of_f(effects, EACH)
    assert lower - 4 * (0.25 / count) ** 0.5 < found < upper + 4 * (0.25 / count) ** 0.5
    assert size < 0.6 or lower > 0.95


@pytest.mark.parametrize("size", [0.3, 0.6])
def test_a_mean_of_rows_passes_as_often_as_hotellings_test_on_three_quarters_of_them(generator, size):
    """50 images, 4 components of equal means and variances, independent: T^2 is the most powerful invariant test."""
    count, k = OBJECTS // 2, 4
    found = rate([zero_mean(rows, FEW) for rows in normal(generator, count, 50, k) + size / k**0.5])

    def power(n):
        least = scipy.stats.f.ppf(1 - LEVEL, k, n - k)
        return scipy.stats.ncf.sf(least, k, n - k, n * size**2)

    # Each component's own variance in place of their covariance costs nothing where they are independent, and tells
    # a little more, since fewer numbers are estimated.
    assert found > power(37) - 4 * (0.25 / count) ** 0.5


def rate(p_values):
    return sum(p <= LEVEL for p in p_values) / len(p_values)


def own_scores(params, index):
    """Losses whose scores are the entries of v."""
    return params["w"][index]


def toy(distribution, draw, scores):
    count = len(scores)
    index, psi = torch.arange(count), distribution.psi("initial", ["x"])[0]
    images = torch.zeros(count, 3, 1, 1)
    batch = ObjectImages(psi, distribution, images, index, torch.full((count,), 1.0 / count), draw)
    params = {"w": torch.zeros(count, dtype=DOUBLE)}
    return Losses(own_scores, None, own_scores), params, {"w": scores}, batch


def test_estimators_test_each_factor_by_itself(generator):
    """Scores that know the light and not the pose, and the other way round."""
    distribution = SceneDistribution.of([Pose(bins=BINS), Illumination(anchors=4)])
    psi = distribution.psi("initial", ["x"])[0]
    draw = distribution.hard(psi, distribution.draw_noise(200, generator, DOUBLE, explore=True))
    draw = distribution.lit(draw, psi, normal(generator, 200, 4))
    by_pose = EVERY[draw.bins[:, 0]]
    by_light = draw.explored[:, 0] / 0.1
    noise = normal(generator, 200)
    for signal, told, not_told in ((by_pose, "pose", "illumination"), (by_light, "illumination", "pose")):
        inputs = toy(distribution, draw, noise + 2 * signal)
        found = ReinforceEstimator().estimate(*inputs, {})
        assert found.p_values[told] == SMALLEST and found.p_values[not_told] > LEVEL
        # What lights have in common, their constraint takes back.
        assert (
            ReinforceEstimator()
            .estimate(*toy(distribution, draw, draw.explored.sum(-1)), {})
            .p_values["illumination"]
            > LEVEL
        )
    lights = torch.arange(4).repeat_interleave(EACH)
    index = torch.arange(len(KNOWN) + len(lights))
    probes = {"pose": Probes(index[: len(KNOWN)], KNOWN), "illumination": Probes(index[len(KNOWN) :], lights)}
    for signal, told, not_told in (
        (torch.cat([EVERY[KNOWN], 0.0 * lights]), "pose", "illumination"),
        (torch.cat([0.0 * KNOWN, (lights == 1).double()]), "illumination", "pose"),
    ):
        scores = 2 * signal + normal(generator, len(index))
        scores[len(KNOWN) :] += 9.0 * normal(generator, EACH).repeat(4)  # of the scene, under whatever light
        still = torch.zeros(len(index))
        inputs = toy(distribution, SceneDraw(still, still, still, index[:, None]), scores)
        found = StratifiedEstimator(EACH).estimate(*inputs, probes)
        assert found.p_values[told] == SMALLEST and found.p_values[not_told] > LEVEL
