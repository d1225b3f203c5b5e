"""Export a detector to ONNX, with the decoded boxes and scores of all anchors, or detections, as outputs."""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from typing_extensions import override

from neural_sim.detector.saved_detector import SavedDetector
from neural_sim.documents import write_whole
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
        self.detector = saved.detector
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
    """Write an ONNX file to ``path``, and return it. The input is ``images`` [n, 3, h, w] in [0, 1], for any n.

    Without ``nms`` the outputs are ``boxes`` [n, anchors, 4] and ``scores`` [n, anchors, classes], see
    ``Decoded``. With it they are the detections in all images, chosen as by ``Detector.predict``: ``image``
    [d], ``boxes`` [d, 4], ``scores`` [d], ``labels`` [d], image by image, and best first in each. The file's metadata
    has the ``class_names`` as JSON.

    Raises:
        ValueError: a package is missing.
    """
    require("onnx", "model.onnx")
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
    return write_whole(path, model.SerializeToString())


@torch.no_grad()
def largest_difference(saved: SavedDetector, path: Path, images: Float[Tensor, "n 3 h w"]) -> float:
    """Compare torch with onnxruntime, on an ONNX file exported without non-maximum suppression.

    Returns:
        The largest difference of scores, and of boxes as fractions of the image's longer side; nan if an output is.
    """
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    network, differences = Decoded(saved), [torch.zeros(())]
    for chunk in images.split(16):
        given = chunk.float().cpu()
        boxes, scores = (torch.from_numpy(out) for out in session.run(None, {"images": given.numpy()}))
        wanted_boxes, wanted_scores = network(given)
        differences += [
            (boxes - wanted_boxes).abs().max() / max(saved.image_size),
            (scores - wanted_scores).abs().max(),
        ]
    return float(torch.stack(differences).max())


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


INPUTS = ("anchor_boxes", "anchor_scores")
"""Names of the network's outputs, which are the inputs of non-maximum suppression."""


def with_nms(model: Any, saved: SavedDetector) -> Any:
    """Append the steps of ``Detector.predict`` to ``model``, an ``onnx.ModelProto`` with the outputs ``INPUTS``.

    The appended steps take each level's best candidates, suppress within each class, and keep the best ``limit``
    detections of an image.
    """
    import onnx

    text = _graph(saved, model.opset_import[0].version, model.ir_version)
    suppression = onnx.parser.parse_model(text)
    return onnx.compose.merge_models(model, suppression, io_map=[(name, name) for name in INPUTS])


def _graph(saved: SavedDetector, opset: int, ir_version: int) -> str:
    """Write the graph in ONNX's textual syntax; names of intermediate values begin with ``nms_``."""
    settings, per_level = saved.detector.detections, saved.detector.anchors_per_level or [_anchors(saved)]
    anchors, classes = sum(per_level), len(saved.class_names)
    nodes, levels, first = [], [], 0
    for number, count in enumerate(per_level):
        nodes.append(_level(number, first, first + count, min(settings.candidates, count * classes)))
        levels.append(f"nms_kept{number}")
        first += count
    return f"""
<ir_version: {ir_version}, opset_import: ["" : {opset}]>
suppression (float[n, {anchors}, 4] anchor_boxes, float[n, {anchors}, {classes}] anchor_scores)
    => (int64[d] image, float[d, 4] boxes, float[d] scores, int64[d] labels)
{{
    nms_below = Constant<value = float {{-1.0}}>()
    nms_zero = Constant<value = int64[1] {{0}}>()
    nms_one = Constant<value = int64[1] {{1}}>()
    nms_axis = Constant<value = int64 {{0}}>()
    nms_rows = Constant<value = int64[2] {{0, -1}}>()
    nms_off_on = Constant<value = int64[2] {{0, 1}}>()
    nms_limit = Constant<value = int64[1] {{{settings.limit}}}>()
    nms_iou = Constant<value = float[1] {{{float(settings.nms_iou)!r}}}>()
    nms_least = Constant<value = float[1] {{{float(settings.score_threshold)!r}}}>()
    {"".join(nodes)}
    nms_kept = Concat<axis = 1>({", ".join(levels)})
    nms_by_class = Transpose<perm = [0, 2, 1]>(nms_kept)
    nms_index = NonMaxSuppression(anchor_boxes, nms_by_class, nms_limit, nms_iou, nms_least)
    nms_score = GatherND(nms_by_class, nms_index)
    nms_image3, nms_label3, nms_anchor3 = Split<axis = 1, num_outputs = 3>(nms_index)
    nms_image = Squeeze(nms_image3, nms_one)
    nms_count = Shape(nms_score)
    nms_sorted, nms_by_score = TopK(nms_score, nms_count)
    nms_image_by_score = Gather(nms_image, nms_by_score)
    nms_images, nms_by_image = TopK<largest = 0>(nms_image_by_score, nms_count)
    nms_order = Gather(nms_by_score, nms_by_image)
    nms_batch = Shape<start = 0, end = 1>(anchor_boxes)
    nms_depth = Squeeze(nms_batch, nms_zero)
    nms_own = OneHot<axis = -1>(nms_images, nms_depth, nms_off_on)
    nms_so_far = CumSum(nms_own, nms_axis)
    nms_counted = Mul(nms_own, nms_so_far)
    nms_rank = ReduceSum<keepdims = 0>(nms_counted, nms_one)
    nms_among = LessOrEqual(nms_rank, nms_limit)
    nms_best = Compress<axis = 0>(nms_order, nms_among)
    nms_chosen = Gather(nms_index, nms_best)
    nms_image1, nms_label1, nms_anchor1 = Split<axis = 1, num_outputs = 3>(nms_chosen)
    image = Squeeze(nms_image1, nms_one)
    labels = Squeeze(nms_label1, nms_one)
    scores = Gather(nms_score, nms_best)
    nms_where = Concat<axis = 1>(nms_image1, nms_anchor1)
    boxes = GatherND(anchor_boxes, nms_where)
}}
"""


def _anchors(saved: SavedDetector) -> int:
    """Count the detector's anchors."""
    backbone, trainable = saved.detector.split(saved.params)
    blank = torch.zeros(1, 3, *saved.image_size)
    with torch.no_grad():
        return saved.detector.outputs(trainable, saved.detector.features(backbone, blank))[0].shape[1]


def _level(number: int, first: int, last: int, candidates: int) -> str:
    """Keep the best scores of one pyramid level; the others become -1, which no threshold lets pass."""
    return f"""
    nms_from{number} = Constant<value = int64[1] {{{first}}}>()
    nms_to{number} = Constant<value = int64[1] {{{last}}}>()
    nms_many{number} = Constant<value = int64[1] {{{candidates}}}>()
    nms_last{number} = Constant<value = int64[1] {{{candidates - 1}}}>()
    nms_level{number} = Slice(anchor_scores, nms_from{number}, nms_to{number}, nms_one)
    nms_flat{number} = Reshape(nms_level{number}, nms_rows)
    nms_top{number}, nms_top_index{number} = TopK<axis = 1>(nms_flat{number}, nms_many{number})
    nms_worst{number} = Slice(nms_top{number}, nms_last{number}, nms_many{number}, nms_one)
    nms_bound{number} = Unsqueeze(nms_worst{number}, nms_one)
    nms_good{number} = GreaterOrEqual(nms_level{number}, nms_bound{number})
    nms_kept{number} = Where(nms_good{number}, nms_level{number}, nms_below)
"""
