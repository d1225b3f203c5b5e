"""Cameras of photographs, found from the photographs alone: structure from motion by COLMAP."""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge
from jaxtyping import Bool
from PIL import Image
from tqdm import tqdm

from neural_sim.extras import require
from neural_sim.interruption import signals_kept
from neural_sim.objects.album import Album, Shot
from neural_sim.objects.capture import Capture, Frame
from neural_sim.objects.colmap import posed
from neural_sim.objects.found import LEAST, FoundCapture, common_up, judged
from neural_sim.objects.standing import standing_parts
from neural_sim.pictures import read_picture
from neural_sim.ranges import PositiveInt, validated

_log = logging.getLogger(__name__)

ALL_PAIRS = 40
"""Largest number of photographs for which ``matching="auto"`` compares every pair."""
SKELETON = 5
"""``matching="auto"`` also compares every fifth photograph with every other fifth one: a walk may end at its start."""
LARGE = 800
"""Longer side in pixels from which features are searched for only at the photographs' own size."""
BATCH = 8
SEED = 0
"""Seed of COLMAP's random samples; not the run's, so that runs share poses."""

MaskOf = Callable[[Shot], Bool[np.ndarray, "_ _"] | None]
"""Gives the region of a photograph that shows the object, or None if it is unknown."""


@validated
@dataclass(frozen=True)
class Colmap:
    """Finds the cameras of photographs from SIFT features, and reports those that it cannot find.

    Args:
        picture_size: longer side in pixels to which larger photographs are reduced for the search.
        features: approximate number of features to keep of each photograph, those with the largest scales; COLMAP
            may keep nearly twice as many.
        matching: which pairs of photographs are compared. ``exhaustive``: all; ``sequential``: those nearby in the
            order of their names; ``auto``: all of up to 40 photographs; of more, nearby ones and all pairs among every
            fifth photograph.
        overlap: number of following photographs with which each is compared, if not all pairs are; those 1, 2, 4, 8,
            ... places after it are added.
        region: which part of a photograph is searched. ``all``: all of it; ``object``: only what the masks show;
            ``auto``: all of it; if the room stands still while the object turns, only what the masks show or, without
            masks, only what moves.
    """

    picture_size: Annotated[int, Ge(200)] = 1000
    features: Annotated[int, Ge(200)] = 1500
    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    overlap: PositiveInt = 10
    region: Literal["auto", "all", "object"] = "auto"

    def find(self, album: Album, mask: MaskOf, progress: bool = False) -> FoundCapture:
        """Return the photographs' cameras.

        Args:
            album: the photographs.
            mask: gives the region of a photograph that shows the object; None if it is unknown.
            progress: whether to show a bar.

        Raises:
            ValueError: the cameras cannot be found; the message says why, and what to do.
        """
        if len(album.shots) < LEAST:
            raise ValueError(
                f"{album.folder}: want at least {LEAST} photographs to find cameras, got {len(album.shots)}; take 40 "
                "or more from all sides, each showing two thirds of what the one before shows"
            )
        require("photos", f"objects/poses=colmap: {album.folder}")
        with tempfile.TemporaryDirectory(prefix="neural-sim-") as place:
            return _Search(self, album, Path(place), progress).run(mask)

    def pairs(self, count: int) -> list[tuple[int, int]]:
        """Return which pairs of ``count`` photographs are compared."""
        if self.matching == "exhaustive" or (self.matching == "auto" and count <= ALL_PAIRS):
            return list(combinations(range(count), 2))
        steps = {*range(1, self.overlap + 1), *(2**power for power in range(count.bit_length()))}
        chosen = {(i, i + step) for i in range(count) for step in steps if i + step < count}
        if self.matching == "auto":
            chosen |= set(combinations(range(0, count, SKELETON), 2))
        return sorted(chosen)


@dataclass(frozen=True)
class _Search:
    """One search for cameras, in a folder of its own."""

    settings: Colmap
    album: Album
    place: Path
    progress: bool

    def run(self, mask: MaskOf) -> FoundCapture:
        """Run the search."""
        shots, album = self.album.shots, self.album
        with signals_kept():
            import pycolmap

        pairs = self.settings.pairs(len(shots))
        with (
            _quiet(pycolmap),
            tqdm(
                total=3 * len(shots),
                desc=f"cameras of {album.name}",
                bar_format="{desc}: {percentage:3.0f}%|{bar}| {elapsed}<{remaining}",
                disable=not self.progress,
                leave=False,
            ) as bar,
        ):
            standing = standing_parts(shots)
            masked = self._write(mask, standing)
            self._extract(pycolmap, masked, bar)
            self._match(pycolmap, pairs, standing is not None, bar)
            models = self._map(pycolmap, standing is not None, bar)
            return judged(album, self._read(models), self._verified(pycolmap), standing is not None)

    @property
    def database(self) -> Path:
        """COLMAP's file of features and matches."""
        return self.place / "database.db"

    def _write(self, mask: MaskOf, standing: Mapping[Path, Bool[np.ndarray, "_ _"]] | None) -> bool:
        """Write reduced photographs, and masks of the regions to search, if any; return whether there are masks."""
        region = self.settings.region
        (self.place / "images").mkdir()
        (self.place / "masks").mkdir()
        masked = 0
        for number, shot in enumerate(self.album.shots):
            picture, size = read_picture(shot.image, upright=False).convert("L"), self._reduced(shot)
            picture.resize(size, Image.Resampling.BOX, reducing_gap=3.0).save(
                self.place / "images" / _file(number)
            )
            counts = mask(shot) if region == "object" or (region == "auto" and standing is not None) else None
            if counts is None and region == "auto" and standing is not None:
                counts = ~standing[shot.image]
            if counts is not None:
                counted = Image.fromarray(np.where(counts, 255, 0).astype(np.uint8))
                counted.resize(size, Image.Resampling.NEAREST).save(
                    self.place / "masks" / f"{_file(number)}.png"
                )
                masked += 1
        if region == "object" and masked < len(self.album.shots):
            raise ValueError(
                f"{self.album.folder}: objects.poses.region=object wants a mask of each photograph; "
                f"{len(self.album.shots) - masked} of {len(self.album.shots)} have none"
            )
        return masked > 0

    def _reduced(self, shot: Shot) -> tuple[int, int]:
        factor = min(1.0, self.settings.picture_size / max(shot.size))
        width, height = (max(1, round(factor * side)) for side in shot.size)
        return width, height

    def _extract(self, pycolmap: Any, masked: bool, bar: Any) -> None:
        """Find features; photographs from one camera share its intrinsics."""
        options = pycolmap.FeatureExtractionOptions()
        options.use_gpu, options.num_threads = False, _threads()
        options.max_image_size = self.settings.picture_size
        options.sift.max_num_features = self.settings.features
        # Small photographs are also searched at twice their size: four times the work, but they have few features.
        largest = max(max(self._reduced(shot)) for shot in self.album.shots)
        options.sift.first_octave = -1 if largest < LARGE else 0
        groups: dict[object, list[int]] = {}
        for number, shot in enumerate(self.album.shots):
            groups.setdefault(shot.camera, []).append(number)
        with self._open(pycolmap):
            pass  # creates an empty database for the import
        for numbers in groups.values():
            reader, shot = pycolmap.ImageReaderOptions(), self.album.shots[numbers[0]]
            if shot.focal is not None:
                width, height = self._reduced(shot)
                focal = shot.focal * width / shot.size[0]
                reader.camera_params = f"{focal},{0.5 * width},{0.5 * height},0"
            # The import assigns ids in order; the threads of the extraction would assign them in any order.
            pycolmap.import_images(
                self.database, self.place / "images", pycolmap.CameraMode.SINGLE,
                [_file(number) for number in numbers], reader,
            )  # fmt: skip
        reader = pycolmap.ImageReaderOptions()
        if masked:
            reader.mask_path = str(self.place / "masks")
        for begin in range(0, len(self.album.shots), BATCH):
            batch = [_file(number) for number in range(begin, min(begin + BATCH, len(self.album.shots)))]
            pycolmap.extract_features(
                self.database, self.place / "images", batch, pycolmap.CameraMode.AUTO, reader, options
            )
            bar.update(len(batch))

    @contextmanager
    def _open(self, pycolmap: Any) -> Iterator[Any]:
        database = pycolmap.Database.open(self.database)
        try:
            yield database
        finally:
            database.close()

    def _match(self, pycolmap: Any, pairs: Sequence[tuple[int, int]], standing: bool, bar: Any) -> None:
        """Compare pairs of photographs, and keep matches that a motion of the camera explains."""
        matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
        matching.use_gpu, matching.num_threads = False, _threads()
        verification.ransac.random_seed = SEED
        verification.compute_relative_pose = True
        # Matches in a room that stands still while the object turns would show a camera that did not move.
        verification.filter_stationary_matches = standing and self.settings.region == "auto"
        imported, listed = pycolmap.ImportedPairingOptions(), self.place / "pairs.txt"
        imported.match_list_path = str(listed)
        chunk = max(50, len(pairs) // 20)
        share = len(self.album.shots) / len(pairs)
        for begin in range(0, len(pairs), chunk):
            part = pairs[begin : begin + chunk]
            listed.write_text("".join(f"{_file(i)} {_file(j)}\n" for i, j in part))
            pycolmap.match_image_pairs(self.database, matching, imported, verification)
            bar.update(len(part) * share)

    def _map(self, pycolmap: Any, standing: bool, bar: Any) -> list[Any]:
        """Return COLMAP's models, the largest first."""
        options = pycolmap.IncrementalPipelineOptions()
        # One thread, because rounding depends on the order of threads, and the same photographs must always give the
        # same cameras.
        options.num_threads, options.random_seed, options.extract_colors = 1, SEED, False
        options.min_model_size, options.max_num_models = 3, 5
        # A turning object fills only a small part of the photographs, too little to determine the lens.
        lens = not (standing and all(shot.focal for shot in self.album.shots))
        options.ba_refine_focal_length = options.ba_refine_extra_params = lens
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = lens
        out = self.place / "models"
        out.mkdir()
        try:
            models = pycolmap.incremental_mapping(
                self.database, self.place / "images", out, options, next_image_callback=lambda: bar.update(1)
            )
        except Exception as error:  # COLMAP raises whatever its C++ checks raise
            raise ValueError(f"{self.album.folder}: COLMAP found no cameras: {error}") from error
        return sorted(models.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))

    def _read(self, models: Sequence[Any]) -> list[tuple[Any, Capture]]:
        """Return each model with its capture, whose lenses are those of the full-size photographs."""
        return [(model, self._capture(model)) for model in models]

    def _capture(self, model: Any) -> Capture:
        found = {}
        for image in model.images.values():
            if image.has_pose:
                number = int(Path(image.name).stem)
                shot = self.album.shots[number]
                pose, lens = posed(image, model, f"{self.album.folder}: {self.album.called(shot)}")
                found[number] = Frame(shot.image, pose, lens.resized(*shot.size))
        frames = tuple(found[number] for number in sorted(found))
        shots = [self.album.shots[number] for number in sorted(found)]
        up = common_up(np.stack([frame.camera_to_world for frame in frames]), shots)
        images = tuple(shot.image for shot in self.album.shots)
        return Capture(self.album.name, frames, self.album.folder, images, up)

    def _verified(self, pycolmap: Any) -> dict[tuple[int, int], tuple[str, int]]:
        """Return the kind of motion and the number of matches for each pair of photographs that a motion explains."""
        with self._open(pycolmap) as database:
            numbers = {image.image_id: int(Path(image.name).stem) for image in database.read_all_images()}
            ids, geometries = database.read_two_view_geometries()
        found, kinds = {}, pycolmap.TwoViewGeometryConfiguration
        for pair, geometry in zip(ids, geometries, strict=True):
            first, second = pycolmap.pair_id_to_image_pair(pair)
            if len(geometry.inlier_matches):
                found[numbers[first], numbers[second]] = (
                    kinds(geometry.config).name,
                    len(geometry.inlier_matches),
                )
        return found


def _file(number: int) -> str:
    return f"{number:05d}.bmp"


def _threads() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def _quiet(pycolmap: Any) -> Iterator[None]:
    """Keep COLMAP's own messages out of the log; its exceptions are still raised."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before
