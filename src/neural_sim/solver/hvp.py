"""Products with the Hessian of a training loss, without the matrix (Pearlmutter 1994).

The loss is a sum of terms, one for each chunk of images. A product differentiates one term at a time, so that only one
chunk is in memory. It costs as much as 2 to 4 gradients: central differences least, reverse over reverse most unless
the first gradient's graph is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.ranges import check
from neural_sim.solver.operator import columns, flatten, norm, unflatten

Term = Callable[[dict[str, Tensor]], Tensor]
Mode = Literal["reverse_over_reverse", "central_difference"]


class HessianOperator:
    """The operator ``vector -> H vector`` for the Hessian H of ``sum(term(params) for term in terms)`` at ``params``.

    Args:
        terms: the terms of the loss.
        params: where the Hessian is taken; vectors are flattened in this order.
        mode: ``reverse_over_reverse`` (exact) or ``central_difference`` (two gradients at ``theta +- h v``; error of
            relative order eps^(2/3)).
        retain_graph: for reverse_over_reverse, keep the first gradient's graph of all terms: a product then costs one
            backward pass, but all chunks are in memory.

    Raises:
        ValueError: no terms, or an unknown mode.
    """

    def __init__(
        self,
        terms: Sequence[Term],
        params: Mapping[str, Tensor],
        mode: Mode = "reverse_over_reverse",
        retain_graph: bool = False,
    ) -> None:
        if not terms:
            raise ValueError("HessianOperator: got no loss terms, want at least one")
        check(mode, Mode, "HessianOperator.mode")
        self._terms = list(terms)
        self._params = {name: tensor.detach() for name, tensor in params.items()}
        self._point = flatten(self._params)
        self._mode = mode
        self._retained = (
            list(self._gradient_graphs()) if retain_graph and mode == "reverse_over_reverse" else None
        )

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self._point.numel()

    def __call__(self, vector: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        """Apply the Hessian to a vector."""
        if self._mode == "central_difference":
            return self._central_difference(vector)
        return self._reverse_over_reverse(vector)

    def dense(self, batch: int = 64) -> Float[Tensor, "n n"]:
        """Build the matrix: ``batch`` columns at a time on a retained graph, otherwise one product per column."""
        if self._retained is None:
            return columns(self, self._point)
        basis = torch.eye(self.size, dtype=self._point.dtype, device=self._point.device)
        total = torch.zeros_like(basis)
        for point, slope in self._retained:
            if slope.requires_grad:
                parts = [
                    torch.autograd.grad(
                        slope, point, rows, retain_graph=True, is_grads_batched=True, materialize_grads=True
                    )[0]
                    for rows in torch.split(basis, batch)
                ]
                total += torch.cat(parts)
        return total

    def _gradient_graphs(self) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield, for each term, a leaf point and the gradient there with its graph."""
        for term in self._terms:
            point = self._point.clone().requires_grad_()
            with torch.enable_grad():
                loss = term(unflatten(point, self._params))
                (slope,) = torch.autograd.grad(loss, point, create_graph=True)
            yield point, slope

    def _reverse_over_reverse(self, vector: Tensor) -> Tensor:
        total = torch.zeros_like(self._point)
        kept = self._retained is not None
        for point, slope in self._gradient_graphs() if self._retained is None else self._retained:
            if slope.requires_grad:  # a linear term's gradient is constant
                (part,) = torch.autograd.grad(slope, point, vector, retain_graph=kept, materialize_grads=True)
                total += part
        return total

    def _central_difference(self, vector: Tensor) -> Tensor:
        length = difference_length(self._point, vector)
        if length == 0.0:
            return torch.zeros_like(vector)
        step = length * vector
        above, below = (
            gradient(self._terms, unflatten(point, self._params))
            for point in (self._point + step, self._point - step)
        )
        return (above - below) * (0.5 / length)


def difference_length(point: Float[Tensor, "n"], vector: Float[Tensor, "n"]) -> float:
    """Choose h for the difference between ``point + h vector`` and ``point - h vector``; 0 for the zero vector.

    The truncation error (h |vector|)^2 and the rounding error eps / (h |vector|) balance at eps^(1/3), relative to 1
    plus the root mean square of the point.
    """
    size = norm(vector)
    reach = torch.finfo(vector.dtype).eps ** (1 / 3) * (1.0 + norm(point) / point.numel() ** 0.5)
    return reach / size if size > 0.0 else 0.0


def gradient(terms: Sequence[Term], params: Mapping[str, Tensor]) -> Float[Tensor, "n"]:
    """Differentiate ``sum(term(params) for term in terms)``, flattened, with one term in memory at a time."""
    if not terms:
        raise ValueError("gradient: got no loss terms, want at least one")
    leaves = {name: tensor.detach().requires_grad_() for name, tensor in params.items()}
    total = torch.zeros_like(flatten(leaves))
    for term in terms:
        with torch.enable_grad():
            loss = term(leaves)
        slopes = torch.autograd.grad(loss, list(leaves.values()), materialize_grads=True)
        total += torch.cat([slope.reshape(-1) for slope in slopes])
    return total.detach()
