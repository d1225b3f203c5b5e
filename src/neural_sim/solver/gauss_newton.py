"""Gauss-Newton products ``J^T H_out J v`` (Schraudolph 2002) of losses given as a function of model outputs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.solver.flatten import flatten, unflatten
from neural_sim.solver.operator import columns


@dataclass(frozen=True)
class CompositeTerm:
    """A loss term split at the model's outputs: ``loss(outputs(params))``. Outputs are any nest of tensors."""

    outputs: Callable[[dict[str, Tensor]], Any]
    loss: Callable[[Any], Tensor]

    def __call__(self, params: dict[str, Tensor]) -> Tensor:
        return self.loss(self.outputs(params))


class GaussNewtonOperator:
    """``vector -> sum over terms of J^T H_out J vector``: the Hessian without the model's own second
    derivative.

    Equal to the Hessian where outputs are linear in the parameters; positive semi-definite where every loss
    is convex in the outputs (a sigmoid focal loss is not, everywhere). Needs forward-mode rules. ``retain_graph``
    keeps every term's outputs and the way back between products. Raises ``ValueError`` without terms.
    """

    def __init__(
        self, terms: Sequence[CompositeTerm], params: Mapping[str, Tensor], retain_graph: bool = False
    ) -> None:
        if not terms:
            raise ValueError("GaussNewtonOperator: got no loss terms, want at least one")
        self._terms = list(terms)
        self._params = {name: tensor.detach() for name, tensor in params.items()}
        self._point = flatten(self._params)
        self._retained = list(self._pulled_back()) if retain_graph else None

    def _pulled_back(self) -> Iterator[tuple[CompositeTerm, Any, Callable]]:
        """Each term with its outputs at the parameters and the product with its Jacobian's transpose."""
        for term in self._terms:
            yield term, *torch.func.vjp(term.outputs, self._params)[:2]

    def __call__(self, vector: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        tangent = unflatten(vector, self._params)
        total = torch.zeros_like(vector)
        for term, outputs, pull_back in self._pulled_back() if self._retained is None else self._retained:
            moved = torch.func.jvp(term.outputs, (self._params,), (tangent,))[1]
            curved = torch.func.jvp(torch.func.grad(term.loss), (outputs,), (moved,))[1]
            (part,) = pull_back(curved)
            total += flatten(part)
        return total

    def dense(self) -> Float[Tensor, "n n"]:
        """The matrix itself, one product a column."""
        return columns(self, self._point)
