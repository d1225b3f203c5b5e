"""Compare synthesised images with a target's: size, position, number, light and sharpness; propose settings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.stats import mannwhitneyu
from torch import Tensor

from neural_sim.synthesis.sensor import SensorDraw, seen_by
from neural_sim.types import LabelledImages

LEVEL = 0.01
"""Family-wise level over all statistics."""
LARGE = 0.2
"""Smallest distance of ``Mismatch.larger`` from one half at which a significant difference counts."""
_LUMA = (0.299, 0.587, 0.114)  # ITU-R BT.601
_BLURS = 25


@dataclass(frozen=True)
class Mismatch:
    """One statistic of the target's images and of the synthesised images, as medians.

    ``larger`` is the probability that a random target image (or box) has a larger value than a random synthesised one
    (the Mann-Whitney statistic over its largest value); it is 0.5 if they do not differ. ``p_value`` tests for
    equality.
    """

    name: str
    target: float
    synthesised: float
    larger: float
    p_value: float
    tests: int

    @property
    def counts(self) -> bool:
        """Whether the difference is significant at the family-wise level (Bonferroni) and large."""
        return self.p_value * self.tests <= LEVEL and abs(self.larger - 0.5) >= LARGE


def statistics(images: LabelledImages) -> dict[str, Float[Tensor, "_"]]:
    """Return the compared statistics: a value for each image, or for each box if the name says so.

    Sizes and offsets are fractions of the image's size (of the root of its area, and of half its diagonal); brightness,
    contrast, noise and sharpness are of luma, saturation is of the sRGB channels; luma and channels are in [0, 1].
    """
    height, width = images.images.shape[-2:]
    present = images.present
    boxes = images.boxes[present]
    sides = boxes[:, 2:] - boxes[:, :2]
    offset = 0.5 * (boxes[:, 2:] + boxes[:, :2]) - boxes.new_tensor([width / 2, height / 2])
    luma = luma_of(images.images)
    return {
        "box size": sides.prod(-1).sqrt() / math.sqrt(width * height),
        "box aspect": sides[:, 0] / sides[:, 1].clamp_min(1e-6),
        "box offset": offset.norm(dim=-1) / (0.5 * math.hypot(width, height)),
        "objects": present.sum(-1).double(),
        "brightness": luma.mean((-2, -1)),
        "contrast": luma.std((-2, -1)),
        "saturation": (images.images.amax(1) - images.images.amin(1)).mean((-2, -1)),
        "sharpness": sharpness(luma),
        "noise": noise(luma),
    }


def mismatches(target: LabelledImages, synthesised: LabelledImages) -> list[Mismatch]:
    """Compare every statistic for which both sets have values."""
    others = statistics(synthesised)
    pairs = [(name, mine, others[name]) for name, mine in statistics(target).items()]
    pairs = [(name, mine, other) for name, mine, other in pairs if len(mine) and len(other)]
    found = []
    for name, mine, other in pairs:
        test = mannwhitneyu(mine.double().numpy(), other.double().numpy())
        larger = float(test.statistic) / (len(mine) * len(other))
        found.append(
            Mismatch(
                name, float(mine.median()), float(other.median()), larger, float(test.pvalue), len(pairs)
            )
        )
    return found


def luma_of(images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n h w"]:
    """Compute the weighted sum of the sRGB channels."""
    return torch.einsum("nchw,c->nhw", images, images.new_tensor(_LUMA))


def noise(luma: Float[Tensor, "n h w"]) -> Float[Tensor, "n"]:
    """Estimate the standard deviation of white noise by Immerkaer's difference of two Laplacians.

    It does not respond to edges that are straight over three pixels (Fast Noise Variance Estimation, 1996). The median
    replaces the mean, so that texture counts less; for Gaussian noise |x| has the median 0.6745 sigma, and the mask has
    the norm 6.
    """
    mask = luma.new_tensor([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]])
    filtered = torch.nn.functional.conv2d(luma[:, None], mask[None, None])
    return filtered.abs().flatten(1).median(1).values / (0.6745 * 6.0)


def sharpness(luma: Float[Tensor, "n h w"]) -> Float[Tensor, "n"]:
    """Compute the mean gradient between neighbouring pixels over the steepest hundredth, which are edges."""
    steps = torch.stack([luma[:, 1:, :-1] - luma[:, :-1, :-1], luma[:, :-1, 1:] - luma[:, :-1, :-1]]).norm(
        dim=0
    )
    flat = steps.flatten(1)
    count = max(1, flat.shape[1] // 100)
    return flat.topk(count, dim=1).values.mean(1)


def matching_settings(
    target: LabelledImages, synthesised: LabelledImages, found: list[Mismatch], largest_blur: float = 3.0
) -> dict[str, str]:
    """Return settings of ``synthesis`` that would remove the differences, by key, where their effect is known."""
    differs = {m.name: m for m in found if m.counts}
    settings: dict[str, str] = {}
    mine, other = statistics(target), statistics(synthesised)
    level = 0.0
    if "noise" in differs and differs["noise"].larger > 0.5:
        own = other["noise"].median().square()
        # Noise in independent channels: that of luma divided by the norm of its weights.
        scale = math.hypot(*_LUMA)
        low, high = (
            float((mine["noise"].quantile(q).square() - own).clamp_min(0).sqrt() / scale) for q in (0.1, 0.9)
        )
        level = 0.5 * (low + high)
        settings["synthesis.sensor.noise"] = f"[{low:.2g},{high:.2g}]"
    if "sharpness" in differs and differs["sharpness"].larger < 0.5:
        # A single blur instead of a range, because the sharpness of images also varies with what they show.
        blur = _blur_to(mine["sharpness"].median(), synthesised, largest_blur, level)
        settings["synthesis.sensor.blur"] = f"[{blur:.2g},{blur:.2g}]"
    if "objects" in differs:
        # Synthesised images show each class once at most.
        most = max(1, 1 + int(max(images.labels.max() for images in (target, synthesised))))
        low, high = (min(int(mine["objects"].quantile(q)), most) for q in (0.05, 0.95))
        settings["synthesis.objects_per_image"] = f"[{low},{max(high, 1)}]"
    return settings


def distance_factor(found: list[Mismatch]) -> float | None:
    """Return the factor on the camera's distances that would give boxes the target's size; None if sizes agree.

    Sizes are inversely proportional to distance for objects that are small compared with it.
    """
    size: Mapping[str, Mismatch] = {m.name: m for m in found}
    if "box size" not in size or not size["box size"].counts:
        return None
    return size["box size"].synthesised / size["box size"].target


def _blur_to(wanted: Tensor, synthesised: LabelledImages, largest: float, level: float) -> float:
    """Find the blur, on a grid up to ``largest``, at which the synthesised images' median sharpness is ``wanted``.

    Noise of the standard deviation ``level`` is added after each blur, because it adds to the differences between
    pixels in the target as well.
    """
    deviations, images = torch.linspace(0.0, largest, _BLURS), synthesised.images
    grain = level * torch.randn(images.shape, generator=torch.Generator().manual_seed(0)).to(images)
    reached = []
    for deviation in deviations:
        seen = SensorDraw(deviation.expand(len(images)), grain)
        reached.append(float(sharpness(luma_of(seen_by(images, seen))).median()))
    nearest = (torch.tensor(reached) - float(wanted)).abs().argmin()
    return float(deviations[nearest])
