"""Milliseconds and samples of a field's images: `python benchmarks/render.py --root ../shared/ycb --names 019`.

Times `NerfRenderer.render` against image size, and its error against a render with nothing left out.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import statistics
import time
from pathlib import Path

import torch
from field import HELD_OUT, fit, load_objects, training_views  # the benchmark beside this one
from machine import machine

from neural_sim import cameras
from neural_sim.field.base import RadianceField
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.types import PinholeCamera, PosedViews, Rays


def measure(field: RadianceField, views: PosedViews, size: int, repeats: int) -> dict[str, float]:
    renderer = NerfRenderer()
    camera, pose = PinholeCamera(size, size, math.radians(40.0)), views.camera_to_world[-HELD_OUT:]
    seconds = []
    for _ in range(repeats + 1):
        begun = time.perf_counter()
        rgb, opacity = renderer.render(field, camera, pose)
        seconds.append((time.perf_counter() - begun) / len(pose))
    every_rgb, every_opacity = renderer.render(field, camera, pose, exact=True)
    shown = (opacity > 0.01) | (every_opacity > 0.01)
    bundle = cameras.rays(camera, pose[:1])
    rays = Rays(bundle.origins.reshape(-1, 3), bundle.directions.reshape(-1, 3))
    samples = field.sample(rays, renderer.termination)
    hit = int((samples.starts.diff() > 0).sum())
    return {
        "size": size,
        "milliseconds": 1e3 * statistics.median(seconds[1:]),
        "rays_hit": hit / len(rays.origins),
        "samples_per_hit_ray": len(samples) / max(hit, 1),
        "opacity_error": float((opacity - every_opacity).abs()[shown].mean()),
        "colour_psnr": -10.0 * math.log10(float((rgb - every_rgb).square().mean()) + 1e-20),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", help="a folder in the YCB layout; without it the embedded objects")
    parser.add_argument("--names", nargs="*")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--sizes", type=int, nargs="*", default=[64, 96, 128, 256])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("outputs/benchmarks/render.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    rows = []
    print(f"{'object':24}{'size':>6}{'ms':>8}{'hit':>6}{'samples/ray':>13}{'opacity err':>13}{'psnr':>7}")
    for item in load_objects(arguments.root, arguments.names):
        views = training_views(item, 128, 100)
        field, _ = fit(views, arguments.steps, 0)
        for size in arguments.sizes:
            row = measure(field, views, size, arguments.repeats)
            rows.append({"object": item.name, **row})
            print(
                f"{item.name:24}{size:6}{row['milliseconds']:8.1f}{row['rays_hit']:6.2f}"
                f"{row['samples_per_hit_ray']:13.1f}{row['opacity_error']:13.2e}{row['colour_psnr']:7.1f}",
                flush=True,
            )
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps({"machine": machine(), "rows": rows}, indent=2))


if __name__ == "__main__":
    main()
