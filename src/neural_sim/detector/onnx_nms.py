"""Non-maximum suppression as part of an ONNX file: from all anchors' boxes and scores to detections."""

from __future__ import annotations

from typing import Any

import torch

from neural_sim.detector.saved import SavedDetector

INPUTS = ("anchor_boxes", "anchor_scores")
"""The network's outputs, which are the inputs of suppression."""


def with_nms(model: Any, saved: SavedDetector) -> Any:
    """Append the steps of ``Detector.predict`` to ``model``, an ``onnx.ModelProto`` with the outputs ``INPUTS``.

    The appended steps take the best candidates of each level, suppress within each class, and keep the best ``limit``
    of an image.
    """
    import onnx

    text = _graph(saved, model.opset_import[0].version, model.ir_version)
    suppression = onnx.parser.parse_model(text)
    return onnx.compose.merge_models(model, suppression, io_map=[(name, name) for name in INPUTS])


def _graph(saved: SavedDetector, opset: int, ir_version: int) -> str:
    """Write the graph in ONNX's textual syntax; names of the nodes' results begin with ``nms_``."""
    detector: Any = saved.detector
    settings, per_level = detector.detections, detector.anchors_per_level or [_anchors(saved)]
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
