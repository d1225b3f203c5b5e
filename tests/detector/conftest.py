"""A detector small enough for dense float64 checks, and a few labelled images."""

from pathlib import Path

import pytest
import torch
from composing import composed
from hydra.utils import instantiate

from neural_sim.detector.cached_set import CachedSet
from neural_sim.detector.onnx_export import export, largest_difference
from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.saved_detector import SavedDetector
from neural_sim.detector.settings import Anchors, Backbone, Head, Losses
from neural_sim.solver.operator import flatten, unflatten
from neural_sim.types import LabelledImages

CLASSES = 3
SIZE = 32


def make_detector(backbone=(), head=(), anchors=(), losses=(), **others) -> RetinaNet:
    parts = {
        "backbone": Backbone(**dict(backbone)),
        "head": Head(**{"channels": 8, "convs": 1, **dict(head)}),
        "anchors": Anchors(**{"sizes": ((8, 12), (16, 24)), "reference": SIZE, **dict(anchors)}),
        "losses": Losses(**dict(losses)),
    }
    return RetinaNet(**{"num_classes": CLASSES, "image_size": SIZE, **parts, **others})


def make_images(n: int = 4, seed: int = 0, dtype: torch.dtype = torch.float64) -> LabelledImages:
    """Noise with up to two boxes an image; the last image has none."""
    generator = torch.Generator().manual_seed(seed)
    images = torch.rand(n, 3, SIZE, SIZE, generator=generator, dtype=dtype)
    corner = torch.rand(n, 2, 2, generator=generator, dtype=dtype) * 14
    side = 6 + torch.rand(n, 2, 2, generator=generator, dtype=dtype) * 12
    labels = torch.randint(0, CLASSES, (n, 2), generator=generator)
    labels[0, 1] = -1
    if n > 1:
        labels[-1] = -1
    boxes = torch.where((labels >= 0)[..., None], torch.cat([corner, corner + side], dim=-1), 0.0)
    return LabelledImages(images, boxes, labels, torch.full((n,), -1))


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(7)


@pytest.fixture
def images() -> LabelledImages:
    return make_images()


def as_double(params: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name: value.double() for name, value in params.items()}


def noisy(params: dict[str, torch.Tensor], generator: torch.Generator) -> dict[str, torch.Tensor]:
    """Float64 parameters away from the symmetric start, so that scores and boxes differ."""
    return {
        name: value.double() + 0.1 * torch.randn(value.shape, generator=generator, dtype=torch.float64)
        for name, value in params.items()
    }


@torch.no_grad()
def mean_loss(detector: RetinaNet, params: dict[str, torch.Tensor], images: LabelledImages) -> float:
    backbone, trainable = detector.split(params)
    targets = detector.assign(images.boxes, images.labels)
    return float(
        detector.per_image_loss(trainable, detector.features(backbone, images.images), targets).mean()
    )


def check_hessian(detector, images: LabelledImages, generator, step: float, rtol: float) -> None:
    """Compare the loss's Hessian product with central differences of gradients, and its jvp with the gradient."""
    backbone, trainable = detector.split(noisy(detector.init(generator), generator))
    cached, rows = CachedSet.of(detector, backbone, images), torch.arange(len(images))

    def slope(theta, create_graph=False):
        point = theta if theta.requires_grad else theta.detach().requires_grad_()
        loss = cached.losses(unflatten(point, trainable), rows).mean()
        return torch.autograd.grad(loss, point, create_graph=create_graph)[0]

    theta = flatten(trainable).requires_grad_()
    along = torch.randn(theta.shape, generator=generator, dtype=theta.dtype)
    (product,) = torch.autograd.grad(slope(theta, create_graph=True), theta, along)
    difference = [(slope(theta + h * along) - slope(theta - h * along)) / (2 * h) for h in (2 * step, step)]
    extrapolated = (4 * difference[1] - difference[0]) / 3
    assert float((product - extrapolated).norm()) < rtol * float(product.norm())
    jvp = torch.func.jvp(lambda p: cached.losses(p, rows), (trainable,), (unflatten(along, trainable),))[1]
    assert float(jvp.mean()) == pytest.approx(float(slope(theta) @ along), rel=1e-10)


def check_model_files(make, names, folder: Path, generator) -> tuple[SavedDetector, float]:
    """Compare detections after a round trip through files, to the bit; return what was read, and ONNX's difference."""
    detector = make(num_classes=len(names), image_size=(48, 64))
    params = {
        name: value + 0.2 * torch.randn(value.shape, generator=generator)
        for name, value in detector.init(generator).items()
    }
    saved = SavedDetector(make, params, names, (48, 64))
    again = SavedDetector.load(saved.save(folder))
    images = torch.rand(4, 3, 48, 64, generator=generator)
    found = (
        each.predict(held, images) for each, held in ((detector, params), (again.detector, again.params))
    )
    for ours, theirs in zip(*found, strict=True):
        assert len(ours["scores"]) and all(torch.equal(ours[key], theirs[key]) for key in ours)
    pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    return again, largest_difference(saved, export(saved, folder / "model.onnx"), images)


def configured(name: str):
    """A choice of ``detector=...``, still without classes and image size."""
    return instantiate(composed(f"detector={name}").detector)


@pytest.fixture
def tools():
    """The helpers above; with importlib mode tests cannot import their conftest."""

    class Tools:
        detector = staticmethod(make_detector)
        configured = staticmethod(configured)
        images = staticmethod(make_images)
        double = staticmethod(as_double)
        noisy = staticmethod(noisy)
        mean_loss = staticmethod(mean_loss)
        check_hessian = staticmethod(check_hessian)
        check_model_files = staticmethod(check_model_files)

    return Tools
