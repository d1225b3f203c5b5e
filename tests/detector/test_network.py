"""Configured networks: the published RetinaNet against torchvision's own, and the one whose Hessian fits in memory."""

import pytest
import torch
from torchvision.models import resnet50
from torchvision.models.detection.backbone_utils import _resnet_fpn_extractor
from torchvision.models.detection.retinanet import RetinaNet, _default_anchorgen
from torchvision.ops.feature_pyramid_network import LastLevelP6P7

from neural_sim.detector.cached_set import CachedSet
from neural_sim.detector.network import group_norm
from neural_sim.detector.training import Optimisation, train_detector
from neural_sim.gradient.implicit import InnerProblem
from neural_sim.solver.hvp import HessianOperator
from neural_sim.solver.operator import flatten, unflatten

CLASSES = 3


@pytest.fixture
def published(tools):
    return tools.configured("retinanet_resnet50")


@pytest.fixture(scope="module")
def torchvisions() -> RetinaNet:
    """The same network from torchvision: group normalisation in its backbone, none after it, P6 on C5."""
    body = resnet50(norm_layer=group_norm)
    backbone = _resnet_fpn_extractor(
        body, 5, returned_layers=[2, 3, 4], extra_blocks=LastLevelP6P7(2048, 256)
    )
    return RetinaNet(backbone, CLASSES, anchor_generator=_default_anchorgen()).double().eval()


def renamed(name: str) -> str:
    """Our parameter's name in torchvision's model."""
    name = name.replace("fpn.extra_blocks.convs.0.", "fpn.extra_blocks.p6.")
    name = name.replace("fpn.extra_blocks.convs.1.", "fpn.extra_blocks.p7.")
    return name if name.startswith(("backbone.", "head.")) else f"backbone.{name}"


def test_outputs_and_loss_are_torchvisions(published, torchvisions, tools, generator):
    detector = published(num_classes=CLASSES, image_size=64)
    params = tools.double(detector.init(generator))
    torchvisions.load_state_dict({renamed(name): value for name, value in params.items()}, strict=True)
    images = torch.rand(2, 3, 64, 64, generator=generator, dtype=torch.float64)
    mean, std = (
        torch.tensor(values, dtype=torch.float64).view(3, 1, 1)
        for values in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
    )
    normalised = (images - mean) / std
    with torch.no_grad():
        pyramid = list(torchvisions.backbone(normalised).values())
        wanted = torchvisions.head(pyramid)
        backbone, trainable = detector.split(params)
        logits, deltas = detector.outputs(trainable, detector.features(backbone, images))
    assert [tuple(level.shape[-2:]) for level in pyramid] == [(8, 8), (4, 4), (2, 2), (1, 1), (1, 1)]
    assert detector.anchors_per_level == [9 * level[0, 0].numel() for level in pyramid]
    torch.testing.assert_close(logits, wanted["cls_logits"], rtol=1e-10, atol=1e-13)
    torch.testing.assert_close(deltas, wanted["bbox_regression"], rtol=1e-10, atol=1e-13)
    boxes = torch.tensor([[[4.0, 6, 40, 50]], [[20.0, 10, 61, 33]]], dtype=torch.float64)
    labels = torch.tensor([[0], [2]])
    truth = [{"boxes": box, "labels": label} for box, label in zip(boxes, labels, strict=True)]
    losses = torchvisions.compute_loss(truth, wanted, [detector.anchors.double()] * 2)
    mine = detector.losses_of((logits, deltas), detector.assign(boxes, labels)).mean()
    torch.testing.assert_close(mine, sum(losses.values()), rtol=1e-10, atol=0)


@pytest.mark.parametrize("size", [64, 256, 384])
def test_anchors_are_torchvisions(published, size):
    # Sizes at which torchvision's strides, the image's side over the level's, are 8 to 128 or the level is one pixel.
    images = type("Images", (), {"tensors": torch.zeros(1, 3, size, size), "image_sizes": [(size, size)]})()
    sides = [max(1, size // stride) for stride in (8, 16, 32, 64, 128)]
    wanted = _default_anchorgen()(images, [torch.zeros(1, 256, side, side) for side in sides])[0]
    detector = published(num_classes=CLASSES, image_size=size)
    assert torch.equal(detector.anchors, wanted)
    assert detector.anchors_per_level == [9 * side * side for side in sides]


def test_levels_below_a_pixel_are_one_pixel(tools, generator):
    detector = tools.detector(
        image_size=(24, 40), anchors={"strides": (8, 16, 32, 64), "sizes": ((8,), (16,), (32,), (64,))}
    )
    assert detector.anchors_per_level == [15, 6, 2, 1]
    found = detector.predict(detector.init(generator), torch.rand(2, 3, 24, 40, generator=generator))
    assert len(found) == 2


def test_without_normalisation_the_heads_start_small_and_the_pyramid_keeps_its_scale(published, generator):
    state = published(num_classes=CLASSES, image_size=64).init(generator)
    for name, value in state.items():
        if name.endswith("bias") and "backbone" not in name and "cls_logits" not in name:
            assert not value.any(), name
    for name in ("head.classification_head.conv.3.0.weight", "head.regression_head.bbox_reg.weight"):
        assert state[name].std().item() == pytest.approx(0.01, rel=0.02)
    for name, inputs in (("fpn.extra_blocks.convs.0.weight", 9 * 2048), ("fpn.inner_blocks.0.0.weight", 512)):
        assert state[name].std().item() == pytest.approx(inputs**-0.5, rel=0.02)
    prior = state["head.classification_head.cls_logits.bias"].sigmoid()
    torch.testing.assert_close(prior, torch.full_like(prior, 0.01))


@pytest.fixture
def micro(tools):
    return tools.configured("micro")


@pytest.mark.parametrize("size", [32, 48])
def test_it_has_at_most_5000_parameters_and_learns(micro, tools, generator, size):
    detector = micro(num_classes=6, image_size=size)
    start = detector.init(generator)
    assert sum(value.numel() for value in start.values()) <= 5000
    assert sum(value.numel() for value in detector.split(start)[1].values()) <= 5000
    images = tools.images(4, dtype=torch.float32)
    if size != 32:
        return
    how = Optimisation(60, batch_size=4, learning_rate=1e-2, weight_decay=1e-2)
    trained, _ = train_detector(detector, start, images, generator, how)
    assert tools.mean_loss(detector, trained, images) < 0.5 * tools.mean_loss(detector, start, images)


def test_products_with_the_hessian_of_its_loss_agree(micro, tools, generator, images):
    """Both modes with forward over reverse, in float64."""
    detector = micro(num_classes=3, image_size=32)
    backbone, trainable = detector.split(tools.noisy(detector.init(generator), generator))
    cached = CachedSet.of(detector, backbone, images)
    weights = torch.full((len(images),), 1.0 / len(images), dtype=torch.float64)
    terms = InnerProblem(trainable, cached.losses, weights, proximal=0.7, anchor=trainable).terms()
    operator = HessianOperator(terms, trainable)
    vector = torch.randn(operator.size, generator=generator, dtype=torch.float64)
    slope = torch.func.grad(lambda at: sum(term(unflatten(at, trainable)) for term in terms))
    expected = torch.func.jvp(slope, (flatten(trainable),), (vector,))[1]
    assert (operator(vector) - expected).norm() < 1e-10 * expected.norm()
    differenced = HessianOperator(terms, trainable, "central_difference")(vector)
    assert (differenced - expected).norm() < 1e-6 * expected.norm()
