"""p_psi as a table of sampling weights, for other renderers."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from typing import Any

from jaxtyping import Float
from torch import Tensor

from neural_sim.parameter.factor import BinnedFactor
from neural_sim.parameter.product import SceneDistribution

COLUMNS = ("object", "factor", "coordinate", "unit", "spacing", "bin", "low", "high", "weight")


def psi_rows(
    distribution: SceneDistribution, psi: Float[Tensor, "objects K"], names: Sequence[str]
) -> list[dict[str, Any]]:
    """Tabulate every bin of every object, counted from 1.

    To draw, choose a bin of each factor by its weight, then a number between ``low`` and ``high``, uniformly, or
    uniformly in its logarithm if ``spacing`` is ``log``. Coordinates that no factor draws are one bin of weight 1. The
    weights of lights are not probabilities: each image is lit by all anchor lights in these proportions.
    """
    rows, p = [], distribution.probabilities(psi.double())
    free = set(distribution.ranges) - {factor.coordinate for factor in distribution.binned}
    for label, name in enumerate(names):
        for factor in distribution.factors:
            weights = p[factor.name][label].tolist()
            for bin, weight in enumerate(weights):
                edges = _edges(factor, bin, distribution) if isinstance(factor, BinnedFactor) else _LIGHT
                rows.append(
                    {"object": name, "factor": factor.name, **edges, "bin": bin + 1, "weight": weight}
                )
        for coordinate in sorted(free):
            low, high = distribution.ranges[coordinate]
            edges = _placed(coordinate, low, high, "linear", distribution)
            rows.append({"object": name, "factor": "", **edges, "bin": 1, "weight": 1.0})
    return rows


_LIGHT = {"coordinate": "light", "unit": "anchor", "spacing": "", "low": "", "high": ""}


def _edges(factor: BinnedFactor, bin: int, distribution: SceneDistribution) -> dict[str, Any]:
    low, high = (math.log(end) if factor.geometric else end for end in (factor.low, factor.high))
    width = (high - low) / factor.bins
    ends = [low + width * (bin + side) for side in (0, 1)]
    spacing = "log" if factor.geometric else "linear"
    start, end = (math.exp(value) if factor.geometric else value for value in ends)
    return _placed(factor.coordinate, start, end, spacing, distribution)


def _placed(
    coordinate: str, low: float, high: float, spacing: str, distribution: SceneDistribution
) -> dict[str, Any]:
    if coordinate in ("phi", "rho"):
        low, high, unit = math.degrees(low), math.degrees(high), "degrees"
    else:
        unit = distribution.distance_unit if coordinate == "distance" else "times"
    return {"coordinate": coordinate, "unit": unit, "spacing": spacing, "low": low, "high": high}


def psi_csv(rows: Sequence[dict[str, Any]]) -> str:
    """Write the table as CSV, with a header."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows([row[column] for column in COLUMNS] for row in rows)
    return stream.getvalue()
