"""Runs with labelled photographs: which detectors they train and score, and which results they share."""

import json
import shutil

import pytest
import torch
from composing import composed

from neural_sim.detector.metrics import evaluate
from neural_sim.detector.real import Sampling
from neural_sim.detector.training import train_detector
from neural_sim.main import build, context_of
from neural_sim.outer.records import Cost
from neural_sim.randomness import stream
from neural_sim.stages import detector as detector_stages
from neural_sim.stages.detector import DetectorStage, TrainedDetector
from neural_sim.stages.graph import Graph
from neural_sim.stages.scene import LoadedImages
from neural_sim.stages.target_sets import TargetSets, TargetSetsStage
from neural_sim.target.rendered import RenderedTarget
from neural_sim.tasks.walk import walk
from neural_sim.types import LabelledImages

SMALL = [
    "+experiment=pose_gap", "scale=smoke", "progress=false", "baseline=ns", "detector=micro", "views.count=8",
    "views.held_out=2", "budget.grid.steps=20", "budget.grid.resolution=64", "training.cold_epochs=4",
    "training.warm_epochs=4", "training.images_per_object=16", "training.batch_size=8", "target.val_per_object=4",
    "objects.names=[pitcher,drill]", "target.train_per_object=6",
]  # fmt: skip
ROWS = {"ns", "learned", "matched", "synthetic_only", "real_only", "views_only"}


def small(*overrides):
    return composed(*SMALL, *overrides)


def graph_of(*overrides):
    return Graph(build(small(*overrides)))


def keys(*overrides):
    graph = graph_of(*overrides)
    psi = graph.psi("target")
    return {
        "warm": graph.warm_start.key, "psi": graph.learned.key, "synthetic": graph.synthetic(psi, "").key,
        "scored": graph.trained_on(psi, "").key, "real": graph._on_photographs(None).key,
    }  # fmt: skip


def test_what_photographs_do_not_train_is_shared_by_all_modes():
    none, combined, pretrain = (
        keys(f"training.real.mode={mode}") for mode in ("none", "combined", "pretrain")
    )
    assert none["synthetic"] == none["scored"] == combined["synthetic"] == pretrain["synthetic"]
    assert none["warm"] == pretrain["warm"] != combined["warm"]
    assert none["psi"] == pretrain["psi"] != combined["psi"]
    assert len({none["scored"], combined["scored"], pretrain["scored"]}) == 3
    assert combined["real"] == pretrain["real"]
    assert keys("training.real.mode=combined", "training.real.count=0")["psi"] == none["psi"]
    assert keys("training.real.mode=pretrain", "training.real.finetune=0.5")["psi"] == none["psi"]


def test_the_warm_start_s_images_decide_on_it_and_on_psi_alone():
    initial, uniform = (
        keys("training.real.mode=pretrain", f"training.warm_start={which}")
        for which in ("initial", "uniform")
    )
    assert {name for name in initial if initial[name] != uniform[name]} == {"warm", "psi"}


@pytest.mark.parametrize(
    "other",
    ["training.real.count=3", "training.real.batch_fraction=0.25", "target.train_per_object=7", "seed=1"],
)
def test_which_photographs_train_and_how_tells_detectors_apart(other):
    combined = "training.real.mode=combined"
    assert keys(combined)["scored"] != keys(combined, other)["scored"]


@pytest.mark.parametrize("mode", ["combined", "pretrain"])
def test_as_many_photographs_are_the_same_training_however_they_were_asked_for(monkeypatch, mode):
    """Where the target says how many it has without reading them."""
    monkeypatch.setattr(RenderedTarget, "training_count", lambda target, seed: 12, raising=False)
    of_all, fewer = keys(f"training.real.mode={mode}"), "training.real.fewer=all"
    assert of_all == keys(f"training.real.mode={mode}", "training.real.count=50", fewer)
    half = keys(f"training.real.mode={mode}", "training.real.fraction=0.5")
    assert half == keys(f"training.real.mode={mode}", "training.real.count=6")
    assert half["scored"] != of_all["scored"] and half["real"] != of_all["real"]
    with pytest.raises(ValueError, match="want 50 photographs or more to train on, got 12"):
        keys(f"training.real.mode={mode}", "training.real.count=50")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["training.real.mode=combined", "target.train_per_object=0"], "combined needs labelled photographs"),
        (["training.real.mode=pretrain", "target.train_per_object=0"], "pretrain needs labelled photographs"),
    ],
)
def test_what_cannot_be_is_refused_before_any_stage(overrides, message):
    with pytest.raises(ValueError, match=message):
        graph_of(*overrides)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, empty_store):
    made = tmp_path_factory.mktemp("photographs")
    shutil.copy(empty_store, made / "mlflow.db")
    return made


def run(folder, *overrides):
    paths = [f"paths.store={folder / 'store'}", f"paths.mlflow={folder / 'mlflow.db'}"]
    context, others = context_of(small(*overrides, *paths), folder / "run")
    walk(context, others)
    return context


def test_a_report_has_rows_of_real_only_synthetic_only_and_both(folder, capsys):
    context = run(folder, "training.real.mode=combined", "training.real.count=5")
    results = json.loads((folder / "run" / "results.json").read_text())
    assert set(results["ap"]) == ROWS
    assert results["real"] == {"mode": "combined", "photographs": 5, "available": 12}
    detections = json.loads((folder / "run" / "detections.json").read_text())
    assert set(detections) == {"images", "truth", *ROWS}
    printed = capsys.readouterr().out
    (means,) = (line.split() for line in printed.splitlines() if line.startswith("mean"))
    assert len(means) == 1 + len(ROWS)
    assert "also trained on 5 photographs (training.real.mode=combined)" in printed
    targets, graph = context.results(context.graph.targets), context.graph
    parts = [targets.train, targets.val, targets.test]
    pixels = [{image.numpy().tobytes() for image in part.images} for part in parts]
    assert not (pixels[0] & pixels[1] or pixels[0] & pixels[2] or pixels[1] & pixels[2])
    assert graph.learned.warm_start.photographs(context.results) is not None

    # real_only by hand: four epochs of as many batches as the 32 synthetic images have.
    training, detector = context.experiment.training, graph.warm_start.build()
    generator = stream(0, "fine-tuning")
    photographs = training.real.chosen(targets.train, 0)
    params, history = train_detector(
        detector,
        detector.init(generator),
        photographs,
        generator,
        training.of(4),
        sampling=Sampling((5,), (5,), 4),
    )
    assert history.steps == 16
    scored = evaluate(detector.predict(params, targets.test.images), targets.test, list(graph.names))
    assert results["ap"]["real_only"]["ap"] == scored.ap
    for row in ("ns", "real_only", "synthetic_only", "views_only"):
        steps = context.results(
            graph.compared(context.results(graph.learned))[row].trained
        ).cost.detector_steps
        assert steps == 16, row
    of_views = graph.compared(context.results(graph.learned))["views_only"].trained
    for subject, views in zip(context.results(of_views.scene).subjects, graph.views, strict=True):
        seen = context.results(views).images[:8]  # views.held_out=2 more are not trained on
        area = subject.pictures[..., 3].mean((1, 2))
        torch.testing.assert_close(area, seen[..., 3].mean((1, 2)), atol=0.01, rtol=0.0)


@pytest.mark.parametrize("mode", ["combined", "pretrain"])
def test_where_fewer_may_do_every_row_takes_all_that_there_are(folder, mode):
    few = [f"training.real.mode={mode}", "training.real.count=50", "training.real.fewer=all"]
    context = run(folder, *few, "stages=[views,field,target_sets,warm_start,psi,evaluate]")
    rows = context.graph.compared(context.results(context.graph.learned))
    assert set(rows) == ROWS
    own = context.results(rows["real_only"].trained).params
    of_all = context.results(graph_of(few[0])._on_photographs(None)).params
    assert all(torch.equal(value, of_all[name]) for name, value in own.items())


def test_fine_tuning_goes_on_from_the_detector_of_synthetic_images(folder):
    stages = "stages=[views,field,target_sets,warm_start,psi,evaluate]"
    context = run(folder, "training.real.mode=pretrain", "training.real.fraction=0.5", stages)
    graph, made = context.graph, context.results
    assert set(graph.compared(made(graph.learned))) == ROWS
    assert graph.learned.warm_start.photographs(made) is None
    learned = graph.compared(made(graph.learned))["learned"].trained
    before, after = made(learned.start), made(learned)
    assert before.cost.detector_steps == 16 and after.cost.detector_steps == 16 + round(0.3 * 16)
    training, detector = context.experiment.training, graph.warm_start.build()
    photographs = training.real.chosen(made(graph.targets).train, 0)
    generator = stream(0, "fine-tuning")
    how = training.of(1)
    how = type(how)(1, how.batch_size, training.real.finetune_learning_rate, how.weight_decay)
    params, _ = train_detector(
        detector, before.params, photographs, generator, how, sampling=Sampling((6,), (6,), 5)
    )
    assert all(torch.equal(value, params[name]) for name, value in after.params.items())


class Clock:
    """Time that only passes while an input is made."""

    def __init__(self):
        self.now = 0.0

    def perf_counter(self):
        return self.now

    process_time = perf_counter


@pytest.mark.parametrize("mode", ["combined", "pretrain"])
def test_the_cost_of_a_training_excludes_making_its_inputs(mode, monkeypatch):
    """And an input that is a training itself is charged once."""
    monkeypatch.setattr(detector_stages, "time", clock := Clock())
    graph = graph_of(f"training.real.mode={mode}")
    size, zeros = (graph.camera.height, graph.camera.width), torch.zeros(6, dtype=torch.long)
    boxes = torch.tensor([2.0, 2.0, 20.0, 20.0]).expand(6, 1, 4)
    few = LabelledImages(torch.rand(6, 3, *size), boxes, zeros[:, None], zeros)
    stage = graph.trained_on(graph.psi("initial"), "initial")
    params, ready = stage.build().init(torch.Generator()), set()

    def made(wanted):
        clock.now += 0.0 if wanted.entry in ready else 1000.0
        ready.add(wanted.entry)
        if isinstance(wanted, TargetSetsStage):
            return TargetSets(few, few, few)
        is_training = isinstance(wanted, DetectorStage)
        return TrainedDetector(params, Cost(7, 8, 9, 5.0, 5.0)) if is_training else LoadedImages(few)

    cost = stage.make(made).cost
    spent = 5.0 if mode == "pretrain" else 0.0
    assert (cost.seconds, cost.cpu_seconds) == (spent, spent) and clock.now == 2000.0
