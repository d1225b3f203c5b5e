"""Linear systems at the edges of the arithmetic: right-hand sides of any size, float32, one unknown, NaN and
inf."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from neural_sim.solver.base import LinearSolver
from neural_sim.solver.operator import Shifted
from neural_sim.solver.solution import Solution, Status
from neural_sim.stress.cases import Check, Checks, Scope, case, eps
from neural_sim.stress.linear import (
    ALL,
    CONVERGED,
    SIZE,
    backward_error,
    krylov_steps,
    logarithmic,
    product,
    relative,
    system,
)


@case
def right_hand_side_sizes(scope: Scope) -> Checks:
    """b = 0 gives exactly 0. b times a power of two is exact, so that the solution is the scaled one bit for
    bit: 2^100 = 1.3e30, 2^-100 = 7.9e-31. The decimal 1e30 rounds b by eps, which moves x by k eps, and the
    two solves may stop at different iterates within rtol: k (2 rtol + eps) |b| / (|A| |x|) <= k (2 rtol +
    eps).
    """
    condition, rtol = 10.0, 1e-5
    for dtype in (torch.float32, torch.float64):
        problem = system(logarithmic(condition), scope.generator())
        matrix, b = problem.matrix.to(dtype), problem.b.to(dtype)
        for name in ("cg", "minres", "exact", "cholesky", "neumann", "identity"):
            solver = ALL[name]

            def solved(rhs: Tensor, solver: LinearSolver = solver, matrix: Tensor = matrix) -> Solution:
                return solver.solve(product(matrix), rhs, rtol=rtol, max_steps=200)

            label = f"{name}, {str(dtype).removeprefix('torch.')}"
            plain, nothing = solved(b), solved(torch.zeros_like(b))
            status = nothing.status.name
            yield Check(f"|x| for b = 0: {label}", float(nothing.value.norm()), 0.0, status, (CONVERGED,))
            for power in (100, -100):
                scaled = solved(b * 2.0**power)
                value = float((scaled.value * 2.0**-power - plain.value).abs().max())
                quantity = f"change by 2^{power}: {label}"
                yield Check(quantity, value, 0.0, scaled.status.name, (plain.status.name,))
            for scale in (1e30, 1e-30):
                scaled = solved(b * scale)
                value = relative(scaled.value / scale, plain.value)
                bound = condition * (2.0 * rtol + eps(dtype))
                quantity = f"change by {scale:.0e}: {label}"
                yield Check(quantity, value, bound, scaled.status.name, (plain.status.name,))


@case
def operator_units(scope: Scope) -> Checks:
    """An operator in another unit: x changes by its inverse, and by a power of two no digit of it, out to where
    squares of its entries leave the range of the arithmetic. Neumann's rate is LAPACK's eigenvalue, which scales by
    factors of its own: known to n eps, which each of the steps takes up.
    """
    for dtype, powers in ((torch.float32, (-90, 90)), (torch.float64, (-900, -600, 600, 900))):
        problem = system(logarithmic(1e3), scope.generator())
        matrix, b = problem.matrix.to(dtype), problem.b.to(dtype)
        for name in ("cg", "minres", "exact", "cholesky", "neumann"):
            plain = ALL[name].solve(product(matrix), b, rtol=1e-4, max_steps=200)
            for power in powers:
                found = ALL[name].solve(product(matrix * 2.0**power), b, rtol=1e-4, max_steps=200)
                change = float((found.value.double() * 2.0**power - plain.value.double()).abs().max())
                label = f"{name}, unit 2^{power}, {str(dtype).removeprefix('torch.')}"
                bound = (
                    found.steps * SIZE * eps(dtype) * float(plain.value.norm()) if name == "neumann" else 0.0
                )
                yield Check(f"change: {label}", change, bound, found.status.name, (plain.status.name,))


@case
def single_precision(scope: Scope) -> Checks:
    """float32 against the float64 solution of the very same rounded system, by the bound of
    ``condition_numbers`` with float32's eps; where that bound exceeds 1 no digit is promised, and the claim
    must be honest: trusted only if the float64 residual is below rtol and the rounding of one product, n eps
    |A| |x| / |b|.
    """
    generator = scope.generator()
    for condition in (1.0, 1e2, 1e4, 1e8, 1e12):
        problem = system(logarithmic(condition), generator)
        matrix, b = problem.matrix.float(), problem.b.float()
        truth = torch.linalg.solve(matrix.double(), b.double())
        lift = float(truth.norm() / b.double().norm())
        rtol = min(0.5, backward_error(torch.float32) * lift)
        bound = condition * 2.0 * backward_error(torch.float32)
        for name in ("cg", "minres", "exact", "cholesky"):
            found = ALL[name].solve(
                product(matrix), b, rtol=rtol, max_steps=min(2000, krylov_steps(condition, rtol))
            )
            label = f"{name}, condition {condition:.0e}"
            if bound < 1.0:
                error = relative(found.value, truth)
                yield Check(f"error: {label}", error, bound, found.status.name, (CONVERGED,))
                continue
            value = found.value.double()
            residual = float((b.double() - matrix.double() @ value).norm() / b.double().norm())
            slack = SIZE * eps(torch.float32) * float(value.norm() / b.double().norm())
            claimed = rtol if found.status.trusted else 1.0
            yield Check(f"claimed residual: {label}", residual, claimed + slack, found.status.name)


@case
def one_parameter(scope: Scope) -> Checks:
    """One unknown: x = b / a to a few roundings, whatever the size or (where the solver takes it) sign of a."""
    b = torch.tensor([6.0], dtype=torch.float64)
    for entry in (3.0, 1e-300, 1e-20, 1e20, 1e300, -3.0):
        for name in ("cg", "minres", "exact", "cholesky", "neumann"):
            found = ALL[name].solve(lambda v, entry=entry: entry * v, b, rtol=1e-9)
            label = f"{name}, a = {entry:g}"
            if entry < 0.0 and name not in ("minres", "exact"):
                wanted = (Status.NEGATIVE_CURVATURE.name,)
                yield Check(f"residual: {label}", found.residual, 1.0, found.status.name, wanted)
                continue
            error = abs(float(found.value) * entry / 6.0 - 1.0)
            yield Check(f"error: {label}", error, 8 * eps(torch.float64), found.status.name, (CONVERGED,))


@case
def non_finite_operators(scope: Scope) -> Checks:
    """NaN and inf at once or only from the third product on, in b, and a product that overflows: a status,
    and no number that is not finite anywhere in the solution. A bad warm start is dropped and costs nothing.
    """
    problem = system(logarithmic(1e3), scope.generator())
    nothing = problem.b.clone()
    nothing[3] = math.nan
    huge = (problem.matrix * 1e38).float() * 100.0

    def late() -> Callable[[Tensor], Tensor]:
        left = iter(range(2))
        return lambda v: problem.matrix @ v if next(left, None) is not None else v * math.nan

    for name, solver in ALL.items():
        shift = (lambda op: Shifted(op, 0.5)) if name == "nystrom" else (lambda op: op)
        trials = {
            "NaN": solver.solve(shift(lambda v: v * math.nan), problem.b),
            "inf": solver.solve(shift(lambda v: v * math.inf), problem.b),
            "NaN in b": solver.solve(shift(lambda v: problem.matrix @ v), nothing),
            "overflow": solver.solve(shift(lambda v: huge @ v), problem.b.float()),
        }
        if name != "identity":  # which takes one product in all
            trials["NaN from the third product"] = solver.solve(shift(late()), problem.b, rtol=1e-12)
        for label, found in trials.items():
            yield Check(
                f"numbers not finite: {name}, {label}",
                float(_not_finite(found)), 0.0, found.status.name, (Status.NON_FINITE.name,),
            )  # fmt: skip
    for name in ("cg", "minres", "neumann"):
        start = torch.full_like(problem.b, math.nan)
        cold = ALL[name].solve(lambda v: problem.matrix @ v, problem.b, rtol=0.1)
        warm = ALL[name].solve(lambda v: problem.matrix @ v, problem.b, start, rtol=0.1)
        value = float((warm.value - cold.value).abs().max())
        yield Check(f"change by a NaN warm start: {name}", value, 0.0, warm.status.name, (cold.status.name,))


def _not_finite(found: Solution) -> int:
    numbers = [found.residual, *found.curvature]
    return int((~torch.isfinite(found.value)).sum()) + sum(not math.isfinite(number) for number in numbers)
