"""The interface of a radiance field: densities and colours at points, and the distances to sample along rays."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from jaxtyping import Float
from torch import Tensor, nn

from neural_sim.field.extinction import Surface
from neural_sim.field.quadrature import PackedSamples, Span, composite, sample_points, transmittance
from neural_sim.types import PinholeCamera, Rays


class RadianceField(nn.Module, ABC):
    """Density and colour in the object's frame, where the object lies in the unit sphere around the origin."""

    directed: bool = True
    """Whether colour may depend on the viewing direction."""
    light_rates: int = 0
    """Number of derivatives of colour alone that ``query_with_tangents`` adds to the requested ones."""

    @abstractmethod
    def query(
        self, positions: Float[Tensor, "samples 3"], directions: Float[Tensor, "samples 3"]
    ) -> tuple[Float[Tensor, "samples"], Float[Tensor, "samples 3"]]:
        """Return density ``sigma`` (per object radius, at least 0) and colour in [0, 1].

        ``directions`` are unit vectors that point away from the camera. The result is differentiable in both arguments,
        in forward and reverse mode.
        """

    def query_with_tangents(
        self,
        positions: Float[Tensor, "samples 3"],
        directions: Float[Tensor, "samples 3"],
        velocities: Float[Tensor, "m samples 3"],
        turns: Float[Tensor, "m samples 3"],
    ) -> tuple[
        Float[Tensor, "samples"],
        Float[Tensor, "samples 3"],
        Float[Tensor, "m samples"],
        Float[Tensor, "m samples 3"],
    ]:
        """Return ``query`` and its m >= 1 derivatives for positions moving at ``velocities``, directions at ``turns``.

        Under a changing light, colour has ``light_rates`` more derivatives than density; they come last.

        The base class uses Jacobian-vector products; a field that knows its own derivative overrides this.
        """
        values, rates = [], []
        for velocity, turn in zip(velocities, turns, strict=True):
            value, rate = torch.func.jvp(self.query, (positions, directions), (velocity, turn))[:2]
            values.append(value)
            rates.append(rate)
        sigma_rates, rgb_rates = (torch.stack(parts) for parts in zip(*rates, strict=True))
        return *values[0], sigma_rates, rgb_rates

    @abstractmethod
    def sample(self, rays: Rays, termination: float) -> PackedSamples:
        """Return the distances at which to ``query`` the field along rays of shape (rays, 3).

        They are deterministic (the same rays always give the same distances) and detached. Samples whose
        transmittance is below ``termination`` may be skipped; at 0, none are.
        """

    def with_step(self, multiple: float) -> RadianceField:
        """Return this field, with shared tensors, sampled at ``multiple`` times its step; itself if it has no step."""
        return self

    @torch.no_grad()
    def trace(
        self,
        rays: Rays,
        termination: float,
        span: Span | None = None,
        skip_empty: bool = True,
        surface: Surface | None = None,
    ) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"]]:
        """Compute premultiplied colour and opacity of rays (rays, 3) by quadrature on the samples of ``sample``.

        It is not differentiable. ``span`` is what the method ``span`` returned for these rays; with ``skip_empty``,
        space known to be empty is skipped. Neither changes a pixel, and fields that do not track empty space ignore
        both. ``surface``, if given, records where the rays lose half of their light.
        """
        samples = self.sample(rays, termination)
        sigma, rgb = self.query(*sample_points(rays, samples))
        if surface is not None:
            before = -transmittance(sigma, samples).log()
            surface.enter(samples.ray, samples.distance, samples.width, before, sigma * samples.width)
        return composite(sigma, rgb, samples)

    @property
    def reach(self) -> float:
        """Radius around the origin, in object radii, beyond which there is no density."""
        return 1.0

    def span(self, camera: PinholeCamera, camera_to_world: Float[Tensor, "4 4"], rows: range) -> Span | None:
        """Return distances between which rays of an image's ``rows`` may meet anything; None if nothing is known."""
        return None

    @abstractmethod
    def settings(self) -> dict[str, object]:
        """Return the constructor's arguments, for ``field_state``."""
