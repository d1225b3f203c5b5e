"""Parts of a set of photographs: equal ones in one part, a warning where others look alike across parts."""

from __future__ import annotations

import hashlib
import itertools
import logging
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.target.near_duplicates import near_duplicates
from neural_sim.target.split import for_training, joined, split

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Looks:
    """What says which photographs belong together. ``name`` is one's own, for messages, ``group`` what the split keeps
    together, ``image`` its letterboxed pixels, ``thumbnail`` that of :func:`near_duplicates.thumbnail`.
    """

    name: str
    group: Hashable
    image: Float[Tensor, "3 height width"]
    thumbnail: Float[Tensor, "24 24"]


@dataclass(frozen=True)
class Parting:
    """Fractions of the parts, and what groups are by; the same arguments of a target set.

    ``source`` is the file or folder, for messages.
    """

    val_fraction: float
    train_fraction: float | None
    split_by: str | None
    source: object

    def parts(self, photos: Sequence[Looks], generator: torch.Generator) -> dict[str, list[int]]:
        """Rows of ``val``, ``test`` and any ``train``, see :func:`split.split`. Without ``split_by``, warns of
        near-duplicates in two parts: where one frame of a video trained a detector or steered psi, the score on the
        next frame says little.
        """
        pixels = [hashlib.sha256(photo.image.numpy().tobytes()).digest() for photo in photos]
        groups = joined([photo.group for photo in photos], pixels)  # a photograph that is there twice is one
        val, test = (part.tolist() for part in split(groups, self.val_fraction, generator))
        parts = {**for_training(val, groups, self.train_fraction, generator), "test": test}
        if self.split_by is None:
            for first, second in itertools.combinations(parts, 2):
                self._warn_of_duplicates(photos, parts[first], parts[second], first, second)
        else:
            _log.info(
                "%s: target.split_by=%s makes %d groups; val has %d of %d images (val_fraction %g), train %d",
                self.source, self.split_by, len({photo.group for photo in photos}), len(parts["val"]), len(photos),
                self.val_fraction, len(parts.get("train", ())),
            )  # fmt: skip
        return parts

    def _warn_of_duplicates(
        self, photos: Sequence[Looks], one: Sequence[int], other: Sequence[int], first: str, second: str
    ) -> None:
        left, right = (torch.stack([photos[row].thumbnail for row in rows]) for rows in (one, other))
        duplicates = near_duplicates(left, right)
        if duplicates.test:
            _log.warning(
                "%s: %d of %d %s images look like one of %s (%s like %s); if they are of one video, scene or "
                "capture, keep them together by target.split_by",
                self.source, len(duplicates.test), duplicates.compared, second, first,
                photos[other[duplicates.test[0]]].name, photos[one[duplicates.val[0]]].name,
            )  # fmt: skip
