from urllib.error import URLError

import pytest
import torch
from torch import nn
from torchvision.models import resnet18
from torchvision.models.detection import RetinaNet
from torchvision.models.detection.anchor_utils import AnchorGenerator


class _Nothing(nn.Module):
    out_channels = 8


def reference(detector, sizes) -> RetinaNet:
    """torchvision's own RetinaNet around the detector's head, for its loss and its post-processing."""
    return RetinaNet(
        _Nothing(),
        detector.num_classes,
        anchor_generator=AnchorGenerator(sizes, ((1.0,),) * len(sizes)),
        head=detector._predictor.head,
        detections_per_img=detector.detections.limit,
    )


def test_anchors_are_torchvisions(tools):
    sizes = ((8, 12), (16, 24))
    detector = tools.detector(anchors={"sizes": sizes})
    model = reference(detector, sizes)
    maps = [torch.zeros(1, 8, 4, 4), torch.zeros(1, 8, 2, 2)]
    images = type("Images", (), {"tensors": torch.zeros(1, 3, 32, 32), "image_sizes": [(32, 32)]})()
    assert torch.equal(detector.anchors, model.anchor_generator(images, maps)[0])
    assert detector.anchors_per_level == [32, 8]


def test_anchors_grow_with_the_image(tools):
    small, large = tools.detector(), tools.detector(image_size=64)
    assert len(large.anchors) == 4 * len(small.anchors)
    assert torch.equal(large.anchors[:2], 2 * small.anchors[:2])


@pytest.mark.parametrize("activation", ["relu", "silu"])
def test_loss_is_torchvisions(tools, generator, images, activation):
    detector = tools.detector(losses={"box": "l1"}, activation=activation)
    params = tools.noisy(detector.init(generator), generator)
    backbone, trainable = detector.split(params)
    features = detector.features(backbone, images.images)
    logits, deltas = detector.outputs(trainable, features)
    kept = [labels >= 0 for labels in images.labels]
    truth = [
        {"boxes": boxes[k], "labels": labels[k]}
        for boxes, labels, k in zip(images.boxes, images.labels, kept, strict=True)
    ]
    wanted = reference(detector, ((8, 12), (16, 24))).compute_loss(
        truth, {"cls_logits": logits, "bbox_regression": deltas}, [detector.anchors.double()] * len(images)
    )
    got = detector.per_image_loss(trainable, features, detector.assign(images.boxes, images.labels)).mean()
    torch.testing.assert_close(got, sum(wanted.values()), rtol=1e-12, atol=0)


def test_images_do_not_see_each_other(tools, generator, images):
    detector = tools.detector()
    backbone, trainable = detector.split(tools.noisy(detector.init(generator), generator))
    targets = detector.assign(images.boxes, images.labels)
    together = detector.per_image_loss(trainable, detector.features(backbone, images.images), targets)
    for i in range(len(images)):
        alone = detector.features(backbone, images.images[i : i + 1])
        single = detector.per_image_loss(trainable, alone, targets.select(slice(i, i + 1)))
        torch.testing.assert_close(single, together[i : i + 1], rtol=1e-10, atol=0)


def test_predict_is_torchvisions(tools, generator, images):
    sizes = ((8, 12), (16, 24))
    detector = tools.detector(head={"prior": 0.2})
    params = tools.noisy(detector.init(generator), generator)
    backbone, trainable = detector.split(params)
    logits, deltas = detector.outputs(trainable, detector.features(backbone, images.images))
    levels = detector.anchors_per_level
    wanted = reference(detector, sizes).postprocess_detections(
        {"cls_logits": list(logits.split(levels, 1)), "bbox_regression": list(deltas.split(levels, 1))},
        [list(detector.anchors.double().split(levels))] * len(images),
        [(32, 32)] * len(images),
    )
    got = detector.predict(params, images.images, batch_size=3)
    assert sum(len(image["scores"]) for image in wanted) > 10
    for mine, theirs in zip(got, wanted, strict=True):
        for key in ("boxes", "scores", "labels"):
            torch.testing.assert_close(mine[key], theirs[key], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("architecture", ["resnet18", "resnet50"])
def test_resnets_run_on_odd_sizes(tools, generator, architecture):
    detector = tools.detector(
        {"architecture": architecture},
        image_size=(40, 56),
        anchors={"strides": (8, 16, 32), "sizes": ((8,), (16,), (32,))},
    )
    params = detector.init(generator)
    backbone, trainable = detector.split(params)
    features = detector.features(backbone, torch.rand(1, 3, 40, 56, generator=generator))
    logits, deltas = detector.outputs(trainable, features)
    assert logits.shape == (1, len(detector.anchors), 3)
    assert deltas.shape == (1, len(detector.anchors), 4)
    assert not set(backbone) & set(trainable)


def test_weights_from_a_file_reach_the_features(tools, generator, tmp_path):
    source = resnet18().eval()
    for module in source.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.running_mean.normal_(0, 0.1, generator=generator)
            module.running_var.uniform_(0.5, 2, generator=generator)
    torch.save(source.state_dict(), tmp_path / "resnet18.pth")
    detector = tools.detector({"architecture": "resnet18", "weights": str(tmp_path / "resnet18.pth")})
    params = detector.init(generator)
    image = torch.rand(1, 3, 32, 32, generator=generator)
    maps = detector.features(detector.split(params)[0], image)
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    x = (image - mean.view(3, 1, 1)) / std.view(3, 1, 1)
    x = source.layer1(source.maxpool(source.relu(source.bn1(source.conv1(x)))))
    torch.testing.assert_close(maps[0], source.layer2(x), rtol=1e-4, atol=1e-4)
    frozen = set(params) - set(detector.learnable(params))
    assert frozen
    assert all("bn" in name or "downsample.1" in name for name in frozen)
    torch.save({"conv1.weight": torch.zeros(1)}, tmp_path / "wrong.pth")
    with pytest.raises(ValueError, match="does not fit resnet18"):
        tools.detector({"architecture": "resnet18", "weights": str(tmp_path / "wrong.pth")})
    torch.save([1, 2], tmp_path / "list.pth")
    (tmp_path / "text.pth").write_text("no weights")
    (tmp_path / "empty.pth").write_bytes(b"")
    for name, wrong in (
        ("list", "no state dictionary"),
        ("text", "not a torch.save file"),
        ("empty", "not a torch.save file"),
    ):
        with pytest.raises(ValueError, match=wrong):
            tools.detector({"architecture": "resnet18", "weights": str(tmp_path / f"{name}.pth")})


def test_anchors_without_a_reference_are_pixels(tools):
    small, large = tools.detector(), tools.detector(image_size=64, anchors={"reference": None})
    assert torch.equal(small.anchors[:2], large.anchors[:2])


def test_init_depends_on_the_seed_alone(tools):
    detector = tools.detector()
    first = detector.init(torch.Generator().manual_seed(1))
    torch.manual_seed(99)
    again = tools.detector().init(torch.Generator().manual_seed(1))
    other = detector.init(torch.Generator().manual_seed(2))
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert any(not torch.equal(first[name], other[name]) for name in first)
    assert all(torch.isfinite(value).all() for value in first.values())


def test_prior_probability_sets_the_first_scores(tools, generator):
    bias = tools.detector(head={"prior": 0.03}).init(generator)["head.classification_head.cls_logits.bias"]
    torch.testing.assert_close(bias.sigmoid(), torch.full_like(bias, 0.03))


def test_default_tiny_is_small(generator):
    from neural_sim.detector.retinanet import RetinaNet

    params = RetinaNet(6).init(generator)
    assert sum(value.numel() for value in params.values()) < 1_000_000


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"anchors": {"strides": (8, 32)}}, "detector.anchors.strides"),
        ({"anchors": {"strides": (16, 8)}}, "detector.anchors.strides"),
        ({"anchors": {"strides": (8, 16, 64), "sizes": ((8,),) * 3}}, "detector.anchors.strides"),
        ({"anchors": {"strides": (32, 64)}}, "detector.anchors.strides"),
        ({"backbone": {"weights": "DEFAULT"}}, "detector.backbone.weights"),
        ({"backbone": {"architecture": "resnet18", "weights": "nowhere.pth"}}, "detector.backbone.weights"),
    ],
)
def test_bad_settings_are_named(tools, changes, message):
    with pytest.raises(ValueError, match=message):
        tools.detector(**changes)


@pytest.mark.parametrize(
    "content", [b"", b"t", b"PK\x03\x04", b"\x80\x02X\x01\x00\x00\x00\xff", b"\x80\x02("]
)
def test_a_broken_file_of_weights_is_one_line(tools, tmp_path, content):
    (tmp_path / "weights.pth").write_bytes(content)
    backbone = {"architecture": "resnet18", "weights": str(tmp_path / "weights.pth")}
    with pytest.raises(ValueError, match=r"^detector\.backbone\.weights: .* is not a torch\.save file"):
        tools.detector(backbone)


def test_weights_that_cannot_be_downloaded_are_one_line(tools, monkeypatch):
    def offline(*_, **__):
        raise URLError("no network")

    monkeypatch.setattr("neural_sim.detector.network.get_model", offline)
    with pytest.raises(
        ValueError, match=r"^detector\.backbone\.weights: DEFAULT cannot be downloaded \(.*no network"
    ):
        tools.detector({"architecture": "resnet18", "weights": "DEFAULT"})


def test_wrong_image_size_is_refused(tools, generator):
    detector = tools.detector()
    backbone, _ = detector.split(detector.init(generator))
    with pytest.raises(ValueError, match="want images of shape"):
        detector.features(backbone, torch.zeros(1, 3, 40, 40))
