"""A run's detector as a model in MLflow, with its signature and an input example."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from neural_sim.detector.saved import DOCUMENT, WEIGHTS
from neural_sim.report.tracking import Run

NAME = "detector"
"""Of the model in the run."""
CODE = Path(__file__).parent / "pyfunc_model.py"
REQUIRED = (
    "torch",
    "torchvision",
    "lightning",
    "safetensors",
    "numpy",
    "pandas",
    "pillow",
    "jaxtyping",
    "mlflow",
)
"""What the model's code imports; the code of this package travels with it."""


def log_detector(
    run: Run, folder: Path, example: UInt8[np.ndarray, "n h w 3"], registered_name: str | None = None
) -> str:
    """Write the detector of ``folder`` (``model.safetensors`` and ``model.json``) to an open run, and register it as a
    version of ``registered_name``. Returns its URI, ``models:/...``, for ``mlflow.pyfunc.load_model``.

    The model takes RGB photographs of any one size, ``example`` some of them, and gives a table of detections, see
    :class:`pyfunc_model.PhotographDetector`.
    """
    with run.fluent() as mlflow:
        from mlflow.models import Model, ModelSignature
        from mlflow.types import ColSpec, Schema, TensorSpec

        boxes = (ColSpec("double", name) for name in ("score", "x0", "y0", "x1", "y1"))
        photographs = TensorSpec(np.dtype(np.uint8), (-1, -1, -1, 3))
        logged = Model.log(
            artifact_path=None,
            name=NAME,
            flavor=mlflow.pyfunc,
            run_id=run.run_id,
            registered_model_name=registered_name,
            python_model=str(CODE),
            artifacts={"weights": str(folder / WEIGHTS), "document": str(folder / DOCUMENT)},
            code_paths=[str(Path(__file__).parents[1])],
            signature=ModelSignature(
                Schema([photographs]), Schema([ColSpec("long", "image"), ColSpec("string", "label"), *boxes])
            ),
            input_example=example,
            pip_requirements=[f"{name}=={version(name)}" for name in REQUIRED],
        )
    return logged.model_uri
