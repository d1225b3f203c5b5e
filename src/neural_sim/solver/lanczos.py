"""Extreme eigenvalues by the Lanczos process with full reorthogonalisation (Golub and Van Loan, Sec. 10.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.solver.operator import Matvec, NonFiniteProduct, Watched, norm


@dataclass(frozen=True)
class Krylov:
    """The Krylov space of a start vector b of norm ``size``: orthonormal rows of ``basis``, and A in that basis."""

    basis: Float[Tensor, "m n"]
    tridiagonal: Float[Tensor, "m m"]
    size: float

    def solve(self, shift: float) -> Float[Tensor, "n"] | None:
        """The Galerkin solution of ``(A + shift I) x = b``, which is what m steps of conjugate gradients from zero
        reach; no products, whatever the shift (Krylov spaces do not depend on it). None where the shifted
        matrix is not positive definite on this space.
        """
        shifted = self.tridiagonal + shift * torch.eye(len(self.tridiagonal), dtype=torch.float64)
        factor, info = torch.linalg.cholesky_ex(shifted)
        if int(info) != 0:
            return None
        first = torch.zeros(len(shifted), 1, dtype=torch.float64)
        first[0] = self.size
        weights = torch.cholesky_solve(first, factor)[:, 0].to(self.basis)
        return self.basis.T @ weights if bool(torch.isfinite(weights).all()) else None


@dataclass(frozen=True)
class Spectrum:
    """Extreme Ritz values. Some eigenvalue lies within ``smallest_error`` of ``smallest`` (likewise the
    largest).

    ``finite`` is False where the operator returned inf or nan; the values are those found until then (0 if
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
        """Condition number of A + shift I if that is positive definite on what was seen, else inf."""
        low, high = self.smallest + shift, self.largest + shift
        return high / low if low > 0.0 else math.inf


def lanczos(matvec: Matvec, start: Float[Tensor, "n"], steps: int) -> Spectrum:
    """Ritz values of a symmetric operator after at most ``steps`` products from ``start`` (any non-zero
    vector).

    Ritz values lie inside the spectrum, so ``smallest`` is an upper bound of the smallest eigenvalue that the
    start vector has a part in. Memory: steps vectors. Raises ``ValueError`` for a zero or non-finite start or
    steps < 1.
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
    basis = [vector / norm(vector)]
    alphas: list[float] = []
    betas: list[float] = []
    finite = True
    for _ in range(min(steps, start.numel())):
        try:
            product = operator(basis[-1])
        except NonFiniteProduct:
            finite = False
            break
        reach = norm(product)
        columns = torch.stack(basis)
        overlaps = columns @ product
        product = product - columns.T @ overlaps
        correction = columns @ product  # twice is enough (Parlett and Kahan)
        product = product - columns.T @ correction
        alphas.append(float(overlaps[-1] + correction[-1]))
        betas.append(norm(product))
        if betas[-1] <= 10.0 * torch.finfo(start.dtype).eps * reach:
            betas[-1] = 0.0  # an invariant subspace: its Ritz values are eigenvalues
            break
        basis.append(product / betas[-1])
    size = biggest * norm(vector)
    return _extremes(
        alphas, betas, operator.products, finite, torch.stack(basis[: max(len(alphas), 1)]), size
    )


def random_start(
    size: int, generator: torch.Generator, *, dtype: torch.dtype, device: torch.device | str = "cpu"
) -> Tensor:
    """A Gaussian start vector, which almost surely has a part in every eigenvector."""
    return torch.randn(size, generator=generator, dtype=dtype, device=generator.device).to(device)


def _extremes(
    alphas: list[float], betas: list[float], products: int, finite: bool, basis: Tensor, size: float
) -> Spectrum:
    if not alphas:
        return Spectrum(0.0, 0.0, 0.0, 0.0, products, finite)
    off = torch.tensor(betas[: len(alphas) - 1], dtype=torch.float64)
    tridiagonal = (
        torch.diag(torch.tensor(alphas, dtype=torch.float64)) + torch.diag(off, 1) + torch.diag(off, -1)
    )
    values, vectors = torch.linalg.eigh(tridiagonal)
    errors = betas[len(alphas) - 1] * vectors[-1].abs()  # residual of a Ritz pair: beta_m |e_m^T y|
    low, high = float(values[0]), float(values[-1])
    return Spectrum(
        low, high, float(errors[0]), float(errors[-1]), products, finite, Krylov(basis, tridiagonal, size)
    )
