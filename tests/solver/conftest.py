"""Symmetric systems with known eigenvalues, as functions that tests ask for by name."""

import math

import pytest
import torch

DOUBLE = torch.float64
SIZE = 24


@pytest.fixture
def symmetric():
    """The matrix with given eigenvalues in a random orthonormal basis."""

    def make(eigenvalues: torch.Tensor, seed: int = 0) -> torch.Tensor:
        generator = torch.Generator().manual_seed(seed)
        size = eigenvalues.numel()
        basis, _ = torch.linalg.qr(torch.randn(size, size, generator=generator, dtype=DOUBLE))
        matrix = basis * eigenvalues @ basis.T
        return 0.5 * (matrix + matrix.T)

    return make


@pytest.fixture
def right_hand_side():
    """A Gaussian right-hand side."""

    def make(size: int = SIZE, seed: int = 1) -> torch.Tensor:
        return torch.randn(size, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)

    return make


@pytest.fixture
def spread():
    """Eigenvalues from 1 to 1 / condition, evenly in log."""

    def make(condition: float, size: int = SIZE) -> torch.Tensor:
        return torch.logspace(0.0, -math.log10(condition), size, dtype=DOUBLE)

    return make
