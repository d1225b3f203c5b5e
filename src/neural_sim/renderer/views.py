"""Posed views of an object, by whichever mesh renderer this machine can run."""

from __future__ import annotations

import functools
import logging
import os
import subprocess
import sys
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.objects.mesh import ObjectMesh
from neural_sim.renderer.base import MeshRenderer
from neural_sim.renderer.lighting import Lighting
from neural_sim.renderer.raycast import RaycastRenderer
from neural_sim.renderer.rig import LightRig
from neural_sim.types import PinholeCamera, PosedViews

log = logging.getLogger(__name__)

PROBE_SECONDS = 60
# Draws one triangle: a context can be made and still fail at the first shader.
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
    backend: Literal["auto", "pyrender", "raycast"] = "auto",
    supersample: int = 2,
    lighting: Lighting | None = None,
) -> MeshRenderer:
    """``auto``: pyrender over EGL, else over OSMesa, else ray casting, which the log then says.

    Raises ``ValueError`` for an unknown backend, ``RuntimeError`` where ``pyrender`` is demanded and no OpenGL answers.
    """
    if backend not in ("auto", "pyrender", "raycast"):
        raise ValueError(f"renderer.backend: want auto, pyrender or raycast, got {backend!r}")
    if backend == "raycast":
        return RaycastRenderer(supersample, lighting)
    platform = opengl_platform()
    if platform is None:
        if backend == "pyrender":
            raise RuntimeError(
                "renderer.backend=pyrender: neither EGL nor OSMesa could draw; use auto or raycast"
            )
        log.warning("No OpenGL (EGL, OSMesa) on this machine: meshes are drawn by ray casting, more slowly")
        return RaycastRenderer(supersample, lighting)
    # PyOpenGL picks its platform when it is first imported, so the variable comes before the import.
    os.environ["PYOPENGL_PLATFORM"] = platform
    from neural_sim.renderer.mesh import PyrenderRenderer

    log.info("Meshes are drawn by pyrender over %s", platform)
    return PyrenderRenderer(supersample, lighting)


@functools.cache
def opengl_platform() -> str | None:
    """``egl`` or ``osmesa``, the first that draws a triangle in a process of its own; None if neither does.

    Trying in this process is no choice: PyOpenGL keeps the first platform, and a broken driver may abort. A
    PYOPENGL_PLATFORM set by the user is the only one tried.
    """
    wanted = os.environ.get("PYOPENGL_PLATFORM")
    for platform in (wanted,) if wanted else ("egl", "osmesa"):
        environment = {**os.environ, "PYOPENGL_PLATFORM": platform}
        try:
            run = subprocess.run(
                [sys.executable, "-c", PROBE], env=environment, capture_output=True, timeout=PROBE_SECONDS
            )
        except subprocess.TimeoutExpired:
            log.info("OpenGL over %s: no answer within %d s", platform, PROBE_SECONDS)
            continue
        if run.returncode == 0:
            return platform
        reason = run.stderr.decode(errors="replace").strip().splitlines()
        log.info("OpenGL over %s failed: %s", platform, reason[-1] if reason else f"exit {run.returncode}")
    return None


def render_views(
    renderer: MeshRenderer,
    item: ObjectMesh,
    camera: PinholeCamera,
    camera_to_world: Float[Tensor, "views 4 4"],
    rig: LightRig | None = None,
    weights: Float[Tensor, "views k"] | None = None,
) -> PosedViews:
    """Views of a normalised object with their cameras (OpenGL axes, object radii).

    With a ``rig`` each view is lit by the anchors at its ``weights``; views that share weights are rendered together.
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
