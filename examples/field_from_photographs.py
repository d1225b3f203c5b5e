"""Fit one radiance field to photographs, score it on held-out ones, and render it from all sides.

The folder contains photographs with cameras (``transforms.json`` or a COLMAP model) and masks. If cameras or masks are
missing, have them computed:

    python examples/field_from_photographs.py my_mug turntable.png --poses colmap --masks scene
"""

from __future__ import annotations

import argparse
import logging
import math
from pathlib import Path

import torch
from torchvision.utils import save_image

from neural_sim.cameras import orbit
from neural_sim.field.fitting import GridFitting
from neural_sim.field.grid import GridField
from neural_sim.field.quality import POOR
from neural_sim.field.recipe import fit_field
from neural_sim.field.scene.recipe import SceneMasks
from neural_sim.objects.motion import Colmap
from neural_sim.objects.photos import Photos
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.types import PinholeCamera


def main() -> None:
    """Read the photographs, fit the field, print its score and write eight renders of it."""
    parser = argparse.ArgumentParser(description="Fit one radiance field to photographs.")
    parser.add_argument("folder", type=Path, help="folder with the photographs of one object")
    parser.add_argument("picture", type=Path, help="file to write the rendered views to")
    parser.add_argument("--poses", choices=["given", "colmap"], default="given")
    parser.add_argument("--masks", choices=["auto", "files", "alpha", "scene"], default="auto")
    parser.add_argument(
        "--size", type=int, default=160, help="side in pixels of the views that the field is fitted to"
    )
    parser.add_argument("--steps", type=int, default=240, help="optimiser steps")
    options = parser.parse_args()
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)  # no tips

    source = Photos(
        options.folder,
        masks=options.masks,
        poses=Colmap() if options.poses == "colmap" else None,
        scene=SceneMasks() if options.masks == "scene" else None,
    )
    (name,) = source.names()
    held_out = len(source.split(name, count=84, held_out=16)[1])
    views = source.views(name, count=84, held_out=16, image_size=options.size)

    # The grid starts coarse: after a third of the steps empty cells are pruned and the others halved.
    third = options.steps // 3
    fitting = GridFitting(GridField(), resolution=128, refine_steps=(third,), prune_steps=(2 * third,))
    generator = torch.Generator().manual_seed(0)
    field, history = fit_field(views, fitting, generator, steps=options.steps, held_out=held_out)
    score = history[-1]["psnr_foreground"]
    print(f"{name}: {score:.1f} dB on the object in {held_out} photographs that the field has not seen")
    if score < POOR:
        print(f"below {POOR:g} dB a field does not show its object: look at the masks and the photographs")

    # Poses are (phi, rho, distance); at phi = 90 degrees the camera looks at an upright object from the side.
    turns = torch.arange(8) * (2 * math.pi / 8)
    poses = orbit(torch.full((8,), math.radians(70.0)), turns, torch.full((8,), 3.0))
    rgb, opacity = NerfRenderer().render(field, PinholeCamera(192, 192, math.radians(45.0)), poses)
    over_white = rgb + (1 - opacity[..., None])
    save_image(over_white.movedim(-1, 1), options.picture, nrow=4)
    print(f"eight views of it: {options.picture}")


if __name__ == "__main__":
    main()
