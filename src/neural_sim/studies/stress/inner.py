"""Inner problems with a known implicit derivative: far from stationary, flat, indefinite, or in other units."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neural_sim.detector.cached_set import CachedSet
from neural_sim.gradient.base import MixedDerivative, Params
from neural_sim.gradient.hypergradient import Hypergradient, ImplicitAdjoint
from neural_sim.gradient.implicit import InnerProblem, hypergradient
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.solver.base import LinearSolver, Status
from neural_sim.solver.cg import ConjugateGradient
from neural_sim.solver.damping import FixedDamping, LanczosDamping
from neural_sim.solver.direct import Exact
from neural_sim.solver.hvp import gradient
from neural_sim.solver.minres import MinimumResidual
from neural_sim.solver.operator import flatten, unflatten
from neural_sim.studies.stress.cases import (
    DOUBLE,
    Check,
    Checks,
    Scope,
    case,
    eps,
    not_finite,
    small_detector,
    worst,
)
from neural_sim.studies.stress.linear import UNTRUSTED, ended, logarithmic, relative, system
from neural_sim.types import LabelledImages

ROWS, SIZE, PSI = 12, 6, 3
TRIED: dict[str, LinearSolver] = {"cg": ConjugateGradient(), "minres": MinimumResidual(), "exact": Exact()}


@dataclass(frozen=True)
class Quadratic:
    """A least-squares problem whose implicit derivative is a closed form.

    ``L_train = s (sum_i (a_i theta - c_i - d_i psi)^2 / 2 N + lambda |theta|^2 / 2)``, ``L_val = |B theta - t|^2 / 2``.
    At psi = 0 the minimiser is ``(A^T A / N + lambda)^-1 A^T c / N``, and at any theta the implicit formula gives ``D^T
    A (A^T A / N + lambda)^-1 B^T (B theta - t) / N``, which is dL_val/dpsi at the minimiser only.
    """

    a: Tensor
    c: Tensor
    d: Tensor
    b: Tensor
    t: Tensor
    damping: float = 0.1
    unit: float = 1.0

    @staticmethod
    def random(scope: Scope) -> Quadratic:
        """Draw a problem."""
        a, c, d, b, t = scope.normal(ROWS * (SIZE + 1 + PSI) + 4 * (SIZE + 1)).split(
            [ROWS * SIZE, ROWS, ROWS * PSI, 4 * SIZE, 4]
        )
        return Quadratic(a.view(ROWS, SIZE), c, d.view(ROWS, PSI), b.view(4, SIZE), t)

    @property
    def hessian(self) -> Tensor:
        """The Hessian of L_train divided by the unit s."""
        return self.a.T @ self.a / ROWS + self.damping * torch.eye(SIZE, dtype=DOUBLE)

    @property
    def minimiser(self) -> Tensor:
        """The minimiser of L_train at psi = 0."""
        return torch.linalg.solve(self.hessian, self.a.T @ self.c / ROWS)

    def implicit(self, theta: Tensor) -> Tensor:
        """Evaluate the implicit formula in closed form."""
        slope = self.b.T @ (self.b @ theta - self.t)
        return self.d.T @ self.a @ torch.linalg.solve(self.hessian, slope) / ROWS

    def solved(self, theta: Tensor, solver: LinearSolver, rtol: float) -> Hypergradient[ImplicitAdjoint]:
        """Solve with the code under test, using the proximal term as damping."""
        params = {"w": theta[:2].clone(), "v": theta[2:].clone()}
        weights = torch.full((ROWS,), self.unit / ROWS, dtype=DOUBLE)
        anchor = {name: torch.zeros_like(value) for name, value in params.items()}

        def losses(params: Params, rows: Tensor) -> Tensor:
            return 0.5 * (self.a[rows] @ flatten(params) - self.c[rows]).square()

        def estimate(vector: Params) -> MixedDerivative:
            value = -self.unit * self.d.T @ (self.a @ flatten(vector)) / ROWS
            return MixedDerivative(value, torch.zeros_like(value))

        inner = InnerProblem(params, losses, weights, 5, self.unit * self.damping, anchor)
        adjoint = AdjointSolver(solver, FixedDamping(0.0, 0), rtol=rtol, max_steps=100)
        terms = [lambda p: 0.5 * (self.b @ flatten(p) - self.t).square().sum()]
        return hypergradient(inner, terms, {"x": estimate}, adjoint, torch.Generator())


@case
def far_from_stationary(scope: Scope) -> Checks:
    """Solve at theta* + delta for |delta| from 0 to 1e6.

    The stationarity is |H delta|, and the implicit gradient is off by D^T A H^-1 B^T B delta / N, both closed forms.
    The name of the quantity says how far it is from dL_val/dpsi at theta*. Rounding costs N eps for the summed terms;
    the gradient also has the solve's error, rtol and n^2 eps times |H^-1|.
    """
    problem = Quadratic.random(scope)
    towards = torch.nn.functional.normalize(scope.normal(SIZE), dim=0)
    best, hessian = problem.minimiser, problem.hessian
    truth = problem.implicit(best)
    rtol = SIZE**2 * eps(DOUBLE)
    lifted = float((problem.d.T @ problem.a).norm() / ROWS * torch.linalg.inv(hessian).norm())
    for distance in (0.0, 1e-6, 1.0, 1e3, 1e6):
        theta = best + distance * towards
        exact = problem.implicit(theta)
        size = float(hessian.norm() * theta.norm() + (problem.a.T @ problem.c).norm() / ROWS)
        slope = float((problem.b.T @ (problem.b @ theta - problem.t)).norm())
        bound = lifted * slope * (rtol + 2 * SIZE**2 * eps(DOUBLE)) * float(torch.linalg.cond(hessian))
        for name, solver in TRIED.items():
            result = problem.solved(theta, solver, rtol)
            label = f"{name}, |delta| = {distance:g}"
            error = abs(result.adjoint.stationarity - float((hessian @ (theta - best)).norm()))
            yield ended(
                f"stationarity: {label}", error, 4 * ROWS * eps(DOUBLE) * size, result.adjoint.solution
            )
            value = float((result.gradients["x"] - exact).norm())
            off = f"{relative(exact, truth):.1e} off the truth"
            yield ended(f"gradient ({off}): {label}", value, bound, result.adjoint.solution)


@case
def units(scope: Scope) -> Checks:
    """Solve with L_train in another unit, which dL_val/dpsi does not depend on; powers of two change no digit."""
    problem = Quadratic.random(scope)
    plain = problem.solved(problem.minimiser, ConjugateGradient(), 1e-10)
    for power in (-200, -60, 60, 200):
        scaled = replace(problem, unit=2.0**power)
        result = scaled.solved(problem.minimiser, ConjugateGradient(), 1e-10)
        change = worst(result.gradients["x"] - plain.gradients["x"])
        yield ended(f"change by a unit of 2^{power}", change, 0.0, result.adjoint.solution)


@case
def degenerate(scope: Scope) -> Checks:
    """Solve flat inner problems, and losses that are NaN or overflow.

    A flat problem without damping has no inverse, so v must be 0 and the status must say so; with lambda, v is
    b / lambda. For a loss that is NaN or overflows, v must be 0 and the status NON_FINITE.
    """
    b = scope.normal(SIZE)
    params = {"x": torch.ones(SIZE, dtype=DOUBLE)}
    flat = {"linear": lambda p: p["x"].sum(), "constant": lambda p: 0.0 * p["x"].square().sum()}
    bad = {
        "NaN": lambda p: (p["x"] * math.nan).square().sum(),
        "overflow": lambda p: (p["x"] * 1e200).square().sum().square(),
    }
    for name, solver in TRIED.items():
        for label, term in flat.items():
            solved = AdjointSolver(solver, FixedDamping(0.0, 0), rtol=1e-3).solve(
                [term], params, b, None, torch.Generator()
            )
            yield ended(f"|v|: {name}, {label}", worst(solved.vector), 0.0, solved.solution, *UNTRUSTED)
            damped = AdjointSolver(solver, FixedDamping(1e-3, 0), rtol=1e-3)
            solved = damped.solve([term], params, b, None, torch.Generator())
            error = relative(solved.vector * 1e-3, b)
            yield ended(f"v with damping: {name}, {label}", error, SIZE**2 * eps(DOUBLE), solved.solution)
        for label, term in bad.items():
            solved = AdjointSolver(solver, LanczosDamping()).solve([term], params, b, None, torch.Generator())
            yield ended(
                f"|v|: {name}, {label}", worst(solved.vector), 0.0, solved.solution, Status.NON_FINITE
            )


@case
def indefinite_hessians(scope: Scope) -> Checks:
    """Damp Hessians of any sign and condition by the default rule, with as many Lanczos steps as parameters.

    The damping must exceed minus the most negative eigenvalue by its margin, up to the rounding n eps |H| of a Ritz
    value. The solve must agree with the dense one up to the condition of the damped matrix times rtol and n^2 eps.
    """
    spectra = {
        "definite, condition 1e12": logarithmic(1e12),
        "one negative": torch.cat([logarithmic(1e2)[:-1], torch.tensor([-0.5], dtype=DOUBLE)]),
        "both signs, 1e6": 1e6 * logarithmic(1e3) * torch.tensor([1.0, -1.0], dtype=DOUBLE).repeat(12),
        "all negative": -logarithmic(1e2),
        "zero": torch.zeros(24, dtype=DOUBLE),
    }
    damping = LanczosDamping(lanczos_steps=24)
    params = {"x": torch.zeros(24, dtype=DOUBLE)}
    for label, values in spectra.items():
        problem = system(values, scope.generator())
        terms = [lambda p, matrix=problem.matrix: 0.5 * p["x"] @ (matrix @ p["x"])]
        least, rounding = 1.25 * max(0.0, -float(values.min())), 24 * eps(DOUBLE) * worst(values)
        for name in ("cg", "minres"):
            adjoint = AdjointSolver(TRIED[name], damping, rtol=1e-10, max_steps=400)
            solved = adjoint.solve(terms, params, problem.x, None, scope.generator())
            chosen = solved.damping.value
            short = max(0.0, least - chosen)
            yield Check(f"lambda short of its margin: {name}, {label}", short, 4 * rounding)
            truth = torch.linalg.solve(problem.matrix + chosen * torch.eye(24, dtype=DOUBLE), problem.x)
            condition = float((values + chosen).abs().max() / (values + chosen).abs().min())
            bound = condition * (1e-10 + 2 * 24**2 * eps(DOUBLE))
            yield ended(f"v: {name}, {label}", relative(solved.vector, truth), bound, solved.solution)


@case
def untrained_detector(scope: Scope) -> Checks:
    """Take the stationarity of a real detector at its random start, and at 10 and 100 times those parameters.

    The truth is the directional derivative of the loss along its gradient, extrapolated from two central differences
    (Richardson). The tolerance is the error of this truth: what the extrapolation changed, and eps L / step.
    """
    detector = small_detector(2)
    start = {name: value.double() for name, value in detector.init(scope.generator()).items()}
    backbone, head = detector.split(start)
    pixels = torch.rand(3, 3, 32, 32, generator=scope.generator(), dtype=DOUBLE)
    boxes = torch.tensor([[4.0, 4, 15, 14], [8, 9, 26, 27], [12, 2, 30, 18]], dtype=DOUBLE)[:, None]
    images = LabelledImages(pixels, boxes, torch.tensor([[0], [1], [0]]), torch.full((3,), -1))
    cached = CachedSet.of(detector, backbone, images)
    adjoint = AdjointSolver(ConjugateGradient(), LanczosDamping())
    for factor in (1.0, 10.0, 100.0):
        params = {name: factor * value for name, value in head.items()}
        inner = InnerProblem(params, cached.losses, torch.full((3,), 1.0 / 3.0, dtype=DOUBLE))
        along = torch.nn.functional.normalize(gradient(inner.terms(), params), dim=0)
        result = hypergradient(inner, cached.mean_terms(), {}, adjoint, scope.generator())

        def loss(step: float, inner: InnerProblem = inner, along: Tensor = along) -> float:
            moved = unflatten(flatten(inner.params) + step * along, inner.params)
            with torch.no_grad():
                return float(sum(term(moved) for term in inner.terms()))

        step = 1e-4 * float(flatten(params).norm()) / len(along) ** 0.5
        coarse, fine = ((loss(h) - loss(-h)) / (2 * h) for h in (step, 0.5 * step))
        truth = fine + (fine - coarse) / 3.0
        bound = abs(truth - fine) + 64 * eps(DOUBLE) * abs(loss(0.0)) / step
        quantity = f"stationarity, {result.adjoint.stationarity:.1e}: {factor:g} times the start"
        yield Check(quantity, abs(result.adjoint.stationarity - truth), bound)
        wrong = not_finite(result.adjoint.solution.value)
        yield Check(f"numbers not finite: {factor:g} times the start", wrong, 0.0)
