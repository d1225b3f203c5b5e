"""A scene whose objects are rendered as meshes, or as any other subject, in the place of their fields."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.cameras import cameras_of, orbit
from neural_sim.parameter.product import SceneNoise
from neural_sim.renderer.subject import Subject
from neural_sim.synthesis.assembly import RenderedObject
from neural_sim.synthesis.draws import HARD, Draws, RelaxedDraws
from neural_sim.synthesis.scene import Scene
from neural_sim.types import SceneDraw


@dataclass(frozen=True)
class SubjectScene(Scene):
    """A :class:`Scene` that renders ``subjects``, one for each name, from the same random numbers.

    Equal generators give equal poses, distances, backgrounds and places in the image.

    Raises:
        ValueError: another number of subjects than of objects; when it draws, relaxed draws or a light that moves.
    """

    subjects: tuple[Subject, ...] = ()

    def __post_init__(self) -> None:
        if len(self.subjects) != len(self.names):
            raise ValueError(f"SubjectScene: want {len(self.names)} subjects, got {len(self.subjects)}")

    @staticmethod
    def of(scene: Scene, subjects: tuple[Subject, ...]) -> SubjectScene:
        return SubjectScene(**{f.name: getattr(scene, f.name) for f in fields(Scene)}, subjects=subjects)

    @torch.no_grad()
    def render(self, label: int, draw: SceneDraw, noise: SceneNoise | None = None) -> RenderedObject:
        if draw.weights is not None:
            raise ValueError("SubjectScene: want one fixed light, got weights of lights")
        draw = self._sized(label, draw)
        poses = orbit(draw.phi, draw.rho, draw.distance, radius=draw.radius)
        taken = cameras_of(self.camera, draw.magnification)
        rgba = torch.cat([self.subjects[label].render(camera, poses[rows]) for camera, rows in taken])
        rgba = rgba.to(self.device(label), self.dtype(label))
        return RenderedObject(draw, rgba[..., :3] * rgba[..., 3:], rgba[..., 3], noise)

    def drawn(
        self, label: int, psi: Float[Tensor, "K"], count: int, generator: torch.Generator, how: Draws = HARD
    ) -> RenderedObject:
        if isinstance(how, RelaxedDraws):
            raise ValueError("SubjectScene: want hard draws, a mesh is not differentiated by psi")
        return super().drawn(label, psi, count, generator, how)
