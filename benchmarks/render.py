"""Milliseconds, samples and memory of a field's images: `python benchmarks/render.py --root ../shared/ycb --names 019`.

Times `NerfRenderer.render` of each quality against image size, with its error against a render with nothing left out;
at `--omit-size` also with each omission of the final quality undone, to see what it saves and costs.
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
from machine import add_device

from neural_sim.devices import peak_bytes, synchronise
from neural_sim.field.base import RadianceField
from neural_sim.renderer.nerf import NerfRenderer, Quality
from neural_sim.report.provenance import machine
from neural_sim.studies.work_precision.renderer import left_out
from neural_sim.types import PinholeCamera, PosedViews


def variants(qualities: list[Quality], undo: bool) -> dict[str, NerfRenderer]:
    made = {quality: NerfRenderer(quality) for quality in qualities}
    if not undo:
        return dict(made)
    return {
        **made,
        "every pixel": NerfRenderer(cull=False),
        "every step": NerfRenderer(skip_empty=False),
        "every sample": NerfRenderer(termination=0.0),
    }


def measure(
    field: RadianceField, renderer: NerfRenderer, views: PosedViews, size: int, repeats: int
) -> dict[str, float]:
    device = next(field.parameters()).device
    camera, pose = PinholeCamera(size, size, math.radians(40.0)), views.camera_to_world[-HELD_OUT:].to(device)
    renderer.render(field, camera, pose)
    synchronise(device)
    seconds, processor = [], []
    for _ in range(repeats):
        begun, worked = time.perf_counter(), time.process_time()
        renderer.render(field, camera, pose)
        synchronise(device)
        seconds.append((time.perf_counter() - begun) / len(pose))
        processor.append((time.process_time() - worked) / len(pose))
    lost = left_out(field, renderer, camera, pose)
    return {
        "size": size,
        "milliseconds": 1e3 * statistics.median(seconds),
        "cpu_milliseconds": 1e3 * statistics.median(processor),
        "images_per_second": 1.0 / statistics.median(seconds),
        "peak_megabytes": peak_bytes(lambda: renderer.render(field, camera, pose), device) / 2**20,
        "rays_cast": lost.cast,
        "samples_per_hit_ray": lost.samples,
        "opacity_error": lost.opacity,
        "colour_psnr": -20.0 * math.log10(lost.colour + 1e-10),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", help="a folder in the YCB layout; without it the embedded objects")
    parser.add_argument("--names", nargs="*")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--sizes", type=int, nargs="*", default=[64, 96, 128, 256])
    parser.add_argument("--qualities", nargs="*", default=["draft", "normal", "final"])
    parser.add_argument("--omit-size", type=int, default=128)
    parser.add_argument("--repeats", type=int, default=3)
    add_device(parser)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("outputs/benchmarks/render.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    rows = []
    print(
        f"{'object':24}{'size':>5} {'variant':13}{'ms':>7}{'cpu ms':>8}{'MB':>7}{'cast':>6}{'smp/ray':>8}"
        f"{'opacity err':>12}{'psnr':>7}"
    )
    for item in load_objects(arguments.root, arguments.names):
        views = training_views(item, 128, 100)
        field, _ = fit(views, arguments.steps, 0, arguments.device)
        for size in arguments.sizes:
            for name, renderer in variants(arguments.qualities, size == arguments.omit_size).items():
                row = measure(field, renderer, views, size, arguments.repeats)
                rows.append({"object": item.name, "variant": name, **row})
                print(
                    f"{item.name:24}{size:5} {name:13}{row['milliseconds']:7.1f}{row['cpu_milliseconds']:8.1f}"
                    f"{row['peak_megabytes']:7.1f}{row['rays_cast']:6.2f}"
                    f"{row['samples_per_hit_ray']:8.1f}{row['opacity_error']:12.2e}{row['colour_psnr']:7.1f}",
                    flush=True,
                )
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps({"machine": machine(arguments.device), "rows": rows}, indent=2))


if __name__ == "__main__":
    main()
