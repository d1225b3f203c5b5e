"""The choice of lambda in ``(H + lambda I) v = b``."""

from __future__ import annotations

import abc
import logging
import math
from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Gt
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from neural_sim.ranges import NonNegative, NonNegativeInt, Positive, PositiveInt, validated
from neural_sim.solver.base import Search
from neural_sim.solver.lanczos import Krylov, Spectrum, lanczos, random_start
from neural_sim.solver.operator import Matvec

logger = logging.getLogger(__name__)


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

    def search(self, times: float = 1.0) -> Search | None:
        """Solve with lambda multiplied by ``times``, using only the estimate's products; None if there are none."""
        return None if self.krylov is None else self.krylov.search(times * self.value)


class Damping(abc.ABC):
    """Chooses lambda for an operator."""

    @abc.abstractmethod
    def choose(self, matvec: Matvec, b: Float[Tensor, "n"], generator: torch.Generator) -> Damped:
        """Choose lambda for ``matvec`` and the right-hand side ``b``."""

    def raised(self, damped: Damped, lowest: float) -> Damped | None:
        """Raise lambda after a solve met the curvature ``lowest`` < -lambda; None: lambda is fixed."""
        return None


@validated
@dataclass(frozen=True)
class FixedDamping(Damping):
    """A given lambda, for instance 0 where the inner problem's own proximal term bounds its curvature.

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
