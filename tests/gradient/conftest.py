"""A bilevel problem whose inner minimiser has a closed form for every psi."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from neural_sim import cameras
from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Head
from neural_sim.field.grid import GridField
from neural_sim.gradient.base import Losses, ObjectImages, RenderedPath
from neural_sim.gradient.implicit import InnerProblem
from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.solver.operator import flatten, unflatten
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.motion import pose_rates
from neural_sim.synthesis.synthesizer import Synthesizer
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
        self.psi, self.distribution = draw(bins), SceneDistribution.of([Pose(bins=bins)])
        self.centres = torch.arange(bins, dtype=DOUBLE) * (2 * math.pi / bins)

    def relaxed(self, psi):
        weights = torch.softmax((self.gumbel + torch.log_softmax(psi, -1)) / 0.7, -1)
        phi = weights @ self.centres + 0.2 * self.within
        return SceneDraw(phi, self.other * 0.3, 3.0 + 0.1 * torch.sin(phi), weights.argmax(-1)[:, None])

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
        return ObjectImages(self.psi, self.distribution, images, torch.arange(count), weights, draw, path)

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
        return PathwiseEstimator(**settings).estimate(losses, params, vector, batch, {})

    return estimate


@pytest.fixture
def stand_in_tangents():
    return tangents


@pytest.fixture
def problem() -> Bilevel:
    return Bilevel()


COUNT = 4
PIPELINE_CAMERA = PinholeCamera(width=32, height=32, field_of_view=math.radians(40.0))


class Pipeline:
    """Four images of one textured block, their detector, and everything between psi and their losses."""

    camera = PIPELINE_CAMERA

    def __init__(self) -> None:
        generator = torch.Generator().manual_seed(5)
        self.field = GridField().double().eval()
        self.field.reset(torch.ones(4, 4, 4, dtype=torch.bool), torch.full((3,), -0.6, dtype=DOUBLE), 0.3)
        with torch.no_grad():
            self.field.table.copy_(
                torch.randn(self.field.table.shape, generator=generator, dtype=DOUBLE) + 1.0
            )
        self.field.requires_grad_(False)
        self.distribution = SceneDistribution.of([Pose(bins=4, temperature=0.8)])
        self.psi = torch.randn(4, generator=generator, dtype=DOUBLE)
        self.noise = self.distribution.draw_noise(COUNT, generator, DOUBLE)
        self.synthesizer = Synthesizer(ProceduralClutter(), shift=0.1)
        self.nuisance = self.synthesizer.draw_nuisance(COUNT, PIPELINE_CAMERA, generator)
        self.detector = RetinaNet(2, 32, anchors=Anchors(sizes=((10,), (18,))), head=Head(8, 1))
        params = {name: value.double() for name, value in self.detector.init(generator).items()}
        self.backbone, self.trainable = self.detector.split(params)
        flat = flatten(self.trainable)
        noise = torch.randn(2, flat.numel(), generator=generator, dtype=DOUBLE)
        self.trainable = unflatten(flat + 0.05 * noise[0], self.trainable)
        self.vector = unflatten(noise[1], self.trainable)
        labelled = self.compose(*self.render(self.psi))
        self.images, self.targets = labelled.images, self.detector.assign(labelled.boxes, labelled.labels)
        self.features = self.detector.features(self.backbone, self.images)

    def render_rays(self, rays: Rays):
        return NerfRenderer(termination=0.0).render_rays(self.field, rays)

    def render(self, psi):
        draw = self.distribution.relaxed(psi, self.noise)
        bundle = cameras.rays(PIPELINE_CAMERA, cameras.orbit(draw.phi, draw.rho, draw.distance))
        rgb, opacity = self.render_rays(Rays(bundle.origins.reshape(-1, 3), bundle.directions.reshape(-1, 3)))
        return rgb.view(COUNT, 32, 32, 3), opacity.view(COUNT, 32, 32)

    def tangents(self, draw, names):
        poses, rates = cameras.orbit(draw.phi, draw.rho, draw.distance), pose_rates(draw, names)
        _, moved = NerfRenderer(termination=0.0).render_with_tangents(
            self.field, PIPELINE_CAMERA, poses, rates
        )
        return dict(zip(names, moved, strict=True))

    def compose(self, rgb, opacity):
        return self.synthesizer.compose(rgb, opacity, self.nuisance, 1, torch.zeros(COUNT, dtype=torch.long))

    def loss_of(self, params, images, index):
        features = self.detector.features(self.backbone, images)
        return self.detector.per_image_loss(params, features, self.targets.select(index))

    def losses(self, params, index):
        features = [level[index] for level in self.features]
        return self.detector.per_image_loss(params, features, self.targets.select(index))

    def object_images(self) -> ObjectImages:
        with torch.no_grad():
            draw = self.distribution.relaxed(self.psi, self.noise)
            rgb, opacity = self.render(self.psi)
        path = RenderedPath(
            relaxed=lambda psi: self.distribution.relaxed(psi, self.noise),
            render_rays=self.render_rays,
            compose=lambda rgb, opacity: self.compose(rgb, opacity).images,
            camera=PIPELINE_CAMERA,
            rgb=rgb,
            opacity=opacity,
        )
        weights = torch.full((COUNT,), 1.0 / COUNT, dtype=DOUBLE)
        return ObjectImages(
            self.psi, self.distribution, self.images, torch.arange(COUNT), weights, draw, path
        )


@pytest.fixture(scope="module")
def pipeline() -> Pipeline:
    return Pipeline()
