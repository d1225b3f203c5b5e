"""Parts from outside the package, each one file and one YAML in tests/outside: what CONTRIBUTING.md says to add."""

import importlib.util
import json
import shutil
import sys
from pathlib import Path

import pytest
import torch
from composing import composed
from PIL import Image

from neural_sim.detector.onnx_export import TOLERANCE, export, largest_difference
from neural_sim.detector.saved_detector import SavedDetector
from neural_sim.main import UserError, build, context_of
from neural_sim.synthesis.export.coco import write_coco
from neural_sim.tasks.walk import walk

OUTSIDE = Path(__file__).parent / "outside"
MINE = {
    "parameter": "parameter=[my_turn]",
    "gradient": "gradient=my_score_function",
    "detector": "detector=my_cells",
}


@pytest.fixture(autouse=True)
def on_the_path(monkeypatch):
    monkeypatch.syspath_prepend(OUTSIDE)
    yield
    for path in OUTSIDE.glob("*.py"):
        sys.modules.pop(path.stem, None)


def outside(*overrides):
    """As ``python -m src.main --config-dir tests/outside/conf`` composes it."""
    return composed(f"hydra.searchpath=[file://{OUTSIDE / 'conf'}]", "scale=smoke", *overrides)


def test_each_is_built_from_its_group():
    pose = build(outside()).imaging.distribution
    with_turn = build(outside("parameter=[pose,my_turn]")).imaging.distribution
    assert with_turn.names == ("pose", "turn") and with_turn.size == pose.size + 4
    target = with_turn.probabilities(with_turn.psi("target", ["mug"]))["turn"][0]
    torch.testing.assert_close(target, torch.tensor([0.02, 0.94, 0.02, 0.02], dtype=torch.float64))
    assert build(outside(MINE["gradient"])).loop.gradient.chunk_size == 8
    detector = build(outside(MINE["detector"])).detector(num_classes=2, image_size=(32, 48))
    assert len(detector.anchors) == 24


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("parameter.turn.bins=two", "parameter.turn.bins: want a whole number, got 'two'"),
        ("parameter.turn.range_deg=[3,1]", r"parameter.turn.range_deg: want increasing values, got \[3, 1\]"),
        ("+gradient.draws=1", "gradient.draws: unknown key, want one of chunk_size"),
        ("detector.cell=0.5", "detector.cell: want a whole number, got 0.5"),
    ],
)
def test_its_settings_are_checked_like_all_others(override, message):
    with pytest.raises(UserError, match=message):
        build(outside(*MINE.values(), override))


def test_the_pages_example_is_the_detector_that_is_run_here():
    page = (OUTSIDE.parents[1] / "docs" / "extending.md").read_text(encoding="utf-8")
    for path in ("my_detector.py", "conf/detector/my_cells.yaml"):  # the site's build takes the files in
        assert f'\n--8<-- "tests/outside/{path}"\n' in page and (OUTSIDE / path).is_file()
    assert len((OUTSIDE / "my_detector.py").read_text(encoding="utf-8").splitlines()) <= 60


def test_the_detector_s_boxes_are_those_that_it_was_assigned():
    detector = build(outside(MINE["detector"])).detector(num_classes=2, image_size=(32, 48))
    boxes = torch.tensor([[[4.0, 3, 22, 25], [20, 8, 44, 30]]])
    targets = detector.assign(boxes, torch.tensor([[1, 0]]))
    found = targets.labels[0] >= 0
    decoded = detector.decode(targets.deltas)[0, found]
    assert found.any()
    torch.testing.assert_close(decoded, boxes[0, 1 - targets.labels[0, found]])
    anchors = found.nonzero()[:, 0]
    torch.testing.assert_close(detector.decode(targets.deltas[0, anchors], anchors), decoded)


def test_a_target_is_parted_letterboxed_and_keyed_like_all_others(tmp_path):
    """Twelve photographs of a can, of different greys, with one box each; half of them are scored."""
    lines = ["file,class,x0,y0,x1,y1"]
    for number in range(12):
        Image.new("RGB", (40, 20), (20 * number,) * 3).save(tmp_path / f"{number}.png")
        lines.append(f"{number}.png,can,4,2,24,12")
    (tmp_path / "boxes.csv").write_text("\n".join(lines))
    table = f"target.table={tmp_path}/boxes.csv"
    words = ["target=my_table", table, "target.val_fraction=0.5", "target.train_fraction=0.5"]
    config = outside(
        *words, "objects.names=[can,mug]", "stages=[target_sets]", "progress=false", "training.image_size=64",
        f"paths.store={tmp_path}/store", f"paths.mlflow={tmp_path}/mlflow.db",
    )  # fmt: skip
    context, _ = context_of(config, tmp_path)
    graph = context.graph
    made = context.results(graph.targets)
    assert (len(made.train), len(made.val), len(made.test)) == (3, 3, 6)
    for part in (made.train, made.val, made.test):
        assert part.boxes.tolist() == [[pytest.approx([6.4, 19.2, 38.4, 35.2])]] * len(part)
        assert part.labels.tolist() == [[0]] * len(part)
    assert not graph.renders_target and len(graph.targets.description["target"]["digest"]) == 64
    with pytest.raises(UserError, match=r"target\.val_fraction: want more than 0 and less than 1, got 1\.5"):
        build(outside(*words, "target.val_fraction=1.5"))


@pytest.mark.parametrize("adjoint", [pytest.param("implicit", marks=pytest.mark.slow), "unrolled"])
def test_they_run_together(adjoint, tmp_path):
    config = outside(
        *MINE.values(), "objects.names=[can,mug]", "stages=[views,field,target_sets,warm_start,psi,evaluate]",
        f"outer/adjoint={adjoint}", "baseline=neural_sim_derivative", "outer/steps=free",
        "outer.trust.on_untrusted=keep", "progress=false",
        f"paths.store={tmp_path}/store", f"paths.mlflow={tmp_path}/mlflow.db",
    )  # fmt: skip
    context, others = context_of(config, tmp_path)
    validation_ap = walk(context, others)
    learned = context.results(context.graph.learned)
    assert learned.trajectory.shape == (3, 2, 4) and bool(learned.trajectory.isfinite().all())
    assert bool((learned.last != learned.trajectory[0]).any(-1).all())
    assert validation_ap is not None and 0.0 <= validation_ap <= 1.0
    assert set(learned.records[-1].certificate.actions) == {"can", "mug"}

    # Saved, read back and run on pictures, it gives the detections that were scored.
    graph, test = context.graph, context.results(context.graph.targets).test
    trained = graph.trained_on(learned.last, "learned")
    params = context.results(trained).params
    saved = SavedDetector(trained.detector, params, graph.names, (graph.camera.height, graph.camera.width))
    again = SavedDetector.load(saved.save(tmp_path / "model"))
    scored = context.results(graph.scores(learned.last, "learned")).detections
    assert type(again.detector) is type(saved.detector)
    for ours, theirs in zip(again.detector.predict(again.params, test.images), scored, strict=True):
        assert all(torch.equal(ours[key], theirs[key]) for key in theirs)
    if importlib.util.find_spec("onnx") and importlib.util.find_spec("onnxruntime"):
        path = export(saved, tmp_path / "model.onnx")
        assert largest_difference(saved, path, test.images) <= TOLERANCE
    pictures = write_coco(test, list(graph.names), tmp_path / "pictures")
    words = [
        f"predict.model={tmp_path}/model",
        f"predict.images={tmp_path}/pictures",
        f"predict.annotations={pictures}",
    ]
    walk(*context_of(outside("stages=[predict]", "progress=false", *words), tmp_path / "predicted"))
    assert 0.0 <= json.loads((tmp_path / "predicted" / "scores.json").read_text())["ap"] <= 1.0


def test_a_stage_s_result_is_stored_and_its_task_pulls_it(tmp_path):
    paths = [f"paths.store={tmp_path}/store", "objects.names=[can,mug]", "views.count=3", "views.held_out=1"]

    def brightness(above):
        words = [*paths, "+experiment=my_brightness", f"brightness.above={above}", "progress=false"]
        context, tasks = context_of(outside(*words), tmp_path)
        walk(context, tasks)
        return context, json.loads((tmp_path / "brightness.json").read_text())

    context, found = brightness(0.0)
    assert {*found} == {"can", "mug"} and all(
        0.0 < part < 1.0 for part in found.values()
    )  # the objects' pixels
    assert {*context.account.seconds} == {"views", "brightness"}
    again, same = brightness(0.0)
    stored = {each.what for each in again.account.left_out if each.why == "found in the store"}
    assert same == found and stored == {"brightness of can", "brightness of mug"}  # the views are not read
    _, brighter = brightness(0.9)
    assert all(brighter[name] < found[name] for name in found)
    with pytest.raises(UserError, match=r"brightness\.above must lie in \[0, 1\], got 2\.0"):
        brightness(2.0)


def test_a_study_publishes_what_it_found(tmp_path, empty_store, capsys):
    shutil.copy(empty_store, tmp_path / "mlflow.db")
    words = ["+experiment=my_study", f"paths.mlflow={tmp_path}/mlflow.db", "progress=false"]
    walk(*context_of(outside(*words), tmp_path / "run"))
    found = json.loads((tmp_path / "run" / "distances.json").read_text())
    assert found["pitcher"] > 0.5 and found["can"] == 0.0  # the pitcher's start is biased
    assert "| pitcher | 0." in (tmp_path / "run" / "distances.md").read_text()
    assert (tmp_path / "run" / "figures" / "distances.png").is_file()
    assert "| pitcher | 0." in capsys.readouterr().out
    with pytest.raises(ValueError, match=r"distances\.factor: want one of \['pose'\], got zoom"):
        walk(*context_of(outside(*words, "distances.factor=zoom"), tmp_path / "none"))
    assert not (tmp_path / "none").exists()
