"""The product of parameters: independent factors, one psi, everything else uniform."""

import math

import pytest
import torch

from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.parameter.unlearned import Unlearned
from neural_sim.parameter.zoom import Zoom
from neural_sim.types import SceneDraw

PEAKED = {"mug": {"initial": {"dominant": 2}, "target": {"dominant": 4}}}
JOINT = SceneDistribution.of([Pose(bins=6, floor=0.0), Zoom(floor=0.0, biased=PEAKED)])


def drawn(bins):
    """A draw of which only the bins matter."""
    still = torch.zeros(len(bins))
    return SceneDraw(still, still, still, bins)


def test_psi_holds_the_factors_one_after_the_other():
    psi = JOINT.psi("initial", ["mug", "can"])
    assert psi.shape == (2, 10) and JOINT.size == 10 and JOINT.names == ("pose", "zoom")
    p = JOINT.probabilities(psi)
    torch.testing.assert_close(p["pose"], torch.full((2, 6), 1 / 6, dtype=torch.float64))
    assert p["zoom"][0].tolist() == pytest.approx([0.02, 0.94, 0.02, 0.02], abs=1e-6)
    assert torch.equal(JOINT.join(JOINT.split(psi)), psi)


def test_factors_are_drawn_independently_and_by_their_own_p(generator):
    count, psi = 40_000, JOINT.psi("initial", ["mug"])[0]
    draw = JOINT.hard(psi, JOINT.draw_noise(count, generator, torch.float64))
    assert torch.equal(JOINT.bins_of(draw), draw.bins)
    p = JOINT.probabilities(psi)
    frequencies = torch.zeros(6, 4, dtype=torch.float64)
    frequencies.index_put_(draw.bins.unbind(1), torch.full((count,), 1.0 / count, dtype=torch.float64), True)
    wanted = p["pose"][:, None] * p["zoom"]
    assert ((frequencies - wanted).abs() < 5 * (wanted / count).sqrt()).all()


def test_balanced_noise_gives_every_factor_its_expected_numbers_and_a_selection_of_it_is_independent(
    generator,
):
    psi = torch.zeros(10, dtype=torch.float64)
    noise = JOINT.draw_noise(120, generator, torch.float64, balanced=True)
    draw = JOINT.hard(psi, noise)
    assert [draw.bins[:, i].bincount().tolist() for i in (0, 1)] == [[20] * 6, [30] * 4]
    selected = JOINT.hard(psi, noise.select(torch.arange(120)))
    assert torch.equal(selected.bins[:, 0], noise.bins["pose"].gumbel.argmax(-1))


def test_uniform_psi_is_that_of_equal_probabilities_in_every_factor():
    for p in JOINT.probabilities(JOINT.uniform).values():
        torch.testing.assert_close(p, torch.full_like(p, 1 / len(p)))


def test_log_prob_is_that_of_the_cell():
    psi = torch.linspace(-1.0, 1.0, 10, dtype=torch.float64)
    cells = torch.cartesian_prod(torch.arange(6), torch.arange(4))
    assert JOINT.log_prob(psi, drawn(cells)).exp().sum().item() == pytest.approx(1.0)
    parts = JOINT.probabilities(psi)
    expected = (parts["pose"][:, None] * parts["zoom"]).log().flatten()
    torch.testing.assert_close(JOINT.log_prob(psi, drawn(cells)), expected)


def test_a_stratum_holds_one_factor_and_draws_the_others(generator):
    psi = JOINT.psi("target", ["mug"])[0].float()
    bins = torch.arange(6).repeat_interleave(100)
    draw = JOINT.stratum("pose", bins, psi, JOINT.draw_noise(600, generator))
    assert torch.equal(draw.bins[:, 0], bins)
    assert (draw.bins[:, 1] == 3).float().mean() > 0.85  # 0.94 of the target


def test_what_nothing_learns_is_uniform_in_its_range(generator):
    unlearned = Unlearned(rho_deg=(10.0, 20.0), distance=(3.0, 5.0))
    zoom = SceneDistribution.of([Zoom()], unlearned)
    draw = zoom.hard(torch.zeros(4), zoom.draw_noise(2_000, generator))
    assert draw.phi.min() < 0.05 and draw.phi.max() > 2 * math.pi - 0.05
    assert math.radians(10) <= draw.rho.min() and draw.rho.max() <= math.radians(20)
    assert draw.magnification is None
    pose = SceneDistribution.of([Pose()], unlearned)
    draw = pose.hard(torch.zeros(8), pose.draw_noise(2_000, generator))
    assert draw.distance.min() >= 3.0 and draw.distance.max() <= 5.0
    assert math.radians(10) <= draw.rho.min() and draw.rho.max() <= math.radians(20)
    own = SceneDistribution.of([Pose(other_range_deg=(-45.0, 45.0))], unlearned)  # a pose may say it itself
    draw = own.hard(torch.zeros(8), own.draw_noise(2_000, generator))
    assert draw.rho.min() < -0.7 and draw.rho.max() > 0.7


def test_both_angles_are_two_factors(generator):
    target = {"phi": {"dominant": 3}, "rho": {"dominant": 1}}
    both = SceneDistribution.of([Pose(axis="both", other_bins=3, biased={"mug": {"target": target}})])
    assert both.names == ("pose", "turn") and both.size == 11
    draw = both.hard(both.psi("target", ["mug"])[0].float(), both.draw_noise(400, generator))
    assert torch.equal(both.bins_of(draw), draw.bins)
    assert draw.bins.mode(0).values.tolist() == [2, 0]
    assert draw.rho.abs().max() <= math.pi / 4 + 1e-6


@pytest.mark.parametrize(("gap", "expected"), [("disjoint", 1), ("uniform", None), ("same", 3)])
def test_the_gap_says_where_biased_objects_start(gap, expected):
    p = Zoom(biased=PEAKED, gap=gap).factors[0].probabilities("initial", "mug")
    assert (p.argmax() == expected) if expected is not None else torch.equal(p, torch.full_like(p, 0.25))


def test_two_factors_of_one_coordinate_are_refused():
    with pytest.raises(ValueError, match="different names and coordinates"):
        SceneDistribution.of([Pose(), Pose(axis="azimuth")])
    with pytest.raises(ValueError, match=r"unlearned\.distance"):
        Unlearned(distance=(0.5, 2.0))
