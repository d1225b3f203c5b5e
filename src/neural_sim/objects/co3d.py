"""Captures of CO3D (Reizenstein et al. 2021), version 2: photographs with cameras and masks, by category.

``<root>/<category>/frame_annotations.jgz`` and ``sequence_annotations.jgz`` are gzipped JSON lists; paths in them are
relative to ``<root>``. Cameras are PyTorch3D's: row vectors, x_camera = x_world R + T, with x to the left, y up and z
ahead.
"""

from __future__ import annotations

import gzip
from collections import Counter
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from neural_sim.documents import parsed_json
from neural_sim.objects.capture import Capture, Frame, Lens, checked_pose
from neural_sim.objects.files import Names
from neural_sim.objects.photos import Photos, PoseCorrector, Up
from neural_sim.objects.pictures import Box, Masks, SceneMaskMaker
from neural_sim.pictures import read_header
from neural_sim.ranges import NonNegativeInt, Positive, validated

FRAMES, SEQUENCES = "frame_annotations.jgz", "sequence_annotations.jgz"
FORMATS = ("ndc_norm_image_bounds", "ndc_isotropic")
OPENGL = np.diag([-1.0, 1.0, -1.0])
"""Converts PyTorch3D's camera axes to OpenGL's, and back."""


@validated
class Co3d(Photos):
    """One sequence of each category, as an object with the category's name.

    Args:
        root: the folder that holds the categories' folders.
        names: categories; null: all.
        sequences: category -> name of its sequence. Categories that are not listed use the sequence with the highest
            ``viewpoint_quality_score``, or the longest if none has a score.
        masks, up, size, box, scene, refinement, poor, mask_command, mask_value: see ``Photos``.

    Raises:
        ValueError: a folder is missing or has no categories, a name or sequence is unknown, or annotations cannot be
            read or lack a key (the message names the file and the key); see ``Photos`` for other reasons.
    """

    def __init__(
        self,
        root: str | Path,
        names: Names = None,
        sequences: Mapping[str, str] | None = None,
        masks: Masks = "auto",
        up: Up | Mapping[str, Up | None] | None = None,
        size: Positive | Mapping[str, Positive | None] | None = None,
        box: Box | Mapping[str, Box | None] | None = None,
        scene: SceneMaskMaker | None = None,
        refinement: PoseCorrector | None = None,
        poor: Literal["refuse", "use"] = "refuse",
        mask_command: str | None = None,
        mask_value: NonNegativeInt | Mapping[str, NonNegativeInt | None] | None = None,
    ) -> None:
        self.sequences = dict(sequences or {})
        super().__init__(
            root, names, masks, up, size, box, scene, refinement, poor, None, mask_command, mask_value
        )
        strange = sorted(set(self.sequences) - set(self.names()))
        if strange:
            raise ValueError(
                f"objects.sequences: {strange} are not objects, want some of {', '.join(self.names())}"
            )

    def _found(self) -> dict[str, Path]:
        found = {p.name: p for p in sorted(self.root.iterdir()) if (p / FRAMES).is_file()}
        if not found:
            raise ValueError(f"objects.root: {self.root} holds no category folder with {FRAMES}")
        return found

    def _read(self, name: str) -> Capture:
        source = self._folders[name] / FRAMES
        entries = _entries(source, "sequence_name")
        sequence = self._sequence(name, Counter(entry["sequence_name"] for entry in entries))
        own = [(n, entry) for n, entry in enumerate(entries) if entry["sequence_name"] == sequence]
        own.sort(key=lambda pair: pair[1].get("frame_number", pair[0]))
        frames = tuple(_frame(self.root, entry, f"{source}: [{n}]") for n, entry in own)
        listed = (path for frame in frames for path in (frame.image, frame.mask) if path is not None)
        return Capture(name, frames, source, (source, *listed))

    def _sequence(self, name: str, counts: Counter[str]) -> str:
        """Choose the sequence of a category; ``counts`` is the number of frames in each of its sequences."""
        wanted = self.sequences.get(name)
        if wanted is not None:
            if wanted not in counts:
                raise ValueError(
                    f"objects.sequences: {name} has no sequence {wanted!r}, want one of {', '.join(sorted(counts))}"
                )
            return wanted
        scores = self._scores[name]
        return max(sorted(counts), key=lambda sequence: (scores.get(sequence, -np.inf), counts[sequence]))

    @cached_property
    def _scores(self) -> dict[str, dict[str, float]]:
        """The quality scores of each category's sequences, for those that have one."""
        found: dict[str, dict[str, float]] = {}
        for name, folder in self._folders.items():
            path = folder / SEQUENCES
            entries = _entries(path, "sequence_name") if path.is_file() else []
            scores = {entry["sequence_name"]: entry.get("viewpoint_quality_score") for entry in entries}
            found[name] = {key: float(score) for key, score in scores.items() if score is not None}
        return found


def _entries(path: Path, key: str) -> list[dict[str, Any]]:
    """Read a file's entries, all of which must have the key."""
    try:
        entries = parsed_json(gzip.decompress(path.read_bytes()))
    except (OSError, EOFError, ValueError) as error:
        raise ValueError(f"{path}: not readable as gzipped JSON ({error})") from error
    if not isinstance(entries, list) or not entries:
        raise ValueError(f"{path}: want a list of annotations, as in CO3D")
    for number, entry in enumerate(entries):
        if not isinstance(entry, dict) or not isinstance(entry.get(key), str):
            raise ValueError(f"{path}: [{number}].{key}: want a string, got {entry!r:.80}")
    return entries


def _frame(root: Path, entry: Mapping[str, Any], where: str) -> Frame:
    image = root / _text(entry, "image", where)
    if not image.is_file():
        raise ValueError(f"{where}.image.path: no such file: {image}")
    mask = None
    if entry.get("mask"):
        mask = root / _text(entry, "mask", where)
        if not mask.is_file():
            raise ValueError(f"{where}.mask.path: no such file: {mask}")
    size = _numbers(entry["image"], "size", (2,), f"{where}.image")
    header = read_header(image, f"{where}: {image}")
    width, height = header.stored
    if size.tolist() != [height, width]:
        raise ValueError(
            f"{where}.image.size: want height and width of {image}, {[height, width]}, got {size.tolist()}"
            f"{header.turning}"
        )
    view, where = entry.get("viewpoint"), f"{where}.viewpoint"
    if not isinstance(view, dict):
        raise ValueError(f"{where}: want a camera, got {view!r}")
    return Frame(image, _pose(view, where), _lens(view, width, height, where), mask)


def _pose(view: Mapping[str, Any], where: str) -> np.ndarray:
    rotation, shift = _numbers(view, "R", (3, 3), where), _numbers(view, "T", (3,), where)
    # For column vectors, x_camera = R^T x + T: the axes are the columns of R, and the centre is where x_camera is 0.
    pose = np.column_stack([rotation @ OPENGL, -rotation @ shift])
    return checked_pose(pose.tolist(), f"{where}.R and T")


def _lens(view: Mapping[str, Any], width: int, height: int, where: str) -> Lens:
    focal, point = (_numbers(view, key, (2,), where) for key in ("focal_length", "principal_point"))
    kind = view.get("intrinsics_format") or FORMATS[0]
    if kind not in FORMATS:
        raise ValueError(f"{where}.intrinsics_format: want one of {', '.join(FORMATS)}, got {kind!r}")
    half = 0.5 * np.array([width, height], dtype=np.float64)
    unit = half if kind == FORMATS[0] else np.full(2, half.min())
    (fx, fy), (cx, cy) = (focal * unit).tolist(), (half - point * unit).tolist()
    try:
        return Lens(width, height, fx, fy, cx, cy)
    except ValueError as error:
        raise ValueError(f"{where}.focal_length: {error}") from error


def _text(entry: Mapping[str, Any], key: str, where: str) -> str:
    path = entry[key].get("path") if isinstance(entry.get(key), dict) else None
    if not isinstance(path, str):
        raise ValueError(
            f"{where}.{key}.path: want a file's path relative to the root, got {entry.get(key)!r:.80}"
        )
    return path


def _numbers(entry: Mapping[str, Any], key: str, shape: tuple[int, ...], where: str) -> np.ndarray:
    wanted = " x ".join(map(str, shape))
    try:
        values = np.array(entry.get(key), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}.{key}: want {wanted} numbers, got {entry.get(key)!r:.80}") from error
    if values.shape != shape or not np.isfinite(values).all():
        raise ValueError(f"{where}.{key}: want {wanted} finite numbers, got {entry.get(key)!r:.80}")
    return values
