"""An MLflow store of a test's own."""

import shutil

import pytest

from neural_sim.report import tracking


@pytest.fixture
def uri(empty_store, tmp_path):
    return tracking.tracking_uri(str(shutil.copy(empty_store, tmp_path / "mlflow.db")))
