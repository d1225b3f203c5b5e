"""Render posed views of an object, with a mesh renderer that works on this machine."""

from __future__ import annotations

import functools
import logging
import math
import os
import subprocess
import sys
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from annotated_types import Gt, Lt
from jaxtyping import Float
from torch import Tensor

from neural_sim.cameras import orbit
from neural_sim.objects.mesh import ObjectMesh
from neural_sim.ranges import Ascending, NonNegativeInt, PositiveInt, check, validated
from neural_sim.renderer.base import MeshRenderer
from neural_sim.renderer.lighting import Lighting
from neural_sim.renderer.raycast import RaycastRenderer
from neural_sim.renderer.rig import LightRig, VariedLight
from neural_sim.types import PinholeCamera, PosedViews

_log = logging.getLogger(__name__)

Backend = Literal["auto", "pyrender", "raycast"]
"""Backend that draws meshes. auto: pyrender over EGL, else over OSMesa, else ray casting, which the log says."""

PROBE_SECONDS = 60
# The probe draws a triangle, because a context may be created and still fail at its first shader.
PROBE = """
import numpy, pyrender
scene = pyrender.Scene(bg_color=(0.0, 0.0, 0.0, 0.0))
triangle = numpy.array([[-1, -1, -2], [1, -1, -2], [0, 1, -2]], dtype=numpy.float32)
scene.add(pyrender.Mesh([pyrender.Primitive(positions=triangle)]))
scene.add(pyrender.PerspectiveCamera(yfov=1.0), pose=numpy.eye(4))
context = pyrender.OffscreenRenderer(16, 16)
colour, depth = context.render(scene, flags=pyrender.RenderFlags.FLAT | pyrender.RenderFlags.RGBA)
context.delete()
raise SystemExit(0 if depth.max() > 1.0 else 3)
"""


def choose_mesh_renderer(
    backend: Backend = "auto",
    supersample: int = 2,
    lighting: Lighting | None = None,
) -> MeshRenderer:
    """Return the renderer of a backend.

    Raises:
        ValueError: an unknown backend, or ``pyrender`` although OpenGL does not work.
    """
    check(backend, Backend, "views.backend")
    if backend == "raycast":
        return RaycastRenderer(supersample, lighting)
    platform = opengl_platform()
    if platform is None:
        if backend == "pyrender":
            tried = " or ".join(_platforms())
            raise ValueError(f"views.backend=pyrender: OpenGL cannot draw with {tried}; want auto or raycast")
        _log.warning("OpenGL does not work on this machine: meshes are drawn by ray casting, more slowly")
        return RaycastRenderer(supersample, lighting)
    # PyOpenGL chooses its platform when it is first imported, so the variable must be set before.
    os.environ["PYOPENGL_PLATFORM"] = platform
    from neural_sim.renderer.mesh import PyrenderRenderer

    _log.info("Meshes are drawn by pyrender over %s", platform)
    return PyrenderRenderer(supersample, lighting)


@functools.cache
def opengl_platform() -> str | None:
    """Return ``egl`` or ``osmesa``, the first that draws a triangle in another process; None if neither does.

    This process cannot try them itself: PyOpenGL keeps its first platform, and a broken driver may abort the process.
    If PYOPENGL_PLATFORM is set, only that platform is tried.
    """
    for platform in _platforms():
        environment = {**os.environ, "PYOPENGL_PLATFORM": platform}
        try:
            run = subprocess.run(
                [sys.executable, "-c", PROBE], env=environment, capture_output=True, timeout=PROBE_SECONDS
            )
        except subprocess.TimeoutExpired:
            _log.info("OpenGL over %s: no answer within %d s", platform, PROBE_SECONDS)
            continue
        if run.returncode == 0:
            return platform
        reason = run.stderr.decode(errors="replace").strip().splitlines()
        _log.info("OpenGL over %s failed: %s", platform, reason[-1] if reason else f"exit {run.returncode}")
    return None


def _platforms() -> tuple[str, ...]:
    wanted = os.environ.get("PYOPENGL_PLATFORM")
    return (wanted,) if wanted else ("egl", "osmesa")


def render_views(
    renderer: MeshRenderer,
    item: ObjectMesh,
    camera: PinholeCamera,
    camera_to_world: Float[Tensor, "views 4 4"],
    rig: LightRig | None = None,
    weights: Float[Tensor, "views k"] | None = None,
) -> PosedViews:
    """Render views of a normalised object, and return them with their cameras (OpenGL axes, object radii).

    With a ``rig``, each view is lit by the anchors at its ``weights``; views that share weights are rendered together.
    """
    if rig is None or weights is None:
        images = renderer.render(item.mesh, camera, camera_to_world)
        return PosedViews(images, camera_to_world, camera)
    images = torch.zeros(len(camera_to_world), camera.height, camera.width, 4)
    lights, light_of = weights.unique(dim=0, return_inverse=True)
    for number, light in enumerate(lights):
        seen = (light_of == number).nonzero()[:, 0]
        images[seen] = renderer.render(item.mesh, camera, camera_to_world[seen], rig.lighting(light))
    return PosedViews(images, camera_to_world, camera, weights)


OutsideSphere = Annotated[float, Gt(1)]
"""Distance of a camera that is outside the object's bounding sphere, in object radii."""


@validated
@dataclass(frozen=True)
class Views:
    """Posed views that train a field: uniform poses over both angles, uniform distances (paper, Secs. 4 and B.2).

    ``count`` views are used for training; ``held_out`` more, the last ones, only score the field. ``image_size`` is in
    pixels, ``distance_range`` in object radii. ``lights`` vary over the views; None: one fixed light.
    """

    count: PositiveInt = 100
    held_out: NonNegativeInt = 16
    image_size: PositiveInt = 128
    field_of_view_deg: Annotated[float, Gt(0), Lt(180)] = 40.0
    distance_range: Annotated[tuple[OutsideSphere, OutsideSphere], Ascending()] = (2.4, 4.0)
    supersample: PositiveInt = 2
    backend: Backend = "auto"
    lights: VariedLight | None = None
    seed: NonNegativeInt = 0

    def __post_init__(self) -> None:
        if self.lights is not None:
            self.lights.weights(self.count, torch.Generator())  # raises unless each anchor lights a view

    def camera(self, image_size: int) -> PinholeCamera:
        """Return the square camera of this field of view."""
        return PinholeCamera(image_size, image_size, math.radians(self.field_of_view_deg))

    @property
    def rig(self) -> LightRig | None:
        """The anchor lights; None if the light is fixed."""
        return self.lights.rig if self.lights is not None else None

    def render(self, renderer: MeshRenderer, item: ObjectMesh) -> PosedViews:
        """Render all views of one object, held-out ones last; equal seeds give all objects equal poses and lights."""
        generator, total = torch.Generator().manual_seed(self.seed), self.count + self.held_out
        uniform = torch.rand((3, total), generator=generator)
        near, far = self.distance_range
        poses = orbit(2 * torch.pi * uniform[0], 2 * torch.pi * uniform[1], near + (far - near) * uniform[2])
        rig = weights = None
        if self.lights is not None:
            rig, weights = self.lights.rig, self.lights.weights(total, generator)
        return render_views(renderer, item, self.camera(self.image_size), poses, rig, weights)
