"""The hypergradient of the training that was run, by each adjoint, against the response of training.

The response (:mod:`outer.response`) repeats the training with part of an object's images moved to one bin, under common
random numbers, and takes no derivative. Derivatives are compared with it as vectors over an object's bins.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import combinations
from statistics import fmean

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.outer.module import SimulatorModule
from neural_sim.outer.response import centred_cosine, response
from neural_sim.outer.settings import Outer
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.solver.direct import Identity
from neural_sim.studies.work_precision.series import Point, Series, Timing
from neural_sim.studies.work_precision.world import World

Slopes = Float[Tensor, "objects K"]
DEFAULT = "unrolled, as configured"


@dataclass(frozen=True)
class Way:
    """An adjoint: the loop's settings and the solver, and the line of the figure that it is on."""

    line: str
    outer: Outer
    solver: AdjointSolver


def ways(outer: Outer, solver: AdjointSolver) -> dict[str, Way]:
    """Return every adjoint by name, as changes of the loop's own settings."""

    def unrolled(line: str, **changed: object) -> Way:
        how = replace(outer.unrolled, **changed)  # pyright: ignore[reportArgumentType]
        return Way(line, replace(outer, adjoint="unrolled", unrolled=how), solver)

    implicit = replace(outer, adjoint="implicit")
    everything: dict[str, object] = {"probes_per_step": 0, "scored_steps": 0}
    return {
        DEFAULT: unrolled("unrolled"),
        "unrolled, central differences": unrolled("product", product="central_difference"),
        "unrolled, exact products": unrolled("product", product="reverse_over_reverse"),
        "unrolled, 1 probe every step": unrolled("probes", probes_per_step=1, scored_steps=0),
        "unrolled, all probes every step": unrolled("probes", **everything),
        "unrolled, exact: no floor": unrolled("floor", floor=0.0),
        "unrolled, last half of the steps": unrolled("part", part=0.5),
        "unrolled, last quarter": unrolled("part", part=0.25),
        "implicit, as configured": Way("implicit", implicit, solver),
        "implicit, all images, rtol 1e-3": Way(
            "implicit", replace(implicit, curvature_images=0), replace(solver, rtol=1e-3)
        ),
        "first order: dL_val/dtheta alone": Way("first order", implicit, replace(solver, linear=Identity())),
    }


@dataclass(frozen=True)
class Hypergradients:
    """The family ``hypergradient``.

    Args:
        trainings: seeds of the training whose derivative is taken.
        solver: of the implicit ways, the project's own.

    Raises:
        ValueError: fewer than one training.
    """

    trainings: int = 2
    solver: AdjointSolver = field(default_factory=AdjointSolver)

    def __post_init__(self) -> None:
        if self.trainings < 1:
            raise ValueError(
                f"work_precision.hypergradient.trainings must be at least 1, got {self.trainings}"
            )

    def measure(self, world: World, timing: Timing, seed: int) -> Iterator[Series]:
        """At the loop's first psi; 1 - correlation over an object's bins, mean over objects and trainings."""
        del timing  # a hypergradient notes its own time
        named, truths = ways(world.outer, self.solver), []
        rows: dict[str, list[tuple[float, float]]] = {name: [] for name in named}
        for repeat in range(self.trainings):
            loop = world.simulator(world.outer, self.solver, 1_000 * seed + repeat)
            truth = response(loop.inner, loop.psi.detach()).value
            truths.append(truth)
            for name, way in named.items():
                found, seconds = slopes(loop, way)
                # A correlation of 1 may be rounded beyond it.
                rows[name].append((max(0.0, 1.0 - correlation(found, truth)), seconds))
        both = [correlation(a, b) for a, b in combinations(truths, 2)]
        again = f"; the responses of two trainings correlate by {fmean(both):.2f}" if both else ""
        points = tuple(
            Point(name, fmean(error for error, _ in found), fmean(spent for _, spent in found), None, name == DEFAULT,
                  named[name].line, _spread([error for error, _ in found]))
            for name, found in rows.items()
        )  # fmt: skip
        note = (
            f"{', '.join(world.names)} at the loop's start, {self.trainings} training(s); against the response of "
            f"training, by bins{again}. Seconds on the wall, without the training itself."
        )
        yield Series(
            "hypergradient/of a training", "1 - correlation with the response", points, (), note, "seconds"
        )


def slopes(loop: SimulatorModule, way: Way) -> tuple[Slopes, float]:
    """Return the rise of objects' scores by the part of their images that moves to each bin; the derivative's seconds.

    Images, training and probes are the same for all ways: the loop's common random numbers, and its generator anew.
    """
    inner = copy.copy(loop.inner)
    inner.settings, inner.generator = (
        way.outer,
        torch.Generator().manual_seed(loop.inner.generator.initial_seed()),
    )
    other = SimulatorModule(inner, loop.psi.detach().clone(), loop.estimator, way.solver)
    found = other.derivative()
    p = torch.cat([*loop.scene.distribution.probabilities(loop.psi.detach()).values()], -1)
    slope = torch.stack([found.psi_gradients[name] for name in loop.scene.names])
    return -slope / p, sum(found.seconds.values())


def correlation(found: Slopes, truth: Slopes) -> float:
    """Return the correlation over each object's bins, mean over objects; 0 for an object where either vanishes."""
    each = [centred_cosine(a, b) for a, b in zip(found, truth, strict=True)]
    return fmean(0.0 if math.isnan(value) else value for value in each)


def _spread(errors: list[float]) -> str:
    return f"{min(errors):.2f} to {max(errors):.2f}" if len(errors) > 1 else ""
