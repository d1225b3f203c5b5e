"""Estimate the cost of `+experiment=pose_bin1_ycb +variant=paper scale=paper`: `python benchmarks/paper_scale.py`.

It measures the CPU seconds of a sample of each kind of work (rays through the paper's network, and images of its
RetinaNet at 256 pixels) and multiplies them by the counts in the configuration.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from machine import add_device

from neural_sim.detector.cached_set import CachedSet
from neural_sim.devices import synchronise
from neural_sim.documents import markdown_table
from neural_sim.main import build, conf_directory
from neural_sim.solver.hvp import HessianOperator
from neural_sim.stages.experiment import Experiment
from neural_sim.types import LabelledImages, Rays

OBJECTS = 6
PRODUCTS = 20
"""Hessian products per iteration: for the Lanczos estimate, and for conjugate gradients."""


def seconds(work: Callable[[], object], device: torch.device) -> float:
    """Measure CPU seconds, or wall-clock seconds on a GPU, of the second call, since the first allocates memory."""
    clock = time.process_time if device.type == "cpu" else time.perf_counter
    work()
    synchronise(device)
    begun = clock()
    work()
    synchronise(device)
    return clock() - begun


def of_rays(made: Experiment, count: int, device: torch.device) -> dict[str, float]:
    """Measure seconds per ray through the sphere of the object."""
    field = made.imaging.field.field().to(device).eval()
    aim = 0.5 * torch.randn(count, 3, generator=torch.Generator().manual_seed(0)).clamp(-1.0, 1.0)
    origins = torch.tensor([0.0, 0.0, 3.0]).expand(count, 3)
    rays = Rays(origins.to(device), torch.nn.functional.normalize(aim - origins, dim=-1).to(device))

    def render(by: str) -> None:
        start = rays.origins.clone().requires_grad_()
        with torch.set_grad_enabled(by != "nothing"):
            rgb, _ = made.imaging.renderer.render_rays(field, Rays(start, rays.directions))
        if by != "nothing":
            wanted = [start] if by == "origins" else list(field.parameters())
            torch.autograd.grad(rgb.sum(), wanted, allow_unused=True)

    return {
        "ray: rendered": seconds(lambda: render("nothing"), device) / count,
        "ray: rendered and differentiated by its camera": seconds(lambda: render("origins"), device) / count,
        "ray: a step of the network": seconds(lambda: render("weights"), device) / count,
    }


def of_images(made: Experiment, count: int, device: torch.device) -> dict[str, float]:
    """Measure seconds per image for the detector."""
    size = made.training.image_size
    detector = made.detector(num_classes=OBJECTS, image_size=size)
    params = {k: v.to(device) for k, v in detector.init(torch.Generator().manual_seed(0)).items()}
    images = LabelledImages(
        torch.rand(count, 3, size, size),
        torch.tensor([[0.2, 0.2, 0.7, 0.8]]).mul(size).repeat(count, 1, 1),
        torch.zeros(count, 1, dtype=torch.long),
        torch.zeros(count, dtype=torch.long),
    ).to(device)
    loop = detector.in_loop(0)
    frozen, head = loop.split(params)
    cached = CachedSet.of(loop, frozen, images)

    def whole() -> None:
        leaf = {name: value.clone().requires_grad_() for name, value in params.items()}
        backbone, rest = detector.split(leaf)
        outputs = detector.outputs(rest, detector.features(backbone, images.images))
        loss = detector.losses_of(outputs, detector.assign(images.boxes, images.labels)).sum()
        torch.autograd.grad(loss, list(leaf.values()), allow_unused=True)

    def part() -> None:
        leaf = {name: value.clone().requires_grad_() for name, value in head.items()}
        torch.autograd.grad(
            cached.losses(leaf, torch.arange(count, device=device)).sum(), list(leaf.values())
        )

    operator = HessianOperator(cached.mean_terms(), head)
    vector = torch.randn(operator.size, device=device)
    return {
        "image: trained on": seconds(whole, device) / count,
        "image: trained on, backbone frozen": seconds(part, device) / count,
        "image: a product with the Hessian": seconds(lambda: operator(vector), device) / count,
    }


def whole_run(made: Experiment, budget: Mapping[str, Any], parts: Mapping[str, float]) -> dict[str, float]:
    """Multiply the parts by the counts in the configuration; in seconds."""
    render, twice, step, trained, frozen, product = parts.values()
    near, far = made.imaging.distribution.ranges["distance"]
    slope = math.tan(math.radians(made.imaging.views.field_of_view_deg / 2.0))
    distances = torch.linspace(near, far, 101).double()
    seen = (math.pi / 4.0 * ((distances**-1).asin().tan() / slope).square()).clamp(max=1.0).mean()
    rays = float(seen) * made.training.image_size**2
    images = OBJECTS * made.loop.outer.images_per_object
    iteration = {
        "an iteration: images, and their derivative by the second pass": images * rays * (render + twice),
        "an iteration: training": images * (made.loop.outer.epochs * frozen + trained / 3.0),
        "an iteration: the solve": images * PRODUCTS * product,
        "an iteration: derivative with respect to the images": images * 2.5 * trained,
    }
    scored = 3 * made.training.cold_epochs * OBJECTS * made.training.images_per_object
    return {
        "networks of six objects": OBJECTS * budget["mlp"]["steps"] * 1024 * step,
        **iteration,
        f"the psi loop, {made.loop.outer.iterations} iterations": made.loop.outer.iterations
        * sum(iteration.values()),
        "warm start and two scored detectors": scored * trained
        + scored / made.training.cold_epochs * rays * render,
    }


def main() -> None:
    """Print the parts and their total."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_device(parser)
    parser.add_argument("--rays", type=int, default=256)
    parser.add_argument("--images", type=int, default=2)
    arguments = parser.parse_args()
    device = torch.device(arguments.device)
    with initialize_config_dir(str(conf_directory()), version_base="1.3"):
        config = compose("config", ["+experiment=pose_gap", "+variant=paper", "scale=paper"])
    made = build(config)
    parts = {**of_rays(made, arguments.rays, device), **of_images(made, arguments.images, device)}
    print(markdown_table(["a part", "s"], [[name, f"{value:.3g}"] for name, value in parts.items()]))
    total = whole_run(made, config.budget, parts)
    print(markdown_table(["scale=paper", "hours"], [[name, f"{s / 3600:,.1f}"] for name, s in total.items()]))


if __name__ == "__main__":
    main()
