"""Trust-region steps of psi, accepted or rejected by a training at the new psi.

The training has the random numbers of the training at the old psi, whose derivative was taken (the same initial
parameters, batches, backgrounds and noise of the draws), so that the difference of the two measures the effect of the
step with little noise. A step is accepted if its derivative and this difference together are significant, because
either alone often is not, and if the score did not fall beyond its error. The radius grows after a step that raised the
object's score beyond the error and shrinks after one that lowered it beyond the error or was rejected (Conn, Gould and
Toint 2000, Chapter 6, with the reduction measured object by object); in the last case less: the noise of a training
does not shrink with the step, so that a much shorter one would be judged by chance even more.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neural_sim.gradient.hypergradient import Hypergradient
from neural_sim.outer.certificate import Certificate
from neural_sim.outer.evidence import Average
from neural_sim.outer.settings import Checks
from neural_sim.outer.steps import PValues, Verdict, by_p, fractions, stacked
from neural_sim.outer.trust_region import within
from neural_sim.parameter.product import SceneDistribution

SMALLEST = 1e-15  # p-value, whose normal quantile is -8


class CheckedSteps:
    """Trust-region steps, see the module.

    Args:
        settings: radii and acceptance.
        shrink: fraction of an untrusted step that is taken.
        distribution: p_psi.
        names, labels: the learned objects and their classes.
        psi: initial psi of these objects.
    """

    def __init__(
        self,
        settings: Checks,
        shrink: float,
        distribution: SceneDistribution,
        names: Sequence[str],
        labels: Sequence[int],
        psi: Float[Tensor, "objects K"],
    ) -> None:
        self.settings, self.shrink, self.distribution = settings, shrink, distribution
        self.names, self.labels = names, torch.tensor(labels)
        self.accepted = self.trial = psi.detach().clone()
        parts = distribution.split(psi)
        self.radius = {name: torch.full_like(part[:, 0], settings.radius) for name, part in parts.items()}
        self._averages = {name: Average.zeros(part, settings.momentum) for name, part in parts.items()}
        self._joined = dict(self._averages)  # with the derivatives since the last step
        self._expected = torch.zeros_like(psi[:, 0])
        self._moved = {name: torch.zeros(len(psi), dtype=torch.bool) for name in parts}
        self._foretold = torch.zeros_like(
            self._expected
        )  # the derivatives' significance, in standard deviations
        self._at_rest: list[float] = []  # see _of_trainings

    @property
    def reported(self) -> Float[Tensor, "objects K"]:
        """With the last step: until a training has judged it, its expected gain speaks for it."""
        return self.trial

    @property
    def pending(self) -> bool:
        return bool(self._pending.any())

    @property
    def waiting(self) -> set[tuple[str, str]]:
        """Their radius is too small, or their gain beside the largest one."""
        return {
            (name, factor)
            for factor, moved in self._moved.items()
            for name, moves in zip(self.names, moved.tolist(), strict=True)
            if not moves
        }

    @property
    def _pending(self) -> Bool[Tensor, "objects"]:
        """Objects that moved, by any factor, and whose step is neither accepted nor rejected yet."""
        return torch.stack([*self._moved.values()]).any(0)

    @property
    def _of_trainings(self) -> float:
        """Variance of a gain between trainings: what objects at rest gained or lost beyond the errors of images, the
        median judgment's, because after large steps they really gain by the better images of others.
        """
        return max(median(self._at_rest), 0.0) if self._at_rest else 0.0

    def judge(
        self, before: Float[Tensor, "classes images"], after: Float[Tensor, "classes images"]
    ) -> dict[str, Verdict]:
        """Accept an object's step if its derivative and the measured gain together are significant at ``level``, by the
        sum of their normal quantiles over the root of 2 (Stouffer et al. 1949), and the score did not fall beyond
        ``errors``: a derivative may differ from zero with certainty and yet promise next to nothing. The gain's error
        is that of the images' paired differences and of trainings, which the scores of objects that did not move show.
        Where the mean over all classes fell by more than its own error, though all steps would be accepted, all are
        rejected.
        """
        change = after.double() - before.double()
        gains, images = change.sum(1), _of_sums(change)
        total, pending = gains.nansum(), self._pending
        # Without at_rest below: what this step costs others is not scatter of trainings.
        of_total = (_of_sums(change.nansum(0)).square() + len(gains) * self._of_trainings).sqrt()
        at_rest = (gains.square() - images.square())[self.labels][~pending]
        at_rest = at_rest[at_rest.isfinite()]
        if len(at_rest):
            self._at_rest.append(float(at_rest.mean()))
        gain, error = gains[self.labels], (images.square() + self._of_trainings).sqrt()[self.labels]
        rose, fell = gain > self.settings.errors * error, gain < -self.settings.errors * error
        measured = torch.where(gain == 0.0, 0.0, gain / error)
        accepted = pending & ~fell & (self._foretold + measured > 2.0**0.5 * _beyond(self.settings.level))
        if bool(accepted[pending].all()) and total < -self.settings.errors * of_total:
            accepted, fell = torch.zeros_like(accepted), torch.ones_like(fell)
        self.accepted = self.trial = torch.where(accepted[:, None], self.trial, self.accepted)
        for name, radius in self.radius.items():
            factor = torch.where(rose, self.settings.grow, 1.0)
            factor = torch.where(accepted, factor, self.settings.shrink**0.5)
            factor = torch.where(fell, self.settings.shrink, factor)
            scaled = (radius * factor).clamp_max(self.settings.largest)
            self.radius[name] = torch.where(self._moved[name], scaled, radius)
        verdicts = {
            name: Verdict(bool(accepted[i]), float(self._expected[i]), float(gain[i]), float(error[i]))
            for i, name in enumerate(self.names)
            if pending[i]
        }
        self._averages = {name: average.moved(accepted) for name, average in self._averages.items()}
        self._joined = dict(self._averages)
        self._moved = {name: torch.zeros_like(pending) for name in self._moved}
        return verdicts

    def observe(self, result: Hypergradient) -> PValues:
        gradient, error = stacked(result, self.names, self.accepted)
        psi, slope, noise = (self.distribution.split(values) for values in (self.accepted, gradient, error))
        p_values: dict[str, dict[str, float]] = {name: {} for name in self.names}
        for factor in self.distribution.factors:
            name = factor.name
            self._joined[name] = self._joined[name].joined(*by_p(factor, psi[name], slope[name], noise[name]))
            for object_name, value in zip(self.names, self._joined[name].p_values.tolist(), strict=True):
                p_values[object_name][name] = value
        return p_values

    def next(self, certificate: Certificate) -> Float[Tensor, "objects K"]:
        self._expected = torch.zeros_like(self._expected)
        if certificate.void:
            self._joined = dict(self._averages)
            self.trial = self.accepted
            return self.trial
        self._averages = dict(self._joined)
        psi = self.distribution.split(self.accepted)
        moved, gains = {}, {}
        for factor in self.distribution.factors:
            name = factor.name
            taken = psi[name].new_tensor(fractions(certificate, self.names, name, self.shrink))
            radius = self.radius[name] * taken
            radius = torch.where(self.radius[name] < self.settings.smallest, 0.0, radius)
            direction = self._averages[name].value
            moved[name] = within(factor, psi[name], direction, radius, self.settings.keep)
            change = factor.p_of(moved[name]) - factor.p_of(psi[name])
            gains[name] = (direction * change).sum(1)
        due = self.settings.waits_below * torch.stack([*gains.values()]).max()
        for name, gain in gains.items():
            moves = (gain >= due) & (moved[name] != psi[name]).any(1)
            moved[name] = torch.where(moves[:, None], moved[name], psi[name])
            self._moved[name] = moves
            self._expected = self._expected + torch.where(moves, gain, 0.0)
        self._foretold = self._significance
        self.trial = self.distribution.join(moved)
        return self.trial

    @property
    def _significance(self) -> Float[Tensor, "objects"]:
        """That of the derivatives by the factors that move, in standard deviations; of several, the most significant
        one counts, its p-value times their number (Bonferroni).
        """
        moves = torch.stack([*self._moved.values()])
        p_values = torch.stack([self._averages[name].p_values for name in self._moved])
        p_value = p_values.where(moves, 1.0).amin(0) * moves.sum(0)
        return _beyond(p_value.clamp(SMALLEST, 1.0 - SMALLEST))


def _beyond(p: Float[Tensor, "*n"] | float) -> Float[Tensor, "*n"]:
    """What a standard normal variable exceeds with probability p."""
    return -torch.special.ndtri(torch.as_tensor(p, dtype=torch.float64))


def _of_sums(change: Float[Tensor, "*n images"]) -> Float[Tensor, "*n"]:
    """Standard errors of sums over images; 0 for one image, whose scatter is not known."""
    images = change.shape[-1]
    return images**0.5 * change.std(-1) if images > 1 else torch.zeros_like(change[..., 0])
