"""Export a detector to ONNX, with the decoded boxes and scores of all anchors, or detections, as outputs."""

from __future__ import annotations

import json
import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from typing_extensions import override

from neural_sim.detector.onnx_nms import INPUTS, with_nms
from neural_sim.detector.saved import SavedDetector
from neural_sim.extras import require

OPSET = 18
TOLERANCE = 1e-4
"""Largest accepted difference of scores, and of boxes as fractions of the image's longer side."""


class Decoded(nn.Module):
    """A detector that maps images [n, 3, h, w] in [0, 1] to boxes and scores of all anchors.

    Boxes [n, anchors, 4] are (x0, y0, x1, y1) in pixels, scores [n, anchors, classes] are in [0, 1].
    """

    def __init__(self, saved: SavedDetector) -> None:
        super().__init__()
        self.detector: Any = saved.detector
        self.names = list(saved.params)
        for index, name in enumerate(self.names):
            self.register_buffer(f"p{index}", saved.params[name].detach().cpu())

    @override
    def forward(self, images: Float[Tensor, "n 3 h w"]) -> tuple[Tensor, Tensor]:
        params = {name: getattr(self, f"p{index}") for index, name in enumerate(self.names)}
        backbone, trainable = self.detector.split(params)
        outputs = self.detector.outputs(trainable, self.detector.features(backbone, images))
        return self.detector.decode(outputs[1]), self.detector.ranking(outputs).sigmoid()


def export(saved: SavedDetector, path: Path, nms: bool = False) -> Path:
    """Write ``path``: input ``images`` [n, 3, h, w] in [0, 1], any n.

    Without ``nms`` the outputs are ``boxes`` [n, anchors, 4] and ``scores`` [n, anchors, classes], see
    ``Decoded``. With it they are the detections in all images, chosen as by ``Detector.predict``: ``image``
    [d], ``boxes`` [d, 4], ``scores`` [d], ``labels`` [d], image by image, the best first. The file's metadata has the
    ``class_names`` as JSON.

    Raises:
        ValueError: a package is missing, or the detector cannot decode the boxes of all anchors.
    """
    require("onnx", "model.onnx")
    if not callable(getattr(saved.detector, "decode", None)):
        raise ValueError(
            f"model.onnx: want a detector with a method decode(deltas) -> boxes in pixels, {saved.make} has none"
        )
    import onnx

    height, width = saved.image_size
    network, example = Decoded(saved).eval(), torch.zeros(2, 3, height, width)
    with _quiet(), torch.no_grad():
        program = torch.onnx.export(
            network, (example,), dynamo=True, opset_version=OPSET, verbose=False,
            input_names=["images"], output_names=[*INPUTS] if nms else ["boxes", "scores"],
            dynamic_shapes={"images": {0: torch.export.Dim("n", min=1)}},
        )  # fmt: skip
    if program is None:
        raise RuntimeError("torch.onnx.export gave no program")
    model = program.model_proto
    if nms:
        model = with_nms(model, saved)
    model.metadata_props.clear()
    onnx.helper.set_model_props(model, {"class_names": json.dumps(saved.class_names)})
    onnx.checker.check_model(model, full_check=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.part")
    onnx.save(model, draft)
    os.replace(draft, path)
    return path


@torch.no_grad()
def largest_difference(saved: SavedDetector, path: Path, images: Float[Tensor, "n 3 h w"]) -> float:
    """Compare torch with onnxruntime, on an ONNX file exported without non-maximum suppression.

    Returns:
        The largest difference of scores, and of boxes as fractions of the image's longer side.
    """
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    network, largest = Decoded(saved), 0.0
    for chunk in images.split(16):
        given = chunk.float().cpu()
        boxes, scores = (torch.from_numpy(out) for out in session.run(None, {"images": given.numpy()}))
        wanted_boxes, wanted_scores = network(given)
        for difference, unit in (
            (boxes - wanted_boxes, max(saved.image_size)),
            (scores - wanted_scores, 1.0),
        ):
            largest = max(largest, float(difference.abs().max()) / unit)
    return largest


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the exporter's notices, which users need not act on."""
    noisy = [logging.getLogger(name) for name in ("torch.onnx", "onnxscript", "onnx_ir")]
    levels = [logger.level for logger in noisy]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for logger in noisy:
            logger.setLevel(logging.ERROR)
        try:
            yield
        finally:
            for logger, level in zip(noisy, levels, strict=True):
                logger.setLevel(level)
