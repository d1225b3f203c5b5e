"""Divide photographs into parts for validation, test and training, by whole groups.

Near-duplicates are recognised by the normalised cross-correlation of local contrast: grey thumbnails of 24 x 24 cells,
each cell minus the mean of the 5 x 5 cells around it, the best over shifts of up to two cells. Local contrast is used
because any two photographs with light from above correlate; shifts, because hand-held cameras move.

Measured on 600 pictures of each of five kinds (amplitudes falling as 1/f and as f^-1.5, the first also with a bright
top, and the procedural clutter), the correlation of every picture with every other was at most 0.49, with one pair in
10,000 above 0.40. Pictures and their copies moved by up to 8 % of their width, brighter, with noise of 3 % of their
contrast, had 0.62 or more in nine of ten; consecutive frames of YCB-Video 0.92 or more, frames of different scenes
0.15 at most.
"""

from __future__ import annotations

import hashlib
import itertools
import logging
import re
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple, TypeVar

import torch
from annotated_types import Gt, Lt
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from neural_sim.ranges import validated

_log = logging.getLogger(__name__)

T = TypeVar("T")
PartOfAll = Annotated[float, Gt(0), Lt(1)]
ATTRIBUTE = "attribute:"
CELLS, WINDOW, SHIFT = 24, 5, 2
ALIKE = 0.6
"""Correlation above which two photographs count as near-duplicates, between the two sides of the measurement above."""
COMPARED = 1000
"""Number of photographs of one part that are compared with all of another, so that a large set takes seconds."""


@dataclass(frozen=True)
class Look:
    """The properties that decide which photographs belong together.

    Args:
        name: the photograph's own name, for messages.
        group: the group that the split keeps together.
        image: its letterboxed pixels; photographs with equal ones are the same.
        inside: the part of ``image`` that the photograph fills.
    """

    name: str
    group: Hashable
    image: Float[Tensor, "3 height width"]
    inside: Float[Tensor, "3 _ _"]


@validated
@dataclass(frozen=True)
class Split:
    """How photographs are divided; the fields are settings of every target of photographs.

    Args:
        val_fraction: fraction for validation, as near as whole groups allow; the rest is scored.
        train_fraction: fraction of the unscored photographs that is for training, also in whole groups; None: no
            training set.
        split_by: which photographs form a group, see ``groups_of``; None: the data set's own groups.
    """

    val_fraction: PartOfAll = 0.3
    train_fraction: PartOfAll | None = None
    split_by: str | None = None

    def parts(self, groups: Sequence[Hashable], generator: torch.Generator) -> dict[str, list[int]]:
        """Divide photographs by their groups.

        Returns:
            Rows of ``val``, ``test`` and, with a ``train_fraction``, ``train``. No group is in two of them.

        Raises:
            ValueError: see ``split``.
        """
        val, test = (part.tolist() for part in split(groups, self.val_fraction, generator))
        return {**self.unscored(val, groups, generator), "test": test}

    def unscored(
        self, rows: Sequence[int], groups: Sequence[Hashable], generator: torch.Generator
    ) -> dict[str, list[int]]:
        """Divide the unscored photographs; which ones these are does not depend on ``train_fraction``.

        Args:
            rows: those photographs.
            groups: the groups of all photographs.
            generator: source of the random choice.

        Returns:
            ``rows`` as ``val`` and, with a ``train_fraction``, ``train``.

        Raises:
            ValueError: the rows belong to a single group, which cannot be divided.
        """
        if self.train_fraction is None:
            return {"val": list(rows)}
        own = [groups[row] for row in rows]
        if len(set(own)) < 2:
            raise ValueError(
                "target.train_fraction takes whole groups of the images that are not scored, but these all belong to "
                f"one group, {own[0]!r}; want a larger target.val_fraction (all that is not scored) or smaller groups"
            )
        train, rest = split(own, self.train_fraction, generator, ("training", "validation"))
        return {"train": [rows[row] for row in train.tolist()], "val": [rows[row] for row in rest.tolist()]}

    def parts_by_look(
        self, looks: Sequence[Look], generator: torch.Generator, source: object
    ) -> dict[str, list[int]]:
        """Divide photographs by their groups, with equal photographs in one group.

        Without ``split_by``, near-duplicates in two parts give a warning: if one frame of a video trained a detector or
        chose psi, the score on the next frame says little.

        Args:
            looks: the photographs.
            generator: source of the random choice.
            source: their file or folder, for messages.

        Returns:
            Rows as from ``parts``.
        """
        pixels = [hashlib.sha256(look.image.numpy().tobytes()).digest() for look in looks]
        parts = self.parts(joined([look.group for look in looks], pixels), generator)
        if self.split_by is not None:
            _log.info(
                "%s: target.split_by=%s makes %d groups; val has %d of %d images (val_fraction %g), train %d",
                source, self.split_by, len({look.group for look in looks}), len(parts["val"]), len(looks),
                self.val_fraction, len(parts.get("train", ())),
            )  # fmt: skip
            return parts
        thumbnails = torch.stack([thumbnail(look.inside) for look in looks])
        for first, second in itertools.combinations(parts, 2):
            found = near_duplicates(thumbnails[parts[first]], thumbnails[parts[second]])
            if found.second:
                _log.warning(
                    "%s: %d of %d %s images look like one of %s (%s like %s); if they are of one video, scene or "
                    "capture, keep them in one part by target.split_by",
                    source, len(found.second), found.compared, second, first,
                    looks[parts[second][found.second[0]]].name, looks[parts[first][found.first[0]]].name,
                )  # fmt: skip
        return parts


def groups_of(
    names: Sequence[str],
    split_by: str,
    source: object,
    entries: Sequence[Mapping[str, Any]] | None = None,
) -> list[str]:
    """Return the group of each photograph, such as its scene or video.

    Args:
        names: the photographs' file names.
        split_by: ``attribute:<name>``: the group is that attribute of the photograph's entry; otherwise a regular
            expression that is searched for in the name: the group is its first capture group, or the whole match if it
            has none.
        source: origin of the photographs, for messages.
        entries: the photographs' entries; None: there are none, so that a regular expression is needed.

    Raises:
        ValueError: the regular expression does not compile, it does not match a photograph, a photograph lacks the
            attribute, or there are fewer than two groups.
    """
    where = f"target.split_by={split_by!r}, {source}"
    if not split_by.startswith(ATTRIBUTE):
        groups = _matches(names, split_by, where)
    elif entries is None:
        raise ValueError(f"target.split_by: want a regular expression or null, got {split_by!r}")
    else:
        groups = _attributes(entries, split_by.removeprefix(ATTRIBUTE), where)
    lacking = [name for name, group in zip(names, groups, strict=True) if group is None]
    if lacking:
        raise ValueError(
            f"{where}: {len(lacking)} of {len(names)} images have no group, the first {lacking[0]!r}"
        )
    if len(set(groups)) < 2:
        raise ValueError(f"{where}: want at least two groups, got {sorted(set(map(str, groups)))}")
    return [str(group) for group in groups]


def _matches(names: Sequence[str], split_by: str, where: str) -> list[str | None]:
    try:
        pattern = re.compile(split_by)
    except re.error as error:
        raise ValueError(f"{where}: not a regular expression ({error})") from error
    matches = [pattern.search(name) for name in names]
    return [None if match is None else match[min(1, pattern.groups)] for match in matches]


def _attributes(entries: Sequence[Mapping[str, Any]], name: str, where: str) -> list[Any]:
    values = [entry.get(name) for entry in entries]
    strange = next((value for value in values if isinstance(value, (dict, list))), None)
    if strange is not None:
        raise ValueError(f"{where}: want a text or a number, got {strange!r}")
    return values


def split(
    groups: Sequence[Hashable],
    fraction: float,
    generator: torch.Generator,
    parts: tuple[str, str] = ("validation", "test"),
) -> tuple[Int[Tensor, "first"], Int[Tensor, "second"]]:
    """Divide photographs into two parts of whole groups, neither of them empty.

    Groups are put in random order. The first part gets the number of photographs, among those that groups allow, that
    is nearest to ``fraction`` of all (the smaller of two equally near ones), made up of the fewest groups in that
    order. If every photograph is its own group, this is a random part of exactly the requested size.

    Args:
        groups: the group of each photograph.
        fraction: fraction for the first part, in (0, 1).
        generator: source of the random order.
        parts: names of the two parts in messages.

    Returns:
        Rows of the two parts.

    Raises:
        ValueError: the fraction is outside (0, 1) or leaves a part empty, or there are fewer than two groups.
    """
    first, second = parts
    if not 0.0 < fraction < 1.0:
        raise ValueError(f"target: the {first} fraction must lie in (0, 1), got {fraction}")
    wanted = round(fraction * len(groups))
    if not 0 < wanted < len(groups):
        raise ValueError(
            f"target: {fraction} of {len(groups)} images leaves {first} or {second} empty; want more images"
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


def nearest(sizes: Sequence[int], wanted: int) -> set[int]:
    """Choose some but not all of the ``sizes``, such that their sum is nearest to ``wanted``.

    Subset sum by dynamic programming: bit s of ``reached`` says whether the sizes so far can add up to s;
    ``last[s]`` is the position that first made it possible.

    Returns:
        Positions in ``sizes``.
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


def evenly(items: Sequence[T], limit: int | None) -> list[T]:
    """Return at most ``limit`` of the items, evenly spaced; None: all."""
    if limit is None or limit >= len(items):
        return list(items)
    return [items[i * len(items) // limit] for i in range(limit)]


def joined(groups: Sequence[Hashable], equal: Sequence[Hashable]) -> list[int]:
    """Join groups of photographs that share a value of ``equal``, such as a digest of pixels.

    Returns:
        For each photograph, the row of the first one in its joined group.
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


class NearDuplicates(NamedTuple):
    """Rows of a second part that resemble rows of a first, the row that each resembles, and the number compared."""

    second: list[int]
    first: list[int]
    compared: int


def near_duplicates(
    first: Float[Tensor, "n 24 24"], second: Float[Tensor, "m 24 24"], limit: int = COMPARED
) -> NearDuplicates:
    """Find photographs of a second part that look like one of a first, by their thumbnails.

    If the second part has more than ``limit``, evenly spaced ones are compared.
    """
    rows = torch.linspace(0, len(second) - 1, min(limit, len(second))).round().long()
    best, row = correlation(second[rows], first).max(1)
    alike = best >= ALIKE
    return NearDuplicates(rows[alike].tolist(), row[alike].tolist(), len(rows))


def thumbnail(photo: Float[Tensor, "3 height width"]) -> Float[Tensor, "24 24"]:
    """Return the local contrast of a photograph in grey cells."""
    grey = functional.adaptive_avg_pool2d(photo.mean(0)[None, None], CELLS)
    margin = WINDOW // 2
    around = functional.avg_pool2d(functional.pad(grey, (margin,) * 4, mode="reflect"), WINDOW, 1)
    return (grey - around)[0, 0]


def correlation(first: Float[Tensor, "n 24 24"], second: Float[Tensor, "m 24 24"]) -> Float[Tensor, "n m"]:
    """Compute the largest correlation of thumbnails over shifts; a plain photograph correlates with none."""
    inner, width = slice(SHIFT, -SHIFT), CELLS - 2 * SHIFT
    centre = _normalised(first[:, inner, inner])
    best = torch.full((len(first), len(second)), -1.0)
    for down in range(2 * SHIFT + 1):
        for right in range(2 * SHIFT + 1):
            moved = _normalised(second[:, down : down + width, right : right + width])
            best = torch.maximum(best, centre @ moved.T)
    return best


def _normalised(cells: Float[Tensor, "n h w"]) -> Float[Tensor, "n hw"]:
    flat = cells.flatten(1) - cells.mean((1, 2))[:, None]
    length = flat.norm(dim=1, keepdim=True)
    plain_but_for_rounding = length <= 1e-4
    return torch.where(plain_but_for_rounding, 0.0, flat / length.clamp_min(1e-4))
