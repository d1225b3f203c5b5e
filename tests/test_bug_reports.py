"""Inputs of public bug reports, as the scripts beside the repository lay them out: right, or refused with the file."""

import logging
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from shared_inputs import laid_out

from neural_sim.cameras import orbit
from neural_sim.objects.files import MeshFiles
from neural_sim.objects.folder import MeshFolder
from neural_sim.objects.photos import Photos
from neural_sim.pictures import check_headers, read_picture
from neural_sim.renderer.lighting import Lighting
from neural_sim.renderer.raycast import RaycastRenderer
from neural_sim.report.tracking import opened, tracking_uri
from neural_sim.synthesis.background import PhotoFolder
from neural_sim.target.bop import BopScenes
from neural_sim.target.coco import CocoTarget
from neural_sim.target.folders import FolderTarget
from neural_sim.target.frames import FrameName
from neural_sim.target.photographs import PhotoFiles
from neural_sim.types import LabelledImages, PinholeCamera

NAMES = ["mug", "can"]


def loaded(path: Path) -> LabelledImages:
    return CocoTarget(path).load(NAMES, 60, 80)


def test_01_boxes_lie_on_the_objects_of_turned_photographs(tmp_path):
    images = loaded(laid_out("01", tmp_path) / "labels.json")
    for image, boxes in zip(images.images, images.boxes.tolist(), strict=True):
        rows, columns = np.nonzero((image[0] - image[1]).numpy() > 0.5)
        found = columns.min(), rows.min(), columns.max() + 1, rows.max() + 1
        assert np.abs(np.subtract(found, boxes[0])).max() <= 1


def test_02_one_id_of_several_images_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"labels\.json: .*'000\.png' and '001\.png'.* id, 20250116"):
        loaded(laid_out("02", tmp_path) / "labels.json")


def test_03_annotations_of_no_image_are_refused(tmp_path):
    out = laid_out("03", tmp_path)
    for name in ("labels", "orphans", "mixed"):
        with pytest.raises(ValueError, match=rf"{name}\.json: no annotation is of an image that it lists"):
            loaded(out / f"{name}.json")


def test_04_boxes_that_are_none_are_named(tmp_path):
    out = laid_out("04", tmp_path)
    places = {"category_null": "category_id", "category_list": "category_id", "image_list": "image_id"}
    for path in sorted(out.glob("*.json")):
        if path.stem == "labels":
            assert len(loaded(path)) == 6
            continue
        place = places.get(path.stem, "bbox")
        with pytest.raises(ValueError, match=rf"{path.name}: annotations\[0\].*{place}"):
            loaded(path)


def test_05_backslashes_are_read_and_a_number_is_no_name(tmp_path):
    out = laid_out("05", tmp_path)
    assert loaded(out / "labels.json").present.sum() == 6
    with pytest.raises(ValueError, match=r"number\.json: images\[0\]\.file_name: .*got 7"):
        loaded(out / "number.json")


def test_06_sixteen_bits_and_floats_are_grey(tmp_path):
    out = laid_out("06", tmp_path)
    means = [float(image.mean()) for image in loaded(out / "labels.json").images]
    assert 0.3 < means[0] < 0.5 and means == sorted(means, reverse=True) and means[5] < 0.3
    photos = PhotoFiles(str(out / "*.*"), "predict.images")
    for name in ("picture.png", "float.tif"):
        values = np.asarray(photos.read(out / name))[0]
        assert np.abs(values[:, 0].astype(float) - np.linspace(0, 255, 80)).max() < 1.1
    captures = Photos(out / "captures")
    depth, masks = (
        captures.pictures(name).rgba(captures.captures[name].frames[0]) for name in ("photo16", "mask16")
    )
    assert 0.1 < float(depth[..., :3].mean()) < 0.9
    assert set(masks[..., 3].unique().tolist()) == {0.0, 1.0}
    placements = [captures.placement(name) for name in ("photo16", "mask16")]
    assert placements[0].radius == placements[1].radius


def test_08_pictures_above_pillows_limit_are_named_before_anything_is_computed(tmp_path):
    out = laid_out("08", tmp_path)
    for read in (
        lambda: loaded(out / "labels.json"), lambda: PhotoFolder(out / "backgrounds"),
        lambda: check_headers(PhotoFiles(str(out / "pictures"), "predict.images").paths, "predict.images"),
        lambda: Photos(out / "captures"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=r"0\.png.*not a readable image .*exceeds limit"):
            read()


def test_09_large_metadata_is_named(tmp_path):
    out = laid_out("09", tmp_path)
    with pytest.raises(ValueError, match=r"000\.png \(named in .*not a readable image"):
        loaded(out / "labels.json")
    try:
        read_picture(out / "001.png")
    except ValueError as error:
        assert "001.png: not a readable image" in str(error)


def test_10_leftovers_of_a_mac_are_left_out(tmp_path, caplog):
    out = laid_out("10", tmp_path)
    with caplog.at_level(logging.WARNING):
        assert len(PhotoFolder(out / "backgrounds").files) == 6
        assert len(FolderTarget(out / "by_class").photographs(NAMES)) == 12
        assert len(PhotoFiles(str(out / "pictures"), "predict.images").paths) == 6
        for folder in ("meshes", "macosx"):
            meshes: MeshFiles = MeshFolder(out / folder)
            assert meshes.names() == ["box"]
    assert caplog.text.count("leftovers of other programs are left out, such as") == 6


def seen_colours(path: Path, name: str) -> list[list[int]]:
    """What an object of a folder shows of itself where it is plain, by the left edge of each colour."""
    (item,) = MeshFolder(path, [name]).load()
    pose = orbit(*(torch.tensor([value], dtype=torch.float64) for value in (0.9, 0.1, 3.0)))
    renderer = RaycastRenderer(1, Lighting((), ambient=1.0))
    view = 255.0 * renderer.render(item.mesh, PinholeCamera(48, 48, 0.8), pose)[0]
    pixels = view[(view[..., 3] > 254.0).nonzero(as_tuple=True)][:, :3].round()
    colours, counts = pixels.unique(dim=0, return_counts=True)
    return [colour.int().tolist() for colour, count in zip(colours, counts, strict=True) if count > 30]


def test_12_models_and_masks_of_colmaps_layouts_are_found_by_their_whole_names(tmp_path):
    """Masks of another photograph would show: the spheres' outlines differ from camera to camera."""
    out = laid_out("12", tmp_path)
    with pytest.raises(
        ValueError, match=r"halved/sparse/0: image .*has 120 x 90 pixels, but camera 1 has 240 x 180"
    ):
        Photos(out, ["halved"])
    kinds = ("spaces", "spaces_binary", "folders", "no_points", "comments", "upper", "input")
    plain = Photos(out, ["comments"]).placement("comments")
    for name in kinds:
        photos = Photos(out, [name])
        assert len({frame.image for frame in photos.captures[name].frames}) == 12, name
        placement = photos.placement(name)
        assert placement.radius == pytest.approx(plain.radius) and 0.5 < plain.radius < 0.6, name
        for frame in photos.captures[name].frames:
            rgba = photos.pictures(name).rgba(frame)
            background = (rgba[..., :3] - 200 / 255).abs().amax(-1) < 1e-3
            assert (background == (rgba[..., 3] == 0)).float().mean() > 0.99, frame.image


def test_13_frames_are_divided_as_the_file_says(tmp_path, caplog):
    out = laid_out("13", tmp_path)
    with caplog.at_level(logging.INFO):
        photos = Photos(out)
        train, scored = photos.split("ball", 100, 100)
    assert [frame.image.name for frame in scored] == [f"f{number:03d}.png" for number in range(12, 16)]
    assert len(train) == 12 and "train 12, val 2, test 2" in caplog.text


def test_14_intrinsics_are_the_frames_own_or_refused_by_file_frame_and_key(tmp_path, caplog):
    out = laid_out("14", tmp_path)
    for name in ("backslash", "bom", "no_suffix", "frame_angle", "per_frame_only", "null_values"):
        lens = Photos(out, [name]).captures[name].frames[0].lens
        assert (lens.fx, lens.cx, lens.cy) == pytest.approx((140.0, 60.0, 45.0)), name
    reasons = {
        "angle_zero": r"frames\[0\] .*camera_angle_x: want an angle in radians .*got 0",
        "angle_degrees": r"frames\[0\] .*camera_angle_x: want an angle in radians .*got 46\.",
        "w_nan": r"frames\[0\] .*w: want a number, got nan", "strings": r"frames\[0\] .*fl_x: want a number, got '140",
        "halved_no_wh": r"frames\[0\] .*cx and cy \(120, 90\) are outside", "halved_wh": r"frames\[0\] .*240 x 180",
        "some_frames": r"frames\[0\] .*want intrinsics",
        "duplicated": r"frames\[0\] and frames\[1\] are both of 'images/000\.png'",
        "fisheye_name": r"frames\[0\] .*camera_model: .*'FISHEYE'",
        "equirectangular": r"frames\[0\] .*camera_model: .*EQUI",
    }  # fmt: skip
    for name, reason in reasons.items():
        with pytest.raises(ValueError, match=rf"{name}/transforms\.json: {reason}"):
            Photos(out, [name])
    assert len(Photos(out, ["unregistered"]).captures["unregistered"].frames) == 11
    assert "transforms.json: 1 photographs have no pose and are left out" in caplog.text


def test_16_every_primitive_of_a_glb_has_its_own_colour(tmp_path):
    """By glTF 2.0, in linear space: sRGB of linear 0.02, 0.2, 0.7 is 39, 124, 218."""
    out = laid_out("16", tmp_path)
    red, green, blue = [240, 79, 79], [39, 218, 39], [39, 39, 218]
    wanted = {
        "colour_no_material": [red], "colour_and_material": [red], "two_factors": [blue, green],
        "texture_and_factor": [[20, 180, 20], blue], "texture_times_factor": [[250, 87, 87]],
        "two_unit_factors": [[20, 20, 180], [20, 180, 20]], "two_no_factors": [[20, 20, 180], [20, 180, 20]],
        "factor_grey": [[124, 124, 124]], "factor_grey_beside_blue": [blue, [124, 124, 124]],
        "textured_and_vertex": [[20, 180, 20], red],
    }  # fmt: skip
    for name, colours in wanted.items():
        assert np.abs(np.subtract(seen_colours(out, name), colours)).max() <= 1, name
    with pytest.raises(ValueError, match=r"draco\.glb: .*requires KHR_draco_mesh_compression"):
        MeshFolder(out, ["draco"]).load()


def test_17_materials_of_obj_files_are_found_or_refused_by_name(tmp_path):
    out = laid_out("17", tmp_path)
    red, blue = [220, 20, 20], [20, 20, 220]
    plain = (
        "sub_folder", "backslash", "windows_path", "spaces", "options", "case", "no_usemtl", "kd_tint", "cmyk",
        "palette", "tga", "bmp",
    )  # fmt: skip
    wanted = {
        "two": [blue, red], "kd_and_texture": [[26, 26, 230], red], "two_kd": [[26, 26, 230], [230, 26, 26]],
        "dissolve": [[230, 26, 26]], "grey16": [[78, 78, 78]], **{name: [red] for name in plain},
    }  # fmt: skip
    for name, colours in wanted.items():
        assert np.abs(np.subtract(seen_colours(out, name), colours)).max() <= 1, name
    assert red in seen_colours(out, "tiled") and blue in seen_colours(out, "tiled")
    with pytest.raises(ValueError, match=r"missing\.obj: .*missing\.mtl, line 2: the texture 'gone\.png'"):
        MeshFolder(out, ["missing"]).digests()


@pytest.mark.parametrize(
    ("given", "name"),
    [
        (1, "1"),
        (20240501, "2024_05_01"),
        ("on", "on"),
        (None, "null"),
        (1000.0, "1e3"),
        (True, "true"),
        (7, "007"),
    ],
)
def test_18_names_that_the_command_line_takes_for_numbers_are_names(tmp_path, given, name):
    root = laid_out("18", tmp_path) / "meshes"
    assert MeshFolder(root, [given]).names() == [name]
    with pytest.raises(ValueError, match=r"3 is not in .*; quote it: \"objects\.names=\['3'\]\""):
        MeshFolder(root, [3])


def test_18_folders_and_categories_of_digits_are_classes(tmp_path):
    out = laid_out("18", tmp_path)
    target = FolderTarget(out / "by_class", classes={0: "mug", 1: "can"})
    assert len(target.photographs(NAMES)) == 12
    assert len(CocoTarget(out / "labels.json", categories={0: "mug", 1: "can"}).load(NAMES, 60, 80)) == 8


def test_19_what_is_no_database_is_refused_at_once_with_its_key(tmp_path):
    out = laid_out("19", tmp_path)
    reasons = {
        "garbage": "is not an SQLite database",
        "folder": "is a folder, want a file",
        "newer": "a newer MLflow",
    }
    for name, reason in reasons.items():
        with (
            pytest.raises(ValueError, match=rf"paths\.mlflow: .*{name}\.db.*{reason}.*set paths\.mlflow"),
            opened(tracking_uri(str(out / f"{name}.db")), "gap", "run", {}, {}),
        ):
            raise AssertionError(f"{name} was opened")


def test_21_bop_sets_of_other_writers_are_read_or_refused_by_file(tmp_path):
    out = laid_out("21", tmp_path)
    itodd = BopScenes(out / "itodd")
    depth = itodd.frame(FrameName("val/000000", 1), depth=True).depth
    assert depth is not None and np.allclose(depth, 0.3)  # 3000 of 0.1 mm
    with pytest.raises(ValueError, match=r"scene_gt_info\.json: 0\[0\]: visib_fract: want .*got 1\.0002"):
        BopScenes(out / "above_one").frame(FrameName("train_pbr/000000", 0))
    with pytest.raises(ValueError, match=r"blenderproc/train_pbr/000000/scene_gt_info\.json: not readable"):
        BopScenes(out / "blenderproc").frame(FrameName("train_pbr/000000", 0))


@pytest.mark.parametrize("number", ["23", "26"])
def test_23_26_a_changed_texture_changes_the_digest(tmp_path, number):
    out = laid_out(number, tmp_path)
    before = MeshFolder(out).digests()
    for name in before:
        assert seen_colours(out, name) == [[220, 20, 20]] or name == "jpg"
        texture = next(
            path for path in (out / name).rglob("*") if path.suffix in (".png", ".bmp", ".tga", ".jpg")
        )
        Image.new("RGB", (8, 8), (20, 220, 20)).save(texture)
    after = MeshFolder(out).digests()
    assert all(before[name] != after[name] for name in before)


def test_26_a_missing_texture_of_a_ply_is_refused_by_name(tmp_path):
    out = laid_out("26", tmp_path)
    (out / "spaces" / "my texture.png").unlink()
    with pytest.raises(ValueError, match=r"m\.ply: .*'my texture\.png' was not found"):
        MeshFolder(out, ["spaces"]).digests()


def test_20_a_root_category_is_left_out(tmp_path, caplog):
    out = laid_out("20", tmp_path)
    with caplog.at_level(logging.WARNING):
        assert loaded(out / "labels.json").present.sum() == 6
    assert "['shelf-objects'] are not objects and have no annotation: left out" in caplog.text


def test_24_an_opaque_alpha_channel_is_no_mask(tmp_path):
    with pytest.raises(ValueError, match=r"000\.png: has no mask of the object"):
        Photos(laid_out("24", tmp_path)).placement("ball")


def test_15_turned_photographs_of_captures_are_as_stored_or_refused_by_their_exif(tmp_path):
    out = laid_out("15", tmp_path)
    stored = Photos(out, ["stored"])
    frame = stored.captures["stored"].frames[0]
    assert stored.pictures("stored").rgba(frame).shape == (90, 120, 4)
    with pytest.raises(ValueError, match=r"90 x 120 pixels, .*say 120 x 90; its EXIF orientation 6 shows"):
        Photos(out, ["upright"])
