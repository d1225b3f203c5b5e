"""Linear systems. Truths are closed forms in the eigenbasis, or a solution chosen before its right-hand side.

Notation: n unknowns, condition number k = |A| |A^-1|, eps of the arithmetic. A backward stable solver leaves
a residual of at most n^2 eps |A| |x| (the worst-case constant of a dense factorisation; Higham, Accuracy and
Stability, Thm. 10.4), and ``|x - x*| <= |A^-1| |r|`` whatever the solver. More may not be asked of any of
them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from neural_sim.solver.base import LinearSolver
from neural_sim.solver.cg import ConjugateGradient
from neural_sim.solver.exact import Exact
from neural_sim.solver.identity import Identity
from neural_sim.solver.minres import MinimumResidual
from neural_sim.solver.neumann import Neumann
from neural_sim.solver.nystrom import Nystrom
from neural_sim.solver.operator import Shifted
from neural_sim.solver.solution import Solution, Status
from neural_sim.stress.cases import Check, Checks, Scope, case, eps

SIZE = 24
CONVERGED = Status.CONVERGED.name
UNTRUSTED = tuple(status.name for status in Status if not status.trusted)
SOLVERS: dict[str, LinearSolver] = {
    "cg": ConjugateGradient(),
    "minres": MinimumResidual(),
    "exact": Exact(),
    "cholesky": Exact(method="cholesky"),
    "nystrom": Nystrom(rank=SIZE),
}
ALL = {**SOLVERS, "neumann": Neumann(lanczos_steps=SIZE), "identity": Identity()}


@dataclass(frozen=True)
class System:
    """``A = Q diag(values) Q^T`` as stored, a chosen ``x`` and ``b = A x``."""

    matrix: Tensor
    basis: Tensor
    values: Tensor
    x: Tensor
    b: Tensor

    @property
    def lift(self) -> float:
        """|A| |x| / |b|: what a backward error is multiplied by in the relative residual; from 1 to k."""
        return float(self.values.abs().max() * self.x.norm() / self.b.norm())

    def solve(self, solver: LinearSolver, rtol: float, max_steps: int = 400) -> Solution:
        return solver.solve(self.operator(solver), self.b, rtol=rtol, max_steps=max_steps)

    def operator(self, solver: LinearSolver) -> Callable[[Tensor], Tensor]:
        if not isinstance(solver, Nystrom):
            return lambda v: self.matrix @ v
        # Nystrom takes A apart into a matrix of low rank and a damping: the smallest eigenvalue is the damping.
        shift = float(self.values.min())
        return Shifted(lambda v: self.matrix @ v - shift * v, shift)


def system(values: Tensor, generator: torch.Generator) -> System:
    size = len(values)
    basis, _ = torch.linalg.qr(torch.randn(size, size, generator=generator, dtype=torch.float64))
    matrix = basis * values @ basis.T
    matrix = 0.5 * (matrix + matrix.T)
    x = torch.randn(size, generator=generator, dtype=torch.float64)
    return System(matrix, basis, values, x, matrix @ x)


def product(matrix: Tensor) -> Callable[[Tensor], Tensor]:
    return lambda vector: matrix @ vector


def logarithmic(condition: float, size: int = SIZE) -> Tensor:
    return torch.logspace(0.0, -math.log10(condition), size, dtype=torch.float64)


def relative(value: Tensor, truth: Tensor) -> float:
    return float((value.double() - truth.double()).norm() / truth.double().norm())


def backward_error(dtype: torch.dtype = torch.float64, size: int = SIZE) -> float:
    return size**2 * eps(dtype)


def krylov_steps(condition: float, rtol: float) -> int:
    """Steps within which conjugate gradients and MINRES must have converged: twice the Chebyshev bound."""
    return math.ceil(math.sqrt(condition) * math.log(2.0 * math.sqrt(condition) / rtol)) + 2 * SIZE


@case
def condition_numbers(scope: Scope) -> Checks:
    """k from 1 to 1e12, asked for the residual of a backward stable solver.

    ``|x - x*| / |x*| <= k (rtol |b| / (|A| |x*|) + n^2 eps)``: the residual asked for, and the rounding of
    ``A x*`` and of the recomputed residual, n eps each. The rounding of MINRES' short recurrences reaches the
    residual as k^2 eps (Sleijpen, van der Vorst and Modersitzki 2000): beyond k = 1 / sqrt(eps) it may stop
    with STAGNATED instead, no worse than zero; LEAST_SQUARES would be a false claim here.
    """
    generator = scope.generator()
    for condition in (1.0, 1e2, 1e4, 1e6, 1e8, 1e10, 1e12):
        problem = system(logarithmic(condition), generator)
        rtol = backward_error() * problem.lift
        steps = krylov_steps(condition, rtol)
        for name, solver in SOLVERS.items():
            found = problem.solve(solver, rtol, steps)
            label = f"{name}, condition {condition:.0e}"
            beyond = name == "minres" and condition > eps(torch.float64) ** -0.5
            if beyond and not found.status.trusted:
                wanted = (Status.STAGNATED.name,)
                yield Check(f"residual: {label}", found.residual, 1.0, found.status.name, wanted)
                continue
            bound = condition * 2.0 * backward_error()
            error = relative(found.value, problem.x)
            yield Check(f"error: {label}", error, bound, found.status.name, (CONVERGED,))


@case
def neumann_series(scope: Scope) -> Checks:
    """The series with rate 1 / lambda_max leaves ``r_k = (I - A / lambda_max)^k b``, known in the eigenbasis.

    Each step rounds ``A x`` by at most n eps |A| |x| and never amplifies what came before: k n eps in all,
    times the lift. It converges within ``k ln(1 / rtol)`` steps; at 1e12 it must say that its budget is
    spent.
    """
    generator = scope.generator()
    for condition, steps in ((1.0, 20), (1e1, 300), (1e2, 3000), (1e12, 500)):
        problem = system(logarithmic(condition), generator)
        found = problem.solve(ALL["neumann"], 1e-9, steps)
        left = (1.0 - problem.values / problem.values.max()) ** found.steps * (problem.basis.T @ problem.b)
        truth = float(left.norm() / problem.b.norm())
        bound = (found.steps + SIZE) * SIZE * eps(torch.float64) * problem.lift
        wanted = (CONVERGED if condition < 1e3 else Status.MAX_STEPS.name,)
        quantity = f"residual against (1 - eta lambda)^k, condition {condition:.0e}"
        yield Check(quantity, abs(found.residual - truth), bound, found.status.name, wanted)


@case
def identity_residual(scope: Scope) -> Checks:
    """The one-step choice says how wrong it is: its residual is |b - A b| / |b|, to n eps of a product."""
    generator = scope.generator()
    for condition in (1.0, 1e6, 1e12):
        problem = system(logarithmic(condition), generator)
        found = problem.solve(ALL["identity"], 1e-9)
        rotated = problem.basis.T @ problem.b
        truth = float(((1.0 - problem.values) * rotated).norm() / rotated.norm())
        wanted = (CONVERGED,) if condition == 1.0 else (Status.APPROXIMATE.name,)
        bound = 4.0 * SIZE * eps(torch.float64)
        quantity = f"residual, condition {condition:.0e}"
        yield Check(quantity, abs(found.residual - truth), bound, found.status.name, wanted)


@case
def indefinite(scope: Scope) -> Checks:
    """Eigenvalues of both signs, and all negative.

    MINRES and the dense solve reach the bound of ``condition_numbers``. Conjugate gradients run over n
    A-conjugate directions, among which as many have negative curvature as A has negative eigenvalues
    (Sylvester), so they must meet one before they converge; Cholesky meets a negative pivot, Neumann's
    Lanczos a negative Ritz value. What those hand back is no worse than zero, whose residual is 1.
    """
    generator = scope.generator()
    signs = torch.ones(SIZE, dtype=torch.float64)
    signs[::2] = -1.0
    for label, sign in (("+-", signs), ("all -", -torch.ones_like(signs))):
        for condition in (1e2, 1e6):
            problem = system(sign * logarithmic(condition), generator)
            rtol = backward_error() * problem.lift
            for name in ("minres", "exact"):
                # On a spectrum of both signs k stands where sqrt(k) does on a definite one.
                found = problem.solve(ALL[name], rtol, krylov_steps(condition**2, rtol))
                bound = condition * 2.0 * backward_error()
                error = relative(found.value, problem.x)
                quantity = f"error: {name}, {label}, condition {condition:.0e}"
                yield Check(quantity, error, bound, found.status.name, (CONVERGED,))
            for name in ("cg", "cholesky", "neumann"):
                found = problem.solve(ALL[name], rtol, krylov_steps(condition, rtol))
                wanted = (Status.NEGATIVE_CURVATURE.name,)
                quantity = f"residual: {name}, {label}, condition {condition:.0e}"
                yield Check(quantity, found.residual, 1.0, found.status.name, wanted)


@case
def singular_consistent(scope: Scope) -> Checks:
    """Three zero eigenvalues, b in the range: the minimum-norm solution, from a closed form in the
    eigenbasis.

    On the range the bound is that of ``condition_numbers``; a step adds at most n eps |A| |x| outside it,
    which costs 1 / (smallest non-zero eigenvalue) at most, that is the same bound with the number of steps
    for n.
    """
    condition, rank = 1e3, SIZE - 3
    values = torch.cat([logarithmic(condition, rank), torch.zeros(3, dtype=torch.float64)])
    problem = system(values, scope.generator())
    coordinates = problem.basis.T @ problem.x
    coordinates[rank:] = 0.0
    truth = problem.basis @ coordinates
    b = problem.basis @ (values * coordinates)
    rtol = backward_error() * float(truth.norm() / b.norm())
    steps = krylov_steps(condition, rtol)
    for name in ("cg", "minres", "exact"):
        found = ALL[name].solve(lambda v: problem.matrix @ v, b, rtol=rtol, max_steps=steps)
        bound = condition * 2.0 * max(1.0, found.steps / SIZE) * backward_error()
        wanted = (CONVERGED, Status.SINGULAR.name)
        yield Check(f"error: {name}", relative(found.value, truth), bound, found.status.name, wanted)


@case
def singular_inconsistent(scope: Scope) -> Checks:
    """b with a part outside the range, and the zero operator: the least residual, |P_null b| / |b| in closed
    form.

    Of a residual that is minimal only the square sees an error of x, so the bound of ``singular_consistent``
    on x more than bounds it. Solvers for definite systems may not claim success, and do no worse than zero.
    """
    condition, rank = 1e3, SIZE - 3
    values = torch.cat([logarithmic(condition, rank), torch.zeros(3, dtype=torch.float64)])
    problem = system(values, scope.generator())
    b = problem.x
    least = float((problem.basis[:, rank:].T @ b).norm() / b.norm())
    for name in ("minres", "exact", "cg", "cholesky", "neumann"):
        found = ALL[name].solve(lambda v: problem.matrix @ v, b, rtol=1e-8, max_steps=400)
        if name in ("minres", "exact"):
            bound = condition * 2.0 * max(1.0, found.steps / SIZE) * backward_error()
            value, wanted = abs(found.residual - least), (Status.LEAST_SQUARES.name,)
            yield Check(f"least residual: {name}", value, bound, found.status.name, wanted)
        else:
            yield Check(f"residual: {name}", found.residual, 1.0, found.status.name, UNTRUSTED)
    for name in ("cg", "minres", "exact", "cholesky", "neumann"):
        found = ALL[name].solve(lambda v: 0.0 * v, b, rtol=1e-8)
        size = float(found.value.norm())
        yield Check(f"|x| of the zero operator: {name}", size, 0.0, found.status.name, UNTRUSTED)
