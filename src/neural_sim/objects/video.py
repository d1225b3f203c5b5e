"""Frames of a video as photographs of an object."""

from __future__ import annotations

import logging
import shutil
import tempfile
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.ndimage import laplace

from neural_sim.extras import require
from neural_sim.objects.album import FOLDER, pictures_of
from neural_sim.pictures import without_leftovers

_log = logging.getLogger(__name__)

VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
JUDGED_AT = 640
"""Longer side in pixels at which the sharpness of frames is compared; finer detail is noise."""


def videos_of(folder: Path) -> list[Path]:
    """Return the videos in a folder."""
    own = sorted(path for path in folder.iterdir() if path.suffix.lower() in VIDEOS and path.is_file())
    return without_leftovers(own, folder)


def can_be_captured(folder: Path) -> bool:
    """Return whether a folder has a video, or pictures in it or in its subfolder ``images``."""
    return bool(pictures_of(folder) or videos_of(folder))


def take_frames(folder: Path, name: str, count: int) -> None:
    """Write frames of a folder's video into its subfolder ``images``, unless there are photographs already.

    The video is cut into ``count`` equal parts, and the sharpest frame of each is kept, upright.

    Raises:
        ValueError: there are several videos, one cannot be read, or the folder cannot be written.
    """
    videos = videos_of(folder)
    if not videos or pictures_of(folder):
        return
    if len(videos) > 1:
        raise ValueError(
            f"{folder}: want one video, got {len(videos)}: {', '.join(video.name for video in videos)}; give "
            "each object a folder with one video"
        )
    require("video", f"objects.root: {videos[0]}")
    images = folder / FOLDER
    try:
        place = Path(tempfile.mkdtemp(prefix=f"._{FOLDER}-", dir=folder))  # is left behind if a run is killed
    except OSError as error:
        raise ValueError(
            f"{folder}: frames of {videos[0].name} cannot be written into it ({error.strerror}); copy the video to a "
            "writable folder"
        ) from error
    try:
        for number, picture in _sharpest(videos[0], count):
            picture.save(place / f"{number:06d}.jpg", quality=95)
        taken = len(list(place.iterdir()))
        place.chmod(0o755)
        place.replace(images)  # whole or not at all
    finally:
        shutil.rmtree(place, ignore_errors=True)
    _log.info(
        "%s: took %d frames of %s, the sharpest in each of as many equal parts, and wrote them to %s; to take another "
        "number (objects.frames), delete that folder", name, taken, videos[0].name, images,
    )  # fmt: skip


def _sharpest(video: Path, count: int) -> Iterator[tuple[int, Image.Image]]:
    """Yield the number and the picture of the sharpest frame in each of at most ``count`` equal parts of a video."""
    import av  # ffmpeg's libraries; loaded only for videos

    try:
        with av.open(video) as container:
            if not container.streams.video:
                raise ValueError(f"{video}: has no video stream")
            total = sum(packet.size > 0 for packet in container.demux(video=0))
        with av.open(video) as container:
            frames = enumerate(container.decode(video=0))
            for _, part in groupby(frames, lambda numbered: numbered[0] * count // max(count, total)):
                number, frame = max(part, key=lambda numbered: _sharpness(numbered[1]))
                # Phones store frames as the sensor sees them, with the angle by which a player should rotate them.
                yield number, frame.to_image().rotate(frame.rotation, expand=True)
    except av.FFmpegError as error:
        raise ValueError(f"{video}: cannot be read as a video: {error.strerror}") from error


def _sharpness(frame: Any) -> float:
    """Return the mean square of a frame's Laplacian."""
    part = min(1.0, JUDGED_AT / max(frame.width, frame.height))
    grey = frame.reformat(round(part * frame.width), round(part * frame.height), "gray").to_ndarray()
    return float(np.square(laplace(grey.astype(np.float32))).mean())
