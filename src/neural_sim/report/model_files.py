"""The files of a run's final detector: for this project, as ONNX, and as an MLflow model."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from neural_sim.detector.onnx_export import TOLERANCE, export, largest_difference
from neural_sim.detector.saved_detector import DOCUMENT, WEIGHTS, SavedDetector
from neural_sim.extras import require
from neural_sim.ranges import validated
from neural_sim.report.tracking import Run

_log = logging.getLogger(__name__)

ONNX = "model.onnx"
CHECKED = 50
"""Largest number of test images on which onnxruntime is compared with torch."""
NAME = "detector"
"""The name of the model in the run."""
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


@validated
@dataclass(frozen=True)
class ModelFiles:
    """The files that the report writes for the final detector, in addition to its weights and ``model.json``.

    Args:
        onnx: write ``model.onnx``; needs the packages of the extra ``onnx``.
        nms: include non-maximum suppression in ``model.onnx``, see ``onnx_export.export``.
        pyfunc: log a pyfunc model to the run in MLflow.
        registered_name: name under which MLflow registers a version of the pyfunc model; None: not registered.

    Raises:
        ValueError: ``onnx`` without its packages; ``nms`` without ``onnx``, or a name without ``pyfunc``.
    """

    onnx: bool = False
    nms: bool = False
    pyfunc: bool = False
    registered_name: str | None = None

    def __post_init__(self) -> None:
        if self.nms and not self.onnx:
            raise ValueError("model.nms needs model.onnx=true: suppression is written into model.onnx")
        if self.registered_name is not None and not (self.pyfunc and self.registered_name):
            raise ValueError(
                f"model.registered_name needs model.pyfunc=true and a name, got {self.registered_name!r}"
            )
        if self.onnx:
            require("onnx", "model.onnx")

    def write(self, saved: SavedDetector, images: Float[Tensor, "n 3 h w"], folder: Path) -> Path:
        """Write the files to ``folder`` and return its ``model.safetensors``; ONNX is checked on ``images``."""
        path = saved.save(folder)
        if self.onnx:
            made = export(saved, folder / ONNX, self.nms)
            # After suppression, detections cannot be compared one by one: nearly equal scores may change places.
            if not self.nms:
                shown = images[:CHECKED]
                difference = largest_difference(saved, made, shown)
                level = logging.INFO if difference <= TOLERANCE else logging.WARNING
                text = "%s: onnxruntime within %.1e of torch on %d test images"
                _log.log(level, text, ONNX, difference, len(shown))
        return path


def log_detector(
    run: Run, folder: Path, example: UInt8[np.ndarray, "n h w 3"], registered_name: str | None = None
) -> str:
    """Write a detector to an open run as a pyfunc model.

    The model maps RGB photographs, all of one size, to a table of detections, see
    ``pyfunc_model.PhotographDetector``.

    Args:
        run: the open run in MLflow.
        folder: folder with ``model.safetensors`` and ``model.json``.
        example: photographs to show how the model is called.
        registered_name: name under which a version of the model is registered; None: not registered.

    Returns:
        The model's URI, ``models:/...``, for ``mlflow.pyfunc.load_model``.
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
