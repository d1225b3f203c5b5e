"""What a run gives back to a sweep: a score that the test set has no part in."""

from dataclasses import replace

import pytest
import torch
from hydra import compose, initialize_config_dir

from neural_sim.artifacts import Artifacts
from neural_sim.detector.metrics import evaluate
from neural_sim.detector.training import train_detector
from neural_sim.main import build, conf_directory
from neural_sim.pipeline import run
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
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("pipeline")


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
