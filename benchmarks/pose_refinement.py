"""Fields from views with wrong poses, before and after refinement, compared with fields from true poses.

Uses views and fields of scale=quick, of YCB objects with `--root ../shared/ycb`, else of the embedded ones. Positions
have errors of `--noise` times the distance to the object (standard deviation per axis), rotations of the same number in
radians. Scores are PSNR in dB over the pixels of the object in held-out views, whose poses are refined as well.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import time
from dataclasses import replace
from pathlib import Path

import torch
from training_views import HELD_OUT, load_objects, quick_psnr, training_views

from neural_sim.renderer.pose_refinement import PoseRefinement, moved, rotation_angle
from neural_sim.report.provenance import machine
from neural_sim.types import PosedViews


def disturbed(views: PosedViews, noise: float) -> PosedViews:
    """Give the views wrong poses, and treat them as photographs, whose silhouettes need not agree."""
    generator = torch.Generator().manual_seed(5)
    step = noise * torch.randn(len(views), 6, generator=generator)
    step[:, 3:] *= views.camera_to_world[:, :3, 3].norm(dim=-1, keepdim=True)
    known = torch.ones(views.images.shape[:3], dtype=torch.bool)
    return replace(views, camera_to_world=moved(views.camera_to_world, step), known=known)


def errors(views: PosedViews, truth: PosedViews) -> tuple[float, float]:
    """Return the median errors of positions in radii and of rotations in degrees."""
    a, b = views.camera_to_world, truth.camera_to_world
    turned = float(rotation_angle(a[:, :3, :3], b[:, :3, :3]).median())
    return float((a[:, :3, 3] - b[:, :3, 3]).norm(dim=-1).median()), math.degrees(turned)


def main() -> None:
    """Parse the command line and run the measurements."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", help="a folder in the YCB layout; without it the embedded objects")
    parser.add_argument("--names", nargs="*")
    parser.add_argument("--photos", type=int, default=40)
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--noise", type=float, nargs="*", default=[0.0, 0.01])
    parser.add_argument("--rounds", type=int, nargs="*", default=[6])
    parser.add_argument("--out", type=Path, default=Path("outputs/benchmarks/pose_refinement.json"))
    options = parser.parse_args()
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    torch.set_num_threads(1)
    rows = []
    print(f"{'object':24}{'noise':>7}{'rounds':>8}{'radii':>9}{'degrees':>9}{'psnr':>7}{'cpu s':>7}")
    for item in load_objects(options.root, options.names):
        truth = training_views(item, options.size, options.photos)
        for noise in options.noise:
            given = disturbed(truth, noise)
            for rounds in (0, *options.rounds):
                began = time.process_time()
                views = PoseRefinement(rounds).refine(given, HELD_OUT)
                seconds = time.process_time() - began
                radii, degrees = errors(views, truth)
                rows.append({
                    "object": item.name, "noise": noise, "rounds": rounds, "radii": radii, "degrees": degrees,
                    "cpu_seconds": seconds, "psnr_foreground": quick_psnr(views),
                })  # fmt: skip
                print(
                    f"{item.name:24}{noise:7.3f}{rounds:8}{radii:9.4f}{degrees:9.3f}"
                    f"{rows[-1]['psnr_foreground']:7.2f}{seconds:7.1f}",
                    flush=True,
                )
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps({"machine": machine(), "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
