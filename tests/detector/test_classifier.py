"""The classifier against torchvision's and torch's own, and what the psi loop needs of it."""

import functools

import pytest
import torch
from torch.nn import functional as F
from torchvision.models import resnet18

from neural_sim.detector.classifier import Classifier
from neural_sim.detector.losses import IGNORED
from neural_sim.detector.onnx_export import TOLERANCE, export
from neural_sim.detector.settings import Backbone
from neural_sim.detector.training import Optimisation, train_detector
from neural_sim.types import LabelledImages


def make(classes=3, size=32, **settings):
    return Classifier(classes, size, **{"backbone": Backbone("micro"), **settings})


def shown(count=6, seed=0, size=32):
    """Noise with one object each, the last image without one."""
    generator = torch.Generator().manual_seed(seed)
    images = torch.rand(count, 3, size, size, generator=generator, dtype=torch.float64)
    labels = torch.randint(0, 3, (count, 1), generator=generator)
    labels[-1] = -1
    boxes = torch.tensor([4.0, 4, 20, 24], dtype=torch.float64).expand(count, 1, 4)
    return LabelledImages(images, boxes, labels, torch.full((count,), -1))


def logits_of(detector, params, images):
    backbone, trainable = detector.split(params)
    return detector.outputs(trainable, detector.features(backbone, images.images))


def test_with_weights_of_a_file_it_is_torchvisions_resnet(tmp_path):
    torch.manual_seed(0)
    theirs = resnet18(num_classes=3).eval()
    for name, value in theirs.named_buffers():  # statistics of batches other than the initial ones
        if "running" in name:
            value.uniform_(0.5, 1.5)
    torch.save(resnet18(num_classes=1000).state_dict() | {
        k: v for k, v in theirs.state_dict().items() if not k.startswith("fc.")
    }, tmp_path / "weights.pt")  # fmt: skip
    detector = make(size=64, backbone=Backbone("resnet18", str(tmp_path / "weights.pt")))
    params = detector.init(torch.Generator().manual_seed(0))
    params |= {"head.weight": theirs.fc.weight.detach(), "head.bias": theirs.fc.bias.detach()}
    images = torch.rand(2, 3, 64, 64)
    mean, std = (torch.tensor(detector.normalisation[key])[:, None, None] for key in ("mean", "std"))
    with torch.no_grad():
        wanted = theirs((images - mean) / std)
        found = logits_of(
            detector,
            params,
            LabelledImages(images, torch.zeros(2, 0, 4), *[torch.zeros(2, 0, dtype=torch.long)] * 2),
        )[0][:, 0]
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-5)
    assert {"head.weight", "backbone.body.conv1.weight"} <= set(detector.learnable(params))
    frozen = make(size=64, backbone=Backbone("resnet18", str(tmp_path / "weights.pt"), freeze=True))
    assert frozen.learnable(params) == ["head.weight", "head.bias"]


def test_loss_and_scores_are_torchs_cross_entropy_and_softmax(tools, generator):
    detector, images = make(), shown()
    outputs = logits_of(detector, tools.noisy(detector.init(generator), generator), images)
    targets = detector.assign(images.boxes, images.labels)
    wanted = F.cross_entropy(outputs[0][:-1, 0], images.labels[:-1, 0], reduction="none")
    losses = detector.losses_of(outputs, targets)
    torch.testing.assert_close(losses[:-1], wanted, rtol=1e-12, atol=0)
    assert int(targets.labels[-1]) == IGNORED and float(losses[-1]) == 0.0
    torch.testing.assert_close(
        detector.ranking(outputs).sigmoid(), outputs[0].softmax(-1), rtol=1e-12, atol=0
    )
    large = detector.ranking((torch.tensor([[[300.0, 0.0, -300.0]]]), outputs[1][:1]))
    torch.testing.assert_close(large, torch.tensor([[[300.0, -300.0, -600.0]]]))


def test_an_image_s_prediction_is_its_best_class_with_its_probability(tools, generator):
    detector, images = make(size=(32, 48)), torch.rand(5, 3, 32, 48, generator=generator).double()
    params = tools.noisy(detector.init(generator), generator)
    backbone, trainable = detector.split(params)
    scores, labels = (
        detector.outputs(trainable, detector.features(backbone, images))[0][:, 0].softmax(-1).max(-1)
    )
    found = detector.predict(params, images, batch_size=2)
    for each, score, label in zip(found, scores, labels, strict=True):
        assert each["labels"].tolist() == [int(label)] and each["boxes"].tolist() == [[0.0, 0.0, 48.0, 32.0]]
        torch.testing.assert_close(each["scores"][0], score, rtol=1e-10, atol=0)


def test_hessian_products_are_central_differences_of_gradients(tools, generator):
    tools.check_hessian(make(), shown(), generator, 1e-4, 1e-7)


def test_it_learns_colours(tools):
    """Squares of three colours at random places, of which the last third is not trained on."""
    generator = torch.Generator().manual_seed(1)
    images, labels = 0.1 * torch.rand(48, 3, 32, 32, generator=generator), torch.arange(48) % 3
    corners = torch.randint(0, 16, (48, 2), generator=generator)
    for image, label, (x, y) in zip(images, labels.tolist(), corners.tolist(), strict=True):
        image[label, y : y + 14, x : x + 14] = 1.0
    boxes = torch.cat([corners, corners + 14], -1)[:, None].float()
    both = LabelledImages(images, boxes, labels[:, None], torch.full((48,), -1))
    detector, how = make(), Optimisation(40, batch_size=8, learning_rate=1e-2)
    start = detector.init(torch.Generator().manual_seed(0))
    trained, history = train_detector(detector, start, both.select(slice(32)), generator, how)
    assert history.losses[0] == pytest.approx(torch.log(torch.tensor(3.0)), rel=0.25)
    assert history.losses[-1] < 0.1 * history.losses[0]
    found = [int(each["labels"][0]) for each in detector.predict(trained, images[32:])]
    assert found == labels[32:].tolist()


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda: make(backbone=Backbone("tiny", "DEFAULT")), r"detector\.backbone\.weights: tiny has no"),
        (
            lambda: make().assign(torch.zeros(2, 2, 4), torch.tensor([[1, -1], [0, 2]])),
            r"classifier: want objects of one class in an image, got \[0, 2\] in image 1",
        ),
        (
            lambda: make().assign(torch.zeros(1, 1, 4), torch.tensor([[3]])),
            "want labels below 3, got 3",
        ),
        (
            lambda: make().features({}, torch.zeros(1, 3, 16, 16)),
            r"want images of shape \[n, 3, 32, 32\], got \[",
        ),
    ],
)
def test_what_cannot_be_is_refused(act, message):
    with pytest.raises(ValueError, match=message):
        act()


def test_images_without_rows_for_boxes_have_no_class():
    targets = make().assign(torch.zeros(2, 0, 4), torch.zeros(2, 0, dtype=torch.long))
    assert targets.labels.tolist() == [[IGNORED], [IGNORED]] and targets.deltas.shape == (2, 1, 4)


def test_a_model_file_and_onnx_give_the_same(tools, generator, tmp_path):
    make = functools.partial(tools.configured("classifier"), backbone=Backbone("micro"))
    saved, difference = tools.check_model_files(make, ("can", "mug", "bowl"), tmp_path, generator)
    assert saved.detector.score == "accuracy" and difference <= TOLERANCE
    export(saved, tmp_path / "detections.onnx", nms=True)
