"""Estimators over a product of parameters against enumeration of all its cells."""

import dataclasses

import pytest
import torch

from neural_sim.gradient.base import Losses, ObjectImages, Probes
from neural_sim.gradient.estimators import ReinforceEstimator, StratifiedEstimator
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.parameter.zoom import Zoom
from neural_sim.types import SceneDraw

DOUBLE = torch.float64
JOINT = SceneDistribution.of([Pose(bins=3, floor=0.01), Zoom(bins=2, range=(2.5, 5.0), floor=0.0)])
PSI = torch.tensor([0.4, -0.3, 0.1, 0.7, -0.2], dtype=DOUBLE)


def _exact(costs):
    """d/dpsi of the mean cost over all cells, by automatic differentiation of the enumerated expectation."""
    leaf = PSI.clone().requires_grad_()
    p = JOINT.probabilities(leaf)
    mean = (p["pose"][:, None] * p["zoom"] * costs).sum()
    return torch.autograd.grad(mean, leaf)[0]


def _images(bins):
    count = len(bins)
    still = torch.zeros(count, dtype=DOUBLE)
    return ObjectImages(
        PSI, JOINT, torch.zeros(count, 3, 1, 1, dtype=DOUBLE), torch.arange(count),
        torch.full((count,), 1.0 / count, dtype=DOUBLE), SceneDraw(still, still, still, bins),
    )  # fmt: skip


def _loss_of_bins(costs, bins):
    """Per-image losses theta * cost(cell), so that the score along theta is the cell's cost."""
    return lambda params, index: params["theta"] * costs[bins[index, 0], bins[index, 1]]


@pytest.mark.parametrize("count", [2, 3])
def test_reinforce_over_a_product_is_unbiased_over_all_draws(count):
    costs = torch.randn(3, 2, generator=torch.Generator().manual_seed(1), dtype=DOUBLE)
    theta, one = {"theta": torch.ones((), dtype=DOUBLE)}, {"theta": torch.ones((), dtype=DOUBLE)}
    cells = torch.cartesian_prod(torch.arange(3), torch.arange(2))
    mean = torch.zeros_like(PSI)
    for outcome in torch.cartesian_prod(*[torch.arange(6)] * count):
        bins = cells[outcome]
        losses = Losses(_loss_of_bins(costs, bins), None)  # pyright: ignore[reportArgumentType]
        found = ReinforceEstimator().estimate(losses, theta, one, _images(bins), {}).value
        mean += JOINT.log_prob(PSI, _images(bins).draw).sum().exp() * found
    torch.testing.assert_close(mean, _exact(costs))


def test_stratified_over_a_product_is_exact_where_probes_hold_every_cell_in_its_share():
    """Each factor's probes hold the other factor's bins in shares of p: then the strata's means are exact."""
    costs = torch.randn(3, 2, generator=torch.Generator().manual_seed(2), dtype=DOUBLE)
    # Shares that whole numbers of images can hold: p = 1/2, 1/4, 1/4 and 3/4, 1/4.
    plain = dataclasses.replace(
        JOINT, factors=tuple(dataclasses.replace(f, floor=0.0) for f in JOINT.factors)
    )
    psi = torch.tensor([0.5, 0.25, 0.25, 0.75, 0.25], dtype=DOUBLE).log()
    zooms, poses = torch.tensor([0, 0, 0, 1]), torch.tensor([0, 0, 1, 2])
    by_pose = torch.stack([torch.arange(3).repeat_interleave(4), zooms.repeat(3)], 1)
    by_zoom = torch.stack([poses.repeat(2), torch.arange(2).repeat_interleave(4)], 1)
    bins = torch.cat([by_pose, by_zoom])
    probes = {
        "pose": Probes(torch.arange(12), by_pose[:, 0]),
        "zoom": Probes(torch.arange(12, 20), by_zoom[:, 1]),
    }
    images = dataclasses.replace(_images(bins), psi=psi, distribution=plain)
    theta, one = {"theta": torch.ones((), dtype=DOUBLE)}, {"theta": torch.ones((), dtype=DOUBLE)}
    losses = Losses(None, None, _loss_of_bins(costs, bins))  # pyright: ignore[reportArgumentType]
    found = StratifiedEstimator(1).estimate(losses, theta, one, images, probes).value
    leaf = psi.clone().requires_grad_()
    p = plain.probabilities(leaf)
    (expected,) = torch.autograd.grad((p["pose"][:, None] * p["zoom"] * costs).sum(), leaf)
    torch.testing.assert_close(found, expected)
