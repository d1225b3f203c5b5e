"""The paper's tools: patches, replay and the chain to psi, against plain autograd through everything."""

from __future__ import annotations

import dataclasses
import itertools

import pytest
import torch

from neural_sim.gradient.base import from_contributions
from neural_sim.gradient.pathwise import (
    contract,
    draw_cotangents,
    map_cotangents,
    psi_contributions,
)
from neural_sim.gradient.significance import DRAWS, zero_mean
from neural_sim.parameter.bins import closing
from neural_sim.synthesis.motion import moved_by
from neural_sim.types import Maps

DOUBLE = torch.float64


@pytest.fixture
def maps(problem, generator) -> Maps:
    shape = (len(problem.gumbel), 2, 3)
    return Maps(
        torch.randn(*shape, 3, generator=generator, dtype=DOUBLE),
        torch.randn(*shape, generator=generator, dtype=DOUBLE),
    )


@pytest.mark.parametrize("patch_size", [1, 2, 5, 6, 7, 41])
def test_sum_over_patches_equals_the_whole_image(problem, maps, patch_size):
    batch = problem.object_images()
    whole = draw_cotangents(batch.path.render_rays, batch.path.camera, batch.draw, maps, 10**6)
    patches = draw_cotangents(batch.path.render_rays, batch.path.camera, batch.draw, maps, patch_size)
    for name in whole:
        assert float((whole[name] - patches[name]).abs().max()) < 1e-10


def test_mixed_derivative_equals_autograd_through_everything(problem, pathwise, generator):
    batch = problem.object_images()
    params = {name: tensor + 0.1 for name, tensor in problem.minimiser(problem.psi).items()}
    vector = {
        name: torch.randn(tensor.shape, generator=generator, dtype=DOUBLE) for name, tensor in params.items()
    }
    weights = torch.rand(len(batch.images), generator=generator, dtype=DOUBLE)
    batch = dataclasses.replace(batch, weights=weights)
    psi = problem.psi.clone().requires_grad_()
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in params.items()}
    loss = problem.loss_of(leaves, problem.images(psi), batch.index) @ weights
    slopes = torch.autograd.grad(loss, list(leaves.values()), create_graph=True)
    along = sum((slope * vector[name]).sum() for slope, name in zip(slopes, leaves, strict=True))
    (reference,) = torch.autograd.grad(along, psi)
    settings = {"patch_size": 4, "chunk_size": 2}
    ours = pathwise(problem.loss_of, params, vector, batch, **settings)
    torch.testing.assert_close(ours.value, reference, rtol=1e-10, atol=1e-12)


def test_tangents_equal_patches(problem, maps, stand_in_tangents):
    batch = problem.object_images()
    reverse = draw_cotangents(batch.path.render_rays, batch.path.camera, batch.draw, maps, 5)
    for name, value in contract(stand_in_tangents(batch.draw), maps).items():
        assert float((value - reverse[name]).abs().max()) < 1e-8


def test_contributions_add_up_to_the_vector_jacobian_product(problem, generator):
    cotangents = {
        name: torch.randn(7, generator=generator, dtype=DOUBLE) for name in ("phi", "rho", "distance")
    }
    rows = psi_contributions(problem.relaxed, problem.psi, cotangents)
    psi = problem.psi.clone().requires_grad_()
    draw = problem.relaxed(psi)
    total = (draw.phi * cotangents["phi"] + draw.distance * cotangents["distance"]).sum()
    torch.testing.assert_close(rows.sum(0), torch.autograd.grad(total, psi)[0])
    assert moved_by(problem.relaxed, problem.psi) == ("phi", "distance")


def test_a_draw_that_does_not_depend_on_psi_gives_zero(problem):
    held = problem.relaxed(problem.psi)
    rows = psi_contributions(lambda psi: held, problem.psi, {"phi": torch.ones(7, dtype=DOUBLE)})
    assert rows.shape == (7, 4) and rows.norm() == 0.0


def test_pixels_without_cotangent_are_not_rendered(problem):
    batch = problem.object_images()
    seen = []

    def render_rays(rays):
        seen.append(len(rays.origins))
        return batch.path.render_rays(rays)

    maps = Maps(torch.zeros_like(batch.path.rgb), torch.zeros_like(batch.path.opacity))
    still = draw_cotangents(render_rays, batch.path.camera, batch.draw, maps, 4)
    assert seen == [] and all(value.norm() == 0.0 for value in still.values())
    maps.opacity[2, 1, 0] = 1.0
    draw_cotangents(render_rays, batch.path.camera, batch.draw, maps, 4)
    assert seen == [1]


def test_map_cotangents_are_the_compositing_adjoint(problem, generator):
    path = problem.object_images().path
    cotangent = torch.randn(7, 3, 2, 3, generator=generator, dtype=DOUBLE)
    maps = map_cotangents(path, cotangent)
    torch.testing.assert_close(maps.rgb, cotangent.permute(0, 2, 3, 1))
    torch.testing.assert_close(maps.opacity, -(cotangent * problem.background).sum(1))


def test_standard_error_is_that_of_a_sum():
    rows = torch.tensor([[1.0, 2.0], [3.0, 2.0], [2.0, 2.0], [6.0, 2.0]], dtype=DOUBLE)
    derivative = from_contributions(rows)
    torch.testing.assert_close(derivative.standard_error[0], rows[:, 0].var().mul(4).sqrt())
    assert derivative.standard_error[1] == 0.0
    assert from_contributions(rows[:1]).standard_error.tolist() == [torch.inf, torch.inf]


def test_the_p_value_is_that_of_contributions_without_what_all_components_share(problem, pathwise, generator):
    """All 2^7 changes of sign of contributions that autograd finds; psi's sum turns all cameras, which moves no p."""
    plain, start, p_values = problem.relaxed, problem.psi, []
    problem.relaxed = lambda psi: dataclasses.replace(
        draw := plain(psi), phi=draw.phi + 0.5 * (psi - start).sum()
    )
    batch, params = problem.object_images(), problem.minimiser(start)
    signs = torch.tensor(list(itertools.product((-1.0, 1.0), repeat=7)), dtype=DOUBLE)
    for _ in range(4):
        vector = {
            name: torch.randn(value.shape, generator=generator, dtype=DOUBLE)
            for name, value in params.items()
        }

        def scores(psi, vector=vector):
            images = problem.images(psi)
            return torch.func.jvp(lambda p: problem.loss_of(p, images, batch.index), (params,), (vector,))[1]

        rows = torch.autograd.functional.jacobian(scores, start)
        rows = rows - rows.mean(1, keepdim=True)
        every, own = ((sums.square() / rows.square().sum(0)).sum(-1) for sums in (signs @ rows, rows.sum(0)))
        exact = float((every >= own * (1.0 - 1e-9)).double().mean())
        found = pathwise(problem.loss_of, params, vector, batch).p_values["pose"]
        assert abs(found - exact) < 4 * (exact * (1.0 - exact) / DRAWS) ** 0.5 + 1 / DRAWS
        p_values.append(exact)
    assert min(p_values) < 0.05


@pytest.mark.parametrize("bin", range(4))
def test_a_closed_bin_changes_no_p_value(problem, pathwise, generator, bin):
    """Its derivatives are 0, and must not come in as rounding errors of the others' mean."""
    opened = torch.arange(4) != bin
    problem.psi = closing(problem.psi, ~opened)
    batch, params = problem.object_images(), problem.minimiser(problem.psi)
    vector = {
        name: torch.randn(value.shape, generator=generator, dtype=DOUBLE) for name, value in params.items()
    }

    def scores(psi):
        images = problem.images(psi)
        return torch.func.jvp(lambda p: problem.loss_of(p, images, batch.index), (params,), (vector,))[1]

    rows = torch.autograd.functional.jacobian(scores, problem.psi)
    assert not rows[:, bin].any() and bool(rows[:, opened].any())
    expected = zero_mean(rows[:, opened] - rows[:, opened].mean(1, keepdim=True))
    assert pathwise(problem.loss_of, params, vector, batch).p_values["pose"] == expected


def test_images_without_a_path_are_refused(problem, pathwise):
    batch = dataclasses.replace(problem.object_images(), path=None)
    with pytest.raises(ValueError, match="path"):
        pathwise(problem.loss_of, {}, {}, batch)
