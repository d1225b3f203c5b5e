"""What is wrong with a capture is named: its file, the frame, and what is wanted."""

import json
import shutil

import pytest
import torch
from captures import capture
from PIL import Image

from neural_sim.objects.photos import Photos
from neural_sim.objects.pictures import Pictures, box_of

KINDS = ("transforms", "colmap_text", "colmap_binary")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return {kind: capture(tmp_path_factory.mktemp(kind), kind=kind) for kind in KINDS}


def broken(made, tmp_path, change):
    """A copy of the capture whose transforms.json ``change`` has spoilt."""
    home = tmp_path / "can"
    for path in sorted(made["transforms"].folder.rglob("*.*")):
        target = home / path.relative_to(made["transforms"].folder)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(path.read_bytes())
    document = json.loads((home / "transforms.json").read_text())
    change(document, home)
    (home / "transforms.json").write_text(json.dumps(document))
    return tmp_path


def no_pose(document, home):
    del document["frames"][2]["transform_matrix"]


def mirrored(document, home):
    document["frames"][2]["transform_matrix"][0] = [-x for x in document["frames"][2]["transform_matrix"][0]]


def stretched(document, home):
    document["frames"][2]["transform_matrix"][0][0] += 0.2


def not_numbers(document, home):
    document["frames"][2]["transform_matrix"] = "identity"


def no_image(document, home):
    (home / "images" / "002.png").unlink()


def no_images(document, home):
    for path in (home / "images").iterdir():
        path.unlink()


def other_size(document, home):
    Image.new("RGB", (100, 75)).save(home / "images" / "002.png")


def other_model(document, home):
    document["camera_model"] = "THIN_PRISM_FISHEYE"


def no_focal_length(document, home):
    del document["fl_x"]


def no_frames(document, home):
    document["frames"] = []


def bad_up(document, home):
    document["up"] = [0, 0, 0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (no_pose, r"transforms\.json: frames\[2\] \(images/002\.png\): has no pose; want a transform_matrix"),
        (mirrored, r"frames\[2\].*transform_matrix.*not a rotation.*determinant -1"),
        (stretched, r"frames\[2\].*transform_matrix.*not a rotation"),
        (not_numbers, r"frames\[2\].*want a matrix of 4 x 4 numbers, got 'identity'"),
        (no_images, r"transforms\.json: all of its 16 photographs are missing, such as images/000\.png"),
        (other_size, r"frames\[2\].*has 100 x 75 pixels, but its intrinsics w and h say 200 x 150"),
        (other_model, r"frames\[0\].*camera_model: want one of .*got 'THIN_PRISM_FISHEYE'"),
        (no_focal_length, r"frames\[0\].*want intrinsics fl_x or camera_angle_x"),
        (no_frames, r"transforms\.json: want a list 'frames' with at least one frame"),
        (bad_up, r"transforms\.json: up: want three numbers"),
    ],
)
def test_what_is_wrong_in_a_file_is_named(made, tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        Photos(broken(made, tmp_path, change))


def test_listed_photographs_that_are_missing_are_left_out_with_a_count(made, tmp_path, caplog):
    photos = Photos(broken(made, tmp_path / "json", no_image))
    assert len(photos.captures["can"].frames) == 15
    assert (
        "transforms.json: 1 of 16 photographs are missing and left out, such as images/002.png" in caplog.text
    )
    home = tmp_path / "model" / "can"
    shutil.copytree(made["colmap_text"].folder, home)
    for name in ("003.png", "007.png"):
        (home / "images" / name).unlink()
    assert len(Photos(home.parent).captures["can"].frames) == 14
    assert "sparse/0: 2 of 16 photographs are missing and left out, such as" in caplog.text


def test_of_several_models_the_one_with_the_most_photographs_is_taken(made, tmp_path, caplog):
    home = tmp_path / "can"
    shutil.copytree(made["colmap_text"].folder, home)
    shutil.copytree(home / "sparse" / "0", home / "sparse" / "1")
    lines = (home / "sparse" / "0" / "images.txt").read_text().splitlines()
    (home / "sparse" / "0" / "images.txt").write_text("\n".join(lines[:6]) + "\n")
    assert len(Photos(tmp_path).captures["can"].frames) == 16
    assert (
        "sparse/1: used because it has the most photographs (16) of 2 models; left out: 0 (3)" in caplog.text
    )


def test_a_folder_of_one_object_is_its_root(made):
    assert Photos(made["transforms"].folder).names() == ["can"]


def test_photographs_alone_are_refused_with_what_finds_their_cameras(made, tmp_path):
    shutil.copytree(made["transforms"].folder / "images", tmp_path / "can")
    with pytest.raises(ValueError, match=r"objects/poses=colmap finds cameras from photographs alone"):
        Photos(tmp_path)


def test_what_is_wrong_with_masks_is_named(made, tmp_path):
    def small(document, home):
        Image.new("L", (20, 15), 255).save(home / "masks" / "002.png")

    with pytest.raises(
        ValueError, match=r"masks/002\.png: the mask has 20 x 15 pixels, but its image .* has 200 x 150"
    ):
        Photos(broken(made, tmp_path / "small", small)).placement("can")

    def gone(document, home):
        (home / "masks" / "002.png").unlink()

    with pytest.raises(ValueError, match=r"002\.png: has no mask of the object; .*masks=scene"):
        Photos(broken(made, tmp_path / "gone", gone)).placement("can")

    def empty(document, home):
        for path in (home / "masks").iterdir():
            Image.new("L", (200, 150)).save(path)

    with pytest.raises(ValueError, match=r"transforms\.json: no object in the masks of can"):
        Photos(broken(made, tmp_path / "empty", empty)).placement("can")


def test_a_model_that_colmap_cannot_read_is_named(made, tmp_path):
    model = tmp_path / "can" / "sparse" / "0"
    model.mkdir(parents=True)
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        (model / name).write_bytes(b"\x07" * 9)
    with pytest.raises(ValueError, match=r"sparse/0: pycolmap .* cannot read this model"):
        Photos(tmp_path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"up": "up"},
            r"Photos\.up: want one of \+x, .* or three numbers, .* or a mapping or null, got 'up'",
        ),
        ({"up": [0, 0]}, r"Photos\.up"),
        ({"up": {"can": [0, 0, 0]}}, r"Photos\.up\.can: want .* three numbers, not all of them zero"),
        ({"size": -1.0}, r"Photos\.size: want more than 0 or a mapping or null, got -1"),
        ({"size": {"can": float("inf")}}, r"Photos\.size\.can: want more than 0 and finite or null, got inf"),
        ({"size": {"pan": 0.1}}, r"objects\.size: 'pan' is not an object, want some of .*can"),
        ({"mask_value": {"can": 1, "mug": 2}}, r"objects\.mask_value: 'mug' is not an object"),
        ({"names": []}, r"Photos\.names: want 1 or more values or null, got \[\]"),
        ({"names": ["mug"]}, r"objects\.names: 'mug' is not in"),
        ({"masks": "scene"}, r"objects\.masks=scene: want objects\.scene, which computes masks, got none"),
        ({"masks": "command"}, r"objects\.mask_command goes with objects\.masks=command, got .*None"),
        (
            {"mask_command": "true {images} {masks}"},
            r"objects\.mask_command goes with objects\.masks=command",
        ),
        (
            {"masks": "command", "mask_command": "true {images}"},
            r"objects\.mask_command: want \{images\} and \{masks\} in it, got 'true \{images\}' without \{masks\}",
        ),
        (
            {"masks": "command", "mask_command": "no-such-program {images} {masks}"},
            r"objects\.mask_command: no such program: no-such-program",
        ),
        (
            {"box": [[0, 0, 0], [1, 1, 1]]},
            r"objects\.box wants objects\.masks=scene, got objects\.masks=auto",
        ),
    ],
)
def test_bad_options_are_refused(made, options, message):
    with pytest.raises(ValueError, match=message):
        Photos(made["transforms"].folder.parent, **options)


@pytest.mark.parametrize(
    "box",
    [
        3.0,
        [[0, 0, 0]],
        [[0, 0], [1, 1]],
        [[0, 0, 0], [1, 1, float("nan")]],
        [[0, 0, 0], [1, -1, 1]],
        [[0, 0, "0"], [1, 1, 1]],
        {"can": [0, 1]},
    ],
)
def test_bad_boxes_are_refused(made, box):
    with pytest.raises(ValueError, match=r"Photos\.box(\.can|\[\d\])*: want .*, got"):
        Photos(made["transforms"].folder.parent, box=box)


def test_a_box_is_everyones_or_one_objects():
    corners = [[0, 0, 0], [1, 2, 3]]
    assert box_of(corners, "can") == ((0.0, 0.0, 0.0), (1.0, 2.0, 3.0)) == box_of({"can": corners}, "can")
    assert box_of({"can": corners}, "mug") is None is box_of(None, "mug")


def test_computed_masks_are_resized_and_as_many_as_photographs(made):
    capture = Photos(made["transforms"].folder.parent).captures["can"]
    with pytest.raises(ValueError, match=r"objects\.masks=scene: want 16 computed masks .* of can, got 1"):
        Pictures(capture, "scene", (torch.ones(3, 4),))
    with pytest.raises(ValueError, match=r"objects\.masks=auto: want 0 computed masks"):
        Pictures(capture, "auto", (torch.ones(3, 4),))
    masks = tuple(torch.full((15, 20), number / 16.0) for number in range(16))
    pictures = Pictures(capture, "scene", masks)
    # Sharpened about a half: 0.25 is nothing, 0.75 all, and 0.4375 lies between.
    for number, alpha in ((4, 0.0), (7, 0.25), (12, 1.0)):
        rgba = pictures.rgba(capture.frames[number])
        assert rgba.shape == (150, 200, 4)
        torch.testing.assert_close(rgba[..., 3], torch.full((150, 200), alpha))


def test_folders_without_captures_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"holds no folder with a transforms\.json or a COLMAP model"):
        Photos(tmp_path)


def test_the_digest_follows_files_and_options(made, tmp_path):
    def nothing(document, home):
        pass

    root = broken(made, tmp_path, nothing)
    first = Photos(root).digests()["can"]
    assert Photos(root).digests()["can"] == first != Photos(root, up="-y").digests()["can"]
    mask = root / "can" / "masks" / "000.png"
    mask.write_bytes((root / "can" / "masks" / "001.png").read_bytes())
    assert Photos(root).digests()["can"] != first
