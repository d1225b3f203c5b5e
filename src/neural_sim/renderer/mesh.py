"""Render meshes offscreen with pyrender (OpenGL), which no other module imports; ``views`` chooses the renderer."""

from __future__ import annotations

import atexit
import contextlib
from collections.abc import Iterator

import numpy as np
import pyrender
from jaxtyping import Float32, Float64
from pyrender.constants import GLTF

from neural_sim.cameras import focal_lengths, principal_point
from neural_sim.objects.paint import Texture
from neural_sim.renderer.base import MeshRenderer
from neural_sim.renderer.surface import Surface
from neural_sim.types import PinholeCamera

with contextlib.suppress(ImportError):
    # Mesa's software rasteriser loads LLVM, and triton (which torch's optimisers import) has its own. If triton is
    # loaded second, it crashes the process; if it is loaded first, both work.
    import triton  # noqa: F401

# Only what lies between these distances from the camera is drawn; objects have radius 1, and cameras stay outside them.
NEAR, FAR = 0.01, 100.0
WRAPS = {"repeat": GLTF.REPEAT, "mirror": GLTF.MIRRORED_REPEAT, "clamp": GLTF.CLAMP_TO_EDGE}


class PyrenderRenderer(MeshRenderer):
    """Renders with pyrender's unlit pass over a surface whose light is baked into its vertices.

    pyrender's own lights are physically based and scaled by pi; baking follows Lambert's law exactly. Each pixel
    averages ``supersample``^2 samples, each of which averages four OpenGL samples. One OpenGL context serves all views
    and all renderers of the process. PYOPENGL_PLATFORM must be set before this module is imported.
    """

    name = "pyrender"

    def _draw(
        self, surface: Surface, camera: PinholeCamera, poses: Float64[np.ndarray, "n 4 4"]
    ) -> Iterator[Float32[np.ndarray, "height width 4"]]:
        scene = pyrender.Scene(bg_color=(0.0, 0.0, 0.0, 0.0))
        scene.add(_primitives(surface))
        lens = pyrender.IntrinsicsCamera(
            *focal_lengths(camera), *principal_point(camera), znear=NEAR, zfar=FAR
        )
        eye = scene.add(lens, pose=np.eye(4))
        flags = pyrender.RenderFlags.FLAT | pyrender.RenderFlags.RGBA
        context = _shared_context(camera.width, camera.height)
        for pose in poses:
            scene.set_pose(eye, pose)
            # Returns colour and depth, or None with flags that are not used here.
            rendered = context.render(scene, flags=flags)[0]  # pyright: ignore[reportOptionalSubscript]
            yield np.asarray(rendered) / np.float32(255.0)


def _primitives(surface: Surface) -> pyrender.Mesh:
    """Build the faces of each texture twice: as they are, and reversed, with the light on their inner side.

    Faces seen from behind are culled, so that exactly one of the two is drawn and they never compete in depth.
    """
    sides = []
    for page in np.unique(surface.page).tolist():
        faces = surface.faces[surface.page == page]
        material = _material(None if page < 0 else surface.textures[page])
        for shade, seen in ((surface.front, faces), (surface.back, faces[:, ::-1])):
            colour = np.ones((len(shade), 4), dtype=np.float32)
            colour[:, :3] = surface.albedo * shade
            sides.append(
                pyrender.Primitive(
                    positions=surface.vertices.astype(np.float32),
                    texcoord_0=None if page < 0 else surface.uv.astype(np.float32),
                    color_0=colour,
                    indices=np.ascontiguousarray(seen, dtype=np.uint32),
                    material=material,
                    mode=GLTF.TRIANGLES,
                )
            )
    return pyrender.Mesh(primitives=sides)


def _material(texture: Texture | None) -> pyrender.MetallicRoughnessMaterial:
    image = None
    if texture is not None:
        u, v = (WRAPS[wrap] for wrap in texture.wrap)
        image = pyrender.Texture(
            source=texture.pixels, source_channels="RGB", sampler=pyrender.Sampler(wrapS=u, wrapT=v)
        )
    return pyrender.MetallicRoughnessMaterial(
        baseColorFactor=(1.0, 1.0, 1.0, 1.0), baseColorTexture=image, alphaMode="OPAQUE", doubleSided=False
    )


# One context per process: freeing one of two EGL contexts closes the display that they share, and so the other one.
_context: pyrender.OffscreenRenderer | None = None


def _shared_context(width: int, height: int) -> pyrender.OffscreenRenderer:
    global _context
    if _context is None:
        _context = pyrender.OffscreenRenderer(width, height)
    _context.viewport_width, _context.viewport_height = width, height
    return _context


# The garbage collector would come too late: PyOpenGL's modules are gone by then.
@atexit.register
def _free_context() -> None:
    if _context is not None:
        _context.delete()
