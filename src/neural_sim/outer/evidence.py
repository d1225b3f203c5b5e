"""Evidence from the derivatives of several trainings: their mean, its variance, and whether it differs from zero."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from neural_sim.parameter.bins import is_closed


@dataclass(frozen=True)
class Average:
    """Weighted mean of derivatives with respect to p, object by object.

    Weights are inverse variances, so that noisy derivatives, which are long, do not dominate the mean. They decay as
    psi moves, to discount derivatives at an earlier psi. A derivative's variance has two parts: its variance over the
    images from which it was computed, and ``between``, the variance between trainings, which differ in random numbers
    and images. A derivative with a component that is not finite is ignored.

    Attributes:
        directions: the derivatives, 0 in closed bins.
        variances: their variances over images, 0 in closed bins.
        moves: number of moves of the object since each derivative.
        open: the components that count: all except closed bins.
        momentum: factor on a derivative's weight for every move.
    """

    directions: Float[Tensor, "n objects k"]
    variances: Float[Tensor, "n objects k"]
    moves: Int[Tensor, "n objects"]
    open: Bool[Tensor, "objects k"]
    momentum: float = 1.0

    @staticmethod
    def zeros(psi: Float[Tensor, "objects k"], momentum: float = 1.0) -> Average:
        """Return a mean without derivatives yet, for objects at ``psi``, whose closed bins never open."""
        nothing = psi.new_zeros(0, *psi.shape)
        return Average(nothing, nothing, nothing[..., 0].long(), ~is_closed(psi), momentum)

    def joined(self, direction: Float[Tensor, "objects k"], variance: Float[Tensor, "objects k"]) -> Average:
        """Add one more derivative, at the present psi."""
        known = (direction.isfinite() & variance.isfinite()).all(1, keepdim=True)
        new = (direction.where(known, 0.0), variance.where(known, torch.inf))
        return replace(
            self,
            directions=torch.cat([self.directions, new[0][None]]),
            variances=torch.cat([self.variances, new[1][None]]),
            moves=torch.cat([self.moves, torch.zeros_like(direction[None, :, 0], dtype=torch.long)]),
        )

    def moved(self, objects: Bool[Tensor, "objects"]) -> Average:
        """Discount the derivatives of the ``objects`` that have moved."""
        return replace(self, moves=self.moves + objects.long())

    @property
    def between(self) -> Float[Tensor, "objects"]:
        """Variance of a component between trainings; 0 if no object has two derivatives at one psi.

        It is estimated from the scatter of an object's derivatives at one psi, less their variance over images, and
        from a prior that counts as one more pair of derivatives. The prior is the object's variance over images, times
        the median over objects of the ratio of the variance between trainings to that over images: a ratio because
        derivatives of different objects differ in size, a median so that one object with wildly scattered derivatives
        does not hide the signal of the others.
        """
        excess, freedom = self._excess
        if not bool((freedom > 0).any()):
            return torch.zeros_like(excess)
        own = excess / freedom.clamp_min(1.0)
        known = self.variances.isfinite() & self.open
        images = torch.where(known, self.variances, 0.0).sum((0, 2)) / known.sum((0, 2)).clamp_min(1)
        noisy = images > 0.0
        ratios = (own / images)[noisy & (freedom > 0)]
        usual = torch.where(noisy, ratios.quantile(0.5).clamp_min(0.0) * images, own) if len(ratios) else own
        pair = self._freedom
        return ((excess + pair * usual) / (freedom + pair).clamp_min(1.0)).clamp_min(0.0)

    @property
    def _freedom(self) -> Float[Tensor, "objects"]:
        """Degrees of freedom of a centred derivative."""
        return (self.open.sum(1) - 1).clamp_min(0).to(self.directions)

    @property
    def _excess(self) -> tuple[Float[Tensor, "objects"], Float[Tensor, "objects"]]:
        """Squared deviations of derivatives from their mean at one psi, less the images' part; degrees of freedom."""
        known = self.variances.isfinite().all(2)
        excess = torch.zeros_like(self.directions[:1].sum((0, 2)))
        freedom = torch.zeros_like(excess)
        for moves in self.moves.unique():
            here = (known & (self.moves == moves)).to(self.directions)[..., None]
            count = here.sum(0)
            mean = (here * self.directions).sum(0) / count.clamp_min(1.0)
            scatter = (here * (self.directions - mean)).square().sum((0, 2))
            images = torch.where(here > 0.0, self.variances, 0.0).sum((0, 2))
            several = (count[:, 0] - 1.0).clamp_min(0.0)
            excess = excess + scatter - several / count[:, 0].clamp_min(1.0) * images
            freedom = freedom + several * self._freedom
        return excess, freedom

    @property
    def _weights(self) -> Float[Tensor, "n objects 1"]:
        """Relative weights. Without any variance (exact derivatives), all are equal."""
        variance = (
            self.variances.sum(2, keepdim=True) / self.open.sum(1, keepdim=True) + self.between[:, None]
        )
        inverse = torch.where(variance > 0.0, 1.0 / variance, 1.0)
        return self.momentum ** self.moves[..., None].to(inverse) * inverse

    @property
    def value(self) -> Float[Tensor, "objects k"]:
        """The mean; zero without a derivative."""
        weights = self._weights
        total = weights.sum(0).clamp_min(torch.finfo(weights.dtype).tiny)
        return (weights * self.directions).sum(0) / total

    @property
    def variance(self) -> Float[Tensor, "objects k"]:
        """Variances of the mean's components; infinite without a derivative."""
        weights = self._weights
        known = self.variances.isfinite()
        each = torch.where(known, self.variances, 0.0) + self.between[:, None] * self.open
        total = weights.sum(0)
        return torch.where(total > 0.0, (weights.square() * each).sum(0) / total.square(), torch.inf)

    @property
    def p_values(self) -> Float[Tensor, "objects"]:
        """P-values of the null hypothesis that all open components of the mean are equal.

        They come from a chi-square test with one degree of freedom less than there are such components, which are
        weighted by their inverse variances. A mean without variance has p-value 0 if it is not zero, otherwise 1. The
        p-value is 1 also without a derivative.
        """
        value, variance = self.value, self.variance
        exact = ((variance == 0.0) | ~self.open).all(1)
        weights = self.open / torch.where(variance > 0.0, variance, 1.0)
        total = weights.sum(1, keepdim=True).clamp_min(torch.finfo(weights.dtype).tiny)
        centre = (weights * value).sum(1, keepdim=True) / total
        statistic = (weights * (value - centre).square()).sum(1)
        # With a single open component the statistic is 0, for which any positive freedom gives 1.
        p_value = torch.special.gammaincc(0.5 * self._freedom.clamp_min(1.0), 0.5 * statistic)
        return torch.where(exact, torch.where(value.abs().amax(1) > 0.0, 0.0, 1.0).to(p_value), p_value)
