"""The hypergradient of the training that was run, by every adjoint, compared with the response of training.

The response (``outer.response``) is a finite difference: it repeats the training with a fraction of an object's images
moved to one bin, under common random numbers. It and the derivatives are compared as vectors over an object's bins.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from statistics import fmean
from typing import Annotated, Literal

import torch
from annotated_types import MinLen
from jaxtyping import Float
from torch import Tensor

from neural_sim.gradient.implicit import Implicit
from neural_sim.gradient.unrolled import Unrolled
from neural_sim.outer.module import SimulatorModule
from neural_sim.outer.response import centred_cosine, response
from neural_sim.outer.settings import Outer
from neural_sim.ranges import PositiveInt, validated
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.solver.direct import Identity
from neural_sim.studies.frozen_loop import relative_error
from neural_sim.studies.work_precision.measurement import Point, Series, Timing, World

_log = logging.getLogger(__name__)
Slopes = Float[Tensor, "objects K"]
Place = Literal["start", "first_step", "end"]
"""Places in a psi loop: the start, after the first step that moved psi, and the end."""
DEFAULT = "unrolled, as configured"
EXACT = "unrolled, exact products, all probes every step"


@dataclass(frozen=True)
class Way:
    """An adjoint, as settings of the loop and the solver, and its line in the figure."""

    line: str
    outer: Outer
    solver: AdjointSolver


def ways(outer: Outer, solver: AdjointSolver) -> dict[str, Way]:
    """Return every adjoint by name, as changes to the configured settings."""

    def unrolled(line: str, **changed: object) -> Way:
        own = outer.adjoint if isinstance(outer.adjoint, Unrolled) else Unrolled()
        how = replace(own, **changed)  # pyright: ignore[reportArgumentType]
        return Way(line, replace(outer, adjoint=how), solver)

    implicit = replace(outer, adjoint=Implicit())
    everything: dict[str, object] = {"probes_per_step": 0, "scored_steps": 0}
    return {
        DEFAULT: unrolled("unrolled"),
        "unrolled, central differences": unrolled("product", product="central_difference"),
        "unrolled, exact products": unrolled("product", product="reverse_over_reverse"),
        "unrolled, 1 probe every step": unrolled("probes", probes_per_step=1, scored_steps=0),
        "unrolled, all probes every step": unrolled("probes", **everything),
        EXACT: unrolled("exact", product="reverse_over_reverse", **everything),
        "unrolled, exact: no floor": unrolled("floor", floor=0.0),
        "implicit, as configured": Way("implicit", implicit, solver),
        "implicit, all images, rtol 1e-3": Way(
            "implicit", replace(outer, adjoint=Implicit(curvature_images=0)), replace(solver, rtol=1e-3)
        ),
        "first order: dL_val/dtheta alone": Way("first order", implicit, replace(solver, linear=Identity())),
    }


@validated
@dataclass(frozen=True)
class Hypergradients:
    """The family ``hypergradient``.

    Args:
        trainings: number of trainings, each with its own seed, whose derivatives are taken.
        solver: the default solver, for implicit adjoints.
        places: places in the psi loop; for all but the start, the loop is run first.
    """

    trainings: PositiveInt = 2
    solver: AdjointSolver = field(default_factory=AdjointSolver)
    places: Annotated[Sequence[Place], MinLen(1)] = ("start",)

    @property
    def after_start(self) -> bool:
        """True if the loop has to be run first."""
        return any(place != "start" for place in self.places)

    def measure(self, world: World, timing: Timing, seed: int) -> Iterator[Series]:
        """Measure at every place that the loop reaches."""
        del timing  # a hypergradient records its own time
        for place in self.places:
            psi = None if place == "start" else world.visited.get(place)
            if psi is None and place != "start":
                _log.warning("work_precision.hypergradient.places: no step moved psi, %s is left out", place)
                continue
            yield from self._at(place, psi, world, seed)

    def _at(self, place: Place, psi: Slopes | None, world: World, seed: int) -> Iterator[Series]:
        """Compare every way with the response of the same training, and the unrolled ones with the exact derivative."""
        named, truths = ways(world.outer, self.solver), []
        responses: dict[str, list[tuple[float, float]]] = {name: [] for name in named}
        exact: dict[str, list[tuple[float, float]]] = {
            name: [] for name in named if name.startswith("unrolled")
        }
        for repeat in range(self.trainings):
            loop = world.simulator(world.outer, self.solver, 1_000 * seed + repeat, psi)
            truth = response(loop.inner, loop.psi.detach(), loop.numbers).value
            truths.append(truth)
            found = {name: slopes(loop, way) for name, way in named.items()}
            for name, (value, seconds) in found.items():
                # Rounding may push a correlation beyond 1.
                responses[name].append((max(0.0, 1.0 - correlation(value, truth)), seconds))
                if name in exact:
                    exact[name].append((centred_error(value, found[EXACT][0]), seconds))
        both = [correlation(a, b) for a, b in combinations(truths, 2)]
        again = f"; the responses of two trainings correlate by {fmean(both):.2f}" if both else ""
        where = (
            f"{', '.join(world.names)} at the loop's {place.replace('_', ' ')}, {self.trainings} training(s)"
        )
        seconds = "Wall-clock seconds, without the training itself."
        more = "" if place == "start" else f", {place.replace('_', ' ')}"
        yield Series(
            f"hypergradient/of a training{more}", "1 - correlation with the response", _points(responses, named), (),
            f"{where}; compared over bins with the response of training{again}. {seconds}", "seconds",
        )  # fmt: skip
        yield Series(
            f"hypergradient/unrolled{more}", "relative error of the derivative", _points(exact, named), (),
            f"{where}; compared with exact Hessian products of all probes in every step. {seconds}", "seconds",
        )  # fmt: skip


def _points(
    found: Mapping[str, Sequence[tuple[float, float]]], named: Mapping[str, Way]
) -> tuple[Point, ...]:
    """Return the mean error and the mean seconds of every way."""
    return tuple(
        Point(name, fmean(error for error, _ in rows), fmean(spent for _, spent in rows), None, name == DEFAULT,
              named[name].line, _spread([error for error, _ in rows]))
        for name, rows in found.items()
    )  # fmt: skip


def slopes(loop: SimulatorModule, way: Way) -> tuple[Slopes, float]:
    """Return slopes of scores in the fraction of images that is moved to each bin, and the seconds they took.

    All ways have the same images, training and probes, because random numbers are common and generators start alike.
    """
    generator = torch.Generator().manual_seed(loop.numbers.generator.initial_seed())
    inner = replace(loop.inner, settings=way.outer)
    other = SimulatorModule(inner, loop.psi.detach().clone(), loop.estimator, way.solver, generator)
    found = other.derivative()
    p = torch.cat([*loop.scene.distribution.probabilities(loop.psi.detach()).values()], -1)
    slope = torch.stack([found.gradients[name] for name in loop.scene.names])
    return -slope / p, sum(found.seconds.values())


def centred_error(found: Slopes, truth: Slopes) -> float:
    """Return |found - truth| / |truth| after subtracting the mean over each object's bins."""
    value, wanted = ((each - each.mean(-1, keepdim=True)).flatten() for each in (found, truth))
    return float(relative_error(value, wanted))


def correlation(found: Slopes, truth: Slopes) -> float:
    """Return the mean over objects of the correlation over bins, which is 0 where either one's slopes are equal."""
    each = [centred_cosine(a, b) for a, b in zip(found, truth, strict=True)]
    return fmean(0.0 if math.isnan(value) else value for value in each)


def _spread(errors: list[float]) -> str:
    return f"{min(errors):.2f} to {max(errors):.2f}" if len(errors) > 1 else ""
