"""Estimate psi from the target's boxes, object by object, with a trained classifier of bins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from neural_sim.baseline.label_shift.calibration import BoxReader, calibrate
from neural_sim.baseline.label_shift.comparison import Templates
from neural_sim.baseline.label_shift.crops import SIZE, Crops, quarters
from neural_sim.baseline.label_shift.evidence import (
    MOVING,
    FactorEstimate,
    Finding,
    Span,
    Strangeness,
    part_farther,
)
from neural_sim.baseline.label_shift.mixture import Cells, Status, grouped, maximise, posterior, ratio_test
from neural_sim.baseline.label_shift.moments import Response, distance, fitted, matched, scattered
from neural_sim.baseline.label_shift.network import BinNetwork, Known, Outputs, outputs_of
from neural_sim.baseline.label_shift.settings import LabelShift
from neural_sim.parameter.distributions import merged
from neural_sim.parameter.factor import Factor
from neural_sim.parameter.product import SceneDistribution
from neural_sim.synthesis.pool import PooledSubject
from neural_sim.synthesis.scene import Scene

Bins = Sequence[Sequence[int]]
"""Groups of bins, numbered from 1, that look the same."""
NEVER = -1e3
"""Logit of a cell that is never drawn; finite, because calibration multiplies it by a weight."""
BEYOND_ALL = 0.995
"""Limit of ``strange`` if psi has lights only: all boxes share one light, so either all of them are strange or none."""
CALIBRATIONS = 20
"""Number of bootstrap samples of the held-out renders. Calibrations on these scatter as much as one of them errs."""


@dataclass(frozen=True)
class Reader:
    """A trained network, with the crops that it was trained on, those held out, and those of the target.

    Attributes:
        settings: settings of the estimate.
        distribution: p_psi.
        network: the classifier; untrained if the reader ``compares``.
        renders: renders without background, of which ``training`` is composed; None if whole images are read.
        training: crops on which it was trained.
        held: crops of held-out renders.
        target: crops of the target.
        views: which view each of them shows; see ``views_of``.
        generator: the source of all random numbers.
    """

    settings: LabelShift
    distribution: SceneDistribution
    network: BinNetwork
    renders: Scene | None
    training: Known
    held: Known
    target: Crops
    views: Int[Tensor, "boxes"]
    generator: torch.Generator

    def read(
        self, label: int, name: str, psi: Float[Tensor, "K"], groups: Mapping[str, Bins]
    ) -> tuple[list[FactorEstimate], Float[Tensor, "K"]]:
        """Return the estimates of an object's factors, and its psi, in which estimates replace factors that move."""
        object_ = self._object(label, name, psi, groups)
        found, new = object_.found(), dict(object_.psi)
        for one in found:
            if one.finding in MOVING:
                factor = self.distribution.factor(one.factor)
                new[one.factor] = factor.project(
                    factor.psi_of(torch.tensor(one.p, dtype=torch.float64), factor.closed(name))
                )
        return found, self.distribution.join(new)

    def posteriors(
        self, label: int, psi: Float[Tensor, "K"]
    ) -> tuple[Float[Tensor, "views cells"], Float[Tensor, "held cells"], Int[Tensor, "held"]]:
        """Return calibrated posteriors of an object's views and held-out renders, and the true cells of the latter."""
        object_ = self._object(label, "", psi, {})
        return *object_.posteriors, object_.held.cells

    def _object(self, label: int, name: str, psi: Float[Tensor, "K"], groups: Mapping[str, Bins]) -> _Object:
        now = self.distribution.split(psi)
        drawn = _drawn(self.distribution, now)
        training, held = (
            known.select((known.crops.labels == label) & drawn[known.cells])
            for known in (self.training, self.held)
        )
        mine = self.target.labels == label
        templates = self._templates(label)
        compared = templates is not None and self.compares
        seen, known = (
            self._guessed(training, templates, crops, drawn)
            for crops in (self.target.select(mine), held.crops)
        )
        limits = None  # stays None if no render shows the object
        if len(training.crops) and len(held.crops):
            features = outputs_of(self.network, training.crops).features
            limits = Strangeness.of(features, training.cells, training.weights.double())
        boxes, seen = len(seen), seen.averaged(self.views[mine])
        return _Object(self, name, now, groups, held, known, seen, boxes, limits, compared)

    @property
    def compares(self) -> bool:
        """True on photographs if psi has only poses: boxes are compared with renders, and nothing else reads them."""
        angles = all(factor.coordinate in ("phi", "rho") for factor in self.distribution.binned)
        poses = angles and not self.distribution.lights
        return bool(self.settings.photographs) and poses and self.renders is not None

    def _templates(self, label: int) -> Templates | None:
        """Return the templates of an object; None without boxes, without a pose, or if no render shows the object."""
        if self.renders is None or self._poses is None:
            return None
        subject = self.renders.subjects[label]
        assert isinstance(subject, PooledSubject)
        return Templates.of(subject, self._poses, self.settings.augmentation.largest_roll_deg)

    @property
    def _poses(self) -> Int[Tensor, "cells"] | None:
        """Pose of each cell: the combination of its bins of angles; None if psi has none."""
        factors = self.distribution.binned
        angles = [factor.coordinate in ("phi", "rho") for factor in factors]
        if not any(angles):
            return None
        cells = Cells(tuple(factor.bins for factor in factors))
        bins = zip(cells.bins(torch.arange(cells.count)), angles, strict=True)
        own = torch.stack([chosen for chosen, angle in bins if angle], 1)
        sizes = tuple(factor.bins for factor, angle in zip(factors, angles, strict=True) if angle)
        return Cells(sizes).index(own)

    def _guessed(
        self, training: Known, templates: Templates | None, crops: Crops, drawn: Bool[Tensor, "cells"]
    ) -> Outputs:
        """Return the network's outputs, with logits from boxes and templates, and weights of lights from colours."""
        outputs = outputs_of(self.network, crops)
        logits, weights = [outputs.logits], [outputs.weights]
        if self.distribution.binned and len(training.crops):
            cells = Cells(tuple(factor.bins for factor in self.distribution.binned))
            own, others = (each.boxes[:, SIZE] for each in (training.crops, crops))
            logits.append(BoxReader.fitted(own, training.cells, cells)(others))
        poses = self._poses
        if templates is not None and poses is not None:
            scores = templates(crops, int(poses.max()) + 1)[:, poses]
            logits = [scores] if self.compares else [*logits, scores]
        if self.distribution.lights:
            own, others = (quarters(each).double() for each in (training.crops, crops))
            weights.append(fitted(own, training.weights.double(), others))
        guesses = torch.stack(logits).masked_fill(~drawn, NEVER)
        return replace(outputs, logits=guesses, weights=torch.cat(weights, 1))


@dataclass(frozen=True)
class _Read:
    """The estimate of one factor with its intervals, the groups of bins that look the same, and the evidence."""

    span: Span
    groups: Bins
    p_value: float
    accuracy: float
    chance: float
    converged: bool = True


@dataclass(frozen=True)
class _Object:
    """One object, with its ``psi`` by factor.

    ``known`` are the outputs for its held-out renders (``held``), ``seen`` those for the views that the target's
    ``boxes`` show. ``compared``: their logits are scores of the comparison with renders alone.
    """

    reader: Reader
    name: str
    psi: Mapping[str, Tensor]
    groups: Mapping[str, Bins]
    held: Known
    known: Outputs
    seen: Outputs
    boxes: int
    limits: Strangeness | None
    compared: bool = False

    @property
    def posteriors(self) -> tuple[Float[Tensor, "boxes cells"], Float[Tensor, "held cells"]]:
        """Calibrated posteriors of the boxes and of the held-out renders."""
        calibrated = calibrate(self.known.logits, self.held.cells)
        return calibrated(self.seen.logits)[0], calibrated(self.known.logits)[0]

    def found(self) -> list[FactorEstimate]:
        """Estimate the factors, in their order."""
        distribution = self.reader.distribution
        read: dict[str, _Read] = {}
        frequency = torch.ones(len(self.held.cells), dtype=torch.float64)
        weights = torch.zeros(0, dtype=torch.float64)
        if distribution.binned:
            read, frequency = self._binned()
        for factor in distribution.factors:
            if factor.name not in read:
                read[factor.name] = self._light(factor)
                weights = torch.tensor(read[factor.name].span.p, dtype=torch.float64)
        strange = 1.0 if self.limits is None else self._strange(self.limits, weights, frequency)
        return [self._judged(factor, read[factor.name], strange) for factor in distribution.factors]

    def _strange(
        self, limits: Strangeness, weights: Float[Tensor, "lights"], frequency: Float[Tensor, "held"]
    ) -> float:
        """Compare the boxes with held-out renders.

        They are compared by the network's features; if psi has lights only, by guesses of their weights; and if logits
        are scores of a comparison, by the best score.
        """
        if self.compared:
            seen, known = (-each.logits[0].amax(-1) for each in (self.seen, self.known))
            return part_farther(seen, known, frequency)
        lights = [f for f in self.reader.distribution.factors if f not in self.reader.distribution.binned]
        if len(lights) == len(self.reader.distribution.factors):
            response = Response.of(self.known.weights, self.held.weights.double())
            seen, known = (
                response.misfits(each.weights, lights[0].project) for each in (self.seen, self.known)
            )
        else:
            seen = limits(self.seen.features, weights)
            known = limits(self.known.features, self.held.weights.double())
        return part_farther(seen, known, frequency)

    def _judged(self, factor: Factor, read: _Read, strange: float) -> FactorEstimate:
        settings, boxes = self.reader.settings, len(self.seen)
        finding: Finding = "moves" if read.p_value <= settings.level else "stays"
        if finding == "moves" and read.span.doubt > settings.doubt:
            finding = "nearer" if read.span.doubt <= settings.nearer * read.span.apart else "uncertain"
        if not read.converged or read.accuracy - read.chance < settings.skill * (1.0 - read.chance):
            finding = "not told apart"
        if strange > (settings.strange if self.reader.distribution.binned else BEYOND_ALL):
            finding = "fits no render"
        if boxes < settings.fewest:
            finding = "too few boxes"
        own = tuple(tuple(group) for group in read.groups)
        start = tuple(factor.p_of(self.psi[factor.name]).tolist())
        span = read.span
        return FactorEstimate(
            self.name, factor.name, boxes, start, span.p, span.low, span.high, own, read.p_value, strange,
            read.accuracy, finding, read.chance, span.doubt, span.apart, read.converged, factor.lights > 0,
            self.boxes - boxes,
        )  # fmt: skip

    def _binned(self) -> tuple[dict[str, _Read], Float[Tensor, "held"]]:
        """Estimate all factors with bins together: boxes are a mixture of combinations of their bins.

        Returns:
            The estimates by factor, and weights with which held-out renders show each cell as often as the boxes do.
        """
        settings, generator = self.reader.settings, self.reader.generator
        factors = self.reader.distribution.binned
        every = Cells(tuple(factor.bins for factor in factors))
        p_now = [f.p_of(self.psi[f.name]).double() for f in factors]
        groups = [
            _drawn_groups(p, self.groups.get(f.name) or [[b + 1] for b in range(f.bins)])
            for p, f in zip(p_now, factors, strict=True)
        ]
        within = [_within(p, own) for p, own in zip(p_now, groups, strict=True)]
        cells = Cells(tuple(len(own) for own in groups))
        seen, held = (grouped(each, every, within) for each in self.posteriors)
        bins = zip(groups, every.sizes, every.bins(self.held.cells), strict=True)
        truth = cells.index(torch.stack([_group_of(own, size)[b] for own, size, b in bins], 1))
        best = maximise(seen, cells, settings.prior)
        drawn = posterior(self._recalibrated(every, within), cells, settings.prior, generator)
        told, true = cells.bins(held.argmax(-1)), cells.bins(truth)
        found = {}
        for i, factor in enumerate(factors):
            null, p_value = {i: merged(p_now[i], groups[i])}, 1.0
            if len(seen) and len(held) and cells.sizes[i] > 1:
                p_value = ratio_test(
                    seen, cells, null, (held, truth), settings.prior, settings.draws, generator
                )
            span = Span.of(best.p[i] @ within[i].T, drawn[i] @ within[i].T, p_now[i], settings.interval)
            accuracy = float((told[i] == true[i]).double().mean()) if len(held) else 0.0
            lengths = [len(group) for group in groups[i]]
            chance = max(lengths) / sum(lengths)
            converged = best.status is Status.CONVERGED
            found[factor.name] = _Read(span, groups[i], p_value, accuracy, chance, converged)
        counts = torch.bincount(truth, minlength=cells.count).clamp_min(1)
        return found, (cells.joint(best.p) / counts)[truth]

    def _recalibrated(
        self, every: Cells, within: Sequence[Float[Tensor, "_ _"]]
    ) -> Float[Tensor, "samples boxes merged"]:
        """Compute the boxes' likelihoods with the calibration of each sample of the held-out renders."""
        renders, generator = len(self.held.cells), self.reader.generator
        drawn = torch.randint(max(renders, 1), (CALIBRATIONS, renders), generator=generator)
        samples = torch.zeros(CALIBRATIONS, renders).scatter_add_(1, drawn, torch.ones(drawn.shape))
        posteriors = calibrate(self.known.logits, self.held.cells, samples)(self.seen.logits)
        return grouped(posteriors.flatten(0, 1), every, within).unflatten(0, posteriors.shape[:2])

    def _light(self, factor: Factor) -> _Read:
        """Estimate the weights of the lights from the mean of all boxes' guesses."""
        settings, generator = self.reader.settings, self.reader.generator
        now, boxes = self.psi[factor.name].double(), len(self.seen)
        each = [[b] for b in range(1, factor.lights + 1)]
        unread = Span.of(now, now[None], now, settings.interval)
        if not len(self.held.cells):
            return _Read(unread, each, 1.0, 0.0, 0.0)
        response = Response.of(self.known.weights, self.held.weights.double())
        if not boxes:
            return _Read(unread, each, 1.0, response.explained, 0.0)
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
        span = Span.of(best, drawn, now, settings.interval)
        return _Read(span, each, p_value, response.explained, 0.0)


def _drawn(distribution: SceneDistribution, psi: Mapping[str, Tensor]) -> Bool[Tensor, "cells"]:
    """Select the combinations of bins that are drawn at all; bins that no photograph of the object shows are not."""
    parts = tuple((factor.p_of(psi[factor.name]) > 0.0).double() for factor in distribution.binned)
    if not parts:
        return torch.ones(1, dtype=torch.bool)
    return Cells(tuple(len(part) for part in parts)).joint(parts) > 0.0


def _drawn_groups(p: Float[Tensor, "k"], groups: Bins) -> Bins:
    """Leave out bins with probability 0, which no photograph of the object shows."""
    left = ([number for number in group if float(p[number - 1]) > 0.0] for group in groups)
    return [group for group in left if group]


def _group_of(groups: Bins, bins: int) -> Int[Tensor, "k"]:
    """Return the index of every bin's group; 0 for bins in none."""
    found = torch.zeros(bins, dtype=torch.long)
    for g, group in enumerate(groups):
        found[torch.tensor(group) - 1] = g
    return found


def _within(p: Float[Tensor, "k"], groups: Bins) -> Float[Tensor, "k g"]:
    """Return the distribution ``p`` within each group, as one column over all bins."""
    matrix = torch.zeros(len(p), len(groups), dtype=torch.float64)
    for g, group in enumerate(groups):
        rows = torch.tensor(group) - 1
        matrix[rows, g] = p[rows] / p[rows].sum()
    return matrix
