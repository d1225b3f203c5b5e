"""Transients: occluders in front of the object in single photographs (NeRF in the Wild, Martin-Brualla et al. 2021)."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from neural_sim.field.quadrature import PackedSamples, composite, render_weights, sum_rays
from neural_sim.field.scores import Rendering, expected_errors

FREQUENCIES = 5
SMALLEST_BETA = 0.03  # as in NeRF in the Wild


class TransientHead(nn.Module):
    """Predicts density, colour and uncertainty of what only one view shows, from a position and the view's code.

    It is used in fitting and dropped afterwards; ``codes`` has 16 numbers per view, as in NeRF in the Wild.
    """

    def __init__(
        self, views: int, code_size: int = 16, width: int = 32, initial_density: float = -4.0
    ) -> None:
        super().__init__()
        self.codes = nn.Parameter(torch.zeros(views, code_size))
        self.place = nn.Linear(3 + 6 * FREQUENCIES, width)
        self.code = nn.Linear(code_size, width, bias=False)
        self.deep = nn.Linear(width, width)
        self.out = nn.Linear(width, 5)
        self.initial_density = initial_density

    def reset(self, generator: torch.Generator) -> None:
        """Draw new codes at random, because equal codes would stay equal under equal gradients."""
        drawn = torch.randn(self.codes.shape, generator=generator, device=generator.device)
        with torch.no_grad():
            self.codes.copy_(drawn)

    def forward(
        self, positions: Float[Tensor, "samples 3"], view: Int[Tensor, "samples"], step: float
    ) -> tuple[Float[Tensor, "samples"], Float[Tensor, "samples 3"], Float[Tensor, "samples"]]:
        """Return density (per object radius; of order 1 / ``step`` where opaque), colour and uncertainty beta."""
        scales = torch.pi * 2.0 ** torch.arange(FREQUENCIES, device=positions.device)
        angles = (positions[:, :, None] * scales).flatten(1)
        encoded = torch.cat([positions, angles.sin(), angles.cos()], -1)
        hidden = functional.silu(self.place(encoded) + self.code(self.codes).index_select(0, view))
        raw = self.out(functional.silu(self.deep(hidden)))
        sigma = functional.softplus(raw[:, 0] + self.initial_density) / step
        return sigma, torch.sigmoid(raw[:, 1:4]), functional.softplus(raw[:, 4])


def composite_both(
    static: tuple[Float[Tensor, "samples"], Float[Tensor, "samples 3"]],
    transient: tuple[Float[Tensor, "samples"], Float[Tensor, "samples 3"], Float[Tensor, "samples"]],
    samples: PackedSamples,
) -> tuple[Rendering, Float[Tensor, "rays"]]:
    """Composite object and transients together; return the image, and each ray's beta as seen through both.

    Densities add up and colours mix by density, as for two media that emit and absorb in the same place. (NeRF in the
    Wild adds the two alphas, whose sum exceeds 1 where both are opaque.)
    """
    sigma = static[0] + transient[0]
    fraction = (transient[0] / sigma.clamp_min(torch.finfo(sigma.dtype).tiny))[:, None]
    rgb = torch.lerp(static[1], transient[1], fraction)
    weights = render_weights(sigma, samples)[:, None]
    beta = sum_rays(weights * fraction * transient[2][:, None], samples)[:, 0]
    return composite(sigma, rgb, samples), SMALLEST_BETA + beta


def uncertain_error(
    rendering: Rendering,
    pixels: Float[Tensor, "rays 4"],
    beta: Float[Tensor, "rays"],
    depths: Float[Tensor, "samples"],
    penalty: float,
) -> Float[Tensor, ""]:
    """Return |C - C^|^2 / (2 beta^2) + log(beta^2) / 2, averaged over rays, plus a penalty on transients.

    ``penalty`` multiplies the mean optical depth of the transients' samples (NeRF in the Wild, Sec. 4.2). The squared
    error is the expected one over random backgrounds.
    """
    errors = expected_errors(rendering, pixels).sum(-1)
    return (0.5 * errors / beta.square() + beta.log()).mean() + penalty * depths.mean()
