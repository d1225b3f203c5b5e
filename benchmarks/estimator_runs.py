"""Estimates of the mixed term from growing numbers of images, drawn and bound as in the psi loop.

Seconds are the process's CPU time, which other work on the machine disturbs less than the clock.
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.detector.cached import CachedSet
from neural_sim.gradient.base import Losses, MixedDerivative, ObjectImages, Probes
from neural_sim.gradient.estimators import ReinforceEstimator, StratifiedEstimator
from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.outer.frozen import FrozenLoop, centred
from neural_sim.parameter.update import shrinkage
from neural_sim.types import SceneDraw

COUNTS = (16, 32, 64, 128)
UNIT = COUNTS[0]


@dataclass(frozen=True)
class Variant:
    """A pathwise estimator with the settings of other packages that belong to it."""

    estimator: PathwiseEstimator
    bin_mean: str = "circular"
    label_gradient: str = "differentiable"

    def of(self, world: FrozenLoop) -> FrozenLoop:
        moved = world.with_factor(dataclasses.replace(world.bins, bin_mean=self.bin_mean))
        synthesizer = dataclasses.replace(moved.scene.synthesizer, label_gradient=self.label_gradient)
        return dataclasses.replace(moved, scene=dataclasses.replace(moved.scene, synthesizer=synthesizer))


RELAXED = "circular, boxes"
PATHWISE = {
    "paper (reverse, linear)": Variant(PathwiseEstimator("reverse"), "linear", "ignored"),
    "linear": Variant(PathwiseEstimator(), "linear", "ignored"),
    "circular": Variant(PathwiseEstimator(), "circular", "ignored"),
    "linear, boxes": Variant(PathwiseEstimator(), "linear"),
    RELAXED: Variant(PathwiseEstimator()),
    "antithetic": Variant(PathwiseEstimator(antithetic=True)),
    "common backgrounds": Variant(PathwiseEstimator(common_backgrounds=True)),
    "straight-through": Variant(PathwiseEstimator(relaxation="straight_through")),
    "Gumbel-Rao": Variant(PathwiseEstimator(relaxation="gumbel_rao", conditional_draws=16)),
}


@dataclass
class Result:
    """One estimator on one world: estimates [repeats, objects, k] and seconds an object, by number of images."""

    estimates: dict[int, Tensor] = field(default_factory=dict)
    seconds: dict[int, float] = field(default_factory=dict)


def run_pathwise(
    world: FrozenLoop, estimator: PathwiseEstimator, units: int, seed: int
) -> tuple[Float[Tensor, "units objects k"], float]:
    """Estimates from ``UNIT`` images each, and the seconds an image took, drawing and rendering included.

    Images are independent, so that estimates from more images are means of these.
    """
    generator, found = torch.Generator().manual_seed(seed), []
    began = time.process_time()
    for _ in range(units):
        found.append(centred(world.pathwise(estimator, UNIT, generator)))
    return torch.stack(found), (time.process_time() - began) / (units * UNIT * len(world.psi))


def score(
    world: FrozenLoop,
    estimator: StratifiedEstimator | ReinforceEstimator,
    cached: CachedSet,
    drawn: Probes,
    label: int,
) -> MixedDerivative:
    """The estimate from the scores of some of the cached images, whose pixels it does not need."""
    count = len(drawn.index)
    still = torch.zeros(count)
    held = ObjectImages(
        world.psi[label].float(),
        world.scene.distribution,
        torch.zeros(count, 3, 1, 1),
        drawn.index,
        torch.full((count,), 1.0 / count),
        SceneDraw(still, still, still, drawn.bins[:, None]),
    )
    losses = Losses(cached.losses, unavailable, cached.losses)
    return estimator.estimate(losses, world.trainable, world.vector, held, {"pose": drawn})


def unavailable(*_: object) -> Tensor:
    raise AssertionError("an estimator asked for losses that it has no business with")


def pathwise_result(units: Tensor, seconds: float) -> Result:
    result = Result()
    for count in COUNTS:
        size = count // UNIT
        result.estimates[count] = units[: len(units) // size * size].unflatten(0, (-1, size)).mean(1)
        result.seconds[count] = seconds * count
    return result


def run_stratified(world: FrozenLoop, pool: int) -> dict[str, Result]:
    """Disjoint parts of ``pool`` images of every bin; as it is, and shrunk by its noise as the psi update does it."""
    began = time.process_time()
    probed = world.probes(pool, torch.Generator().manual_seed(31))
    seconds = (time.process_time() - began) / len(probed.cached)
    cached, probes = probed.cached, [part[world.factor.name] for part in probed.probes]
    bins, plain, shrunk = world.scene.distribution.size, Result(), Result()
    for count in COUNTS:
        per_bin, values, kept = count // bins, [], []
        began = time.process_time()
        for first in range(0, pool - per_bin + 1, per_bin):
            rows = (torch.arange(bins)[:, None] * pool + torch.arange(first, first + per_bin)).flatten()
            parts = [Probes(probe.index[rows], probe.bins[rows]) for probe in probes]
            found = [score(world, StratifiedEstimator(), cached, p, label) for label, p in enumerate(parts)]
            values.append(centred(found))
            noise = torch.stack([part.standard_error.square() for part in found])
            kept.append(values[-1] * shrinkage(values[-1], noise))
        spent = (time.process_time() - began) / (len(values) * len(probes))
        for result, estimates in ((plain, values), (shrunk, kept)):
            result.estimates[count] = torch.stack(estimates)
            result.seconds[count] = seconds * count + spent
    return {"stratified": plain, "stratified, shrunk": shrunk}


def run_reinforce(world: FrozenLoop, pool: int) -> Result:
    """Disjoint parts of ``pool`` hard draws of every object."""
    began = time.process_time()
    rendered = world.scene.training_set(world.psi, pool, torch.Generator().manual_seed(41))
    images, parts = rendered.images, rendered.objects
    cached = CachedSet.of(world.detector, world.backbone, images)
    seconds, result = (time.process_time() - began) / len(images), Result()
    for count in COUNTS:
        began, found = time.process_time(), []
        for first in range(0, pool - count + 1, count):
            rows = torch.arange(first, first + count)
            drawn = [Probes(label * pool + rows, part.draw.bins[rows, 0]) for label, part in enumerate(parts)]
            found.append(
                centred(
                    [score(world, ReinforceEstimator(), cached, p, label) for label, p in enumerate(drawn)]
                )
            )
        spent = (time.process_time() - began) / (len(found) * len(parts))
        result.estimates[count], result.seconds[count] = torch.stack(found), seconds * count + spent
    return result
