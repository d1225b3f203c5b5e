"""Cameras of photographs alone: found where they can be, and refused with what to do where they cannot."""

import logging
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import ExifTags, Image
from scenes import Room

from neural_sim.cameras import orbit
from neural_sim.objects.album import read_album
from neural_sim.objects.motion import Colmap
from neural_sim.objects.procedural import Procedural
from neural_sim.objects.standing import standing_parts
from neural_sim.renderer.raycast import RaycastRenderer
from neural_sim.types import PinholeCamera

pytest.importorskip("pycolmap", reason="the extra photos is not installed")

FOCAL = 300.0
ROOM = Room(half=(4.0, 3.5, 3.0), table=(-0.8, 3.0))
SMALL = Colmap(features=1200)
RANDOM = np.random.default_rng(0)


def nothing(shot):
    return None


def poses_round(count, turn=1.3):
    """Camera-to-world of cameras round the origin, over ``turn`` radians."""
    at = torch.linspace(0.0, 1.0, count, dtype=torch.float64)
    return orbit(
        math.pi * (0.3 + 0.06 * torch.sin(9.0 * at)), turn * at, 2.6 + 0.2 * torch.cos(7.0 * at)
    ).numpy()


def photograph(pose, width=320, height=240, focal=FOCAL, room=ROOM):
    """What a pinhole camera in a room sees."""
    x, y = np.meshgrid(
        (np.arange(2 * width) + 0.5 - width) / (2 * focal),
        (np.arange(2 * height) + 0.5 - height) / (2 * focal),
    )
    rays = np.stack([x, -y, -np.ones_like(x)], -1).reshape(-1, 3) @ pose[:3, :3].T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    seen = room.colours(np.broadcast_to(pose[:3, 3], rays.shape), rays)
    return seen.reshape(height, 2, width, 2, 3).mean((1, 3))


def disc(pose, height, radius):
    """Which pixels of such a photograph show a round table in the room."""
    x, y = np.meshgrid((np.arange(320) + 0.5 - 160.0) / FOCAL, (np.arange(240) + 0.5 - 120.0) / FOCAL)
    rays = np.stack([x, -y, -np.ones_like(x)], -1) @ pose[:3, :3].T
    far = (height - pose[2, 3]) / rays[..., 2]
    return (far > 0.0) & (np.linalg.norm(pose[:2, 3] + far[..., None] * rays[..., :2], axis=-1) < radius)


def save(pixels, path, **more):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((255.0 * pixels.clip(0.0, 1.0)).round().astype(np.uint8)).save(path, quality=95, **more)


def noise(path):
    save(RANDOM.random((240, 320, 3)), path)


def turned(orientation):
    made = Image.Exif()
    made[0x0112] = orientation
    return made


def similarity(found, truth):
    """Scale, rotation and shift that bring one set of points nearest to another (Umeyama 1991)."""
    a, b = found - found.mean(0), truth - truth.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ sign @ vt
    scale = float((s * np.diag(sign)).sum() / (a**2).sum())
    return scale, rotation, truth.mean(0) - scale * rotation @ found.mean(0)


def errors(found, truth):
    """Largest errors of position, in distances of the cameras' spread, and of rotation, in degrees."""
    scale, rotation, shift = similarity(found[:, :3, 3], truth[:, :3, 3])
    apart = np.linalg.norm(scale * found[:, :3, 3] @ rotation.T + shift - truth[:, :3, 3], axis=1)
    spread = np.linalg.norm(truth[:, :3, 3] - truth[:, :3, 3].mean(0), axis=1).mean()
    angles = []
    for one, other in zip(found, truth, strict=True):
        cosine = 0.5 * (np.trace(other[:3, :3].T @ rotation @ one[:3, :3]) - 1.0)
        angles.append(math.degrees(math.acos(min(1.0, max(-1.0, cosine)))))
    return float(apart.max() / spread), max(angles), rotation


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """Fourteen photographs: the first of a camera in landscape, then of another in portrait; some are stored on their
    side with EXIF, and two are of nothing."""
    folder, truth = tmp_path_factory.mktemp("walk") / "table", {}
    poses = poses_round(14)
    for number, pose in enumerate(poses):
        name, pose = f"{number:02d}.jpg", pose.copy()
        if number < 7:
            save(photograph(pose), folder / "images" / name)
        elif number < 11:
            save(photograph(pose, 240, 320, 330.0), folder / "images" / name)
        else:  # the pixels lie a quarter turn to the left of upright ones: shown, EXIF 6 turns them to the right
            upright = photograph(pose, 240, 320)
            save(np.rot90(upright), folder / "images" / name, exif=turned(6))
            pose[:3, :3] = pose[:3, :3] @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        truth[name] = pose
    for name in ("20.jpg", "21.jpg"):
        noise(folder / "images" / name)
    return folder, truth


@pytest.fixture(scope="module")
def found(walk):
    return SMALL.find(read_album(walk[0], "table"), nothing)


def test_cameras_are_those_that_took_the_photographs(walk, found):
    frames, truth = found.capture.frames, walk[1]
    assert [frame.image.name for frame in frames] == sorted(truth)
    apart, degrees, rotation = errors(
        np.stack([frame.camera_to_world for frame in frames]), np.stack([truth[f.image.name] for f in frames])
    )
    assert apart < 0.02 and degrees < 1.0
    # Upright photographs, others on their side by EXIF: up is up.
    up = rotation @ np.array(found.capture.up)
    assert up[2] / np.linalg.norm(up) > 0.99


def test_found_cameras_stand_round_the_origin_on_the_side_of_x(found):
    places = np.stack([frame.camera_to_world[:3, 3] for frame in found.capture.frames])
    assert np.median(np.linalg.norm(places, axis=1)) == pytest.approx(1.0)
    across = places[:, :2] / np.linalg.norm(places[:, :2], axis=1, keepdims=True)
    assert np.arctan2(*across.mean(0)[::-1]) == pytest.approx(0.0, abs=1e-9) and (places[:, 2] > 0.3).all()
    assert found.capture.up == (0.0, 0.0, 1.0)


def test_photographs_of_one_camera_share_its_lens_at_their_own_size(found):
    lenses = {frame.image.name: frame.lens for frame in found.capture.frames}
    assert {(lens.width, lens.height) for lens in lenses.values()} == {(320, 240), (240, 320)}
    assert len({lenses[name] for name in list(lenses)[:7]}) == 1
    for name, lens in lenses.items():
        assert lens.fx == pytest.approx(330.0 if "07" <= name < "11" else FOCAL, rel=0.05)


def test_photographs_without_a_camera_are_named(found, caplog):
    assert found.missing == ("images/20.jpg", "images/21.jpg")
    with caplog.at_level(logging.INFO):
        found.tell()
    assert "found the cameras of 14 of 16 photographs" in caplog.text
    assert (
        "no camera found for 2 photographs, which are left out: images/20.jpg, images/21.jpg" in caplog.text
    )
    assert 0.0 < found.error < 1.0 and found.points > 100 and not found.turning


def refused(folder, message, finder=SMALL):
    with pytest.raises(ValueError, match=message) as error:
        finder.find(read_album(folder, "table"), nothing)
    assert "\n" not in str(error.value) and str(folder) in str(error.value)


def test_too_few_photographs_are_refused(tmp_path):
    for number in range(3):
        noise(tmp_path / f"{number}.png")
    refused(tmp_path, r"want at least 8 photographs to find cameras, got 3; take 40 or more")


def test_photographs_without_overlap_are_refused(tmp_path):
    for number in range(8):
        noise(tmp_path / f"{number}.png")
    refused(
        tmp_path,
        r"no two of the 8 photographs have enough in common.*two thirds of what the one before shows",
    )


def test_photographs_from_one_place_are_refused(tmp_path):
    (pose,) = poses_round(1)
    for number in range(9):
        angle, here = 0.09 * (number - 4), pose.copy()
        turn = np.array(
            [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
        )
        here[:3, :3] = pose[:3, :3] @ turn
        save(photograph(here), tmp_path / f"{number}.png")
    refused(tmp_path, r"taken from (nearly )?one place.*walk around the object")


# --- turntables ---


@pytest.fixture(scope="module")
def turntable(tmp_path_factory):
    """A mug on a stepped table that turns in a room that stands still, by a camera that stands still; the camera's
    poses in the frame of the table, and where the photographs show what turns."""
    folder = tmp_path_factory.mktemp("turntable") / "mug"
    (item,) = Procedural(["mug"]).load()
    count = 12
    poses = orbit(
        torch.full((count,), 0.3 * math.pi, dtype=torch.float64),
        torch.linspace(0.0, 1.1, count, dtype=torch.float64),
        torch.full((count,), 3.6, dtype=torch.float64),
    )
    camera = PinholeCamera(320, 240, 2.0 * math.atan(0.5 * 240 / FOCAL))
    mugs = RaycastRenderer(1).render(item.mesh, camera, poses).numpy()
    empty, masks = Room(half=ROOM.half, table=None), []
    room, said = photograph(poses[0].numpy(), room=empty), Image.Exif()
    # FOCAL in millimetres of film: 32.45, which EXIF rounds.
    said.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 32
    for number, (pose, mug) in enumerate(zip(poses.numpy(), mugs, strict=True)):
        seen, shown = room, mug[..., 3] > 0.5
        for height, radius in ((-1.4, 1.2), (-0.8, 0.8)):
            table = photograph(
                pose, room=Room(half=ROOM.half, table=(height, radius), seed=round(10 * radius))
            )
            on = disc(pose, height, radius)
            seen, shown = np.where(on[..., None], table, seen), shown | on
        seen = mug[..., 3:] * mug[..., :3] + (1.0 - mug[..., 3:]) * seen
        save(seen, folder / f"{number:02d}.jpg", exif=said)
        masks.append(shown)
    return folder, poses.numpy(), np.stack(masks)


@pytest.mark.slow
def test_a_room_that_stands_still_is_told_from_an_object_that_turns(turntable, walk):
    folder, _, masks = turntable
    shots = read_album(folder, "mug").shots
    standing = standing_parts(shots)
    assert standing is not None
    still = next(iter(standing.values()))
    height, width = still.shape
    ever = np.stack([np.asarray(Image.fromarray(mask).resize((width, height))) for mask in masks]).mean(0)
    assert still[ever == 0.0].mean() > 0.8 and still[ever > 0.5].mean() < 0.2
    assert standing_parts(read_album(walk[0], "table").shots[:7]) is None


@pytest.mark.slow
def test_cameras_of_a_turntable_are_those_about_the_object(turntable, caplog):
    folder, poses, masks = turntable
    for mask in (nothing, lambda shot: masks[int(shot.image.stem)]):
        found = SMALL.find(read_album(folder, "mug"), mask)
        numbers = [int(frame.image.stem) for frame in found.capture.frames]
        apart, degrees, _ = errors(
            np.stack([f.camera_to_world for f in found.capture.frames]), poses[numbers]
        )
        # What turns is 200 pixels wide and flat: its 160 features say little of the cameras' tilt, which is off by 5 to
        # 18 degrees, whatever rounding a processor has. Features of the room would put all cameras in one place.
        assert found.turning and len(numbers) == len(poses) and apart < 0.2 and degrees < 25.0
    found.tell()
    assert "the room stands still in the photographs while the object turns" in caplog.text
    # The room alone says that the camera stood still, and the two together say nothing.
    with pytest.raises(ValueError, match=r"fit together|one place"):
        replace(SMALL, region="all").find(read_album(folder, "mug"), nothing)
