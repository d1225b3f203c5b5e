"""A bilevel problem whose inner minimiser has a closed form for every psi."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from neural_sim import cameras
from neural_sim.gradient.base import Losses, ObjectImages, RenderedPath
from neural_sim.gradient.hypergradient import InnerProblem
from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.types import Maps, PinholeCamera, Rays, SceneDraw

DOUBLE = torch.float64
CAMERA = PinholeCamera(width=3, height=2, field_of_view=math.radians(40.0))
RIDGE = 0.3


def render_rays(rays: Rays):
    """A smooth stand-in for a field: colour and opacity are waves of where the ray starts and goes."""
    where = rays.origins + 2.0 * rays.directions
    opacity = torch.sigmoid(where.sum(-1))
    rgb = opacity[:, None] * (0.5 + 0.5 * torch.sin(2.0 * where + rays.directions.roll(1, -1)))
    return rgb, opacity


def render(draw: SceneDraw):
    bundle = cameras.rays(CAMERA, cameras.orbit(draw.phi, draw.rho, draw.distance))
    flat = Rays(bundle.origins.reshape(-1, 3), bundle.directions.reshape(-1, 3))
    rgb, opacity = render_rays(flat)
    return rgb.view(len(draw), 2, 3, 3), opacity.view(len(draw), 2, 3)


def tangents(draw: SceneDraw, names=("phi", "rho", "distance")):
    """Derivatives of the maps by each named number, by generic forward mode through everything."""

    def maps(number, name):
        return render(dataclasses.replace(draw, **{name: number}))

    found = {}
    for name in names:
        number = getattr(draw, name)
        _, rates = torch.func.jvp(lambda x, n=name: maps(x, n), (number,), (torch.ones_like(number),))
        found[name] = Maps(*rates)
    return found


class Bilevel:
    """Ridge regression on rendered pixels: the inner minimiser has a closed form for every psi."""

    def __init__(self, images: int = 7, bins: int = 4, seed: int = 0) -> None:
        generator = torch.Generator().manual_seed(seed)

        def draw(*shape: int):
            return torch.randn(*shape, generator=generator, dtype=DOUBLE)

        self.gumbel, self.within, self.other = draw(images, bins), draw(images), draw(images)
        self.background, self.targets = draw(images, 3, 2, 3).sigmoid(), draw(images, 2)
        self.val_images, self.val_targets = draw(5, 18), draw(5, 2)
        self.psi = draw(bins)
        self.centres = torch.arange(bins, dtype=DOUBLE) * (2 * math.pi / bins)

    def relaxed(self, psi):
        weights = torch.softmax((self.gumbel + torch.log_softmax(psi, -1)) / 0.7, -1)
        phi = weights @ self.centres + 0.2 * self.within
        return SceneDraw(phi, self.other * 0.3, 3.0 + 0.1 * torch.sin(phi), weights.argmax(-1))

    def compose(self, rgb, opacity):
        return rgb.permute(0, 3, 1, 2) + (1.0 - opacity[:, None]) * self.background

    def images(self, psi):
        return self.compose(*render(self.relaxed(psi)))

    def loss_of(self, params, images, index):
        residual = images.flatten(1) @ params["w"] + params["b"] - self.targets[index]
        return 0.5 * residual.square().sum(-1)

    def minimiser(self, psi):
        design = torch.cat([self.images(psi).flatten(1), torch.ones(len(self.gumbel), 1, dtype=DOUBLE)], 1)
        gram = design.T @ design / len(design) + RIDGE * torch.eye(19, dtype=DOUBLE)
        solved = torch.linalg.solve(gram, design.T @ self.targets / len(design))
        return {"w": solved[:-1], "b": solved[-1]}

    def validation(self, params):
        return torch.tanh(self.val_images @ params["w"] + params["b"] - self.val_targets).square().sum()

    def object_images(self):
        with torch.no_grad():
            draw = self.relaxed(self.psi)
            rgb, opacity = render(draw)
            images = self.compose(rgb, opacity)
        count = len(draw)
        path = RenderedPath(self.relaxed, render_rays, self.compose, CAMERA, rgb, opacity)
        weights = torch.full((count,), 1.0 / count, dtype=DOUBLE)
        return ObjectImages(
            self.psi, lambda psi: torch.log_softmax(psi, -1), images, torch.arange(count), weights, draw, path
        )

    def inner(self, images):
        params = self.minimiser(self.psi)
        weights = torch.full((len(images),), 1.0 / len(images), dtype=DOUBLE)
        anchor = {name: torch.zeros_like(tensor) for name, tensor in params.items()}
        return InnerProblem(
            params, lambda p, rows: self.loss_of(p, images[rows], rows), weights, 3, RIDGE, anchor
        )

    def central_difference(self, step: float = 1e-5):
        def outer(psi):
            return self.validation(self.minimiser(psi))

        basis = step * torch.eye(len(self.psi), dtype=DOUBLE)
        return torch.stack([(outer(self.psi + e) - outer(self.psi - e)) / (2 * step) for e in basis])


@pytest.fixture
def pathwise():
    """The pathwise estimate of one object's images from the losses of images."""

    def estimate(loss_of, params, vector, batch, **settings):
        losses = Losses(lambda p, rows: loss_of(p, batch.images[rows], rows), loss_of)
        return PathwiseEstimator(**settings).estimate(losses, params, vector, batch, None)

    return estimate


@pytest.fixture
def stand_in_tangents():
    return tangents


@pytest.fixture
def problem() -> Bilevel:
    return Bilevel()
