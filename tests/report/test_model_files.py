"""The detector as a model in MLflow: loaded back, it gives what the detector itself gives; registered by name."""

import functools

import numpy as np
import pytest
import torch
from colour_detector import ColourDetector
from mlflow import MlflowClient
from PIL import Image

from neural_sim.detector.saved_detector import SavedDetector, detect
from neural_sim.report.model_files import log_detector
from neural_sim.report.tracking import opened


@pytest.fixture
def saved(tmp_path):
    make = functools.partial(ColourDetector)
    params = make(2, (48, 64)).init(torch.Generator())
    held = SavedDetector(make, params, ("red", "green"), (48, 64))
    held.save(tmp_path / "run")
    (tmp_path / "run" / "results.json").write_text("not a part of the model")
    return held


def photographs():
    pictures = np.full((3, 90, 120, 3), 30, np.uint8)
    pictures[0, 10:40, 20:50] = (255, 0, 0)
    pictures[2, 20:60, 30:70] = (255, 0, 0)
    pictures[2, 50:80, 80:100] = (0, 255, 0)
    return pictures


def test_the_logged_model_gives_the_detectors_detections(saved, uri, tmp_path):
    import mlflow

    before = mlflow.get_tracking_uri()
    with opened(uri, "models", "a run", {}, {"seed": 3}) as run:
        where = log_detector(run, tmp_path / "run", photographs()[:1], "shelf detector")
    assert mlflow.get_tracking_uri() == before
    client = MlflowClient(uri)
    (version,) = client.search_model_versions("name='shelf detector'")
    assert version.run_id == run.run_id
    assert [output.model_id for output in client.get_run(run.run_id).outputs.model_outputs] == [
        where.split("/")[-1]
    ]
    logged = client.get_logged_model(where.split("/")[-1])
    assert logged.experiment_id == run.experiment_id
    assert logged.artifact_location.startswith(
        (tmp_path / "mlartifacts").as_uri()
    )  # not in the working folder
    mlflow.set_tracking_uri(uri)
    try:
        models = [mlflow.pyfunc.load_model(place) for place in (where, "models:/shelf detector/1")]
    finally:
        mlflow.set_tracking_uri(before)
    pictures = photographs()
    wanted = detect(saved, [Image.fromarray(picture) for picture in pictures])
    for model in models:
        assert model.metadata.signature.inputs.inputs[0].shape == (-1, -1, -1, 3)
        example = model.input_example
        assert np.array_equal(np.asarray(example, np.uint8), pictures[:1])
        table = model.predict(pictures)
        assert list(table.columns) == ["image", "label", "score", "x0", "y0", "x1", "y1"]
        assert table["image"].tolist() == [0, 2, 2] and table["label"].tolist() == ["red", "red", "green"]
        for number, found in enumerate(wanted):
            own = table[table["image"] == number]
            assert np.array_equal(own[["x0", "y0", "x1", "y1"]].to_numpy(), found["boxes"].double().numpy())
            assert np.array_equal(own["score"].to_numpy(), found["scores"].double().numpy())
        assert len(model.predict(pictures[1:2])) == 0
    with pytest.raises(Exception, match="shape"):
        models[0].predict(pictures[..., :2])
