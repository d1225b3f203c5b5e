"""Which bins photographs show, against angles in closed form."""

import math

import pytest
import torch

from neural_sim.cameras import orbit
from neural_sim.parameter.coverage import coverage, coverages
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.parameter.zoom import Zoom


def directions(phi_deg, rho_deg):
    phi, rho = (torch.tensor(a, dtype=torch.float64).deg2rad() for a in (phi_deg, rho_deg))
    return orbit(phi, rho, torch.ones_like(phi))[:, :3, 3]


def test_a_turn_of_which_photographs_saw_a_third():
    """Azimuth in bins of 45 degrees, photographs at the poses' own height every 10 degrees from 0 to 120."""
    pose = Pose(axis="azimuth", other_range_deg=(85.0, 95.0))
    seen = torch.arange(0.0, 121.0, 10.0).tolist()
    found = coverage(SceneDistribution.of([pose]), "pose", directions([90.0] * len(seen), seen), 20.0)
    assert found is not None
    # Poses up to 20 degrees beyond the last photograph are near: bins 1 to 3, and of five steps of 9 degrees the first
    # of bin 4 and the last two of bin 8, at heights up to 4 degrees off.
    assert found.fractions[:3] == (1.0, 1.0, 1.0)
    assert found.fractions[3] == pytest.approx(0.2, abs=0.01) and found.fractions[7] == pytest.approx(
        0.4, abs=0.01
    )
    assert found.fractions[4:7] == (0.0, 0.0, 0.0)
    assert found.missing == [4, 5, 6, 7, 8]


def test_both_angles_and_what_is_no_direction():
    """Photographs from the positive x axis alone: of phi the second bin's half, of rho the bins about 0."""
    distribution = SceneDistribution.of([Pose(axis="both", bins=4, other_bins=3), Zoom()])
    front = directions([90.0], [0.0])
    phi, rho = (coverage(distribution, name, front, 40.0) for name in ("pose", "turn"))
    assert phi is not None and rho is not None
    assert phi.fractions[2] == phi.fractions[3] == 0.0
    # Within 40 degrees of the axis, cos phi' cos rho' > cos 40: the middle third of rho, +-15 degrees, sees most of it.
    assert rho.fractions[1] == max(rho.fractions) and rho.fractions[0] == rho.fractions[2]
    assert coverage(distribution, "zoom", front, 40.0) is None


def test_all_sides_are_covered():
    """A photograph every 20 degrees each way leaves none of the poses farther than half the diagonal away."""
    grid = [(phi, rho) for phi in range(0, 360, 20) for rho in range(-60, 61, 20)]
    every = directions([float(p) for p, _ in grid], [float(r) for _, r in grid])
    found = coverage(SceneDistribution.of([Pose()]), "pose", every, math.degrees(0.3))
    assert found is not None and found.fractions == (1.0,) * 8 and found.missing == []


def test_what_is_not_covered_is_left_out_of_every_psi():
    """An object seen from above alone, and one that is not in the list; initial and target mode in a closed bin."""
    pose = Pose(biased={"pot": {"initial": {"dominant": 4}, "target": {"dominant": 1}}})
    plain = SceneDistribution.of([pose, Zoom()])
    ring = torch.arange(0.0, 360.0, 20.0).tolist()
    above = directions([40.0] * len(ring), ring).numpy()
    found = coverages(plain, {"pot": above}, 30.0)
    assert found["pot"]["pose"].missing == [3, 4, 5, 6] and set(found["pot"]) == {"pose"}
    distribution = plain.leaving_out(found)
    for which in ("initial", "target"):
        p = distribution.probabilities(distribution.psi(which, ["pot", "mug"]))
        before = plain.probabilities(plain.psi(which, ["pot", "mug"]))
        assert not p["pose"][0, 2:6].any() and float(p["pose"][0].sum()) == pytest.approx(1.0)
        torch.testing.assert_close(p["pose"][1], before["pose"][1])
        torch.testing.assert_close(p["zoom"], before["zoom"])
    assert float(distribution.probabilities(distribution.psi("target", ["pot"]))["pose"][0, 0]) > 0.8
    even = distribution.probabilities(distribution.uniform_of(["pot", "mug"]))["pose"]
    torch.testing.assert_close(even[0, [0, 1, 6, 7]], torch.full((4,), 0.25, dtype=torch.float64))
    noise = distribution.draw_noise(64, torch.Generator().manual_seed(0), torch.float64, balanced=True)
    drawn = distribution.hard(distribution.uniform_of(["pot"])[0], noise)
    assert set(drawn.bins[:, 0].tolist()) == {0, 1, 6, 7}
    below = coverages(plain, {"pot": directions([180.0], [0.0]).numpy()}, 1.0)
    with pytest.raises(ValueError, match=r"parameter\.pose: no bin of pot is near a photograph"):
        plain.leaving_out(below)


@pytest.mark.parametrize("which", ["initial", "target"])
def test_a_distribution_that_is_all_in_closed_bins_is_refused(which):
    """The photographs are from above; what is left of the distribution would be nothing, and psi not a number."""
    plain = SceneDistribution.of([Pose(biased={"pot": {which: [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0]}})])
    ring = torch.arange(0.0, 360.0, 20.0).tolist()
    found = coverages(plain, {"pot": directions([40.0] * len(ring), ring).numpy()}, 30.0)
    with pytest.raises(
        ValueError, match=rf"parameter\.pose\.{which} of pot: want bins that photographs show"
    ):
        plain.leaving_out(found)
