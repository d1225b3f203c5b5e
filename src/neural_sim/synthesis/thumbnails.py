"""Small pictures of an object in every bin of a factor, for pages that refer to bins."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.alpha import over_white
from neural_sim.parameter.factor import COORDINATES
from neural_sim.parameter.product import SceneDistribution, SceneNoise
from neural_sim.synthesis.subjects import RenderedSubject
from neural_sim.types import PinholeCamera


def bin_thumbnails(
    item: RenderedSubject, distribution: SceneDistribution, factor: str, camera: PinholeCamera
) -> Float[Tensor, "bins h w 3"]:
    """Render an object over white from the middle of every bin of one factor.

    All other coordinates are in the middle of their range, or of their middle bin; lights have equal weights.
    """
    learned = {f.coordinate for f in distribution.binned}
    count = next(f.bins for f in distribution.binned if f.name == factor)
    middle = torch.full((count,), 0.5, dtype=item.dtype)
    drawn = [c for c in COORDINATES if c != "magnification" or c in learned]
    bins = {
        f.name: torch.arange(count) if f.name == factor else torch.full((count,), f.bins // 2)
        for f in distribution.binned
    }
    draw = distribution.at_bins(bins, SceneNoise({}, dict.fromkeys(drawn, middle)))
    rendered = item.render(camera, distribution, distribution.lit(draw, distribution.uniform.to(item.dtype)))
    rgba = torch.cat([rendered.rgb, rendered.opacity[..., None]], -1)
    return over_white(rgba).clamp(0.0, 1.0).cpu()
