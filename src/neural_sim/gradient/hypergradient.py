"""The hypergradient ``dL_val/dpsi``, and a record of the adjoint with which it was computed.

``gradient.implicit`` computes it at a stationary point (Eq. 2), ``gradient.unrolled`` for the training that was run.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from jaxtyping import Float
from torch import Tensor

from neural_sim.solver.base import Solution
from neural_sim.solver.damping import Damped


@dataclass(frozen=True)
class ImplicitAdjoint:
    """The solve of ``(H + lambda I) v = dL_val/dtheta``.

    Attributes:
        solution: v, and how the solve ended.
        damping: lambda, and the spectrum from which it was chosen.
        damping_raises: number of increases of lambda after solves that met negative curvature.
        stationarity: ``|dL_train/dtheta|``, 0 at a minimiser, which the implicit function theorem assumes.
        validation_norm: ``|dL_val/dtheta|``.
    """

    solution: Solution
    damping: Damped
    damping_raises: int
    stationarity: float
    validation_norm: float

    @property
    def products(self) -> int:
        """Number of Hessian products, of the solve and of the choice of the damping before it."""
        spectrum = self.damping.spectrum
        return self.solution.products + (spectrum.products if spectrum else 0)


@dataclass(frozen=True)
class UnrolledAdjoint:
    """Summary of a reversed training.

    Attributes:
        steps: number of reversed steps; each takes one Hessian product.
        finite: whether the sums over the steps are finite for all images and probes.
        validation_norm: ``|dL_val/dtheta|`` after the last step.
    """

    steps: int
    finite: bool
    validation_norm: float

    @property
    def products(self) -> int:
        """Number of Hessian products: one a step."""
        return self.steps


Adjoint_co = TypeVar("Adjoint_co", bound=ImplicitAdjoint | UnrolledAdjoint | None, covariant=True)


@dataclass(frozen=True)
class Hypergradient(Generic[Adjoint_co]):
    """``dL_val/dpsi`` by object, and what is needed to judge it.

    Attributes:
        gradients: the derivatives.
        errors: standard errors of their components.
        adjoint: how it was computed; None if trainings were compared and no adjoint was needed.
        p_values: by object and factor, see ``MixedDerivative``; empty where nothing was tested.
        seconds: time by phase: validation, solve (or unrolled) and mixed.
    """

    gradients: dict[str, Float[Tensor, "_"]]
    errors: dict[str, Float[Tensor, "_"]]
    adjoint: Adjoint_co
    p_values: dict[str, Mapping[str, float]] = field(default_factory=dict[str, Mapping[str, float]])
    seconds: dict[str, float] = field(default_factory=dict[str, float])

    @property
    def products(self) -> int:
        """Number of Hessian products."""
        return 0 if self.adjoint is None else self.adjoint.products
