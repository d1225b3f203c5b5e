"""The files of a run's final detector: for this project, as ONNX, and as a model of MLflow's."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from neural_sim.detector.onnx_export import TOLERANCE, export, largest_difference
from neural_sim.detector.saved import SavedDetector
from neural_sim.extras import require

_log = logging.getLogger(__name__)

ONNX = "model.onnx"
CHECKED = 50
"""Test images on which onnxruntime is compared with torch."""


@dataclass(frozen=True)
class ModelFiles:
    """What the report writes of the detector trained on the learned distribution, beside ``model.safetensors`` and
    ``model.json``, which it always writes.

    Args:
        onnx: ``model.onnx``; wants the packages of the extra ``onnx``.
        nms: non-maximum suppression inside ``model.onnx``, see :func:`onnx_export.export`.
        pyfunc: a pyfunc model in the run in MLflow.
        registered_name: under which MLflow registers a version of that; None: it does not.

    Raises:
        ValueError: ``onnx`` without its packages; ``nms`` without ``onnx``, or a name without ``pyfunc``.
    """

    onnx: bool = False
    nms: bool = False
    pyfunc: bool = False
    registered_name: str | None = None

    def __post_init__(self) -> None:
        if self.nms and not self.onnx:
            raise ValueError("model.nms wants model.onnx=true, which it is a part of")
        if self.registered_name is not None and not (self.pyfunc and self.registered_name):
            raise ValueError(
                f"model.registered_name wants model.pyfunc=true and a name, got {self.registered_name!r}"
            )
        if self.onnx:
            require("onnx", "model.onnx")

    def write(self, saved: SavedDetector, images: Float[Tensor, "n 3 h w"], folder: Path) -> Path:
        """The files in ``folder``, whose ``model.safetensors`` is returned. ONNX is checked on ``images``."""
        path = saved.save(folder)
        if self.onnx:
            made = export(saved, folder / ONNX, self.nms)
            if (
                not self.nms
            ):  # detections are not comparable one by one: scores that are nearly equal change places
                difference = largest_difference(saved, made, images[:CHECKED])
                level = logging.INFO if difference <= TOLERANCE else logging.WARNING
                count = len(images[:CHECKED])
                _log.log(
                    level, "%s: onnxruntime within %.1e of torch on %d test images", ONNX, difference, count
                )
        return path
