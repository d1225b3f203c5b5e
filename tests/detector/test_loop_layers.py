"""Detectors of which the psi loop trains the backbone's last stages, against the same ones with all of it frozen."""

import pytest
import torch
from colour_detector import ColourDetector
from torchvision.models import resnet18

from neural_sim.detector.cached_set import CachedSet
from neural_sim.detector.classifier import Classifier
from neural_sim.detector.fcos import Fcos
from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Backbone
from neural_sim.detector.training import Optimisation, train_detector
from neural_sim.detector.trajectory import Recording
from neural_sim.outer.settings import Outer
from neural_sim.types import LabelledImages

KINDS = {
    "tiny": (RetinaNet, "tiny", {}),
    "one map": (RetinaNet, "tiny", {"anchors": Anchors(strides=(8,), sizes=((16.0,),))}),
    "coarse": (RetinaNet, "tiny", {"anchors": Anchors(strides=(16,), sizes=((16.0,),))}),
    "resnet18": (RetinaNet, "resnet18", {"anchors": Anchors((8, 16, 32), ((8.0,), (16.0,), (32.0,)))}),
    "fcos": (Fcos, "tiny", {}),
    "classifier": (Classifier, "tiny", {}),
}


def detector(kind, layers):
    cls, architecture, settings = KINDS[kind]
    return cls(num_classes=3, image_size=32, backbone=Backbone(architecture), **settings).in_loop(layers)


@pytest.fixture(scope="module")
def images():
    pixels = torch.rand(4, 3, 32, 32, generator=torch.Generator().manual_seed(1))
    boxes = torch.tensor([[[4.0, 4.0, 20.0, 20.0]]]).expand(4, 1, 4)
    return LabelledImages(
        pixels, boxes.contiguous(), torch.tensor([[0], [1], [2], [0]]), torch.full((4, 1), -1)
    )


@pytest.mark.parametrize(
    ("kind", "layers"),
    [(kind, layers) for kind in KINDS for layers in (1, 2, 3) if (kind, layers) != ("one map", 3)],
)
def test_the_outputs_are_those_of_the_whole_detector(kind, layers, images):
    whole, parted = detector(kind, 0), detector(kind, layers)
    params = whole.init(torch.Generator().manual_seed(0))
    outputs = []
    for each in (whole, parted):
        backbone, trainable = each.split(params)
        assert set(backbone) | set(trainable) == set(params) and not set(backbone) & set(trainable)
        outputs.append(each.outputs(trainable, each.features(backbone, images.images)))
    for one, other in zip(*outputs, strict=True):
        torch.testing.assert_close(one, other)
    assert params.keys() == parted.init(torch.Generator().manual_seed(0)).keys()


def test_the_last_stages_are_trained_and_the_others_stay(images):
    each = detector("tiny", 2)
    params = each.init(torch.Generator().manual_seed(0))
    cached = CachedSet.of(each, each.split(params)[0], images)
    assert [tuple(level.shape) for level in cached.features] == [(4, 32, 8, 8)]
    trained, _ = train_detector(
        each, params, cached, torch.Generator().manual_seed(2), Optimisation(2, 4, 1e-2, 0.0)
    )

    moved = {
        name.split(".")[2]
        for name in params
        if not torch.equal(params[name], trained[name]) and "backbone" in name
    }
    assert moved == {"2", "3"}


@pytest.mark.parametrize(
    ("architecture", "trained"), [("tiny", {"3"}), ("micro", {"3"}), ("resnet18", set())]
)
def test_a_detector_proposes_the_last_stage_of_a_small_backbone(architecture, trained):
    each = RetinaNet(3, 32, Backbone(architecture)).in_loop(None)
    trainable = each.split(each.init(torch.Generator().manual_seed(0)))[1]
    assert {name.split(".")[2] for name in trainable if name.startswith("backbone.")} == trained


@pytest.mark.parametrize(("kind", "stages"), [("tiny", 4), ("one map", 3)])
def test_a_backbone_with_one_stage_at_least_is_left(kind, stages):
    with pytest.raises(
        ValueError, match=rf"outer\.loop_layers must be at least 0 and below {stages}, got {stages}"
    ):
        detector(kind, stages)


def test_stages_beyond_the_last_map_are_not_built(images):
    """They would have no gradient, which a training that is recorded refuses."""
    each = detector("one map", 1)
    params = each.init(torch.Generator().manual_seed(0))
    backbone, trainable = each.split(params)
    assert {name.split(".")[2] for name in trainable if name.startswith("backbone.")} == {"2"}
    cached = CachedSet.of(each, backbone, images)
    how, generator = Optimisation(1, 4), torch.Generator().manual_seed(2)
    _, history = train_detector(each, params, cached, generator, how, recording=Recording())
    assert len(history.trajectory) == 1


def test_a_negative_number_is_refused_before_any_stage():
    with pytest.raises(ValueError, match=r"Outer\.loop_layers: want at least 0 or null, got -1"):
        Outer(loop_layers=-1)


def test_published_weights_have_no_layers_for_the_loop(tmp_path):
    torch.save(resnet18().state_dict(), tmp_path / "resnet18.pth")
    each = RetinaNet(3, 32, Backbone("resnet18", str(tmp_path / "resnet18.pth")))
    assert each.in_loop(None) is each
    with pytest.raises(
        ValueError, match=r"outer\.loop_layers: want null or 0 with detector\.backbone\.weights, got 1"
    ):
        each.in_loop(1)


def test_a_detector_without_stages_has_no_layers_for_the_loop():
    each = ColourDetector(num_classes=3, image_size=32)
    assert each.in_loop(None) is each and each.in_loop(0) is each
    with pytest.raises(ValueError, match=r"outer\.loop_layers: ColourDetector has no stages"):
        each.in_loop(1)
