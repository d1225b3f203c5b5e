"""Parts of one labelled set for validation, test and training, whole groups of images in each."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import TypeVar

import torch
from jaxtyping import Int
from torch import Tensor

T = TypeVar("T")


def split(
    groups: Sequence[Hashable],
    fraction: float,
    generator: torch.Generator,
    parts: tuple[str, str] = ("validation", "test"),
) -> tuple[Int[Tensor, "first"], Int[Tensor, "second"]]:
    """Rows of the images of two ``parts``, such as validation and test, by the group of each image.

    All images of a group land in the same part, and neither part is empty. Groups are put in random order. The first
    part gets as many images as groups allow that is nearest to ``fraction`` of all, the smaller of two equally near; of
    the choices of groups that have that number, the one that needs the fewest groups in that order. Where every image
    is a group of its own, that is a random part of exactly the size asked for.

    Raises:
        ValueError: a fraction outside (0, 1), one that leaves a part empty, or fewer than two groups.
    """
    first, second = parts
    if not 0.0 < fraction < 1.0:
        raise ValueError(f"target: the {first} fraction must lie in (0, 1), got {fraction}")
    wanted = round(fraction * len(groups))
    if not 0 < wanted < len(groups):
        raise ValueError(
            f"target: {fraction} of {len(groups)} images leaves {first} or {second} empty; give more images"
        )
    members: dict[Hashable, list[int]] = {}
    for row, group in enumerate(groups):
        members.setdefault(group, []).append(row)
    if len(members) < 2:
        raise ValueError(
            f"target: want at least two groups of images for two parts, got {len(members)} for {first} and {second}"
        )
    order, rows = torch.randperm(len(members), generator=generator).tolist(), list(members.values())
    shuffled = [rows[i] for i in order]
    chosen = nearest([len(group) for group in shuffled], wanted)
    taken = ([], [])
    for i, group in enumerate(shuffled):
        taken[i not in chosen].extend(group)
    return torch.tensor(taken[0]), torch.tensor(taken[1])


def for_training(
    val: Sequence[int], groups: Sequence[Hashable], fraction: float | None, generator: torch.Generator
) -> dict[str, list[int]]:
    """The rows ``val``, which are not scored, as parts ``val`` and, with a ``fraction``, ``train``.

    ``groups`` are those of all rows; no group is in both parts, see :func:`split`. Which rows are scored does not
    depend on the fraction.

    Raises:
        ValueError: rows of a single group, which cannot be split.
    """
    if fraction is None:
        return {"val": list(val)}
    own = [groups[row] for row in val]
    if len(set(own)) < 2:
        raise ValueError(
            f"target.train_fraction takes whole groups of the images that are not scored, and those are of one, "
            f"{own[0]!r}; want a larger target.val_fraction, which is the part that is not scored, or smaller groups"
        )
    train, rest = split(own, fraction, generator, ("training", "validation"))
    return {"train": [val[row] for row in train.tolist()], "val": [val[row] for row in rest.tolist()]}


def check_fraction(fraction: float | None) -> None:
    """Raises ``ValueError`` for a ``target.train_fraction`` that is none."""
    if fraction is not None and not 0.0 < fraction < 1.0:
        raise ValueError(f"target.train_fraction must lie in (0, 1) or be null, got {fraction}")


def evenly(items: Sequence[T], limit: int | None) -> list[T]:
    """At most ``limit`` of the items, evenly spaced; None: all."""
    if limit is None or limit >= len(items):
        return list(items)
    return [items[i * len(items) // limit] for i in range(limit)]


def nearest(sizes: Sequence[int], wanted: int) -> set[int]:
    """Positions whose ``sizes`` add up to what is nearest to ``wanted`` of all sums but none and all.

    Subset sum by dynamic programming: bit s of ``reached`` says whether the sizes so far can add up to s,
    ``last[s]`` is the position that first made it so.
    """
    reached, last = 1, {}
    for i, size in enumerate(sizes):
        fresh = (reached << size) & ~reached
        reached |= fresh
        while fresh:
            total = (fresh & -fresh).bit_length() - 1
            fresh &= fresh - 1
            last[total] = i
        if wanted in last:
            break
    total = min((s for s in last if s < sum(sizes)), key=lambda s: (abs(s - wanted), s))
    chosen = set()
    while total:
        chosen.add(last[total])
        total -= sizes[last[total]]
    return chosen


def joined(groups: Sequence[Hashable], equal: Sequence[Hashable]) -> list[int]:
    """Groups of images of which those that share a value of ``equal`` (such as a digest of pixels) are one.

    Returns a number for each image, the row of the first image of its joined group.
    """
    first: dict[tuple[str, Hashable], int] = {}
    parent = list(range(len(groups)))

    def root(row: int) -> int:
        while parent[row] != row:
            row = parent[row]
        return row

    for row, keys in enumerate(zip(groups, equal, strict=True)):
        for kind, key in zip(("group", "equal"), keys, strict=True):
            a, b = root(row), root(first.setdefault((kind, key), row))
            parent[max(a, b)] = min(a, b)
    return [root(row) for row in range(len(groups))]
