"""What a run gives back to a sweep: a score that the test set has no part in. What MLflow shows while it goes on."""

import json
import shutil
import signal
from dataclasses import replace

import pytest
import torch
from hydra import compose, initialize_config_dir
from mlflow import MlflowClient

from neural_sim.artifacts import Artifacts
from neural_sim.detector.metrics import evaluate
from neural_sim.detector.training import train_detector
from neural_sim.main import build, conf_directory
from neural_sim.pipeline import run
from neural_sim.report import logged
from neural_sim.report.run_tracking import LiveRun
from neural_sim.report.tracking import tracking_uri
from neural_sim.synthesis.export import write_coco
from neural_sim.synthesis.scene import join
from neural_sim.target.coco import CocoTarget

SMALL = [
    "+experiment=pose_gap", "scale=smoke", "progress=false", "baseline=ns", "detector=micro", "views.count=8",
    "views.held_out=2", "budget.grid.steps=20", "budget.grid.resolution=64", "training.cold_epochs=12",
    "training.warm_epochs=12", "training.images_per_object=24", "target.val_per_object=8",
    "objects.names=[pitcher,drill]", "stages=[views,field,warm_start,psi,evaluate]",
]  # fmt: skip


def _experiment(folder, *overrides):
    paths = [f"paths.store={folder / 'store'}", f"paths.mlflow={folder / 'mlflow.db'}"]
    with initialize_config_dir(str(conf_directory()), version_base="1.3"):
        return build(compose("config", [*SMALL, *paths, *overrides]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory, empty_store):
    made = tmp_path_factory.mktemp("pipeline")
    shutil.copy(empty_store, made / "mlflow.db")
    return made


@pytest.fixture(scope="module")
def returned(folder):
    return run(_experiment(folder), folder / "run")


def _pixels(images):
    return {image.mul(255).round().byte().numpy().tobytes() for image in images.images}


def test_a_sweep_gets_the_ap_on_val_of_the_detector_trained_on_the_learned_distribution(folder, returned):
    made = Artifacts(_experiment(folder))
    training, val = made.x.training, made.targets["val"]
    generator = torch.Generator().manual_seed(1_000_003 + 1)
    drawn = join(made.scene.training_set(made.psi("initial"), training.images_per_object, generator))
    start = made.detector.init(generator)
    params, _ = train_detector(
        made.detector, start, drawn, generator, epochs=training.cold_epochs, batch_size=training.batch_size,
        learning_rate=training.learning_rate, weight_decay=training.weight_decay, progress=False,
    )  # fmt: skip
    expected = evaluate(made.detector.predict(params, val.images), val, made.names)["ap"]
    assert returned == expected and 0.0 < expected < 1.0
    test = made.targets["test"]
    assert evaluate(made.detector.predict(params, test.images), test, made.names)["ap"] != expected


def test_another_test_set_does_not_change_it(folder, returned):
    overrides = ["target.test_per_object=3", "target.test_per_biased_object=9"]
    made, other = Artifacts(_experiment(folder)), Artifacts(_experiment(folder, *overrides))
    assert len(made.targets["test"]) != len(other.targets["test"])
    assert run(other.x, folder / "other") == returned


def test_without_evaluation_there_is_no_score(folder, returned):
    assert run(_experiment(folder, "stages=[views,field]"), folder / "fields") is None


def test_val_and_test_share_no_image(folder, returned):
    rendered = Artifacts(_experiment(folder)).targets
    assert not _pixels(rendered["val"]) & _pixels(rendered["test"])
    # A user's file may list one photograph under two names.
    twice = type(rendered["test"]).concatenate([rendered["test"], rendered["test"].select(slice(0, 6))])
    path = write_coco(twice, ["pitcher", "drill"], folder / "photos")
    for seed in range(4):
        x = _experiment(folder, f"seed={seed}")
        config = {**x.config, "target": {"val_fraction": 0.5}}
        coco = Artifacts(replace(x, target=CocoTarget(path, val_fraction=0.5), config=config)).targets
        assert len(coco["val"]) + len(coco["test"]) == len(twice)
        assert not _pixels(coco["val"]) & _pixels(coco["test"])


LOOP = ["baseline=random_search", "outer.iterations=1", "outer.images_per_object=4"]  # two rounds
WHOLE = [*LOOP, "stages=[views,field,warm_start,psi,evaluate,report]"]


@pytest.fixture(scope="module")
def uri(folder):
    return tracking_uri(str(folder / "mlflow.db"))


def _seen(uri):
    """The latest run, and the losses that it shows by iteration."""
    run = logged.runs(uri, "pose_gap")[0]
    history = MlflowClient(uri).get_metric_history(run.run_id, "psi/validation_loss")
    return run, {point.step: point.value for point in history}


def test_a_run_is_watched_while_its_loop_goes_on(folder, returned, uri, monkeypatch, capsys):
    seen, iteration = [], LiveRun.iteration

    def watched(live, record):
        iteration(live, record)
        seen.append(_seen(uri))

    monkeypatch.setattr(LiveRun, "iteration", watched)
    run(_experiment(folder, *WHOLE), folder / "live")
    results = json.loads((folder / "live" / "results.json").read_text())
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
    assert printed[-2] == f"mlflow ui --backend-store-uri {uri}"
    assert f"/runs/{held.info.run_id}?" in printed[-1]


@pytest.mark.slow
def test_a_loop_from_the_store_shows_its_iterations_too(folder, returned, uri):
    overrides = [*LOOP, "seed=1"]
    run(_experiment(folder, *overrides), folder / "stored")
    run(_experiment(folder, *overrides, "stages=[psi,evaluate,report]"), folder / "stored")
    held, losses = _seen(uri)
    written = json.loads((folder / "stored" / "results.json").read_text())["iterations"]
    assert losses == {step: record["validation_loss"] for step, record in enumerate(written)}
    assert len(losses) == 2 and held.status == "FINISHED"


def test_a_run_without_the_report_is_not_tracked(folder, tmp_path):
    run(_experiment(folder, f"paths.mlflow={tmp_path / 'none.db'}", "stages=[views,field]"), tmp_path)
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
            run(_experiment(folder, *WHOLE, "seed=2"), folder / "broken")
        assert _seen(uri)[0].status == status
    assert signal.getsignal(signal.SIGINT) == handler
