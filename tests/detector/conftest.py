"""A detector small enough for dense float64 checks, and a few labelled images."""

import pytest
import torch
from composing import composed
from hydra.utils import instantiate

from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Backbone, Head, Losses
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

    return Tools
