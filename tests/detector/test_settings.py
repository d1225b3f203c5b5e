"""The detector's settings have ranges, and a value out of one is refused by its key."""

import math
from functools import partial

import pytest

from neural_sim.detector.classifier import Classifier
from neural_sim.detector.fcos import Fcos
from neural_sim.detector.real import Real
from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Backbone, Detections, Head, Losses, Points
from neural_sim.detector.smooth_scores import SmoothAccuracy, SmoothAP
from neural_sim.detector.training import Optimisation, Training
from neural_sim.detector.trajectory import Recording

THREE = {"strides": (8, 16, 32)}
CASES = [
    (Backbone, {"architecture": "vgg"}, "Backbone.architecture: want one of micro, tiny, resnet18, resnet50"),
    (Backbone, {"freeze": True}, "Backbone.weights: want weights with freeze=true"),
    (Head, {"channels": 12}, "Head.channels: want at least 8 and a multiple of 8, got 12"),
    (Head, {"convs": 5}, "Head.convs: want at least 1 and at most 4, got 5"),
    (Head, {"normalisation": "batch"}, "Head.normalisation: want one of group, none"),
    (Head, {"prior": 1.0}, "Head.prior: want more than 0 and less than 1"),
    (Anchors, {"reference": 0}, "Anchors.reference: want more than 0 or null"),
    (Anchors, {"reference": math.inf}, "Anchors.reference: want more than 0 and finite or null"),
    (Anchors, {"ratios": [-1]}, "Anchors.ratios[0]: want more than 0, got -1"),
    (Anchors, {"ratios": []}, "Anchors.ratios: want 1 or more values"),
    (Anchors, {"sizes": ((8,),)}, "Anchors.sizes: want one list for each stride, all of them equally long"),
    (Anchors, {"sizes": ((8,), (16, 24))}, "Anchors.sizes: want one list for each stride"),
    (Anchors, {"sizes": ((8,), (0,))}, "Anchors.sizes[1][0]: want more than 0"),
    (Anchors, {"strides": (), "sizes": ()}, "Anchors.strides: want 1 or more values"),
    (Anchors, {"foreground_iou": 0.3}, "Anchors.foreground_iou: want at least background_iou=0.4, got 0.3"),
    (Points, {**THREE, "limits": (20, 10)}, "Points.limits: want increasing values, got [20, 10]"),
    (Points, {**THREE, "limits": (10, 10)}, "Points.limits: want increasing values"),
    (Points, {"limits": ()}, "Points.limits: want one for each stride but the last"),
    (Points, {"radius": 0.0}, "Points.radius: want more than 0, got 0.0"),
    (Points, {"reference": -1.0}, "Points.reference: want more than 0 or null"),
    (Losses, {"box": "huber"}, "Losses.box: want one of pseudo_huber, l1, got 'huber'"),
    (Losses, {"box_delta": 0.0}, "Losses.box_delta: want more than 0"),
    (Losses, {"focal_alpha": math.nan}, "Losses.focal_alpha: want more than 0 and less than 1, got nan"),
    (Losses, {"focal_alpha": -1}, "Losses.focal_alpha: want more than 0 and less than 1, got -1"),
    (Losses, {"focal_gamma": -1}, "Losses.focal_gamma: want at least 0, got -1"),
    (Detections, {"score_threshold": math.nan}, "Detections.score_threshold: want at least 0 and less than 1, got nan"),
    (Detections, {"nms_iou": -1}, "Detections.nms_iou: want at least 0 and at most 1, got -1"),
    (Detections, {"limit": 0}, "Detections.limit: want at least 1, got 0"),
    (Detections, {"candidates": 0}, "Detections.candidates: want at least 1, got 0"),
    (RetinaNet, {"num_classes": 0}, "RetinaNet.num_classes: want at least 1"),
    (partial(RetinaNet, 3), {"activation": "tanh"}, "RetinaNet.activation: want one of silu, relu, got 'tanh'"),
    (partial(RetinaNet, 3), {"image_size": (32, 0)}, "RetinaNet.image_size[1]: want at least 1, got 0"),
    (partial(RetinaNet, 3), {"proximal": math.inf}, "RetinaNet.proximal: want at least 0 and finite, got inf"),
    (partial(Fcos, 3), {"focal_alpha": 1.0}, "Fcos.focal_alpha: want more than 0 and less than 1, got 1.0"),
    (partial(Fcos, 3), {"activation": "tanh"}, "Fcos.activation: want one of silu, relu"),
    (Classifier, {"num_classes": 1}, "Classifier.num_classes: want at least 2, got 1"),
    (partial(Classifier, 2), {"activation": "tanh"}, "Classifier.activation: want one of silu, relu"),
    (Real, {"mode": "both"}, "Real.mode: want one of none, combined, pretrain, got 'both'"),
    (Real, {"fewer": "most"}, "Real.fewer: want one of refuse, all, got 'most'"),
    (Real, {"count": -1}, "Real.count: want at least 0 or null, got -1"),
    (Real, {"count": 3, "fraction": 0.5}, "want count or fraction, got both"),
    (Real, {"fraction": 1.5}, "Real.fraction: want more than 0 and at most 1 or null, got 1.5"),
    (Real, {"batch_fraction": 1.0}, "Real.batch_fraction: want more than 0 and less than 1 or null, got 1.0"),
    (Real, {"finetune": 0.0}, "Real.finetune: want more than 0, got 0.0"),
    (Real, {"finetune_learning_rate": math.inf}, "Real.finetune_learning_rate: want more than 0 and finite, got inf"),
    (Training, {"learning_rate": 0}, "Training.learning_rate: want more than 0, got 0"),
    (Training, {"learning_rate": math.inf}, "Training.learning_rate: want more than 0 and finite, got inf"),
    (Training, {"image_size": 8}, "Training.image_size: want at least 16"),
    (Training, {"warm_start": "cold"}, "Training.warm_start: want one of uniform, initial"),
    (Training, {"batch_size": 1, "real": Real("combined")}, "Training.batch_size: want at least 2"),
    (Optimisation, {"epochs": 0}, "Optimisation.epochs: want at least 1"),
    (partial(Optimisation, 1), {"batch_size": 0}, "Optimisation.batch_size: want at least 1"),
    (Recording, {"max_memory_mb": 0.0}, "Recording.max_memory_mb: want more than 0"),
    (SmoothAP, {"temperature": 0.0}, "SmoothAP.temperature: want more than 0"),
    (SmoothAP, {"width": -1.0}, "SmoothAP.width: want more than 0"),
    (SmoothAP, {"per_class": 0}, "SmoothAP.per_class: want at least 1"),
    (SmoothAP, {"loss": -0.1}, "SmoothAP.loss: want at least 0"),
    (SmoothAccuracy, {"temperature": 0.0}, "SmoothAccuracy.temperature: want more than 0"),
    (SmoothAccuracy, {"loss": -0.1}, "SmoothAccuracy.loss: want at least 0"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "values", "message"), CASES)
def test_settings_out_of_range_are_refused(make, values, message):
    with pytest.raises(ValueError) as caught:
        make(**values)
    assert str(caught.value).startswith(message)
