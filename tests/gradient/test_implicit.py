"""The hypergradient against central differences of the retrained inner problem, sign included."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from neural_sim.gradient.estimators import importance_weights, stratified
from neural_sim.gradient.implicit import Implicit, InnerProblem, curvature_rows, hypergradient
from neural_sim.gradient.mixed import scores
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.solver.base import Status
from neural_sim.solver.cg import ConjugateGradient
from neural_sim.solver.damping import FixedDamping, LanczosDamping
from neural_sim.synthesis.motion import moved_by

DOUBLE = torch.float64
EXACT = AdjointSolver(ConjugateGradient(), FixedDamping(0.0, 0), rtol=1e-12, max_steps=200)


def solve(problem, inner, estimate, solver=EXACT):
    return hypergradient(
        inner, [problem.validation], {"can": estimate}, solver, torch.Generator().manual_seed(0)
    )


@pytest.mark.parametrize("patch_size", [1, 4, 1000])
def test_pathwise_hypergradient_is_the_retrained_derivative(problem, pathwise, patch_size):
    batch = problem.object_images()
    settings = {"patch_size": patch_size, "chunk_size": 3}
    inner = problem.inner(batch.images)
    result = solve(problem, inner, lambda v: pathwise(problem.loss_of, inner.params, v, batch, **settings))
    assert result.adjoint.solution.status is Status.CONVERGED
    assert result.adjoint.stationarity < 1e-12
    torch.testing.assert_close(result.gradients["can"], problem.central_difference(), rtol=1e-7, atol=1e-10)


def test_tangents_of_the_first_render_give_the_same_hypergradient(problem, pathwise, stand_in_tangents):
    batch = problem.object_images()
    names = moved_by(batch.path.relaxed, batch.psi)
    assert names == ("phi", "distance")
    path = dataclasses.replace(batch.path, tangents=stand_in_tangents(batch.draw, names))
    batch = dataclasses.replace(batch, path=path)
    inner = problem.inner(batch.images)
    result = solve(problem, inner, lambda v: pathwise(problem.loss_of, inner.params, v, batch))
    torch.testing.assert_close(result.gradients["can"], problem.central_difference(), rtol=1e-7, atol=1e-10)


def test_a_step_along_the_negative_hypergradient_lowers_the_validation_loss(problem, pathwise):
    batch = problem.object_images()
    inner = problem.inner(batch.images)
    result = solve(problem, inner, lambda v: pathwise(problem.loss_of, inner.params, v, batch))
    slope = result.gradients["can"]
    before = problem.validation(problem.minimiser(problem.psi))
    after = problem.validation(problem.minimiser(problem.psi - 1e-4 * slope / slope.norm()))
    assert after < before


def test_stratified_hypergradient_is_the_retrained_derivative_over_hard_bins(problem, generator):
    """Images fixed in their bins; psi enters by the bins' weights alone, in training as in the derivative."""
    bins = torch.arange(4)
    images = torch.rand(4, 3, 2, 3, generator=generator, dtype=DOUBLE)
    design = torch.cat([images.flatten(1), torch.ones(4, 1, dtype=DOUBLE)], 1)

    def log_probabilities(psi):
        return torch.log(0.9 * torch.softmax(psi, -1) + 0.025)

    def minimiser(psi):
        weighted = design * importance_weights(log_probabilities(psi).exp(), bins)[:, None]
        solved = torch.linalg.solve(
            weighted.T @ design + 0.3 * torch.eye(19, dtype=DOUBLE), weighted.T @ problem.targets[:4]
        )
        return {"w": solved[:-1], "b": solved[-1]}

    def losses(params, rows):
        return problem.loss_of(params, images[rows], rows)

    params = minimiser(problem.psi)
    anchor = {name: torch.zeros_like(tensor) for name, tensor in params.items()}
    weights = importance_weights(log_probabilities(problem.psi).exp(), bins)
    inner = InnerProblem(params, losses, weights, 3, 0.3, anchor)

    def estimate(vector):
        along = scores(losses, params, vector, bins)
        return stratified(along[:, None], problem.psi, log_probabilities)

    result = solve(problem, inner, estimate)
    basis = 1e-5 * torch.eye(4, dtype=DOUBLE)
    outer = [
        (problem.validation(minimiser(problem.psi + e)) - problem.validation(minimiser(problem.psi - e)))
        / 2e-5
        for e in basis
    ]
    assert result.adjoint.stationarity < 1e-12
    torch.testing.assert_close(result.gradients["can"], torch.stack(outer), rtol=1e-7, atol=1e-10)


def test_solver_and_damping_are_accounted_for(problem, pathwise):
    batch = problem.object_images()
    inner = problem.inner(batch.images)
    solver = AdjointSolver(ConjugateGradient(), LanczosDamping(max_condition=20.0), rtol=1e-8, max_steps=100)
    result = solve(problem, inner, lambda v: pathwise(problem.loss_of, inner.params, v, batch), solver)
    assert result.adjoint.solution.status is Status.CONVERGED
    assert result.adjoint.damping.condition <= 20.0 * (1 + 1e-6)
    assert set(result.seconds) == {"validation", "solve", "mixed"}
    assert 0.0 < result.p_values["can"]["pose"] <= 1.0
    again = hypergradient(
        inner,
        [problem.validation],
        {},
        solver,
        torch.Generator().manual_seed(0),
        result.adjoint.solution.value,
    )
    assert again.adjoint.solution.warm_started and again.adjoint.solution.steps <= 1


def test_a_subset_stands_for_the_whole_in_hessian_products_only(problem):
    inner = problem.inner(problem.object_images().images)
    part = dataclasses.replace(inner, subset=torch.tensor([1, 4]))
    value = sum(term(inner.params) for term in part.terms(part.subset)[:-1])
    expected = inner.losses(inner.params, torch.tensor([1, 4])).mean()
    torch.testing.assert_close(value, expected)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": torch.zeros(0)}, "weights"),
        ({"chunk_size": 0}, "chunk_size"),
        ({"proximal": -1.0}, "proximal"),
        ({"anchor": None}, "anchor"),
    ],
)
def test_inner_problem_refuses_nonsense(problem, change, message):
    inner = problem.inner(problem.object_images().images)
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(inner, **change)


@pytest.mark.parametrize(
    ("changes", "doubts"),
    [
        ({}, []),
        ({"residual": 0.2}, ["residual"]),
        ({"residual": 0.2, "status": Status.APPROXIMATE}, []),
        ({"status": Status.NON_FINITE}, ["solver"]),
    ],
)
def test_a_solve_is_doubted_beyond_its_limits(problem, pathwise, changes, doubts):
    batch = problem.object_images()
    inner = problem.inner(batch.images)
    adjoint = solve(problem, inner, lambda v: pathwise(problem.loss_of, inner.params, v, batch)).adjoint
    changed = dataclasses.replace(adjoint, solution=dataclasses.replace(adjoint.solution, **changes))
    assert Implicit().doubts(changed) == doubts
    assert Implicit(max_residual=None).doubts(changed) == [doubt for doubt in doubts if doubt == "solver"]


def test_rows_of_the_curvature_keep_the_weight_of_drawn_images_and_of_photographs():
    """60 images drawn from p_psi have three quarters of the weight, 20 photographs the rest."""
    weights = torch.cat([torch.full((60,), 0.75 / 60), torch.full((20,), 0.25 / 20)]).double()
    generator = torch.Generator().manual_seed(0)
    seen = torch.zeros(80, dtype=DOUBLE)
    for _ in range(400):
        rows, scaled = curvature_rows(60, weights, 16, generator)
        assert len(rows.unique()) == 16 and int((rows < 60).sum()) == 12
        torch.testing.assert_close(scaled[rows < 60].sum().double(), torch.tensor(0.75, dtype=DOUBLE))
        torch.testing.assert_close(scaled.sum().double(), torch.tensor(1.0, dtype=DOUBLE))
        seen[rows] += scaled.double() / 400
    # 400 samples of 12 out of 60 (4 of 20): each row's mean weight scatters by 10 % of it.
    assert ((seen / weights - 1.0).abs() < 0.5).all()
    rows, same = curvature_rows(60, weights, 0, generator)
    assert torch.equal(rows, torch.arange(80)) and same is weights
