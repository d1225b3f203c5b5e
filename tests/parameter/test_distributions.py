"""Distributions by name; projections against a quadratic-programming solver, and against closed forms."""

import numpy
import pytest
import scipy.optimize
import torch

from neural_sim.parameter.distributions import (
    distribution,
    merged,
    project_simplex,
    project_sum,
    total_variation,
)


def test_dominant_is_the_papers():
    p = distribution({"dominant": 3}, 8)
    assert p[2].item() == pytest.approx(0.86)
    assert p[[0, 1, 3, 4, 5, 6, 7]].tolist() == pytest.approx([0.02] * 7)


def test_modes_share_the_rest_equally():
    p = distribution({"modes": [1, 6]}, 8)
    assert p[0] == p[5] and p[0].item() == pytest.approx(0.44)
    assert p.sum().item() == pytest.approx(1.0)


@pytest.mark.parametrize("bins", [1, 2, 64])
def test_every_count_of_bins_gives_a_distribution(bins):
    for specification in ("uniform", {"dominant": 1}):
        p = distribution(specification, bins)
        assert p.sum().item() == pytest.approx(1.0) and (p > 0).all()


@pytest.mark.parametrize(
    "bad", ["gaussian", {"dominant": 0}, {"dominant": 9}, {"dominant": True}, {"modes": []}, {"modes": [1, 1]},
            [0.5, 0.5], [0.2] * 8, [-0.1, 0.3] + [0.8 / 6] * 6, [float("nan")] * 8, 3]
)  # fmt: skip
def test_bad_specifications_are_refused_with_their_place(bad):
    with pytest.raises(ValueError, match="here"):
        distribution(bad, 8, "here")


def test_bins_that_are_one_count_together():
    p = torch.tensor([[0.1, 0.2, 0.3, 0.4], [0.25, 0.25, 0.25, 0.25]])
    torch.testing.assert_close(
        merged(p, [[1, 4], [2], [3]]), torch.tensor([[0.5, 0.2, 0.3], [0.5, 0.25, 0.25]])
    )
    assert torch.equal(merged(p, [[1], [2], [3], [4]]), p)


def test_total_variation():
    p, q = torch.tensor([0.5, 0.5, 0.0]), torch.tensor([0.0, 0.5, 0.5])
    assert total_variation(p, q).item() == pytest.approx(0.5)
    assert total_variation(p, p).item() == 0.0


def quadratic_programme(values: torch.Tensor) -> torch.Tensor:
    """min |w - v|^2 with sum(w) = 1 and w >= 0, by non-negative least squares with a heavily weighted row of ones.

    The row's weight W leaves the sum off by the multiplier over W^2.
    """
    weight, count = 1e6, len(values)
    rows = numpy.vstack([numpy.eye(count), weight * numpy.ones(count)])
    solution, _ = scipy.optimize.nnls(rows, numpy.append(values.numpy(), weight))
    return torch.from_numpy(solution)


@pytest.mark.parametrize("count", [1, 2, 5, 12])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 30.0])
def test_projection_solves_the_quadratic_programme(count, scale, generator):
    for values in scale * torch.randn(20, count, generator=generator, dtype=torch.float64):
        expected = quadratic_programme(values)
        torch.testing.assert_close(project_simplex(values), expected, rtol=0, atol=1e-9 * max(1.0, scale))


def test_projection_meets_the_optimality_conditions(generator):
    values = 3 * torch.randn(200, 9, generator=generator, dtype=torch.float64)
    weights = project_simplex(values)
    gap = values - weights  # the same multiplier on all positive weights, at most that on the others
    threshold = torch.where(weights > 0, gap, -torch.inf).amax(-1, keepdim=True)
    torch.testing.assert_close(weights.sum(-1), torch.ones(200, dtype=torch.float64))
    assert (weights >= 0).all()
    assert ((gap - threshold).abs()[weights > 0] < 1e-14).all() and (gap <= threshold + 1e-14).all()


def test_projection_of_what_lies_on_the_simplex_is_itself(generator):
    weights = torch.softmax(torch.randn(50, 6, generator=generator, dtype=torch.float64), -1)
    torch.testing.assert_close(project_simplex(weights), weights, rtol=0, atol=1e-15)
    assert torch.equal(project_simplex(torch.eye(4)), torch.eye(4))
    assert project_simplex(torch.tensor([-7.0])).tolist() == [1.0]


def test_projection_is_differentiable_inside_a_face():
    values = torch.tensor([0.9, 0.5, 0.1, -2.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(project_simplex, (values,))
    assert torch.autograd.gradcheck(project_sum, (values,))


def test_the_plane_of_sum_one_is_met_at_the_nearest_point(generator):
    values = torch.randn(30, 4, generator=generator, dtype=torch.float64)
    weights = project_sum(values)
    torch.testing.assert_close(weights.sum(-1), torch.ones(30, dtype=torch.float64))
    across = weights - values  # parallel to the plane's normal: the same for every weight
    torch.testing.assert_close(across, across[:, :1].expand(-1, 4))
    torch.testing.assert_close(project_sum(values, 3.0).sum(-1), torch.full((30,), 3.0, dtype=torch.float64))


@pytest.mark.parametrize("project", [project_simplex, project_sum])
@pytest.mark.parametrize("bad", [[float("nan"), 0.0], [float("inf"), 0.0], []])
def test_weights_that_are_not_finite_are_refused(project, bad):
    with pytest.raises(ValueError, match="simplex"):
        project(torch.tensor(bad))
