"""Inputs and result of the estimators of ``d/dpsi <dL_train/dtheta, v>``.

The implicit function theorem's minus sign is not theirs: it is applied once, in ``implicit.py``.
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
    """Losses of training images by row, from cached features of a frozen backbone."""

    def __call__(self, params: Params, index: Int[Tensor, "n"], /) -> Float[Tensor, "n"]:
        """Compute the losses of these rows."""
        ...


class ImageLoss(Protocol):
    """Losses of training images, twice differentiable in parameters and images; targets by row ``index``."""

    def __call__(
        self, params: Params, images: Float[Tensor, "n 3 h w"], index: Int[Tensor, "n"], /
    ) -> Float[Tensor, "n"]:
        """Compute the losses of these images."""
        ...


@dataclass(frozen=True)
class Probes:
    """Probes of one object: images of every bin of one factor. ``index`` are their rows among all probes."""

    index: Int[Tensor, "m"]
    bins: Int[Tensor, "m"]


@dataclass(frozen=True)
class Losses:
    """Per-image losses of the training images (from cached features, and from the images), and of the probes."""

    cached: IndexedLoss
    from_images: ImageLoss
    probes: IndexedLoss | None = None


@dataclass(frozen=True)
class RenderedPath:
    """How one object's images were computed from psi, to be computed again with derivatives.

    ``relaxed`` maps psi to the draw with its noise bound (replayed). ``render_rays`` maps rays to premultiplied colour
    [r, 3] and opacity [r], differentiable in the rays. ``compose`` maps colour and opacity maps to images with the
    nuisance bound. ``rgb`` and ``opacity`` are the first render's. ``tangents`` (forward mode only) are the maps'
    derivatives by the draw's numbers that depend on psi, from that same render.
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
    """One object's training images at one psi step.

    ``psi`` is the object's part of all factors of ``distribution``, p_psi. ``index`` are the images' rows in
    the training set and ``weights`` their weights in ``L_train = sum_i w_i l_i`` (1 / N for plain draws).
    ``draw`` is where they were rendered. ``images`` and ``path`` are needed by the pathwise estimator only.
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
    """``d/dpsi <dL_train/dtheta, v>`` of one object, without the minus sign.

    ``standard_error`` is that of ``value`` over draws of the images at fixed v; inf where it is unknown. ``p_values``,
    by factor of psi, are those of the null that all components of that factor are zero, over the same draws; empty
    where nothing was tested.
    """

    value: Float[Tensor, "K"]
    standard_error: Float[Tensor, "K"]
    p_values: Mapping[str, float] = field(default_factory=dict[str, float])


def from_contributions(contributions: Float[Tensor, "n K"]) -> MixedDerivative:
    """Sum the independent contributions of images, and estimate the sum's standard error."""
    value, count = contributions.sum(0), len(contributions)
    if count < 2:
        return MixedDerivative(value, torch.full_like(value, torch.inf))
    return MixedDerivative(value, contributions.std(0) * count**0.5)
