"""Reads the target's boxes object by object with a trained classifier of bins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.baseline.label_shift.crops import Crops
from neural_sim.baseline.label_shift.evidence import FactorEstimate, Finding, Span, Strangeness
from neural_sim.baseline.label_shift.mixture import Cells, grouped, maximise, posterior, ratio_test
from neural_sim.baseline.label_shift.moments import Response, distance, matched, scattered
from neural_sim.baseline.label_shift.network import BinNetwork, Known, Outputs, calibrate, outputs_of
from neural_sim.baseline.label_shift.settings import LabelShift
from neural_sim.parameter.distributions import merged
from neural_sim.parameter.factor import Factor
from neural_sim.parameter.product import SceneDistribution

Bins = Sequence[Sequence[int]]
"""Groups of bins, numbered from 1, that look the same."""


@dataclass(frozen=True)
class Reader:
    """A trained network, and what it was trained on and is to read.

    Attributes:
        settings: how.
        distribution: p_psi.
        network: the classifier.
        training: crops that it was trained on.
        held: crops of other renders.
        target: the target's.
        generator: of everything that is drawn.
    """

    settings: LabelShift
    distribution: SceneDistribution
    network: BinNetwork
    training: Known
    held: Known
    target: Crops
    generator: torch.Generator

    def read(
        self, label: int, name: str, psi: Float[Tensor, "K"], groups: Mapping[str, Bins]
    ) -> tuple[list[FactorEstimate], Float[Tensor, "K"]]:
        """Return the estimates of an object's factors, and its psi with what moves moved."""
        training, held = (known.select(known.crops.labels == label) for known in (self.training, self.held))
        seen = outputs_of(self.network, self.target.select(self.target.labels == label))
        known = outputs_of(self.network, held.crops)
        strange = 1.0  # where no render shows the object
        if len(training.crops) and len(held.crops):
            limits = Strangeness.of(outputs_of(self.network, training.crops).features, training.cells)
            strange = limits.part_above(0.95, known.features, seen.features)
        object_ = _Object(self, name, self.distribution.split(psi), groups, held, known, seen, strange)
        new = dict(object_.psi)
        for one in object_.found:
            if one.finding == "moves":
                factor = self.distribution.factor(one.factor)
                new[one.factor] = factor.project(
                    factor.psi_of(torch.tensor(one.p, dtype=torch.float64), factor.closed(name))
                )
        return object_.found, self.distribution.join(new)


@dataclass(frozen=True)
class _Object:
    """One object: ``psi`` by factor, what is ``known`` of held-out renders and ``seen`` of the target's boxes."""

    reader: Reader
    name: str
    psi: Mapping[str, Tensor]
    groups: Mapping[str, Bins]
    held: Known
    known: Outputs
    seen: Outputs
    strange: float

    @cached_property
    def found(self) -> list[FactorEstimate]:
        """The estimates, in the order of the factors."""
        distribution = self.reader.distribution
        binned = self._binned() if distribution.binned else {}
        return [
            binned[factor.name] if factor.name in binned else self._light(factor)
            for factor in distribution.factors
        ]

    def _estimate(
        self, factor: str, span: Span, groups: Bins, p_value: float, accuracy: float | None = None
    ) -> FactorEstimate:
        settings, boxes = self.reader.settings, len(self.seen)
        finding: Finding = "moves" if p_value <= settings.level else "stays"
        if self.strange > settings.strange:
            finding = "fits no render"
        if boxes < settings.fewest:
            finding = "too few boxes"
        own = tuple(tuple(group) for group in groups)
        start = tuple(self.reader.distribution.factor(factor).p_of(self.psi[factor]).tolist())
        return FactorEstimate(
            self.name,
            factor,
            boxes,
            start,
            span.p,
            span.low,
            span.high,
            own,
            p_value,
            self.strange,
            accuracy,
            finding,
        )

    def _binned(self) -> dict[str, FactorEstimate]:
        """Estimate the distributions of all factors with bins together: boxes are a mixture of their combinations."""
        settings, generator = self.reader.settings, self.reader.generator
        factors = self.reader.distribution.binned
        every = Cells(tuple(factor.bins for factor in factors))
        groups = [self.groups.get(f.name) or [[b + 1] for b in range(f.bins)] for f in factors]
        p_now = [f.p_of(self.psi[f.name]).double() for f in factors]
        within = [_within(p, own) for p, own in zip(p_now, groups, strict=True)]
        cells = Cells(tuple(len(own) for own in groups))
        temperature, bias = calibrate(self.known.logits, self.held.cells)
        seen, held = (
            grouped((outputs.logits / temperature + bias).softmax(-1), every, within)
            for outputs in (self.seen, self.known)
        )
        bins = zip(groups, every.bins(self.held.cells), strict=True)
        truth = cells.index(torch.stack([_group_of(own)[b] for own, b in bins], 1))
        p = maximise(seen, cells, settings.prior).p
        drawn = posterior(seen, cells, settings.prior, generator)
        told, true = cells.bins(held.argmax(-1)), cells.bins(truth)
        found = {}
        for i, factor in enumerate(factors):
            null, p_value = {i: merged(p_now[i], groups[i])}, 1.0
            if len(seen) and len(held) and cells.sizes[i] > 1:
                p_value = ratio_test(
                    seen, cells, null, (held, truth), settings.prior, settings.draws, generator
                )
            span = Span.of(p[i] @ within[i].T, drawn[i] @ within[i].T, settings.interval)
            accuracy = float((told[i] == true[i]).double().mean())
            found[factor.name] = self._estimate(factor.name, span, groups[i], p_value, accuracy)
        return found

    def _light(self, factor: Factor) -> FactorEstimate:
        """Estimate the weights of the lights by the mean of the network's guesses."""
        settings, generator = self.reader.settings, self.reader.generator
        response = Response.of(self.known.weights, self.held.weights.double())
        now, boxes = self.psi[factor.name].double(), len(self.seen)
        each = [[b] for b in range(1, factor.lights + 1)]
        if not boxes:
            return self._estimate(factor.name, Span.of(now, now[None], settings.interval), each, 1.0)
        mean, covariance = self.seen.weights.mean(0), response.covariance(boxes, now)

        def weights(means: Tensor) -> Tensor:
            return matched(means, response.slope, covariance, factor.project)

        def statistic(means: Tensor) -> Tensor:
            nearest = distance(means, weights(means), response.slope, covariance)
            return distance(means, now, response.slope, covariance) - nearest

        under = scattered(response.slope @ now, covariance, settings.draws, generator)
        p_value = (1 + int((statistic(under) >= statistic(mean)).sum())) / (settings.draws + 1)
        best = weights(mean)
        drawn = weights(scattered(mean, response.covariance(boxes, best), settings.draws, generator))
        return self._estimate(factor.name, Span.of(best, drawn, settings.interval), each, p_value)


def _group_of(groups: Bins) -> Int[Tensor, "k"]:
    """Return the position of every bin's group."""
    found = torch.zeros(sum(len(group) for group in groups), dtype=torch.long)
    for g, group in enumerate(groups):
        found[torch.tensor(group) - 1] = g
    return found


def _within(p: Float[Tensor, "k"], groups: Bins) -> Float[Tensor, "k g"]:
    """Return the distribution over the bins of every group, in its column, as ``p`` has it."""
    matrix = torch.zeros(len(p), len(groups), dtype=torch.float64)
    for g, group in enumerate(groups):
        rows = torch.tensor(group) - 1
        matrix[rows, g] = p[rows] / p[rows].sum()
    return matrix
