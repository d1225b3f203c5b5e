"""Frames of videos as photographs, of videos that are made here."""

import logging

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from neural_sim.objects.motion import Colmap
from neural_sim.objects.photos import Photos
from neural_sim.objects.video import take_frames

av = pytest.importorskip("av", reason="the extra video is not installed")

SIZE = (96, 64)
SHARP = (3, 8, 12, 19)
"""One frame in each fourth of twenty."""


def pattern(number: int, sharp: bool) -> np.ndarray:
    """Noise, whose left upper corner says the frame's number in its brightness."""
    noise = np.random.default_rng(number).uniform(0, 255, (SIZE[1], SIZE[0], 3))
    picture = noise if sharp else gaussian_filter(noise, (2.5, 2.5, 0)) + 20.0
    picture[:32, :32] = 12 * number
    return picture.clip(0, 255).astype(np.uint8)


def write(path, count=20):
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = *SIZE, "yuv420p", 4_000_000
        for number in range(count):
            frame = av.VideoFrame.from_ndarray(pattern(number, number in SHARP), "rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def turn(path, matrix):
    """Write how a player turns the pictures: the matrix of MP4's track header (ISO/IEC 14496-12, 8.3.2)."""
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4 + 4 + 20 + 8 + 8
    data[at : at + 36] = np.array(matrix, dtype=">i4").tobytes()
    path.write_bytes(data)


def taken(folder):
    return sorted((folder / "images").iterdir())


def test_the_sharpest_frame_of_each_part_is_taken(tmp_path, caplog):
    write(tmp_path / "mug.mp4")
    with caplog.at_level(logging.INFO):
        take_frames(tmp_path, "mug", 4)
    assert [int(path.stem) for path in taken(tmp_path)] == list(SHARP)
    for path in taken(tmp_path):
        corner = np.asarray(Image.open(path))[8:24, 8:24].mean()
        assert corner == pytest.approx(12 * int(path.stem), abs=6)
    assert "4 frames of mug.mp4" in caplog.text
    assert {path.name for path in tmp_path.iterdir()} == {"images", "mug.mp4"}


def test_photographs_are_left_as_they_are(tmp_path):
    write(tmp_path / "mug.mp4")
    take_frames(tmp_path, "mug", 4)
    before = [path.read_bytes() for path in taken(tmp_path)]
    take_frames(tmp_path, "mug", 7)
    assert [path.read_bytes() for path in taken(tmp_path)] == before


def test_a_video_of_few_frames_gives_all_of_them(tmp_path):
    write(tmp_path / "mug.mp4", count=3)
    take_frames(tmp_path, "mug", 60)
    assert [int(path.stem) for path in taken(tmp_path)] == [0, 1, 2]


def test_frames_are_turned_as_a_player_shows_them(tmp_path):
    """By a quarter to the right, as of a telephone held upright: the left upper corner comes to the right."""
    one = 1 << 16
    turn(write(tmp_path / "mug.mp4"), [0, one, 0, -one, 0, 0, SIZE[1] * one, 0, 1 << 30])
    take_frames(tmp_path, "mug", 4)
    picture = Image.open(taken(tmp_path)[-1])
    assert picture.size == SIZE[::-1]
    assert np.asarray(picture)[8:24, -24:-8].mean() == pytest.approx(12 * SHARP[-1], abs=6)


def test_a_folder_with_a_video_is_an_object(tmp_path):
    (tmp_path / "mug").mkdir()
    write(tmp_path / "mug" / "clip.mov")
    photos = Photos(tmp_path, poses=Colmap(), frames=9)
    assert photos.names() == ["mug"] and len(photos.images("mug")) == 9
    with pytest.raises(ValueError, match="objects/poses=colmap finds cameras from photographs"):
        Photos(tmp_path)


def test_what_cannot_be_read_is_refused_and_leaves_nothing(tmp_path):
    (tmp_path / "mug.mp4").write_bytes(b"no video")
    with pytest.raises(ValueError, match=r"mug\.mp4: cannot be read as a video"):
        take_frames(tmp_path, "mug", 4)
    assert [path.name for path in tmp_path.iterdir()] == ["mug.mp4"]
    write(tmp_path / "other.mp4")
    with pytest.raises(ValueError, match=r"want one video, got 2: mug\.mp4, other\.mp4"):
        take_frames(tmp_path, "mug", 4)
