"""Trust-region steps of psi, accepted or rejected by a training at the new psi.

This training uses the random numbers of the training at the old psi, whose derivative was taken (the same initial
parameters, batches, backgrounds and noise of the draws), so that the difference between the two measures the effect of
the step with little noise. A step is accepted if its derivative and this difference are significant together, because
either alone often is not, and if the score did not fall by more than its error. The radius grows after a step that
raised the object's score by more than the error, and shrinks after one that lowered it by more than the error or was
rejected (Conn, Gould and Toint 2000, Chapter 6, with the reduction measured object by object). It shrinks less after a
step that was rejected without such a fall: the noise of a training does not shrink with the step, so that chance would
decide even more about a much shorter step.

A step goes to the distribution nearest to p + t direction, with t chosen so that its distance from p is the radius.
Bins with equal derivatives gain equally. (Along logits, a bin gains in proportion to its p, and likely bins take nearly
everything.) A bin keeps a fraction of its p: the score is concave in the number of a bin's images, so the derivative
says little about having none.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from statistics import median
from typing import Annotated

import torch
from annotated_types import Ge, Gt, Lt
from jaxtyping import Bool, Float
from torch import Tensor

from neural_sim.configuration import UserError
from neural_sim.gradient.hypergradient import Hypergradient
from neural_sim.outer.certificate import Certificate
from neural_sim.outer.evidence import Average
from neural_sim.outer.steps import LearnedObjects, Proposal, PValues, Verdict, fractions, slopes_by_p, stacked
from neural_sim.parameter.factor import Factor
from neural_sim.ranges import Fraction, NonNegative, Positive, PositiveInt, validated

SMALLEST = 1e-15  # smallest p-value, which is about 8 standard deviations
HALVINGS = 50
# Largest t in p + t direction, for a direction whose largest component is 1: derivatives of bins that differ by a
# thousandth of that still count.
FARTHEST = 1e3

ByFactor = Mapping[str, Float[Tensor, "objects"]]


@validated
@dataclass(frozen=True)
class TrustRegion:
    """``outer.steps``: trust-region steps, which another training accepts or rejects.

    Args:
        trainings: number of trainings in the first iteration, whose derivatives are averaged. Two show how much
            trainings scatter; with one, the test knows only the scatter over images.
        folds: number of disjoint parts of the validation images. Each derivative is that of L_val on one of them, so
            that the scatter between derivatives includes that of the choice of validation images.
        radius: initial trust radius of each object and factor, in total variation (lights: half the absolute change of
            the weights).
        largest: upper bound of the radius.
        smallest: an object with a smaller radius does not move.
        keep: smallest fraction of its p that a step leaves to each bin; 0: no bound.
        level: significance level at which a step is accepted, by its derivative and its measured gain together.
        errors: number of standard errors by which an object's score must rise for its radius to grow, and fall for it
            to shrink by the whole factor.
        waits_below: an object does not move along a factor if the expected gain is below this fraction of the
            iteration's largest one: it waits until the large steps are done. Its derivative was measured with the other
            objects' psi still wrong, and changes once they have moved.
        take_back: whether at the end every object goes back to the best psi that it has had, judged by all trainings
            that saw it (``outer.way``); otherwise the last psi is the result.
        grow: factor on the radius after an accepted step that raised the score.
        shrink: factor on the radius after a step that lowered the score; its square root after another rejected step.
        momentum: factor on a derivative's weight in the average for every later move of its object.

    Raises:
        UserError: the radius is not between its bounds.
    """

    trainings: PositiveInt = 2
    folds: PositiveInt = 2
    radius: Positive = 0.3
    largest: Positive = 0.4
    smallest: Positive = 0.05
    keep: Annotated[float, Ge(0), Lt(1)] = 0.3
    errors: NonNegative = 1.0
    level: Annotated[float, Gt(0), Lt(1)] = 0.05
    waits_below: Fraction = 0.2
    take_back: bool = True
    grow: Annotated[float, Ge(1)] = 1.3
    shrink: Annotated[float, Gt(0), Lt(1)] = 0.4
    momentum: Fraction = 0.5

    def __post_init__(self) -> None:
        if not self.smallest <= self.radius <= self.largest:
            raise UserError(
                "outer.steps.radius: want a radius between outer.steps.smallest and outer.steps.largest, got "
                f"{self.radius} with {self.smallest} and {self.largest}"
            )

    def begin(
        self, objects: LearnedObjects, psi: Float[Tensor, "objects K"], iterations: int
    ) -> TrustRegionSteps:
        """Start at ``psi``, before the first iteration; ``iterations`` makes no difference."""
        psi, parts = psi.detach().clone(), objects.distribution.split(psi)
        averages = {name: Average.zeros(part, self.momentum) for name, part in parts.items()}
        nothing = torch.zeros_like(psi[:, 0])
        return TrustRegionSteps(
            settings=self,
            objects=objects,
            accepted=psi,
            trial=psi,
            radius={name: torch.full_like(part[:, 0], self.radius) for name, part in parts.items()},
            averages=averages,
            observed=averages,
            moved={name: torch.zeros(len(psi), dtype=torch.bool) for name in parts},
            expected=nothing,
            significance=nothing,
        )


@dataclass(frozen=True)
class TrustRegionSteps:
    """Present psi, and the evidence for the next step; see ``outer.steps.Steps``.

    Attributes:
        settings: settings of the steps.
        objects: the learned objects.
        accepted: psi without the pending step.
        trial: psi with the pending step.
        radius: trust radii, by factor.
        averages: the averaged derivatives that steps have followed, by factor.
        observed: these averages, with the derivatives since the last step.
        moved: whether the pending step moved an object, by factor.
        expected: expected gain of the pending step.
        significance: significance, in standard deviations, of the derivatives or the proposal that moved an object in
            the pending step.
        at_rest: the variance between trainings in each judgement: the mean squared gain of the objects that did not
            move, less the squared error over images.
        offered: the objects that the pending step moved to a proposal, which does not change their radii.
    """

    settings: TrustRegion
    objects: LearnedObjects
    accepted: Float[Tensor, "objects K"]
    trial: Float[Tensor, "objects K"]
    radius: ByFactor
    averages: Mapping[str, Average]
    observed: Mapping[str, Average]
    moved: Mapping[str, Bool[Tensor, "objects"]]
    expected: Float[Tensor, "objects"]
    significance: Float[Tensor, "objects"]
    at_rest: tuple[float, ...] = ()
    offered: Bool[Tensor, "objects"] | None = None

    @property
    def reported(self) -> Float[Tensor, "objects K"]:
        """Psi with the pending step, which counts as taken until a training rejects it."""
        return self.trial

    @property
    def pending(self) -> bool:
        """Whether a step waits for ``judge``."""
        return bool(self._pending.any())

    @property
    def waiting(self) -> set[tuple[str, str]]:
        """Pairs of object and factor that the last step did not move, for example because of ``waits_below``."""
        return {
            (name, factor)
            for factor, moved in self.moved.items()
            for name, moves in zip(self.objects.names, moved.tolist(), strict=True)
            if not moves
        }

    @property
    def _pending(self) -> Bool[Tensor, "objects"]:
        """The objects that moved along any factor, and whose step is neither accepted nor rejected yet."""
        moved = torch.stack([*self.moved.values()]).any(0)
        return moved if self.offered is None else moved | self.offered

    def offer(self, proposal: Proposal) -> TrustRegionSteps:
        """Try a proposed psi before any derivative is known."""
        labels = list(self.objects.labels)
        psi, p_values = (values[labels].double() for values in (proposal.psi, proposal.p_values))
        return replace(
            self,
            trial=psi.to(self.accepted),
            offered=(psi != self.accepted).any(1),
            expected=torch.zeros_like(self.expected),
            significance=_quantile(p_values.clamp(SMALLEST, 1.0 - SMALLEST)),
        )

    def held(self, names: Collection[str]) -> TrustRegionSteps:
        """Keep the named objects where they are from now on."""
        held = torch.tensor([name in names for name in self.objects.names])
        radius = {factor: values.masked_fill(held, 0.0) for factor, values in self.radius.items()}
        return replace(self, radius=radius)

    def judge(
        self, before: Float[Tensor, "classes images"], after: Float[Tensor, "classes images"]
    ) -> tuple[TrustRegionSteps, dict[str, Verdict]]:
        """Accept or reject the pending step of each object; see ``outer.steps.Steps``.

        A step is accepted if its derivative and the measured gain are significant together at ``level``, by the sum of
        their normal quantiles divided by the root of 2 (Stouffer et al. 1949), and if the score did not fall by more
        than ``errors`` standard errors: a derivative may certainly differ from zero and yet promise next to nothing.
        The gain's error combines that over images, from paired differences, with the scatter between trainings, which
        the scores of objects that did not move show. If all steps would be accepted, but the sum over all classes fell
        by more than ``errors`` of its own standard errors, all are rejected.
        """
        settings, labels, pending = self.settings, torch.tensor(self.objects.labels), self._pending
        change = after.double() - before.double()
        gains, images = change.sum(1), _errors_of_sums(change)
        # Computed before at_rest is extended: harm that this step does to other objects is not scatter of trainings.
        total_error = (
            _errors_of_sums(change.nansum(0)).square()
            + gains.isfinite().sum() * _between_trainings(self.at_rest)
        ).sqrt()
        excess = (gains.square() - images.square())[labels][~pending]
        excess = excess[excess.isfinite()]
        at_rest = (*self.at_rest, float(excess.mean())) if len(excess) else self.at_rest
        gain, error = gains[labels], (images.square() + _between_trainings(at_rest)).sqrt()[labels]
        fell = gain < -settings.errors * error
        measured = torch.where(gain == 0.0, 0.0, gain / error)
        together = self.significance + measured > 2.0**0.5 * _quantile(settings.level)
        accepted = pending & ~fell & together
        if bool(accepted[pending].all()) and gains.nansum() < -settings.errors * total_error:
            accepted, fell = torch.zeros_like(accepted), torch.ones_like(fell)
        psi = torch.where(accepted[:, None], self.trial, self.accepted)
        averages = {name: average.moved(accepted) for name, average in self.averages.items()}
        verdicts = {
            name: Verdict(bool(accepted[i]), float(self.expected[i]), float(gain[i]), float(error[i]))
            for i, name in enumerate(self.objects.names)
            if pending[i]
        }
        judged = replace(
            self,
            accepted=psi,
            trial=psi,
            radius=self._radii(rose=gain > settings.errors * error, fell=fell, accepted=accepted),
            averages=averages,
            observed=averages,
            moved={name: torch.zeros_like(pending) for name in self.moved},
            at_rest=at_rest,
            offered=None,
        )
        return judged, verdicts

    def _radii(
        self, rose: Bool[Tensor, "objects"], fell: Bool[Tensor, "objects"], accepted: Bool[Tensor, "objects"]
    ) -> ByFactor:
        """Grow or shrink the radii of the factors that moved."""
        settings = self.settings
        factor = torch.where(rose, settings.grow, 1.0)
        factor = torch.where(accepted, factor, settings.shrink**0.5)
        factor = torch.where(fell, settings.shrink, factor)
        return {
            name: torch.where(self.moved[name], (radius * factor).clamp_max(settings.largest), radius)
            for name, radius in self.radius.items()
        }

    def observe(self, result: Hypergradient) -> tuple[TrustRegionSteps, PValues]:
        """Add a derivative at ``accepted`` to the average; see ``outer.steps.Steps``."""
        names, distribution = self.objects.names, self.objects.distribution
        gradient, error = stacked(result, names, self.accepted)
        psi, slope, noise = (distribution.split(values) for values in (self.accepted, gradient, error))
        observed = {
            factor.name: self.observed[factor.name].joined(
                *slopes_by_p(factor, psi[factor.name], slope[factor.name], noise[factor.name])
            )
            for factor in distribution.factors
        }
        tested = {name: average.p_values.tolist() for name, average in observed.items()}
        p_values = {
            name: {factor: values[i] for factor, values in tested.items()} for i, name in enumerate(names)
        }
        return replace(self, observed=observed), p_values

    def propose(self, certificate: Certificate, shrink: float) -> TrustRegionSteps:
        """Step along the averages, as far as the radii; see ``outer.steps.Steps``."""
        if certificate.void:
            nothing = torch.zeros_like(self.expected)
            return replace(self, observed=self.averages, trial=self.accepted, expected=nothing)
        distribution, averages = self.objects.distribution, self.observed
        psi = distribution.split(self.accepted)
        tried, gains = {}, {}
        for factor in distribution.factors:
            name = factor.name
            part = psi[name].new_tensor(fractions(certificate, self.objects.names, name, shrink))
            too_small = self.radius[name] < self.settings.smallest
            radius = torch.where(too_small, 0.0, self.radius[name] * part)
            direction = averages[name].value
            tried[name] = step_within(factor, psi[name], direction, radius, self.settings.keep)
            gains[name] = (direction * (factor.p_of(tried[name]) - factor.p_of(psi[name]))).sum(1)
        due = self.settings.waits_below * torch.stack([*gains.values()]).max()
        moved, expected = {}, torch.zeros_like(self.expected)
        for name, gain in gains.items():
            moved[name] = (gain >= due) & (tried[name] != psi[name]).any(1)
            tried[name] = torch.where(moved[name][:, None], tried[name], psi[name])
            expected = expected + torch.where(moved[name], gain, 0.0)
        return replace(
            self,
            trial=distribution.join(tried),
            averages=averages,
            moved=moved,
            expected=expected,
            significance=_significance(averages, moved),
        )


def step_within(
    factor: Factor,
    psi: Float[Tensor, "objects k"],
    direction: Float[Tensor, "objects k"],
    radius: Float[Tensor, "objects"],
    keep: float,
) -> Float[Tensor, "objects k"]:
    """Move p along ``direction`` until half its absolute change (for bins, the total variation) reaches ``radius``.

    Each bin keeps the fraction ``keep`` of its p, and the move stops at ``FARTHEST``. The length is found by
    bisection.

    Returns:
        The psi of the p that is reached.
    """
    before = factor.p_of(psi)
    size = direction.abs().amax(1, keepdim=True)
    longest = direction * (FARTHEST / torch.where(size > 0.0, size, 1.0))

    def moved(part: Tensor) -> Tensor:
        return factor.moved(psi, part[:, None] * longest, keep)

    def inside(part: Tensor) -> Tensor:
        return 0.5 * (factor.p_of(moved(part)) - before).abs().sum(1) <= radius

    low, high = torch.zeros_like(radius), torch.ones_like(radius)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        within_reach = inside(middle)
        low, high = torch.where(within_reach, middle, low), torch.where(within_reach, high, middle)
    still = (radius <= 0.0) | (size[:, 0] == 0.0)
    return torch.where(still[:, None], psi, moved(torch.where(inside(high), high, low)))


def _between_trainings(at_rest: tuple[float, ...]) -> float:
    """Return the variance of a gain between trainings.

    It is the median over judgements, because a large step of one object can also change the scores of objects at rest.
    """
    return max(median(at_rest), 0.0) if at_rest else 0.0


def _significance(
    averages: Mapping[str, Average], moved: Mapping[str, Bool[Tensor, "objects"]]
) -> Float[Tensor, "objects"]:
    """Return each object's significance, in standard deviations, of the derivatives along which it moves.

    If several factors move, the most significant one counts, with its p-value times their number (Bonferroni).
    """
    moves = torch.stack([*moved.values()])
    p_values = torch.stack([averages[name].p_values for name in moved])
    p_value = p_values.where(moves, 1.0).amin(0) * moves.sum(0)
    return _quantile(p_value.clamp(SMALLEST, 1.0 - SMALLEST))


def _quantile(p: Float[Tensor, "*n"] | float) -> Float[Tensor, "*n"]:
    """Return the value that a standard normal variable exceeds with probability p."""
    return -torch.special.ndtri(torch.as_tensor(p, dtype=torch.float64))


def _errors_of_sums(change: Float[Tensor, "*n images"]) -> Float[Tensor, "*n"]:
    """Return standard errors of sums over images; 0 for a single image, whose scatter is unknown."""
    images = change.shape[-1]
    return images**0.5 * change.std(-1) if images > 1 else torch.zeros_like(change[..., 0])
