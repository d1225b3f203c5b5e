"""What a run gives back to a sweep: a score that the test set has no part in. What MLflow shows while it goes on."""

import json
import logging
import re
import shutil
import signal
from types import SimpleNamespace

import pytest
import torch
from composing import composed
from mlflow import MlflowClient

from neural_sim.detector.metrics import evaluate
from neural_sim.detector.saved_detector import SavedDetector
from neural_sim.detector.training import train_detector
from neural_sim.main import UserError, context_of
from neural_sim.randomness import stream
from neural_sim.report import tracking
from neural_sim.report.run_tracking import LiveRun
from neural_sim.report.tracking import tracking_uri
from neural_sim.stages.target_sets import TargetSets
from neural_sim.synthesis.export.coco import write_coco
from neural_sim.tasks.context import Task
from neural_sim.tasks.walk import walk, warn_of_misreading

SMALL = [
    "+experiment=pose_gap", "scale=smoke", "progress=false", "baseline=ns", "detector=micro", "views.count=8",
    "views.held_out=2", "budget.grid.steps=20", "budget.grid.resolution=64", "training.cold_epochs=30",
    "training.warm_epochs=30", "training.images_per_object=24", "target.val_per_object=8",
    "objects.names=[pitcher,drill]", "stages=[views,field,target_sets,warm_start,psi,evaluate]",
]  # fmt: skip


def _context(folder, *overrides):
    paths = [f"paths.store={folder / 'store'}", f"paths.mlflow={folder / 'mlflow.db'}"]
    return context_of(composed(*SMALL, *paths, *overrides), folder / "run")


def _targets(context) -> TargetSets:
    return context.results(context.graph.targets)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, empty_store):
    made = tmp_path_factory.mktemp("walk")
    shutil.copy(empty_store, made / "mlflow.db")
    return made


@pytest.fixture(scope="module")
def returned(folder):
    return walk(*_context(folder))


def _pixels(images):
    return {image.mul(255).round().byte().numpy().tobytes() for image in images.images}


def test_a_sweep_gets_the_ap_on_val_of_the_detector_trained_on_the_learned_distribution(folder, returned):
    context, _ = _context(folder)
    graph, training, targets = context.graph, context.experiment.training, _targets(context)
    generator, detector = stream(0, "detector"), graph.warm_start.build()
    scene = context.results(graph.scene)
    drawn = scene.training_set(graph.psi("initial"), training.images_per_object, generator).images
    params, _ = train_detector(
        detector, detector.init(generator), drawn, generator, training.of(training.cold_epochs)
    )
    val, test = (
        evaluate(detector.predict(params, part.images), part, list(graph.names)).ap
        for part in (targets.val, targets.test)
    )
    assert returned == val and 0.0 < val < 1.0 and test != val


@pytest.mark.slow
def test_two_processes_make_the_same_bit_for_bit(folder, returned, tmp_path, monkeypatch):
    shutil.copytree(folder / "store" / "views", tmp_path / "store" / "views")
    monkeypatch.setattr(
        "neural_sim.stages.field.FieldStage.make", lambda *_: pytest.fail("not by this process")
    )
    one, (two, _) = _context(folder)[0], _context(tmp_path, "workers=2")
    fields = zip(one.graph.fields, two.together(two.graph.fields), strict=True)
    for alone, together in [(one.results(a).field, two.results(b).field) for a, b in fields]:
        assert torch.equal(alone.table, together.table)
    assert not two.account.left_out


def test_another_test_set_does_not_change_it(folder, returned):
    overrides = ["target.test_per_object=3", "target.test_per_biased_object=9"]
    (context, _), (other, steps) = _context(folder), _context(folder, *overrides)
    assert len(_targets(context).test) != len(_targets(other).test)
    assert walk(other, steps) == returned


def test_another_warm_start_does_not_change_what_the_initial_distribution_scores(folder, returned):
    (uniform, _), (context, steps) = _context(folder), _context(folder, "training.warm_start=initial")
    assert walk(context, steps) == returned
    warm, initial = (each.results(each.graph.warm_start).params for each in (uniform, context))
    assert any(not torch.equal(warm[name], initial[name]) for name in warm)


def test_without_evaluation_there_is_no_score(folder, returned):
    assert walk(*_context(folder, "stages=[views,field]")) is None


def test_what_is_wanted_is_made_with_all_that_it_needs(folder, returned, tmp_path, caplog):
    """The same psi as in the phases' order, each result charged to its own phase."""
    loop = ["baseline=lts", "outer.iterations=1", "outer.images_per_object=4", "budget.outer.pool_per_bin=4"]
    context, tasks = _context(tmp_path, *loop, "stages=[psi]")
    with caplog.at_level(logging.INFO):
        assert walk(context, tasks) is None
    assert "to make: views 2, field 2, warm_start 1, target_sets 1, psi 1\n" in caplog.text
    made = {path.parent.name for path in (tmp_path / "store").rglob("*.pt")}
    assert made == {"views", "field", "target", "detector", "psi"}
    seconds = context.account.seconds
    assert {*seconds} == {"views", "field", "target_sets", "warm_start", "psi"}
    assert min(seconds.values()) > 0.0
    assert all(omission.why != "found in the store" for omission in context.account.left_out)
    ordered, tasks = _context(folder, *loop, "stages=[views,field,target_sets,warm_start,psi]")
    walk(ordered, tasks)
    assert torch.equal(
        context.results(context.graph.learned).last, ordered.results(ordered.graph.learned).last
    )


def test_what_the_store_has_is_read_and_said(folder, returned):
    context, tasks = _context(folder, "stages=[evaluate]")
    assert walk(context, tasks) == returned
    found = {(each.stage, each.what) for each in context.account.left_out if each.why == "found in the store"}
    assert ("psi", "psi loop") in found and not {"views", "field", "warm_start"} & {
        stage for stage, _ in found
    }
    left_out = {each.why for each in context.account.left_out if each.stage == "psi"}
    assert "baseline=ns keeps its distribution" in left_out


def test_a_task_is_refused_before_what_it_reads_is_made_or_tracked(tmp_path):
    context, tasks = _context(tmp_path, "stages=[views,report,preflight]")
    with pytest.raises(ValueError, match="preflight wants a method that follows the hypergradient"):
        walk(context, tasks)
    assert not (tmp_path / "store").exists() and not (tmp_path / "mlflow.db").exists()
    assert not context.account.seconds


def test_a_method_that_keeps_its_distribution_needs_no_detector(tmp_path):
    assert walk(*_context(tmp_path, "stages=[psi]")) is None


def test_val_and_test_share_no_image(folder, returned):
    rendered = _targets(_context(folder)[0])
    assert not _pixels(rendered.val) & _pixels(rendered.test)
    # A user's file may list one photograph under two names.
    twice = type(rendered.test).concatenate([rendered.test, rendered.test.select(slice(0, 6))])
    path = write_coco(twice, ["pitcher", "drill"], folder / "photos")
    for seed in range(4):
        target = ["target=coco", f"target.annotations={path}", "target.val_fraction=0.5", f"seed={seed}"]
        small = [word for word in SMALL if not word.startswith("target.")]
        config = composed(*small, *target, f"paths.store={folder / 'store'}")
        coco = _targets(context_of(config, folder)[0])
        assert len(coco.val) + len(coco.test) == len(twice)
        assert not _pixels(coco.val) & _pixels(coco.test)


def test_photographs_that_cannot_be_used_are_refused_before_fields_are_fitted(folder, returned, tmp_path):
    path = write_coco(_targets(_context(folder)[0]).test, ["pitcher", "drill"], tmp_path / "photos")
    images = json.loads(path.read_text())["images"]
    (path.parent / images[-1]["file_name"]).write_text("no photograph")
    small = [word for word in SMALL if not word.startswith("target.")]
    target = ["target=coco", f"target.annotations={path}"]
    paths = [f"paths.store={tmp_path / 'store'}", f"paths.mlflow={folder / 'mlflow.db'}"]
    config = composed(*small, *target, *paths)
    with pytest.raises(UserError, match="not a readable image"):
        context_of(config, tmp_path)
    assert not (tmp_path / "store").exists()


def test_weights_that_do_not_exist_are_refused_before_anything_is_made(folder, returned):
    named = [
        "detector=tiny",
        "detector.backbone.architecture=resnet18",
        "detector.backbone.weights=nowhere.pth",
    ]
    context, steps = _context(folder, *named)
    with pytest.raises(ValueError, match="want a file or one of"):
        walk(context, steps)
    assert not context.account.seconds


@pytest.mark.parametrize("stages", ["target_sets", "warm_start"])
def test_more_objects_in_an_image_than_there_are_is_refused_before_fields_are_fitted(stages, tmp_path):
    context, steps = _context(tmp_path, "synthesis.objects_per_image=[1,3]", f"stages=[field,{stages}]")
    with pytest.raises(
        ValueError, match=r"^synthesis\.objects_per_image: want at most 2, the number of objects, got 3"
    ):
        walk(context, steps)
    assert not (tmp_path / "store").exists()


def test_the_report_leaves_the_detector_that_was_scored_as_learned(
    folder, returned, tmp_path, capsys, caplog
):
    """Saved, loaded and run again it gives the detections that were scored; ONNX and MLflow where asked for."""
    pytest.importorskip("onnxruntime", reason="the extra onnx is not installed")
    asked = [
        "model.onnx=true",
        "model.pyfunc=true",
        "model.registered_name=shelf",
        "stages=[psi,evaluate,report]",
    ]
    with caplog.at_level(logging.INFO):
        context, steps = _context(folder, *asked)
        walk(context, steps)
    run, graph = folder / "run", context.graph
    saved = SavedDetector.load(run)
    assert saved.class_names == graph.names and saved.camera == graph.camera
    test = _targets(context).test
    scored = context.results(graph.scores(context.results(graph.learned).last, "learned")).detections
    for ours, theirs in zip(saved.detector.predict(saved.params, test.images), scored, strict=True):
        assert all(torch.equal(ours[key], theirs[key]) for key in theirs)
    difference = float(re.search(r"onnxruntime within (\S+) of torch on (\d+) test images", caplog.text)[1])
    assert 0.0 < difference <= 1e-4
    uri = tracking_uri(str(folder / "mlflow.db"))
    (version,) = MlflowClient(uri).search_model_versions("name='shelf'")
    assert f"model: models:/{version.source.split('/')[-1]}\n" in capsys.readouterr().out
    assert {"model.safetensors", "model.json", "model.onnx"} <= tracking.logged_runs(uri, "pose_gap")[0].files

    made = run / "training_set"
    words = [
        f"predict.model={run}",
        f"predict.images={made}",
        f"predict.annotations={made / 'annotations.json'}",
    ]
    walk(*context_of(composed("stages=[predict]", "progress=false", *words), tmp_path))
    assert (
        json.loads((tmp_path / "scores.json").read_text())["ap"] > 0.02
    )  # of the images that it was trained on


LOOP = ["baseline=lts", "outer.iterations=1", "outer.images_per_object=4"]  # two rounds
WHOLE = [*LOOP, "stages=[views,field,target_sets,warm_start,psi,evaluate,report]"]


@pytest.fixture(scope="module")
def uri(folder):
    return tracking_uri(str(folder / "mlflow.db"))


def _seen(uri):
    """The latest run, and the losses that it shows by iteration."""
    run = tracking.logged_runs(uri, "pose_gap")[0]
    history = MlflowClient(uri).get_metric_history(run.run_id, "psi/validation_loss")
    return run, {point.step: point.value for point in history}


def test_a_run_is_watched_while_its_loop_goes_on(folder, returned, uri, monkeypatch, capsys):
    seen, iteration = [], LiveRun.iteration

    def watched(live, record):
        iteration(live, record)
        seen.append(_seen(uri))

    monkeypatch.setattr(LiveRun, "iteration", watched)
    walk(*_context(folder, *WHOLE))
    results = json.loads((folder / "run" / "results.json").read_text())
    losses = [record["validation_loss"] for record in results["iterations"]]
    assert len(losses) == 2
    assert [(held.status, shown) for held, shown in seen] == [
        ("RUNNING", {0: losses[0]}), ("RUNNING", {0: losses[0], 1: losses[1]}),
    ]  # fmt: skip
    held = MlflowClient(uri).get_run(seen[0][0].run_id)
    assert held.info.status == "FINISHED" and held.data.params["outer.iterations"] == "1"
    seconds = {name: held.data.metrics[f"seconds/{name}"] for name in (*results["seconds"], "report")}
    assert held.info.end_time - held.info.start_time >= 1000 * sum(seconds.values())
    printed = capsys.readouterr().out.splitlines()
    command = printed.index(f"mlflow ui --backend-store-uri {uri}")
    assert f"/runs/{held.info.run_id}?" in printed[command + 1] and "report.html" in printed[-1]


@pytest.mark.slow
def test_a_loop_from_the_store_shows_its_iterations_too(folder, returned, uri):
    overrides = [*LOOP, "seed=1"]
    walk(*_context(folder, *overrides))
    walk(*_context(folder, *overrides, "stages=[psi,evaluate,report]"))
    held, losses = _seen(uri)
    written = json.loads((folder / "run" / "results.json").read_text())["iterations"]
    assert losses == {step: record["validation_loss"] for step, record in enumerate(written)}
    assert len(losses) == 2 and held.status == "FINISHED"


def test_a_run_without_the_report_is_not_tracked(folder, tmp_path):
    walk(*_context(folder, f"paths.mlflow={tmp_path / 'none.db'}", "stages=[views,field]"))
    assert not list(tmp_path.glob("none.db*"))


def test_a_run_that_fails_or_is_interrupted_says_so(folder, returned, uri, monkeypatch):
    def broken(live, record):
        raise RuntimeError("the disk is full")

    def interrupted(live, record):
        raise KeyboardInterrupt

    handler = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr("lightning.pytorch.trainer.call.signal.signal", lambda *arguments: handler)
    for act, expected, status in ((broken, RuntimeError, "FAILED"), (interrupted, SystemExit, "KILLED")):
        monkeypatch.setattr(LiveRun, "iteration", act)
        with pytest.raises(expected):
            walk(*_context(folder, *WHOLE, "seed=2", "resume=false"))
        assert _seen(uri)[0].status == status
    assert signal.getsignal(signal.SIGINT) == handler


def test_an_estimate_from_photographs_comes_with_a_warning(tmp_path, caplog):
    said = {}
    for method in ("neural_sim", "label_shift", "neural_sim_derivative", "ns"):
        context, _ = context_of(composed(*SMALL, f"baseline={method}"), tmp_path / "run")
        for rendered in (True, False):
            caplog.clear()
            warn_of_misreading(SimpleNamespace(experiment=context.experiment, renders_target=rendered))
            said[method, rendered] = caplog.text
    assert [each for each, text in said.items() if text] == [("neural_sim", False), ("label_shift", False)]
    assert "a training judges the estimate" in said["neural_sim", False]
    assert "no training judges the estimate with baseline=label_shift" in said["label_shift", False]


@pytest.mark.parametrize("task, warned", [("preflight", 1), ("psi", 1), ("views", 0), ("doctor", 0)])
def test_every_task_that_shows_or_uses_the_estimate_warns(task, warned, tmp_path, monkeypatch):
    class Nothing(Task):
        def run(self, context):
            pass

    graphs = []
    monkeypatch.setattr("neural_sim.tasks.walk.warn_of_misreading", graphs.append)
    context, _ = _context(tmp_path, "stages=[views]")
    walk(context, {task: Nothing()})
    assert len(graphs) == warned
