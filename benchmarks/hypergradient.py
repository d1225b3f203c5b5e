"""Seconds and memory of an image's derivative by V: reverse by patches, reverse whole, forward.

`python benchmarks/hypergradient.py --root ../shared/ycb --names 019`. One 40-degree image, float32; each method ends
with the m numbers d<cotangent, image>/dV for a given cotangent, nonzero in every pixel. Reverse renders twice and goes
back once (`gradient.pathwise`), forward renders once. Peak memory is the largest sum of what torch held at one time, by
its profiler's record of every allocation, outputs included: the maps, and the tangents stored with them. Working memory
is that of rendering (forward) or of the whole (reverse) beyond the outputs.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from field import fit, load_objects, training_views  # the benchmark beside this one
from machine import add_device
from torch import Tensor

from neural_sim import cameras
from neural_sim.devices import synchronise
from neural_sim.field.base import RadianceField
from neural_sim.field.training import field_from_state, field_state
from neural_sim.gradient.pathwise import contract
from neural_sim.outer.peak_memory import peak_bytes
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.report.machine import machine
from neural_sim.synthesis.motion import RIGID, pose_rates
from neural_sim.types import Maps, PinholeCamera, Rays, SceneDraw

PATCHES = (64, 128, 256, 512, 4096)
NUMBERS = (1, 2, 4, 12)


@dataclass(frozen=True)
class Case:
    """One image, the directions its camera moves in, and the cotangent of its maps."""

    field: RadianceField
    renderer: NerfRenderer
    camera: PinholeCamera
    pose: Tensor
    rates: Tensor
    maps: Maps

    def map_bytes(self, maps: int) -> int:
        return 4 * 4 * maps * self.camera.width * self.camera.height

    def with_chunks(self, size: int) -> Case:
        return replace(self, renderer=NerfRenderer(self.renderer.quality, rays_per_chunk=size))

    def render(self) -> tuple[Maps, list[Maps]]:
        return self.renderer.render_with_tangents(self.field, self.camera, self.pose, self.rates)


def case(field: RadianceField, renderer: NerfRenderer, size: int, numbers: int, device: torch.device) -> Case:
    """The first three numbers are phi, rho and distance, the others random directions of the pose's twelve entries."""
    generator = torch.Generator().manual_seed(0)
    camera = PinholeCamera(size, size, math.radians(40.0))
    draw = SceneDraw(*(torch.tensor([x]) for x in (1.1, 0.4, 3.0)), bins=torch.zeros(1, dtype=torch.long))
    rates = torch.randn(12, 1, 4, 4, generator=generator) * 0.3
    rates[:, :, 3] = 0.0
    rates[:3] = pose_rates(draw, RIGID)
    cotangent = torch.randn(1, size, size, 4, generator=generator)
    pose = cameras.orbit(draw.phi, draw.rho, draw.distance)
    cotangent = cotangent.to(device)
    maps = Maps(cotangent[..., :3], cotangent[..., 3])
    return Case(field.to(device), renderer, camera, pose.to(device), rates[:numbers].to(device), maps)


def forward(of: Case) -> Tensor:
    named = {str(number): tangent for number, tangent in enumerate(of.render()[1])}
    return torch.cat(list(contract(named, of.maps).values()))


def reverse(of: Case, patch: int) -> Tensor:
    """As ``draw_cotangents``, for a camera that moves linearly in any number of numbers."""
    of.renderer.render(of.field, of.camera, of.pose)
    rgb, opacity = of.maps.rgb.reshape(-1, 3), of.maps.opacity.reshape(-1)
    total = torch.zeros(len(of.rates), device=of.pose.device)
    for pixels in torch.arange(len(opacity), device=of.pose.device).split(patch):
        numbers = torch.zeros_like(total, requires_grad=True)
        pose = of.pose + torch.einsum("m,mnij->nij", numbers, of.rates)
        rays = cameras.pixel_rays(of.camera, pose, pixels)
        # Most of these matrices are no rotations; the renderer's tangents keep directions of unit length.
        rays = Rays(rays.origins, torch.nn.functional.normalize(rays.directions, dim=-1))
        rendered = of.renderer.render_rays(of.field, rays)
        (part,) = torch.autograd.grad(
            rendered, numbers, (rgb[pixels], opacity[pixels]), materialize_grads=True
        )
        total += part
    return total


def measure(of: Case, name: str, run: Callable[[Case], Tensor], repeats: int) -> dict[str, object]:
    device = of.pose.device
    value, seconds, processor = run(of), [], []
    synchronise(device)
    for _ in range(repeats):
        begun, worked = time.perf_counter(), time.process_time()
        run(of)
        synchronise(device)
        seconds.append(time.perf_counter() - begun)
        processor.append(time.process_time() - worked)
    peak = working = peak_bytes(lambda: run(of), device)
    outputs = of.map_bytes(1)
    if name.startswith("forward"):
        working, outputs = peak_bytes(of.render, device), of.map_bytes(1 + len(of.rates))
    return {
        "method": name,
        "size": of.camera.width,
        "numbers": len(of.rates),
        "milliseconds": 1e3 * statistics.median(seconds),
        "cpu_milliseconds": 1e3 * statistics.median(processor),
        "peak_megabytes": peak / 2**20,
        "working_megabytes": (working - outputs) / 2**20,
        "value": value.tolist(),
    }


def methods(size: int, patches: tuple[int, ...]) -> dict[str, Callable[[Case], Tensor]]:
    made: dict[str, Callable[[Case], Tensor]] = {"forward": forward}
    for patch in patches:
        if patch < size * size:
            made[f"reverse, patches of {patch}"] = lambda of, patch=patch: reverse(of, patch)
    made["reverse, whole"] = lambda of: reverse(of, size * size)
    return made


def compare(rows: list[dict[str, object]]) -> dict[str, float]:
    """How many times longer reverse takes than forward, and how far apart they are, for one size and m."""
    times = {str(row["method"]): float(row["milliseconds"]) for row in rows}  # pyright: ignore[reportArgumentType]
    values = {str(row["method"]): torch.tensor(row["value"]) for row in rows}
    ahead = values["forward"]
    backward = [seconds for name, seconds in times.items() if name.startswith("reverse")]
    return {
        "best_reverse": min(backward) / times["forward"],
        "patches_of_64": times.get("reverse, patches of 64", math.nan) / times["forward"],
        "difference": max(float((v - ahead).norm() / ahead.norm()) for v in values.values()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", help="a folder in the YCB layout; without it the embedded objects")
    parser.add_argument("--names", nargs="*", default=None)
    parser.add_argument("--field", type=Path, help="a saved field; written here where it does not exist")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--sizes", type=int, nargs="*", default=[32, 64, 128, 256, 512])
    parser.add_argument("--numbers", type=int, nargs="*", default=list(NUMBERS))
    parser.add_argument("--numbers-size", type=int, default=64, help="image size at which m varies")
    parser.add_argument("--patches", type=int, nargs="*", default=list(PATCHES))
    parser.add_argument("--largest-reverse", type=int, default=256, help="largest image by small patches")
    parser.add_argument("--chunk", type=int, default=256, help="rays under way at once, to compare memory")
    parser.add_argument("--quality", default="final")
    parser.add_argument("--repeats", type=int, default=3)
    add_device(parser)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("outputs/benchmarks/hypergradient.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    if arguments.field is None or not arguments.field.exists():
        item = load_objects(arguments.root, arguments.names)[0]
        fitted, _ = fit(training_views(item, 128, 100), arguments.steps, 0, arguments.device)
        if arguments.field is not None:
            torch.save(field_state(fitted), arguments.field)
    else:
        fitted = field_from_state(torch.load(arguments.field, weights_only=True))
    renderer = NerfRenderer(arguments.quality)
    asked = [(size, 1) for size in arguments.sizes]
    asked += [
        (arguments.numbers_size, m) for m in arguments.numbers if (arguments.numbers_size, m) not in asked
    ]
    rows, ratios = [], []
    print(f"{'size':>5}{'m':>4}  {'method':24}{'ms':>9}{'cpu ms':>9}{'peak MB':>9}{'working MB':>12}")
    for size, numbers in asked:
        of = case(fitted, renderer, size, numbers, arguments.device)
        patches = tuple(p for p in arguments.patches if size <= arguments.largest_reverse or p >= 4096)
        some = []
        runs = [(of, name, run) for name, run in methods(size, patches).items()]
        runs.insert(1, (of.with_chunks(arguments.chunk), f"forward, chunks of {arguments.chunk}", forward))
        for run in runs:
            row = measure(*run, arguments.repeats)
            some.append(row)
            print(
                f"{size:5}{numbers:4}  {row['method']:24}{row['milliseconds']:9.1f}{row['cpu_milliseconds']:9.1f}"
                f"{row['peak_megabytes']:9.1f}{row['working_megabytes']:12.2f}",
                flush=True,
            )
        ratios.append({"size": size, "numbers": numbers, **compare(some)})
        print("      ", {key: float(f"{value:.3g}") for key, value in ratios[-1].items()}, flush=True)
        rows += some
    result = {"machine": machine(arguments.device), "chunk": arguments.chunk, "ratios": ratios, "rows": rows}
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
