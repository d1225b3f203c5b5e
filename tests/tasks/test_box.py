"""The task saves a box beside the photographs, and ``masks=scene`` reads it."""

import json

import pytest
from captures import capture
from composing import composed

from neural_sim.configuration import UserError
from neural_sim.main import context_of
from neural_sim.objects.photos import Photos
from neural_sim.report import box_page
from neural_sim.tasks import box as task

BOX = ((-0.2, -0.3, -0.1), (0.4, 0.5, 0.6))


@pytest.fixture
def root(tmp_path):
    for name in ("mug", "can"):
        capture(tmp_path / "captures", name, count=4)
    return tmp_path / "captures"


def run(root, tmp_path, *overrides):
    config = composed("stages=[box]", "box.seconds=0", "scale=smoke", f"paths.store={tmp_path}/store",
        *(("objects=photos", f"objects.root={root}") if root else ()), *overrides)  # fmt: skip
    context, tasks = context_of(config, tmp_path)
    list(tasks["box"].reads(context))
    tasks["box"].run(context)


class Pressed(box_page.BoxPage):
    def __post_init__(self):
        super().__post_init__()
        self.first = self.box
        self.box = BOX
        self.saved()


def test_it_is_saved_read_again_and_part_of_the_digest(root, tmp_path, monkeypatch, capsys):
    pytest.importorskip("viser", reason="the extra viewer is not installed")
    scene = object.__new__(type("Maker", (), {"masks": lambda *_: ()}))
    photos = Photos(root, masks="scene", scene=scene)
    before = photos.digests()
    monkeypatch.setattr(task, "BoxPage", Pressed)
    run(root, tmp_path, "box.object=mug")
    assert json.loads((root / "mug" / "box.json").read_text())["box"] == [list(corner) for corner in BOX]
    assert photos.box_of("mug") == BOX and photos.box_of("can") is None
    after = photos.digests()
    assert after["mug"] != before["mug"] and after["can"] == before["can"]
    assert "open http://127.0.0.1" in capsys.readouterr().out
    # What is set comes first; masks that are given know where the object is.
    set_ = Photos(root, masks="scene", scene=scene, box=((0, 0, 0), (1, 1, 1)))
    assert set_.box_of("mug") == ((0, 0, 0), (1, 1, 1)) and Photos(root).box_of("mug") is None


@pytest.mark.parametrize("text", ["{", "[]", '{"box": [[0, 0, 0], [1, -1, 1]]}', '{"box": [1, 2]}', "{}"])
def test_a_file_that_is_no_box_is_refused_by_its_name(root, text):
    (root / "mug" / "box.json").write_text(text)
    with pytest.raises(ValueError, match=r"box\.json"):
        Photos(
            root, masks="scene", scene=object.__new__(type("Maker", (), {"masks": lambda *_: ()}))
        ).digests()


@pytest.mark.parametrize("chosen", [None, "pot"])
def test_an_object_must_be_chosen_among_several(root, tmp_path, chosen):
    with pytest.raises(UserError, match=f"box.object: want one of can, mug, got {chosen}"):
        run(root, tmp_path, *([] if chosen is None else [f"box.object={chosen}"]))


def test_meshes_have_no_box(tmp_path):
    with pytest.raises(UserError, match="want objects=photos"):
        run(None, tmp_path)
