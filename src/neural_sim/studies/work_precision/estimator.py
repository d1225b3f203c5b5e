"""Estimators of the hypergradient's mixed term compared with the derivative over hard bins, by images and seconds.

Each estimates d/dpsi <dL_train/dtheta, v> for one object's psi from N images, drawn as in the psi loop. The reference
is g_i = p_i (s_i - sum_j p_j s_j), up to the floor's factor, where s_b is the mean score <dl/dtheta, v> of bin b. It
differentiates the very distribution that training images are drawn from, but is an estimate, too, from its own images.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Ge, MinLen
from jaxtyping import Float
from torch import Tensor

from neural_sim.detector.cached_set import CachedSet
from neural_sim.gradient.base import Losses, MixedDerivative, ObjectImages, Probes
from neural_sim.gradient.estimators import Estimator, ReinforceEstimator, StratifiedEstimator
from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.parameter.update import shrinkage
from neural_sim.ranges import Ascending, PositiveInt, validated
from neural_sim.studies.frozen_loop import FrozenLoop, centred, relative_error, unavailable
from neural_sim.studies.work_precision.measurement import Point, Series, Timing, World
from neural_sim.types import SceneDraw

Estimates = Float[Tensor, "repeats objects k"]
Result = dict[int, tuple[Estimates, float]]
"""Estimates and seconds per object, by number of images."""


PATHWISE = {
    "paper (reverse, linear)": (PathwiseEstimator("reverse"), "linear"),
    "linear": (PathwiseEstimator(), "linear"),
    "circular": (PathwiseEstimator(), "circular"),
}
"""Pathwise estimators by name, with the ``bin_mean`` of the factor."""


@validated
@dataclass(frozen=True)
class Estimators:
    """The family ``estimator``.

    Args:
        images: numbers N of images per estimate, increasing, each a multiple of the first.
        default: number of images of the default, the stratified estimator: 24 probes in each of 8 bins. It is measured
            in addition to ``images``.
        repeats: number of estimates from the largest N; there are more of smaller N.
        truth_per_bin: images per bin for the reference.
        pathwise: variants of the pathwise estimator, from ``PATHWISE``.

    Raises:
        ValueError: a variant is unknown, or a number of images is not a multiple of the first.
    """

    images: Annotated[tuple[PositiveInt, ...], MinLen(1), Ascending()] = (16, 32, 64, 128)
    default: PositiveInt = 192
    repeats: PositiveInt = 2
    truth_per_bin: Annotated[int, Ge(2)] = 128
    pathwise: Sequence[str] = tuple(PATHWISE)

    def __post_init__(self) -> None:
        unknown = set(self.pathwise) - set(PATHWISE)
        if unknown:
            raise ValueError(
                f"work_precision.estimator.pathwise: want some of {', '.join(PATHWISE)}, got {sorted(unknown)}"
            )
        if any(count % self.images[0] for count in self.images):
            raise ValueError(
                f"work_precision.estimator.images: want multiples of the first, got {list(self.images)}"
            )

    def measure(self, world: World, timing: Timing, seed: int) -> Iterator[Series]:
        """Measure at the initial psi of the run, with v from its solver; means over repeats and objects."""
        loop = world.loop
        random = torch.Generator().manual_seed(1_000 * seed + 21)
        hard = loop.truth(self.truth_per_bin, random)
        truth, noise = centred(hard), torch.stack([part.standard_error for part in hard])
        found = {f"pathwise, {name}": self._pathwise(loop, name, timing, seed) for name in self.pathwise}
        found |= self._stratified(loop, timing, seed)
        found["reinforce"] = self._reinforce(loop, timing, seed)
        cosines = ", ".join(f"{ceiling:.2f}" for ceiling in ceilings(truth, noise))
        note = (
            f"The derivative of the validation loss with respect to the centred logits of {', '.join(world.names)} "
            f"(adjoint solve: {loop.solve}). The reference is from {self.truth_per_bin} images of every bin; the exact "
            f"derivative has an expected cosine of {cosines} with it. Seconds are per object, for drawing, rendering "
            "and estimating."
        )
        for kind, error in (
            ("relative error", relative_error),
            ("1 - cosine", lambda a, b: 1.0 - cosine(a, b)),
        ):
            points = tuple(
                Point(f"{name}, {count} images", float(error(estimates, truth).mean()), seconds, None,
                      name == "stratified" and count == self.default, name, self._spread(error(estimates, truth)))
                for name, result in found.items() for count, (estimates, seconds) in result.items()
            )  # fmt: skip
            yield Series(f"estimator/{kind}", f"{kind} of the estimate", points, (), note, timing.clock)

    @staticmethod
    def _spread(errors: Float[Tensor, "repeats objects"]) -> str:
        """Return the standard deviation over repeats, pooled over objects."""
        if len(errors) < 2:
            return "1 repeat"
        return f"± {float(errors.var(0).mean().sqrt()):.2g} over {len(errors)} repeats"

    def _pathwise(self, loop: FrozenLoop, name: str, timing: Timing, seed: int) -> Result:
        """Estimate with equal seeds, so that variants with the same draws see the same images.

        Images are independent, so estimates from more of them are means of estimates from the smallest number.
        """
        (estimator, bin_mean), unit = PATHWISE[name], self.images[0]
        # Reverse mode gives the same numbers as "linear" up to rounding; one repeat is enough to time it.
        repeats = 1 if estimator.mode == "reverse" else self.repeats
        moved = loop.with_factor(dataclasses.replace(loop.bins, bin_mean=bin_mean))
        generator, units = torch.Generator().manual_seed(seed + 100), []
        begun = timing.now()
        for _ in range(repeats * self.images[-1] // unit):
            units.append(centred(moved.pathwise(estimator, unit, generator)))
        spent = (timing.now() - begun) / (len(units) * unit * len(loop.psi))
        stacked, result = torch.stack(units), Result()
        for count in self.images:
            size = count // unit
            means = stacked[: len(units) // size * size].unflatten(0, (-1, size)).mean(1)
            result[count] = means, spent * count
        return result

    def _stratified(self, loop: FrozenLoop, timing: Timing, seed: int) -> dict[str, Result]:
        """Estimate from disjoint parts of a pool of every bin, without and with the psi update's shrinkage."""
        bins = loop.scene.distribution.size
        counts = sorted({*self.images, self.default})
        pool = self.repeats * max(2, counts[-1] // bins)
        begun = timing.now()
        probed = loop.probes(pool, torch.Generator().manual_seed(seed + 31))
        image = (timing.now() - begun) / len(probed.cached)
        probes, plain, shrunk = [part[loop.bins.name] for part in probed.probes], Result(), Result()
        for count in counts:
            per_bin, values, kept = count // bins, [], []
            if per_bin < 2:  # a single image has no measurable noise
                continue
            begun = timing.now()
            for first in range(0, pool - per_bin + 1, per_bin):
                rows = (torch.arange(bins)[:, None] * pool + torch.arange(first, first + per_bin)).flatten()
                parts = [Probes(probe.index[rows], probe.bins[rows]) for probe in probes]
                found = [
                    score(loop, StratifiedEstimator(), probed.cached, p, label)
                    for label, p in enumerate(parts)
                ]
                values.append(centred(found))
                noise = torch.stack([part.standard_error.square() for part in found])
                kept.append(values[-1] * shrinkage(values[-1], noise))
            spent = (timing.now() - begun) / (len(values) * len(probes))
            for result, estimates in ((plain, values), (shrunk, kept)):
                result[count] = torch.stack(estimates), image * count + spent
        return {"stratified": plain, "stratified, shrunk": shrunk}

    def _reinforce(self, loop: FrozenLoop, timing: Timing, seed: int) -> Result:
        """Estimate from disjoint parts of a pool of hard draws of every object."""
        pool = self.repeats * self.images[-1]
        begun = timing.now()
        rendered = loop.scene.training_set(loop.psi, pool, torch.Generator().manual_seed(seed + 41))
        cached = CachedSet.of(loop.detector, loop.backbone, rendered.images)
        image, result = (timing.now() - begun) / len(rendered.images), Result()
        for count in self.images:
            begun, found = timing.now(), []
            for first in range(0, pool - count + 1, count):
                rows = torch.arange(first, first + count)
                drawn = [
                    Probes(label * pool + rows, part.draw.bins[rows, 0])
                    for label, part in enumerate(rendered.objects)
                ]
                parts = [score(loop, ReinforceEstimator(), cached, p, label) for label, p in enumerate(drawn)]
                found.append(centred(parts))
            spent = (timing.now() - begun) / (len(found) * len(rendered.objects))
            result[count] = torch.stack(found), image * count + spent
        return result


def score(
    loop: FrozenLoop, estimator: Estimator, cached: CachedSet, drawn: Probes, label: int
) -> MixedDerivative:
    """Estimate from the scores of some of the cached images, without their pixels."""
    count = len(drawn.index)
    still = torch.zeros(count)
    images = ObjectImages(
        loop.psi[label].float(), loop.scene.distribution, torch.zeros(count, 3, 1, 1), drawn.index,
        torch.full((count,), 1.0 / count), SceneDraw(still, still, still, drawn.bins[:, None]),
    )  # fmt: skip
    losses = Losses(cached.losses, unavailable, cached.losses)
    return estimator.estimate(losses, loop.trainable, loop.vector, images, {loop.bins.name: drawn})


def cosine(a: Tensor, b: Tensor) -> Tensor:
    """Return the cosine along the last axis; 0 where an estimate is zero."""
    return torch.nn.functional.cosine_similarity(a, b, dim=-1, eps=1e-30)


def ceilings(value: Float[Tensor, "objects k"], standard_error: Float[Tensor, "objects k"]) -> list[float]:
    """Return the expected cosine between the exact vector and each estimate of it."""
    noise = standard_error.square().sum(-1)
    signal = (value.square().sum(-1) - noise).clamp_min(0.0)
    return (signal / (signal + noise).clamp_min(1e-30)).sqrt().tolist()
