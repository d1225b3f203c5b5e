"""A small scene of two blocks, and a context whose MLflow store is the test's own."""

import shutil

import pytest

from neural_sim.studies.work_precision.solver import small_scene
from neural_sim.tasks.context import Context


@pytest.fixture(scope="module")
def scene():
    return small_scene()


@pytest.fixture
def context(empty_store, tmp_path):
    store = shutil.copy(empty_store, tmp_path / "mlflow.db")
    config = {"name": "study", "seed": 4, "paths": {"mlflow": str(store)}}
    folder = tmp_path / "run"
    folder.mkdir()
    return Context(config, folder, lambda: pytest.fail("no experiment is asked for"), ())
