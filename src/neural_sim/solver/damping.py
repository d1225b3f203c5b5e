"""The choice of lambda in ``(H + lambda I) v = b``, by extreme eigenvalues.

They are estimated by the Lanczos process with full reorthogonalisation (Golub and Van Loan, Sec. 10.3).
"""

from __future__ import annotations

import abc
import logging
import math
from dataclasses import dataclass
from typing import Annotated, cast

import torch
from annotated_types import Gt
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from neural_sim.ranges import NonNegative, NonNegativeInt, Positive, PositiveInt, validated
from neural_sim.solver.base import Search
from neural_sim.solver.operator import (
    Matvec,
    NonFiniteProduct,
    Watched,
    eigenpairs,
    in_range,
    norm,
    numbers,
    plain_norm,
)

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Krylov:
    """The Krylov space of a start vector b of norm ``size``: orthonormal rows ``basis``, and A in that basis.

    ``beyond`` is the part of the last product outside the space: its norm is the recurrence's next off-diagonal entry.
    """

    basis: Float[Tensor, "m n"]
    tridiagonal: Float[Tensor, "m m"]
    size: float
    beyond: Float[Tensor, "n"]

    def search(self, shift: float) -> Search | None:
        """Compute where m conjugate-gradient steps from zero on ``(A + shift I) x = b`` end, without any product.

        Krylov spaces do not depend on the shift. None if the shifted matrix is not positive definite on this space.

        With T the shifted tridiagonal matrix, T y = |b| e_1 and T z = e_m, the value is Q y and its residual r is -y_m
        times ``beyond``. Q z is the only direction in the space that is conjugate to all earlier ones; hence
        r + |beyond|^2 y_m Q z is conjugate to the whole space.
        """
        shifted = self.tridiagonal + shift * torch.eye(len(self.tridiagonal), dtype=torch.float64)
        found = cast(tuple[Tensor, Tensor], torch.linalg.cholesky_ex(shifted))  # pyright: ignore[reportUnknownMemberType]
        factor, info = found
        if int(info) != 0:
            return None
        ends = torch.zeros(len(shifted), 2, dtype=torch.float64)
        ends[0, 0], ends[-1, 1] = self.size, 1.0
        weights = torch.cholesky_solve(ends, factor)
        value, last = weights.T.to(self.basis) @ self.basis
        residual = -float(weights[-1, 0]) * self.beyond
        direction = residual + norm(self.beyond) ** 2 * float(weights[-1, 0]) * last
        search = Search(value, residual, direction)
        return search if bool(torch.isfinite(torch.stack([value, residual, direction])).all()) else None


@dataclass(frozen=True)
class Spectrum:
    """Extreme Ritz values: some eigenvalue lies within ``smallest_error`` of ``smallest`` (likewise the largest).

    ``finite`` is False if the operator returned inf or nan; the values are then those found before (0 if
    none). ``krylov`` is the space that was searched, None if no product was finite.
    """

    smallest: float
    largest: float
    smallest_error: float
    largest_error: float
    products: int
    finite: bool
    krylov: Krylov | None = None

    def condition(self, shift: float = 0.0) -> float:
        """Condition number of A + shift I if the Ritz values show it positive definite; otherwise inf."""
        low, high = self.smallest + shift, self.largest + shift
        return high / low if low > 0.0 else math.inf


def lanczos(matvec: Matvec, start: Float[Tensor, "n"], steps: int) -> Spectrum:
    """Find extreme Ritz values of a symmetric operator with at most ``steps`` products, from a non-zero ``start``.

    Ritz values lie inside the spectrum, so ``smallest`` is an upper bound of the smallest eigenvalue among those whose
    eigenvectors contribute to the start vector. Memory: ``steps`` vectors.

    Raises:
        ValueError: the start is zero or not finite, or ``steps`` is below 1.
    """
    if steps < 1:
        raise ValueError(f"lanczos: steps must be at least 1, got {steps}")
    biggest = float(start.abs().max())
    if not math.isfinite(biggest) or biggest == 0.0:
        raise ValueError(
            f"lanczos: the start vector must be finite and non-zero, its largest entry is {biggest}"
        )
    operator = Watched(matvec)
    vector = start / biggest
    steps = min(steps, start.numel())
    basis = start.new_empty(steps, start.numel())
    basis[0] = vector / norm(vector)
    alphas: list[float] = []
    betas: list[float] = []
    beyond = torch.zeros_like(start)
    finite = True
    for step in range(steps):
        try:
            applied = operator.measured(basis[step])
        except NonFiniteProduct:
            finite = False
            break
        product, reach = applied.value, applied.length
        columns = basis[: step + 1]
        overlaps = columns @ product
        product = product - columns.T @ overlaps
        correction = columns @ product  # twice is enough (Parlett and Kahan)
        product = product - columns.T @ correction
        alpha, beta = numbers(overlaps[-1] + correction[-1], plain_norm(product))
        alphas.append(alpha)
        betas.append(in_range(beta, product))
        beyond = product
        if betas[-1] <= 10.0 * torch.finfo(start.dtype).eps * reach:
            betas[-1] = 0.0  # an invariant subspace: its Ritz values are eigenvalues
            beyond = torch.zeros_like(product)
            break
        if step + 1 < steps:
            basis[step + 1] = product / betas[-1]
    space = basis[: max(len(alphas), 1)]
    return _extremes(alphas, betas, operator.products, finite, space, beyond, biggest * norm(vector))


def random_start(
    size: int, generator: torch.Generator, *, dtype: torch.dtype, device: torch.device | str = "cpu"
) -> Tensor:
    """Draw a Gaussian start vector, which almost surely has a component along every eigenvector."""
    return torch.randn(size, generator=generator, dtype=dtype, device=generator.device).to(device)


def _extremes(
    alphas: list[float],
    betas: list[float],
    products: int,
    finite: bool,
    basis: Tensor,
    beyond: Tensor,
    size: float,
) -> Spectrum:
    if not alphas:
        return Spectrum(0.0, 0.0, 0.0, 0.0, products, finite)
    off = torch.tensor(betas[: len(alphas) - 1], dtype=torch.float64)
    tridiagonal = (
        torch.diag(torch.tensor(alphas, dtype=torch.float64)) + torch.diag(off, 1) + torch.diag(off, -1)
    )
    values, vectors = eigenpairs(tridiagonal)
    errors = betas[len(alphas) - 1] * vectors[-1].abs()  # residual of a Ritz pair: beta_m |e_m^T y|
    low, high = float(values[0]), float(values[-1])
    krylov = Krylov(basis, tridiagonal, size, beyond)
    return Spectrum(low, high, float(errors[0]), float(errors[-1]), products, finite, krylov)


@dataclass(frozen=True)
class Damped:
    """A chosen damping.

    ``value`` is lambda >= 0, ``spectrum`` that of the undamped operator, or None if it was not estimated. ``krylov`` is
    the space that the estimate searched, if that space starts from the right-hand side.
    """

    value: float
    spectrum: Spectrum | None
    krylov: Krylov | None = None

    @property
    def condition(self) -> float:
        """Estimated condition number of the damped operator; nan if no spectrum was estimated."""
        return math.nan if self.spectrum is None else self.spectrum.condition(self.value)

    def search(self) -> Search | None:
        """Solve with lambda, using only the estimate's products; None if there are none."""
        return None if self.krylov is None else self.krylov.search(self.value)


class Damping(abc.ABC):
    """Chooses lambda for an operator."""

    @abc.abstractmethod
    def choose(self, matvec: Matvec, b: Float[Tensor, "n"], generator: torch.Generator) -> Damped:
        """Choose lambda for ``matvec`` and the right-hand side ``b``."""

    def raised(self, damped: Damped, lowest: float) -> Damped | None:
        """Raise lambda after a solve met the undamped curvature ``lowest`` < -lambda; None: lambda is fixed."""
        return None


@validated
@dataclass(frozen=True)
class FixedDamping(Damping):
    """A given lambda, for instance 0 where the inner problem's own proximal term makes its Hessian positive definite.

    With ``lanczos_steps`` > 0 the spectrum is still estimated, for the log.
    """

    value: NonNegative
    lanczos_steps: NonNegativeInt = 12

    @override
    def choose(self, matvec: Matvec, b: Float[Tensor, "n"], generator: torch.Generator) -> Damped:
        return Damped(self.value, _estimate(matvec, b, self.lanczos_steps, generator))


@validated
@dataclass(frozen=True)
class LanczosDamping(Damping):
    """A lambda that exceeds the most negative curvature and keeps the condition number below a bound.

    Let ``m = smallest - error`` be the smallest Ritz value less its own error bound. Then
    ``lambda = max(minimum, (1 + margin) max(0, -m), (largest - max_condition m) / (max_condition - 1))``; the
    last term makes ``(largest + lambda) / (m + lambda) <= max_condition``.

    The Krylov space starts from the right-hand side, as conjugate gradients do. Since lambda exceeds the negated
    smallest Ritz value of that space, the first CG steps cannot break down. (From a random start, a few steps miss a
    detector's few negative eigenvalues among many near zero: on a tiny RetinaNet, 12 steps gave -0.01 where lambda_min
    was -2.4.) If a longer solve still meets negative curvature, lambda is raised until it exceeds that too.
    """

    margin: Positive = 0.25
    max_condition: Annotated[float, Gt(1)] = 100.0
    minimum: NonNegative = 1e-6
    lanczos_steps: PositiveInt = 14

    @override
    def choose(self, matvec: Matvec, b: Float[Tensor, "n"], generator: torch.Generator) -> Damped:
        # A zero or non-finite right-hand side has no Krylov space; the solve reports it.
        usable = bool(torch.isfinite(b).all()) and bool(b.any())
        if usable:
            spectrum = lanczos(matvec, b, self.lanczos_steps)
        else:
            spectrum = _estimate(matvec, b, self.lanczos_steps, generator)
        if spectrum is None or not spectrum.finite:
            logger.warning(
                "damping: the operator is not finite; lambda falls to its minimum, %g", self.minimum
            )
            return Damped(self.minimum, spectrum)
        value = self._past(spectrum.smallest - spectrum.smallest_error, spectrum.largest)
        return Damped(value, spectrum, spectrum.krylov if usable else None)

    @override
    def raised(self, damped: Damped, lowest: float) -> Damped:
        largest = damped.spectrum.largest if damped.spectrum is not None else 0.0
        return Damped(max(2.0 * damped.value, self._past(lowest, largest)), damped.spectrum, damped.krylov)

    def _past(self, low: float, largest: float) -> float:
        bounded = (largest - self.max_condition * low) / (self.max_condition - 1.0)
        return max(self.minimum, (1.0 + self.margin) * max(0.0, -low), bounded)


def _estimate(matvec: Matvec, like: Tensor, steps: int, generator: torch.Generator) -> Spectrum | None:
    if steps == 0:
        return None
    return lanczos(matvec, random_start(like.numel(), generator, dtype=like.dtype, device=like.device), steps)
