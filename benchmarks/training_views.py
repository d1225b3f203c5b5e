"""Views of YCB or embedded objects and fields fitted to them, shared by several benchmarks."""

from __future__ import annotations

import math

import torch

from neural_sim import cameras
from neural_sim.field.base import RadianceField
from neural_sim.field.fitting import GridFitting
from neural_sim.field.grid import GridField
from neural_sim.field.recipe import fit_field
from neural_sim.objects.mesh import ObjectMesh
from neural_sim.objects.procedural import Procedural
from neural_sim.objects.ycb import YCB
from neural_sim.renderer.views import choose_mesh_renderer, render_views
from neural_sim.types import PinholeCamera, PosedViews

PAPER_OBJECTS = ["002", "003", "009", "019", "025", "035"]
HELD_OUT = 16


def load_objects(root: str | None, names: list[str] | None) -> list[ObjectMesh]:
    """Load the objects in a folder in the YCB layout, or the embedded ones if ``root`` is None."""
    if root is None:
        return Procedural(names, 0).load()
    return YCB(root, [*(names or PAPER_OBJECTS)]).load()


def training_views(item: ObjectMesh, size: int, count: int) -> PosedViews:
    """Render views at uniform directions and distances of 2.4 to 4 radii, the held-out ones last."""
    generator = torch.Generator().manual_seed(1)
    height, turn, zoom = torch.rand(3, count + HELD_OUT, generator=generator)
    pose = cameras.orbit(torch.arccos(1.0 - 2.0 * height), 2.0 * math.pi * turn, 2.4 + 1.6 * zoom)
    camera = PinholeCamera(size, size, math.radians(40.0))
    return render_views(choose_mesh_renderer(supersample=3), item, camera, pose)


def fit(views: PosedViews, steps: int) -> RadianceField:
    """Fit a field with default settings, scaling the steps at which its structure changes with the budget."""
    refine, pruned = (steps // 6, steps // 2), (2 * steps // 3, 5 * steps // 6)
    fitting = GridFitting(GridField(), refine_steps=refine, prune_steps=pruned)
    generator = torch.Generator().manual_seed(0)
    return fit_field(views, fitting, generator, steps=steps, held_out=HELD_OUT)[0]


def quick_psnr(views: PosedViews, held_out: int = HELD_OUT) -> float:
    """Return the PSNR in dB, over the foreground of held-out views, of a field fitted as in scale=quick."""
    fitting = GridFitting(GridField(), resolution=128, refine_steps=(80,), prune_steps=(160,))
    generator = torch.Generator().manual_seed(0)
    return fit_field(views, fitting, generator, steps=240, held_out=held_out)[1][-1]["psnr_foreground"]
