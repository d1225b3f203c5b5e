"""Linear systems whose solution is a closed form in the eigenbasis, or was chosen before the right-hand side.

Notation: n unknowns, condition number k = |A| |A^-1|, eps of the arithmetic. A backward stable solver leaves a residual
of at most n^2 eps |A| |x| (the worst-case constant of a dense factorisation; Higham, Accuracy and Stability, Thm.
10.4), and for any solver ``|x - x*| <= |A^-1| |r|``. No solver can be expected to do better.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from neural_sim.solver.base import LinearSolver, Solution, Status
from neural_sim.solver.cg import ConjugateGradient
from neural_sim.solver.direct import Exact, Identity
from neural_sim.solver.minres import MinimumResidual
from neural_sim.studies.stress.cases import (
    DOUBLE,
    SINGLE,
    Check,
    Checks,
    Scope,
    case,
    eps,
    not_finite,
    short,
    worst,
)

SIZE = 24
UNTRUSTED = tuple(status for status in Status if status is not Status.CONVERGED)
SOLVERS: dict[str, LinearSolver] = {"cg": ConjugateGradient(), "minres": MinimumResidual(), "exact": Exact()}
ALL = {**SOLVERS, "identity": Identity()}


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
        """|A| |x| / |b|, the factor from backward error to relative residual; between 1 and k."""
        return float(self.values.abs().max() * self.x.norm() / self.b.norm())

    def rounded(self) -> System:
        """Return the system rounded to float32, with the float64 solution of the rounded system."""
        matrix, b = self.matrix.float(), self.b.float()
        truth = torch.linalg.solve(matrix.double(), b.double())
        return System(matrix, self.basis, self.values, truth, b)

    def solve(self, solver: LinearSolver, rtol: float, max_steps: int = 400) -> Solution:
        """Solve with one of the solvers."""
        return solver.solve(self.matrix.mv, self.b, rtol=rtol, max_steps=max_steps)


def system(values: Tensor, generator: torch.Generator) -> System:
    """Draw a basis and a solution for the given eigenvalues."""
    size = len(values)
    basis, _ = torch.linalg.qr(torch.randn(size, size, generator=generator, dtype=DOUBLE))
    matrix = basis * values @ basis.T
    matrix = 0.5 * (matrix + matrix.T)
    x = torch.randn(size, generator=generator, dtype=DOUBLE)
    return System(matrix, basis, values, x, matrix @ x)


def logarithmic(condition: float, size: int = SIZE) -> Tensor:
    """Spread eigenvalues evenly in log from 1 to 1 / ``condition``."""
    return torch.logspace(0.0, -math.log10(condition), size, dtype=DOUBLE)


def relative(value: Tensor, truth: Tensor) -> float:
    """Return |value - truth| / |truth| in float64."""
    return float((value.double() - truth.double()).norm() / truth.double().norm())


def backward_error(dtype: torch.dtype = DOUBLE) -> float:
    """Return n^2 eps, the backward error allowed to a stable solver."""
    return SIZE**2 * eps(dtype)


def krylov_steps(condition: float, rtol: float) -> int:
    """Return the number of steps in which CG and MINRES must converge: twice the Chebyshev bound, and 2 n more."""
    return math.ceil(math.sqrt(condition) * math.log(2.0 * math.sqrt(condition) / rtol)) + 2 * SIZE


def ended(quantity: str, value: float, tolerance: float, solution: Solution, *wanted: Status) -> Check:
    """Check a solve, whose status must be one of ``wanted`` (default: converged)."""
    names = tuple(status.name for status in wanted or (Status.CONVERGED,))
    return Check(quantity, value, tolerance, solution.status.name, names)


@case
def condition_numbers(scope: Scope) -> Checks:
    """Solve for k from 1 to 1e12 in float64 and float32, to the residual of a backward stable solver.

    ``|x - x*| / |x*| <= k (rtol |b| / (|A| |x*|) + n^2 eps)`` is due to the residual asked for, and to the rounding of
    ``A x*`` and of the recomputed residual, n eps each. The rounding of MINRES' short recurrences reaches the residual
    as k^2 eps (Sleijpen, van der Vorst and Modersitzki 2000), so beyond k = 1 / sqrt(eps) it may stop with STAGNATED
    and a residual no larger than that of zero; LEAST_SQUARES would be false.

    float32 is compared with the float64 solution of the same rounded system. If its bound exceeds 1, no digit is
    promised, but CONVERGED may be claimed only if the float64 residual is at most rtol plus the rounding of one
    product, n eps |A| |x| / |b|.
    """
    generator = scope.generator()
    for condition in (1.0, 1e2, 1e4, 1e6, 1e8, 1e10, 1e12):
        exact = system(logarithmic(condition), generator)
        for problem in (exact, exact.rounded()):
            dtype = problem.b.dtype
            rtol = min(0.5, backward_error(dtype) * problem.lift)
            bound = condition * 2.0 * backward_error(dtype)
            steps = krylov_steps(condition, rtol) if dtype is DOUBLE else 2000
            for name in SOLVERS:
                solution = problem.solve(SOLVERS[name], rtol, steps)
                label = f"{name}, condition {condition:.0e}, {short(dtype)}"
                if bound >= 1.0:
                    value, b = solution.value.double(), problem.b.double()
                    residual = float((b - problem.matrix.double() @ value).norm() / b.norm())
                    slack = SIZE * eps(dtype) * float(value.norm() / b.norm())
                    claimed = rtol if solution.status is Status.CONVERGED else 1.0
                    yield Check(f"claimed residual: {label}", residual, claimed + slack, solution.status.name)
                elif name == "minres" and condition > eps(DOUBLE) ** -0.5 and solution.status in UNTRUSTED:
                    yield ended(f"residual: {label}", solution.residual, 1.0, solution, Status.STAGNATED)
                else:
                    yield ended(f"error: {label}", relative(solution.value, problem.x), bound, solution)


@case
def indefinite(scope: Scope) -> Checks:
    """Solve with eigenvalues of both signs, and all negative.

    MINRES and the dense solve reach the bound of ``condition_numbers``. The n A-conjugate directions of conjugate
    gradients include as many of negative curvature as A has negative eigenvalues (Sylvester), so the solver meets one
    before it converges. Its result is no worse than zero, whose residual is 1.
    """
    generator = scope.generator()
    signs = torch.ones(SIZE, dtype=DOUBLE)
    signs[::2] = -1.0
    for label, sign in (("+-", signs), ("all -", -torch.ones_like(signs))):
        for condition in (1e2, 1e6):
            problem = system(sign * logarithmic(condition), generator)
            rtol = backward_error() * problem.lift
            for name in SOLVERS:
                # On an indefinite spectrum the bound has k in place of sqrt(k).
                solution = problem.solve(ALL[name], rtol, krylov_steps(condition**2, rtol))
                quantity = f"{name}, {label}, condition {condition:.0e}"
                if name in ("minres", "exact"):
                    bound = condition * 2.0 * backward_error()
                    yield ended(f"error: {quantity}", relative(solution.value, problem.x), bound, solution)
                else:
                    wanted = Status.NEGATIVE_CURVATURE
                    yield ended(f"residual: {quantity}", solution.residual, 1.0, solution, wanted)


@case
def singular(scope: Scope) -> Checks:
    """Solve with three zero eigenvalues.

    If b is in the range, the solution of minimum norm is a closed form in the eigenbasis, and is met to the bound of
    ``condition_numbers``. Each step adds at most n eps |A| |x| outside the range; divided by the smallest non-zero
    eigenvalue, this is the same bound with the number of steps in place of n.

    If a part of b is outside the range, the residual must be the least possible, |P_null b| / |b|. It depends on an
    error of x only to second order, so the same bound holds with room to spare. Solvers for definite systems may not
    claim success, and do no worse than zero. For the zero operator, the solution is 0.
    """
    condition, rank = 1e3, SIZE - 3
    values = torch.cat([logarithmic(condition, rank), torch.zeros(3, dtype=DOUBLE)])
    problem = system(values, scope.generator())
    coordinates = problem.basis.T @ problem.x
    coordinates[rank:] = 0.0
    truth = problem.basis @ coordinates
    inside, b = problem.basis @ (values * coordinates), problem.x
    rtol = backward_error() * float(truth.norm() / inside.norm())
    least = float((problem.basis[:, rank:].T @ b).norm() / b.norm())

    def bound(solution: Solution) -> float:
        return condition * 2.0 * max(1.0, solution.steps / SIZE) * backward_error()

    for name in SOLVERS:
        steps = krylov_steps(condition, rtol)
        solution = ALL[name].solve(problem.matrix.mv, inside, rtol=rtol, max_steps=steps)
        error = relative(solution.value, truth)
        yield ended(f"error: {name}", error, bound(solution), solution, Status.CONVERGED, Status.SINGULAR)
        solution = ALL[name].solve(problem.matrix.mv, b, rtol=1e-8, max_steps=400)
        if name in ("minres", "exact"):
            error = abs(solution.residual - least)
            yield ended(f"least residual: {name}", error, bound(solution), solution, Status.LEAST_SQUARES)
        else:
            yield ended(f"residual: {name}", solution.residual, 1.0, solution, *UNTRUSTED)
        solution = ALL[name].solve(lambda v: 0.0 * v, b, rtol=1e-8)
        yield ended(f"|x| of the zero operator: {name}", worst(solution.value), 0.0, solution, *UNTRUSTED)


@case
def units(scope: Scope) -> Checks:
    """Solve for b = 0, which gives exactly 0, and in other units.

    Multiplying b or the operator by a power of two changes no digit of the solution, even if the squares of the
    operator's entries leave the range of the arithmetic.
    """
    for dtype, powers in ((SINGLE, (-90, 90)), (DOUBLE, (-900, -600, 600, 900))):
        problem = system(logarithmic(1e3), scope.generator())
        matrix, b = problem.matrix.to(dtype), problem.b.to(dtype)
        for name in ALL:
            solve = partial(ALL[name].solve, rtol=1e-4, max_steps=200)
            plain, nothing = solve(matrix.mv, b), solve(matrix.mv, torch.zeros_like(b))
            label = f"{name}, {short(dtype)}"
            yield ended(f"|x| for b = 0: {label}", worst(nothing.value), 0.0, nothing)
            for power in (100, -100):
                solution = solve(matrix.mv, b * 2.0**power)
                change = worst(solution.value * 2.0**-power - plain.value)
                yield ended(f"change, b in units of 2^{power}: {label}", change, 0.0, solution, plain.status)
            for power in powers if name != "identity" else ():
                solution = solve((matrix * 2.0**power).mv, b)
                change = worst(solution.value.double() * 2.0**power - plain.value.double())
                yield ended(f"change, A in units of 2^{power}: {label}", change, 0.0, solution, plain.status)


@case
def one_parameter(scope: Scope) -> Checks:
    """Solve for one unknown: x = b / a to a few roundings, for any size of a and, if solvers allow it, either sign."""
    b = torch.tensor([6.0], dtype=DOUBLE)
    for entry in (3.0, 1e-300, 1e-20, 1e20, 1e300, -3.0):
        for name in SOLVERS:
            solution = ALL[name].solve(lambda v, entry=entry: entry * v, b, rtol=1e-9)
            label = f"{name}, a = {entry:g}"
            if entry < 0.0 and name not in ("minres", "exact"):
                yield ended(f"residual: {label}", solution.residual, 1.0, solution, Status.NEGATIVE_CURVATURE)
            else:
                error = abs(float(solution.value) * entry / 6.0 - 1.0)
                yield ended(f"error: {label}", error, 8 * eps(DOUBLE), solution)


@case
def non_finite_operators(scope: Scope) -> Checks:
    """Solve with NaN or inf in every product, NaN from the third product on, NaN in b, and products that overflow.

    The status must be NON_FINITE, and every number in the solution finite. A warm start with NaN changes nothing.
    """
    problem = system(logarithmic(1e3), scope.generator())
    plain, nothing = problem.matrix.mv, problem.b.clone()
    nothing[3] = math.nan

    def late() -> Callable[[Tensor], Tensor]:
        left = iter(range(2))
        return lambda v: plain(v) if next(left, None) is not None else v * math.nan

    for name, solver in ALL.items():
        trials = {
            "NaN": (lambda v: v * math.nan, problem.b),
            "inf": (lambda v: v * math.inf, problem.b),
            "NaN in b": (plain, nothing),
            "overflow": (((problem.matrix * 1e38).float() * 100.0).mv, problem.b.float()),
        }
        if name != "identity":  # which takes a single product
            trials["NaN from the third product"] = (late(), problem.b)
        for label, (operator, b) in trials.items():
            solution = solver.solve(operator, b, rtol=1e-12)
            wrong = not_finite(solution.value, torch.tensor([solution.residual, *solution.curvature]))
            yield ended(f"numbers not finite: {name}, {label}", wrong, 0.0, solution, Status.NON_FINITE)
    for name in ("cg", "minres"):
        cold = ALL[name].solve(plain, problem.b, rtol=0.1)
        warm = ALL[name].solve(plain, problem.b, torch.full_like(problem.b, math.nan), rtol=0.1)
        change = worst(warm.value - cold.value)
        yield ended(f"change by a NaN warm start: {name}", change, 0.0, warm, cold.status)
