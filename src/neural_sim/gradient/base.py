"""Inputs and results of the estimators of derivatives with respect to psi.

For the implicit adjoint they estimate ``d/dpsi <dL_train/dtheta, v>``, without the minus sign of the implicit function
theorem, which ``gradient.implicit`` applies. For the unrolled adjoint they estimate ``dL_val/dpsi`` itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.parameter.product import SceneDistribution
from neural_sim.types import Maps, PinholeCamera, Rays, SceneDraw

Params = dict[str, Tensor]


class IndexedLoss(Protocol):
    """Losses of images by row, computed from cached features of the frozen backbone."""

    def __call__(self, params: Params, index: Int[Tensor, "n"], /) -> Float[Tensor, "n"]:
        """Compute the losses of these rows."""
        ...


class ImageLoss(Protocol):
    """Losses of training images, twice differentiable in parameters and images.

    ``index`` holds the images' rows in the training set, which select their targets.
    """

    def __call__(
        self, params: Params, images: Float[Tensor, "n 3 h w"], index: Int[Tensor, "n"], /
    ) -> Float[Tensor, "n"]:
        """Compute the losses of these images."""
        ...


@dataclass(frozen=True)
class Probes:
    """One object's stratified samples of one factor: equally many images of every stratum (bin or anchor light).

    ``index`` holds their rows among all probes, ``bins`` the stratum of each.
    """

    index: Int[Tensor, "m"]
    bins: Int[Tensor, "m"]


@dataclass(frozen=True)
class Losses:
    """Per-image losses of the training images (from cached features, and from pixels) and of the probes."""

    cached: IndexedLoss
    from_images: ImageLoss
    probes: IndexedLoss | None = None


@dataclass(frozen=True)
class RenderedPath:
    """How one object's images were computed from psi, so that they can be computed again with derivatives.

    ``relaxed`` maps psi to the draw, with its noise fixed. ``render_rays`` maps rays to premultiplied colour [r, 3] and
    opacity [r], differentiable in the rays. ``compose`` maps colour and opacity maps to images, with all other random
    choices fixed. ``rgb`` and ``opacity`` come from the first render. ``tangents`` come from it as well: derivatives of
    these maps by the weights of the light and, in forward mode, by the draw's coordinates that depend on psi.
    """

    relaxed: Callable[[Float[Tensor, "K"]], SceneDraw]
    render_rays: Callable[[Rays], tuple[Float[Tensor, "r 3"], Float[Tensor, "r"]]]
    compose: Callable[[Float[Tensor, "n h w 3"], Float[Tensor, "n h w"]], Float[Tensor, "n 3 h w"]]
    camera: PinholeCamera
    rgb: Float[Tensor, "n h w 3"]
    opacity: Float[Tensor, "n h w"]
    tangents: Mapping[str, Maps] | None = None


@dataclass(frozen=True)
class ObjectImages:
    """One object's training images at one psi.

    ``psi`` is the object's psi, one vector for all factors of ``distribution`` (p_psi). ``index`` holds the images'
    rows in the training set, ``weights`` their weights in ``L_train = sum_i w_i l_i`` (1 / N without photographs).
    ``draw`` holds the scene parameters with which they were rendered. For the unrolled adjoint, the weights leave
    photographs out, because each step's batch has its own fraction of them. Only the pathwise estimator needs
    ``images`` and ``path``.
    """

    psi: Float[Tensor, "K"]
    distribution: SceneDistribution
    images: Float[Tensor, "n 3 h w"] | None
    index: Int[Tensor, "n"]
    weights: Float[Tensor, "n"]
    draw: SceneDraw
    path: RenderedPath | None = None


@dataclass(frozen=True)
class MixedDerivative:
    """One object's derivative with respect to psi, as ``Estimator.estimate`` or ``Estimator.accumulated`` defines it.

    ``standard_error`` is the error of ``value`` over draws of the images, with v (or the recorded training) fixed; inf
    if unknown. ``p_values`` has, for each factor of psi, the p-value of the null hypothesis that the derivative with
    respect to the factor is zero, over the same draws; it is empty if nothing was tested.
    """

    value: Float[Tensor, "K"]
    standard_error: Float[Tensor, "K"]
    p_values: Mapping[str, float] = field(default_factory=dict[str, float])


def from_contributions(contributions: Float[Tensor, "n K"]) -> MixedDerivative:
    """Sum the images' independent contributions, and estimate the standard error of the sum (inf for one image)."""
    value, count = contributions.sum(0), len(contributions)
    if count < 2:
        return MixedDerivative(value, torch.full_like(value, torch.inf))
    return MixedDerivative(value, contributions.std(0) * count**0.5)
