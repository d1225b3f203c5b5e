"""Effect of the Gumbel-softmax temperature on relaxed draws and on the pathwise derivative (Sec. A.3)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import torch
from annotated_types import Ge, MinLen
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor
from typing_extensions import override

from neural_sim.documents import markdown_table
from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.parameter.bins import BinNoise, gumbel
from neural_sim.parameter.factor import BinnedFactor
from neural_sim.ranges import Positive, validated
from neural_sim.report import figures
from neural_sim.report.figures import INK, METHOD_COLOURS, MUTED
from neural_sim.report.tracking import Run
from neural_sim.stages.stage import Stage
from neural_sim.studies.frozen_loop import FrozenLoop, centred, check_comparable, pathwise_of
from neural_sim.tasks.context import Context, Task

BIAS, SPREAD = METHOD_COLOURS["learned"], "#e08a1e"
LEAST = 1e-2
"""Lower limit of the figure, as a multiple of the norm of the derivative."""


@dataclass(frozen=True)
class AtTemperature:
    """One object at one temperature; all temperatures use the same noise.

    Attributes:
        object: the object's name.
        temperature: the temperature tau.
        frequencies: fraction of the relaxed draws in each bin.
        bias: |mean estimate - truth| in centred logits, corrected for the variances of both; 0 if these are larger.
        bias_error: standard error of ``bias``.
        spread: square root of one estimate's variance, summed over components.
        cosine: cosine between the mean estimate and the truth.
        images: number of images per estimate.
    """

    object: str
    temperature: float
    frequencies: list[float]
    bias: float
    bias_error: float
    spread: float
    cosine: float
    images: int


@dataclass(frozen=True)
class Truth:
    """One object's derivative over hard bins.

    Attributes:
        object: the object's name.
        length: norm of the derivative.
        noise: standard error of the derivative, as a norm.
        spread: the stratified estimator's spread with as many images as the estimates have.
        probabilities: p, the frequencies that draws should have.
    """

    object: str
    length: float
    noise: float
    spread: float
    probabilities: list[float]


@validated
@dataclass(frozen=True)
class Temperatures(Task):
    """``+experiment=gumbel_temperature``: compare derivatives at several temperatures with that over hard bins.

    Args:
        values: the temperatures tau.
        rounds: number of estimates at each tau, from ``outer.images_per_object`` images each.
        truth_per_bin: images per bin for the reference derivative.
        draws: number of relaxed draws for the frequencies of bins.
    """

    values: Annotated[tuple[Positive, ...], MinLen(1)] = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)
    rounds: Annotated[int, Ge(2)] = 8
    truth_per_bin: Annotated[int, Ge(2)] = 240
    draws: Annotated[int, Ge(2)] = 20_000

    @override
    def reads(self, context: Context) -> Iterable[Stage[Any]]:
        pathwise_of(context, "temperatures")
        check_comparable(context, "temperatures")
        return [context.graph.warm_start, context.graph.targets]

    @override
    def run(self, context: Context) -> None:
        seed, images = context.experiment.run.seed, context.experiment.loop.outer.images_per_object
        loop = FrozenLoop.of(context, seed)
        rows, truths = self.measure(loop, pathwise_of(context, "temperatures"), images, seed)
        print(f"adjoint solve: {loop.solve}")
        publish(context, rows, truths)

    def measure(
        self, loop: FrozenLoop, estimator: PathwiseEstimator, images: int, seed: int
    ) -> tuple[list[AtTemperature], list[Truth]]:
        """Compare estimates from ``images`` images at every temperature with the reference, object by object.

        Raises:
            ValueError: the reference of an object is 0, so that no error can be relative to it.
        """
        names, bins = loop.scene.names, loop.bins.bins
        hard = loop.truth(self.truth_per_bin, torch.Generator().manual_seed(seed))
        truth, errors = centred(hard), torch.stack([part.standard_error for part in hard])
        truths = [
            Truth(
                name,
                float(truth[label].norm()),
                float(errors[label].norm()),
                float(errors[label].norm()) * math.sqrt(self.truth_per_bin * bins / images),
                loop.bins.log_probabilities(loop.psi[label]).exp().tolist(),
            )
            for label, name in enumerate(names)
        ]
        if flat := [each.object for each in truths if each.length == 0.0]:
            raise ValueError(
                f"temperatures: the derivative of {', '.join(flat)} is 0, which has no direction to compare "
                f"estimates with (adjoint solve: {loop.solve})"
            )
        rows = []
        for value in self.values:
            moved = loop.with_factor(replace(loop.bins, temperature=value))
            generator = torch.Generator().manual_seed(seed + 1)  # the same noise at every temperature
            estimates = torch.stack(
                [centred(moved.pathwise(estimator, images, generator)) for _ in range(self.rounds)]
            )
            for label, name in enumerate(names):
                frequencies = bin_frequencies(moved.bins, moved.psi[label], self.draws, seed + 2)
                found = against(estimates[:, label], truth[label], errors[label])
                rows.append(AtTemperature(name, value, frequencies, *found, images))
        return rows, truths


def against(
    estimates: Float[Tensor, "rounds k"], truth: Float[Tensor, "k"], truth_errors: Float[Tensor, "k"]
) -> tuple[float, float, float, float]:
    """Return bias, standard error of the bias, spread and cosine of independent estimates, see ``AtTemperature``."""
    mean, variance = estimates.mean(0), estimates.var(0)
    off = mean - truth
    noise = variance / len(estimates) + truth_errors.square()
    bias = math.sqrt(max(0.0, float(off.square().sum() - noise.sum())))
    # The error of |off| is the noise in its direction or, if no bias is measurable, all of the noise.
    along = float((off.square() * noise).sum().sqrt() / off.norm().clamp_min(1e-30))
    error = along if bias > 0.0 else float(noise.sum().sqrt())
    cosine = float(mean @ truth / (mean.norm() * truth.norm()).clamp_min(1e-30))
    return bias, error, float(variance.sum().sqrt()), cosine


def bin_frequencies(factor: BinnedFactor, psi: Float[Tensor, "k"], draws: int, seed: int) -> list[float]:
    """Return the fraction of relaxed draws in each bin; a draw mixes the centres of the bins."""
    generator = torch.Generator().manual_seed(seed)
    noise = BinNoise(gumbel((draws, factor.bins), generator, torch.float64))
    middle = torch.full((draws,), 0.5, dtype=torch.float64)
    where = factor.bin_of(factor.relaxed(psi.double(), noise, middle)[0])
    return (torch.bincount(where, minlength=factor.bins) / draws).tolist()


def publish(context: Context, rows: Sequence[AtTemperature], truths: Sequence[Truth]) -> Run | None:
    """Write temperatures.json, temperatures.md and the figure, and log the curves over the temperatures to MLflow."""
    document = {
        "rows": [dataclasses.asdict(row) for row in rows],
        "truths": [dataclasses.asdict(truth) for truth in truths],
    }
    curves = {
        f"{truth.object}/{key}": [getattr(row, key) for row in rows if row.object == truth.object]
        for truth in truths
        for key in ("bias", "spread", "cosine")
    }
    drawn = {"temperatures": temperature_figure(rows, truths)}
    return context.publish(
        "temperatures", document, table(rows, truths), drawn, curves, {"method": "pathwise"}
    )


def table(rows: Sequence[AtTemperature], truths: Sequence[Truth]) -> str:
    """Return Markdown with errors relative to the norm of the reference."""
    parts = [
        f"Estimates of d/dpsi <dL_train/dtheta, v> from {rows[0].images} images each. Bias and spread are divided by "
        "the norm of the derivative over hard bins."
    ]
    head = ["temperature", "bias", "spread", "cosine of the mean", "overlap of draws and p"]
    for truth in truths:
        parts.append(
            f"**{truth.object}**: norm over hard bins {truth.length:.2g}, known to {truth.noise / truth.length:.0%}; "
            f"the stratified estimator has a spread of {truth.spread / truth.length:.2f}."
        )
        cells = [
            (
                f"{row.temperature:g}",
                f"{row.bias / truth.length:.2f} ± {row.bias_error / truth.length:.2f}",
                f"{row.spread / truth.length:.2f}",
                f"{row.cosine:.2f}",
                f"{agreement(row, truth):.0%}",
            )
            for row in rows
            if row.object == truth.object
        ]
        parts.append(markdown_table(head, cells))
    return "\n\n".join(parts)


def agreement(row: AtTemperature, truth: Truth) -> float:
    """Return 1 minus the total variation between the frequencies of relaxed draws and p."""
    return 1.0 - 0.5 * float(np.abs(np.subtract(row.frequencies, truth.probabilities)).sum())


def temperature_figure(rows: Sequence[AtTemperature], truths: Sequence[Truth]) -> Figure:
    """Draw for each object the bins of relaxed draws at every temperature next to p, and bias and spread below."""
    figure = Figure(figsize=(3.6 * len(truths) + 0.6, 5.6), layout="constrained")
    grid = figure.subplots(2, len(truths), squeeze=False)
    for column, truth in enumerate(truths):
        own = [row for row in rows if row.object == truth.object]
        _draw_frequencies(grid[0, column], own, truth)
        _draw_errors(grid[1, column], own, truth)
    grid[1, 0].set_ylabel("relative to the derivative over hard bins", color=INK, fontsize=8)
    figures.titled(figure, f"Gumbel-softmax: relaxed draws, and derivatives from {rows[0].images} of them")
    handles, labels = grid[1, 0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=2, frameon=False, fontsize=8, labelcolor=INK
    )
    return figure


def _draw_frequencies(axes: Any, rows: Sequence[AtTemperature], truth: Truth) -> None:
    values = np.array([*(row.frequencies for row in rows), truth.probabilities])
    axes.imshow(values, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    for (y, x), value in np.ndenumerate(values):
        if value >= 0.005:
            colour = "white" if value > 0.5 else INK
            axes.text(x, y, f"{100 * value:.0f}", ha="center", va="center", fontsize=7, color=colour)
    axes.axhline(len(rows) - 0.5, color="white", linewidth=3)
    axes.set_yticks(range(len(values)), [*(f"τ = {row.temperature:g}" for row in rows), "p"])
    axes.set_xticks(range(values.shape[1]), [str(number + 1) for number in range(values.shape[1])])
    axes.set_title(f"{truth.object}: draws by bin, %", color=INK, fontsize=9)
    figures.style(axes)
    axes.tick_params(length=0)


def _draw_errors(axes: Any, rows: Sequence[AtTemperature], truth: Truth) -> None:
    at = [row.temperature for row in rows]
    bias, error, spread = (
        np.array([getattr(row, key) for row in rows]) / truth.length
        for key in ("bias", "bias_error", "spread")
    )
    axes.plot(at, spread, "o-", color=SPREAD, markersize=4, label="spread of one estimate")
    reach = [np.minimum(error, np.maximum(bias - LEAST, 0.0)), error]
    axes.errorbar(
        at, np.maximum(bias, LEAST), yerr=reach, fmt="s", color=BIAS, markersize=4, capsize=2, label="bias"
    )
    axes.axhline(1.0, color=INK, linewidth=0.8, linestyle="--", label="norm of the derivative over hard bins")
    stratified = truth.spread / truth.length
    axes.axhline(
        stratified, color=MUTED, linewidth=0.8, linestyle=":", label="spread of the stratified estimator"
    )
    axes.set(xscale="log", yscale="log")
    axes.set_ylim(bottom=LEAST)
    axes.set_xlabel("temperature", color=INK, fontsize=8)
    figures.style(axes)
