"""PSNR against seconds of grid fields, on YCB objects with `--root ../shared/ycb`, else on the embedded ones.

128 x 128, 100 supersampled views at 2.4 to 4.0 radii, 40 degrees, 16 held-out views. Memory is the process's largest
while the field is fitted, and by how much that exceeds what libraries, meshes and views held before. The goal on a GPU
(32 dB at 256 x 256 in under 6 s): `--device cuda --size 256 --scores 24`.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import time
from pathlib import Path

import torch
from machine import add_device, forget_peak, memory_mb

from neural_sim import cameras
from neural_sim.field.base import RadianceField
from neural_sim.field.fitting import GridFitting
from neural_sim.field.grid import GridField
from neural_sim.field.recipe import fit_field
from neural_sim.objects.mesh import ObjectMesh
from neural_sim.objects.procedural import Procedural
from neural_sim.objects.ycb import YCB
from neural_sim.renderer.views import choose_mesh_renderer, render_views
from neural_sim.report.provenance import gpu, machine
from neural_sim.types import PinholeCamera, PosedViews

PAPER_OBJECTS = ["002", "003", "009", "019", "025", "035"]
HELD_OUT = 16


def load_objects(root: str | None, names: list[str] | None) -> list[ObjectMesh]:
    if root is None:
        return Procedural(names, 0).load()
    return YCB(root, names or PAPER_OBJECTS).load()


def training_views(item: ObjectMesh, size: int, count: int) -> PosedViews:
    """Uniform directions and distances, the held-out views last."""
    generator = torch.Generator().manual_seed(1)
    height, turn, zoom = torch.rand(3, count + HELD_OUT, generator=generator)
    pose = cameras.orbit(torch.arccos(1.0 - 2.0 * height), 2.0 * math.pi * turn, 2.4 + 1.6 * zoom)
    camera = PinholeCamera(size, size, math.radians(40.0))
    return render_views(choose_mesh_renderer(supersample=3), item, camera, pose)


def fit(
    views: PosedViews, steps: int, score_every: int, device: torch.device | None = None
) -> tuple[RadianceField, list[dict[str, float]]]:
    """A field with the default settings, its structure's steps in proportion to the budget."""
    device = device or torch.device("cpu")
    refine = (steps // 6, steps // 2)
    pruned = (2 * steps // 3, 5 * steps // 6)
    fitting = GridFitting(GridField().to(device), refine_steps=refine, prune_steps=pruned)
    generator = torch.Generator().manual_seed(0)
    return fit_field(
        views.to(device), fitting, generator, steps=steps, held_out=HELD_OUT, score_every=score_every
    )


def quick_psnr(views: PosedViews, held_out: int = HELD_OUT) -> float:
    """On the foreground of held-out views, of a field as at quick scale."""
    fitting = GridFitting(GridField(), resolution=128, refine_steps=(80,), prune_steps=(160,))
    generator = torch.Generator().manual_seed(0)
    return fit_field(views, fitting, generator, steps=240, held_out=held_out)[1][-1]["psnr_foreground"]


def seconds_to(history: list[dict[str, float]], psnr: float) -> float:
    """When the score first reached ``psnr`` dB; nan if it never did."""
    return next((score["seconds"] for score in history if score["psnr"] >= psnr), math.nan)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", help="a folder in the YCB layout; without it the embedded objects")
    parser.add_argument("--names", nargs="*")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--views", type=int, default=100)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--scores", type=int, default=4, help="how often the held-out views are rendered")
    parser.add_argument("--psnr", type=float, default=32.0, help="dB whose first time is reported")
    add_device(parser)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("outputs/benchmarks/field.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    rows = []
    print(
        f"{'object':24}{'step':>6}{'seconds':>9}{'psnr':>7}{'fg':>7}{'ssim':>7}{'cpu s':>8}{'MB':>7}{'of fit':>8}"
    )
    for item in load_objects(arguments.root, arguments.names):
        views = training_views(item, arguments.size, arguments.views)
        before, cpu = memory_mb()[0], time.process_time()
        forget_peak(arguments.device)
        _, history = fit(
            views, arguments.steps, max(arguments.steps // arguments.scores, 1), arguments.device
        )
        cpu, peak = time.process_time() - cpu, memory_mb()[1]
        for score in history:
            whole = {"cpu_seconds_with_scoring": cpu, "peak_mb": peak, "peak_mb_of_fit": peak - before}
            whole |= gpu(arguments.device) | {"seconds_to_psnr": seconds_to(history, arguments.psnr)}
            rows.append({"object": item.name, **whole, **score})
            print(
                f"{item.name:24}{score['step']:6.0f}{score['seconds']:9.1f}{score['psnr']:7.2f}"
                f"{score['psnr_foreground']:7.2f}{score['ssim']:7.3f}{cpu:8.1f}"
                f"{peak:7.0f}{peak - before:8.0f}",
                flush=True,
            )
    final = [row for row in rows if row["step"] == arguments.steps]
    mean = {
        key: sum(row[key] for row in final) / len(final)
        for key in ("seconds", "psnr", "psnr_foreground", "ssim")
    }
    reached = {row["object"]: round(row["seconds_to_psnr"], 2) for row in final}
    print(f"seconds to {arguments.psnr:g} dB:", reached)
    print("mean at the end:", {key: round(value, 3) for key, value in mean.items()})
    result = {
        "machine": machine(arguments.device),
        "size": arguments.size,
        "psnr": arguments.psnr,
        "steps": arguments.steps,
        "mean": mean,
        "rows": rows,
    }
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
