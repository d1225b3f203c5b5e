"""Masks that the scene's geometry gives, through the stages."""

import pytest
import torch
from captures import capture, on_a_table
from composing import composed
from scenes import Room

from neural_sim.main import UserError, context_of
from neural_sim.objects.procedural import Procedural
from neural_sim.renderer.raycast import RaycastRenderer

SMALL = (
    "scale=smoke", "progress=false", "objects=photos", "objects.masks=scene", "views.count=10",
    "views.image_size=32", "budget.scene.steps=80", "budget.scene.image_size=64", "budget.scene.resolution=48",
    "stages=[views]",
)  # fmt: skip


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures")
    capture(folder, "can", count=12, width=64, height=48, renderer=RaycastRenderer(1), angles=(0.2, 0.42),
            room=Room(table=(-0.83, 4.0)))  # fmt: skip
    return folder


def graph_of(root, folder, *overrides):
    where = [f"objects.root={root}", f"paths.store={folder}/store", f"paths.mlflow={folder}/mlflow.db"]
    context, _ = context_of(composed(*SMALL, *where, *overrides), folder)
    return context.graph, context.results


def test_masks_are_stored_and_keyed_by_what_makes_them(root, tmp_path):
    box = "objects.box=[[0.15,-0.35,0.95],[0.45,-0.05,1.25]]"
    graph, results = graph_of(root, tmp_path, box)
    (stage,) = graph.views
    assert stage.masks is not None and list(stage.inputs) == [stage.masks]
    views = results(stage)
    assert views.images.shape == (11, 32, 32, 4)
    assert float(views.images[..., 3].max()) > 0.5
    (stored,) = (tmp_path / "store" / "masks").glob("*.pt")
    assert stored.stem == stage.masks.key
    again, results = graph_of(root, tmp_path, box)
    assert again.views[0].key == stage.key
    before = stored.stat().st_mtime_ns
    masks = results(again.views[0].masks)
    assert stored.stat().st_mtime_ns == before and len(masks) == 12 and masks[0].shape == (48, 64)
    assert all(torch.equal(mask, mask.clamp(0.0, 1.0)) for mask in masks)
    changed = ("objects.scene.steps=41", "objects.scene.seed=1", "objects.up=-y", "objects.box=null")
    keys = {graph_of(root, tmp_path, box, change)[0].views[0].masks.key for change in changed}
    assert len(keys | {stage.masks.key}) == 5
    # The run's seed and the size of views move no mask.
    same = graph_of(root, tmp_path, box, "seed=7", "views.image_size=40")[0].views[0]
    assert same.masks.key == stage.masks.key and same.key != stage.key


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("objects.masks=sceen", r"objects\.masks: want .*scene.*got 'sceen'"),
        ("objects.scene.steps=0", r"objects\.scene\.steps: want at least 1, got 0"),
        ("objects.scene=null", r"objects\.masks=scene: want objects\.scene"),
        (
            "objects.box=[[0,0,0],[1,0,1]]",
            r"objects\.box: want \[\[x0, y0, z0\], \[x1, y1, z1\]\] with .* or a mapping or null, got",
        ),
    ],
)
def test_what_is_wrong_is_said_before_any_stage(root, tmp_path, override, message):
    with pytest.raises(UserError, match=message):
        graph_of(root, tmp_path, override)


def test_photographs_with_masks_have_no_such_stage(root, tmp_path):
    (root / "can" / "masks").mkdir(exist_ok=True)
    for file in (root / "can" / "truth").iterdir():
        (root / "can" / "masks" / file.name).write_bytes(file.read_bytes())
    graph, results = graph_of(root, tmp_path, "objects.masks=files")
    assert graph.views[0].masks is None
    assert results(graph.views[0]).images.shape == (11, 32, 32, 4)


@pytest.mark.slow
def test_fields_from_these_masks_are_as_good_as_from_true_ones(tmp_path):
    """A mug, from photographs to a field by the command's own stages. Held-out photographs score each on its object."""
    (item,) = Procedural(["mug"]).load()
    truth = on_a_table(tmp_path / "captures", item, count=32, exposure=0.05)
    (truth.folder / "masks").mkdir()
    for file in (truth.folder / "truth").iterdir():
        (truth.folder / "masks" / file.name).write_bytes(file.read_bytes())
    quick = ("scale=quick", "stages=[views,field]", "views.count=32", "views.image_size=64", "budget.grid.steps=120",
             "budget.scene.steps=240", "budget.scene.image_size=160", "budget.scene.resolution=96")  # fmt: skip
    scores = {}
    for masks in ("scene", "files"):
        graph, results = graph_of(tmp_path / "captures", tmp_path, *quick, f"objects.masks={masks}")
        scores[masks] = results(graph.fields[0]).history[-1]["psnr_foreground"]
    # Pixels that are wrongly the object's, 5 % of it, at an error of 0.3 would add 0.0045 to a squared error of 0.01:
    # 1.6 dB. Twice that is the most that masks with an overlap of 0.9 may cost.
    assert scores["scene"] > scores["files"] - 3.2
