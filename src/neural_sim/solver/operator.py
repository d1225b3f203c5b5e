"""Vectors and linear operators: flat parameters, norms, a shift, and a wrapper that counts and checks products."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

Matvec = Callable[[Tensor], Tensor]


def flatten(params: Mapping[str, Tensor]) -> Float[Tensor, "n"]:
    """Join all parameters into one vector, in the dictionary's order; differentiable.

    Raises:
        ValueError: the dictionary is empty.
    """
    if not params:
        raise ValueError("flatten: got no parameters, want at least one")
    return torch.cat([tensor.reshape(-1) for tensor in params.values()])


def unflatten(vector: Float[Tensor, "n"], like: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Invert ``flatten``, with the names and shapes of ``like``; the parts are differentiable views.

    Raises:
        ValueError: the vector's length does not match.
    """
    wanted = sum(tensor.numel() for tensor in like.values())
    if vector.shape != (wanted,):
        raise ValueError(
            f"unflatten: got shape {tuple(vector.shape)}, want ({wanted},) for {len(like)} parameters"
        )
    pieces = torch.split(vector, [tensor.numel() for tensor in like.values()])
    return {
        name: piece.view(tensor.shape) for (name, tensor), piece in zip(like.items(), pieces, strict=True)
    }


class NonFiniteProduct(ArithmeticError):
    """An operator returned inf or nan. Raised by ``Watched`` and turned into a status by the solver's base."""


@dataclass(frozen=True)
class Shifted:
    """The operator ``x -> A x + shift x``: a Hessian with its damping."""

    matvec: Matvec
    shift: float

    def __call__(self, vector: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        """Apply the operator to a vector."""
        return self.matvec(vector) + self.shift * vector


def numbers(*scalars: Shaped[Tensor, ""]) -> list[float]:
    """Read several scalars as Python numbers in one transfer, so that the host waits for the device only once."""
    stacked = torch.stack([scalar.double() for scalar in scalars])
    return cast(list[float], stacked.tolist())  # pyright: ignore[reportUnknownMemberType]


def plain_norm(vector: Tensor) -> Float[Tensor, ""]:
    """Compute the Euclidean norm in float64, in whose range squares of float32 numbers lie; it stays on the device."""
    return cast(Tensor, torch.linalg.vector_norm(vector, dtype=torch.float64))  # pyright: ignore[reportUnknownMemberType]


def plain_dot(left: Float[Tensor, "n"], right: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """Compute the inner product in float64; it stays on the device."""
    return left.double() @ right.double()


def norm(vector: Tensor) -> float:
    """Compute the Euclidean norm in float64, for float32 entries up to 1e38 and float64 entries of any size."""
    return in_range(float(plain_norm(vector)), vector)


def in_range(size: float, vector: Tensor) -> float:
    """Recompute a vector's ``plain_norm``, given as ``size``, if its squares left the range of float64."""
    if 1e-140 < size < 1e150 or not bool(torch.isfinite(vector).all()):
        return size
    # Scaling by a power of two is exact.
    exponent = math.frexp(float(vector.abs().max()))[1]
    scaled = torch.ldexp(vector.double(), torch.tensor(-exponent))
    return math.ldexp(float(plain_norm(scaled)), exponent)


def dot(left: Float[Tensor, "n"], right: Float[Tensor, "n"]) -> float:
    """Compute the inner product in float64."""
    return float(plain_dot(left, right))


def eigenpairs(symmetric: Float[Tensor, "n n"]) -> tuple[Float[Tensor, "n"], Float[Tensor, "n n"]]:
    """Find the eigenvalues, ascending, and the eigenvectors, as columns."""
    return cast(tuple[Tensor, Tensor], torch.linalg.eigh(symmetric))  # pyright: ignore[reportUnknownMemberType]


@dataclass(frozen=True)
class Product:
    """A product A v: its ``value``, ``energy`` v^T A v, ``size`` |v| and ``length`` |A v|."""

    value: Float[Tensor, "n"]
    energy: float
    size: float
    length: float


class Watched:
    """Counts an operator's products and tracks the range of their Rayleigh quotients; raises ``NonFiniteProduct``."""

    def __init__(self, matvec: Matvec) -> None:
        self._matvec = matvec
        self.products = 0
        self._low, self._high = math.inf, -math.inf

    @property
    def curvature(self) -> tuple[float, float]:
        """Smallest and largest Rayleigh quotient of all products so far; 0, 0 for none."""
        return (self._low, self._high) if self._low <= self._high else (0.0, 0.0)

    def __call__(self, vector: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        """Apply the operator to a vector."""
        return self.measured(vector).value

    def measured(self, vector: Float[Tensor, "n"]) -> Product:
        """Apply the operator to a vector, and read the product's energy and norms in one transfer to the host.

        Raises:
            NonFiniteProduct: the product is not finite.
            ValueError: the product's shape differs from the vector's.
        """
        product = self._matvec(vector)
        if product.shape != vector.shape:
            raise ValueError(
                f"operator: got a product of shape {tuple(product.shape)}, want {tuple(vector.shape)}"
            )
        self.products += 1
        finite, energy, size, length = numbers(
            torch.isfinite(product).all(), plain_dot(vector, product), plain_norm(vector), plain_norm(product)
        )
        if not finite:
            raise NonFiniteProduct(f"product {self.products} of the operator is not finite")
        size, length = in_range(size, vector), in_range(length, product)
        if size > 0.0:
            quotient = energy / size / size
            self.observe(quotient, quotient)
        return Product(product, energy, size, length)

    def dense(self, like: Float[Tensor, "n"]) -> Float[Tensor, "n n"]:
        """Build the operator's matrix, with the operator's own ``dense`` if it has one; count one product per column.

        Raises:
            NonFiniteProduct: the matrix is not finite.
        """
        matrix = _own_matrix(self._matvec)
        if matrix is None:
            return columns(self, like)
        self.products += like.numel()
        if not bool(torch.isfinite(matrix).all()):
            raise NonFiniteProduct("the operator's matrix is not finite")
        self.observe(float(matrix.diagonal().min()), float(matrix.diagonal().max()))
        return matrix

    def observe(self, low: float, high: float) -> None:
        """Widen the curvature range by values known from elsewhere, such as eigenvalues."""
        self._low, self._high = min(self._low, low), max(self._high, high)


def columns(matvec: Matvec, like: Float[Tensor, "n"]) -> Float[Tensor, "n n"]:
    """Build a small operator's matrix from one product per column, with the type and device of ``like``."""
    matrix = like.new_empty(like.numel(), like.numel())
    basis = torch.zeros_like(like)
    for column in range(like.numel()):
        basis[column] = 1.0
        matrix[:, column] = matvec(basis)
        basis[column] = 0.0
    return matrix


def _own_matrix(matvec: Matvec) -> Tensor | None:
    """Build the matrix with the operator's own ``dense``, faster than column by column; None if it has none."""
    if isinstance(matvec, Shifted):
        matrix = _own_matrix(matvec.matvec)
        return None if matrix is None else matrix + matvec.shift * torch.eye(len(matrix)).to(matrix)
    own = getattr(matvec, "dense", None)
    return None if own is None else own()
