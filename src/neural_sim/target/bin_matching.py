"""Choose photographs such that the pose bins of each object follow a given distribution."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.types import LabelledImages


def matching(
    images: LabelledImages,
    rows: Int[Tensor, "part"],
    targets: Mapping[str, Float[Tensor, "_"]],
    generator: torch.Generator,
    where: str,
) -> Int[Tensor, "chosen"]:
    """Choose those photographs of ``rows`` whose bins follow ``targets``.

    ``targets`` has each object's distribution over bins, in label order. For every object, as many photographs are
    chosen as its distribution allows, each at most once and at random within a bin. The number in a bin is that of the
    distribution, rounded up or down. Photographs without a box that has a bin are left out, and so are objects without
    photographs.

    Raises:
        ValueError: a photograph shows several objects or bins, or none shows a bin that the distribution needs; the
            message begins with ``where``.
    """
    cells = _rows_by_cell(images, rows, where)
    chosen: list[int] = []
    for label, (name, p) in enumerate(targets.items()):
        own = [cells.get((label, b), []) for b in range(len(p))]
        if not any(own):
            continue
        counts = most(p.tolist(), [len(each) for each in own], generator)
        if counts is None:
            lacking = [b for b, each in enumerate(own, 1) if not each]
            raise ValueError(
                f"{where}: want {name} in bins as {[round(v, 3) for v in p.tolist()]}, none in {lacking}"
            )
        for each, count in zip(own, counts, strict=True):
            order = torch.randperm(len(each), generator=generator)[:count].tolist()
            chosen += [each[i] for i in order]
    if not chosen:
        raise ValueError(f"{where}: no photograph has a box with a pose bin")
    return torch.tensor(sorted(chosen))


def _rows_by_cell(
    images: LabelledImages, rows: Int[Tensor, "part"], where: str
) -> dict[tuple[int, int], list[int]]:
    """Return the rows that show an object in a bin, by its label and the bin."""
    cells: dict[tuple[int, int], list[int]] = {}
    for row in rows.tolist():
        labels, bins = images.labels[row].tolist(), _bins(images, row)
        seen = {(label, b) for label, b in zip(labels, bins, strict=True) if label >= 0}
        if len(seen) > 1:
            raise ValueError(
                f"{where}: want photographs of one object in one bin each, got one of {sorted(seen)}"
            )
        for label, b in seen:
            if b >= 0:
                cells.setdefault((label, b), []).append(row)
    return cells


def _bins(images: LabelledImages, row: int) -> list[int]:
    own = images.bins[row]
    return own.expand(images.labels.shape[1]).tolist() if own.ndim == 0 else own.tolist()


def most(p: Sequence[float], available: Sequence[int], generator: torch.Generator) -> list[int] | None:
    """Return the counts of the largest ``apportioned`` choice that is available; None if there is none."""
    for total in range(sum(available), 0, -1):
        counts = apportioned(p, total, available, generator)
        if counts is not None:
            return counts
    return None


def apportioned(
    p: Sequence[float], total: int, available: Sequence[int], generator: torch.Generator
) -> list[int] | None:
    """Split ``total`` photographs among bins by largest remainders, each ``total * p`` rounded up or down.

    Among bins with equal remainders, those with enough photographs are rounded up first, in random order.

    Returns:
        The number in each bin; None if a bin has too few photographs.
    """
    quotas = [total * value for value in p]
    counts = [math.floor(quota + 1e-9) for quota in quotas]
    rest = [round(quota - count, 9) for quota, count in zip(quotas, counts, strict=True)]
    enough = [count < limit for count, limit in zip(counts, available, strict=True)]
    ties = torch.randperm(len(p), generator=generator).tolist()
    order = sorted(range(len(p)), key=lambda b: (-rest[b], not enough[b], ties[b]))
    for b in order[: total - sum(counts)]:
        counts[b] += 1
    return counts if all(c <= limit for c, limit in zip(counts, available, strict=True)) else None
