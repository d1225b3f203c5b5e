"""A data set's folder: continued after a kill, extended, refused where it is another's."""

import dataclasses
import hashlib
import json

import numpy as np
import pytest
from small_export import data_of

from neural_sim.synthesis.export import dataset as module
from neural_sim.synthesis.export.images import GOLDEN, SILVER, spread


def written(data, shown=lambda numbers: numbers):
    return data.write(shown)


def contents(root):
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


class Killed(Exception):
    pass


def test_a_killed_export_goes_on_where_it_was(boxes, whole, tmp_path, monkeypatch):
    """In the middle of an image, between files, and in the middle of a record: the result is that of one go."""
    data, at = data_of(boxes, tmp_path / "data"), iter([9, 12, 5])

    def limited(limit):
        calls = iter(range(10**6))

        def write(path, content):
            if next(calls) == limit:
                part = path.with_name(f".{path.name}.part")
                path.parent.mkdir(parents=True, exist_ok=True)
                part.write_bytes(b"half")  # what a process that is killed while it writes leaves
                raise Killed
            original(path, content)

        return write

    original = module.write_whole
    for limit in at:
        monkeypatch.setattr(module, "write_whole", limited(limit))
        with pytest.raises(Killed):
            written(data)
        assert not (tmp_path / "data" / "annotations.json").exists()
        with (tmp_path / "data" / "records.jsonl").open("a") as stream:
            stream.write('{"number": 6, "file": "images/0000')
    monkeypatch.setattr(module, "write_whole", original)
    made = []
    written(data, lambda numbers: made.extend(numbers) or numbers)
    assert 0 < len(made) < 7
    assert contents(tmp_path / "data") == contents(whole[0])


def test_a_set_grows_and_keeps_its_images_and_ids(boxes, whole, tmp_path):
    root = tmp_path / "data"
    written(data_of(boxes, root, count=4))
    few = contents(root)
    before = json.loads(few["annotations.json"])
    made = []
    written(data_of(boxes, root), lambda numbers: made.extend(numbers) or numbers)
    assert made == [4, 5, 6] and contents(root) == contents(whole[0])
    after = json.loads((root / "annotations.json").read_text())
    assert after["images"][:4] == before["images"]
    assert after["annotations"][: len(before["annotations"])] == before["annotations"]
    assert all(
        few[name] == content for name, content in contents(root).items() if name in few and "." not in name
    )
    written(data_of(boxes, root, count=2))  # fewer: none is taken away
    assert contents(root) == contents(whole[0])


def test_a_set_grows_in_the_formats_that_it_has_whatever_is_asked_for(boxes, tmp_path):
    """Otherwise an annotation file would lack images that are in the folder."""
    root = tmp_path / "data"
    written(data_of(boxes, root, count=2, formats=("coco",)))
    written(data_of(boxes, root, count=4, formats=("yolo",)))
    assert len(json.loads((root / "annotations.json").read_text())["images"]) == 4
    written(data_of(boxes, root, count=5, formats=("coco",)))
    assert len(list((root / "labels").iterdir())) == len(list((root / "segment" / "images").iterdir())) == 5


def test_several_processes_write_the_same_bytes(boxes, whole, tmp_path):
    _written_as_by_one(boxes, whole, tmp_path, workers=2)


@pytest.mark.slow
def test_a_cluster_writes_the_same_bytes(boxes, whole, tmp_path, ray_cluster):
    _written_as_by_one(boxes, whole, tmp_path, workers="ray")


def _written_as_by_one(boxes, whole, tmp_path, workers):
    written(data_of(boxes, tmp_path / "data", workers=workers, count=3))
    few = contents(tmp_path / "data")
    assert all(
        content == contents(whole[0])[name] for name, content in few.items() if name.startswith("images/")
    )
    assert len([name for name in few if name.startswith("images/")]) == 3


def test_what_a_worker_raises_is_raised_here(boxes, tmp_path):
    (tmp_path / "data").mkdir()
    data = data_of(boxes, tmp_path / "data", workers=1, count=1)
    for name in ("images", "bop"):
        (tmp_path / name).write_text("no folder")
    blocked = dataclasses.replace(data, root=tmp_path / "images" / "below")
    writer = module.ImageWriter(blocked.source, blocked.root, "png", None, 0.1)
    with pytest.raises(ValueError, match=r"export\.folder: .*000000\.png cannot be written"):
        list(module.each(writer, [0], 1, tmp_path))


def test_a_lost_image_is_made_again(boxes, whole, tmp_path):
    root = tmp_path / "data"
    written(data_of(boxes, root))
    (root / "images" / "000002.png").unlink()
    made = []
    written(data_of(boxes, root), lambda numbers: made.extend(numbers) or numbers)
    assert made == [2] and contents(root) == contents(whole[0])


def test_a_folder_of_something_else_is_refused_and_left_as_it_is(boxes, whole, tmp_path):
    data = data_of(boxes, whole[0])
    before = contents(whole[0])
    other = dataclasses.replace(data, identity={"seed": 3, "psi": {"tall": [0.25]}})
    with pytest.raises(
        ValueError, match=r"export\.folder: .* made with psi\.tall=\[0\.5\], now it is \[0\.25\]; want"
    ):
        written(other)
    assert contents(whole[0]) == before
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    with pytest.raises(
        ValueError, match=r"export\.folder: .*mine has files but no manifest\.json; want a new folder"
    ):
        written(data_of(boxes, tmp_path / "mine"))
    assert contents(tmp_path / "mine") == {"notes.txt": b"mine"}
    with pytest.raises(ValueError, match=r"export\.folder: .*notes\.txt is a file, want a folder"):
        written(data_of(boxes, tmp_path / "mine" / "notes.txt"))
    with pytest.raises(ValueError, match=r"export\.folder: .*below cannot be written: Not a directory"):
        written(data_of(boxes, tmp_path / "mine" / "notes.txt" / "below"))
    (tmp_path / "mine" / "manifest.json").write_text("{")
    with pytest.raises(ValueError, match=r"manifest\.json is not the manifest of an export"):
        written(data_of(boxes, tmp_path / "mine"))


def test_the_manifest_has_hashes_and_poses(whole):
    root, records = whole
    manifest = json.loads((root / "manifest.json").read_text())
    assert manifest["identity"]["seed"] == 3 and [image["number"] for image in manifest["images"]] == list(
        range(7)
    )
    for image, record in zip(manifest["images"], records, strict=True):
        assert image["sha256"] == hashlib.sha256((root / image["file"]).read_bytes()).hexdigest()
        assert len(image["objects"]) == len(record["objects"])
        for item in image["objects"]:
            pose = np.array(item["camera_to_world"])
            assert np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() < 1e-12
            assert np.linalg.norm(pose[:3, 3]) == pytest.approx(item["distance"])


def test_images_for_validation_are_spread_and_stay_so_when_a_set_grows(boxes, tmp_path):
    root = tmp_path / "data"
    written(data_of(boxes, root, count=5, val_fraction=0.3))
    assert (root / "val.txt").read_text() == "./images/000001.png\n./images/000004.png\n"
    assert (root / "dataset.yaml").read_text().startswith("train: train.txt\nval: val.txt\nnc: 3\n")
    written(data_of(boxes, root, val_fraction=0.3))
    assert (root / "segment" / "val.txt").read_text() == "./images/000001.png\n./images/000004.png\n"
    whole, train, val = (
        json.loads((root / f"annotations{part}.json").read_text()) for part in ("", "_train", "_val")
    )
    assert [image["id"] for image in val["images"]] == [2, 5]
    assert sorted(image["id"] for image in (*train["images"], *val["images"])) == [1, 2, 3, 4, 5, 6, 7]
    assert len(train["annotations"]) + len(val["annotations"]) == len(whole["annotations"])
    written(data_of(boxes, root))  # without a split nothing of the old one is left in use
    assert not any((root / name).exists() for name in ("annotations_val.json", "val.txt", "segment/val.txt"))
    assert "no split is made" in (root / "dataset.yaml").read_text()
    thousand = [number for number in range(1000) if spread(number, 0.1, GOLDEN)]
    assert abs(len(thousand) - 100) <= 1
    assert all(abs(sum(number % 6 == label for number in thousand) - 100 / 6) < 4 for label in range(6))


def test_too_few_images_are_not_parted_and_that_is_said(boxes, tmp_path, caplog):
    written(data_of(boxes, tmp_path / "data", count=2, val_fraction=0.1))
    assert "2 images are too few for a split" in caplog.text
    assert "no split is made" in (tmp_path / "data" / "dataset.yaml").read_text()


def test_a_fraction_of_the_images_shows_no_object_and_the_others_are_the_same(boxes, whole, tmp_path):
    data = data_of(boxes, tmp_path / "data")
    data = dataclasses.replace(data, source=dataclasses.replace(data.source, empty=0.3))
    records = written(data)
    empty = [record["number"] for record in records if not record["objects"]]
    assert empty
    for record, before in zip(records, whole[1], strict=True):
        assert record["objects"] == ([] if spread(record["number"], 0.3, SILVER) else before["objects"])
        assert (tmp_path / "data" / "labels" / f"{record['number']:06d}.txt").is_file()
