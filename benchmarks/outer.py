"""Seconds of each phase of one outer iteration against objects and images: `python benchmarks/outer.py`.

The loop is `scale=quick` at its defaults (96 px, detector=tiny, 100 training and 50 target images per object); any
key can be changed, as in `python benchmarks/outer.py solver.rtol=1e-3`. There are six embedded objects, with fields
fitted in few steps; if more are asked for, they are repeated under new names. The goal on a GPU (21 classes, 50 images
of 256 px, under 20 s): `--device cuda --objects 21 --images -- training.image_size=256`. The backbone is untrained,
which changes what is learned but not the cost.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import logging
import math
import statistics
import time
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from machine import add_device, forget_peak

from neural_sim.devices import placed, synchronise
from neural_sim.main import build, conf_directory
from neural_sim.outer.inner import InnerLoop, LoopInputs
from neural_sim.outer.module import SimulatorModule
from neural_sim.report.provenance import gpu, machine
from neural_sim.synthesis.scene import Scene
from neural_sim.target.rendered import RenderedTarget
from neural_sim.tasks.context import Context

SMALL_FIELDS = [
    "scale=quick", "progress=false", "views.count=40", "budget.grid.steps=90", "budget.grid.refine_steps=[30]",
    "budget.grid.prune_steps=[60]",
]  # fmt: skip
PHASES = (
    "render", "probes", "features", "train", "judge", "validation", "solve", "unrolled", "mixed", "rest"
)  # fmt: skip


def repeated(scene: Scene, count: int) -> Scene:
    """Repeat the objects of a scene under new names until there are ``count``."""
    index = [i % len(scene.names) for i in range(count)]
    subjects = tuple(
        dataclasses.replace(scene.fields[i], name=f"{scene.names[i]}_{label}")
        for label, i in enumerate(index)
    )
    return dataclasses.replace(scene, subjects=subjects)


def loop(context: Context, count: int, images: int) -> SimulatorModule:
    """Make the psi loop for ``count`` objects with ``images`` training images each, starting from uniform poses."""
    generator = torch.Generator().manual_seed(0)
    scene = repeated(context.results(context.graph.scene), count)
    detector = context.experiment.detector(
        num_classes=count, image_size=context.experiment.training.image_size
    )
    psi = torch.zeros(count, context.graph.psi("initial").shape[1])
    target = context.experiment.imaging.target
    assert isinstance(target, RenderedTarget), "the benchmark renders its validation images"
    count = target.val_per_object
    validation = scene.training_set(psi, count, generator).images.to("cpu")
    settings, training = (
        dataclasses.replace(context.experiment.loop.outer, images_per_object=images),
        context.experiment.training,
    )
    estimator, solver = context.experiment.loop.gradient, context.experiment.loop.solver
    inputs = LoopInputs(detector, placed(detector.init(generator), context.graph.device), validation)
    inner = InnerLoop.prepare(scene, inputs, settings, training, generator, estimator.draws)
    return SimulatorModule(inner, psi, estimator, solver, generator)


def measure(module: SimulatorModule, repeats: int) -> dict[str, float]:
    """Return medians over iterations, excluding the first, which allocates memory and selects kernels."""
    walls, rows = [], []
    for step in range(repeats + 1):
        begun = time.perf_counter()
        module.training_step(step, step)
        synchronise(module.inner.device)
        walls.append(time.perf_counter() - begun)
        seconds = module.records[-1].seconds
        row = {phase: seconds.get(phase, seconds.get(f"hypergradient_{phase}", 0.0)) for phase in PHASES}
        rows.append(row | {"rest": walls[-1] - sum(row.values())})
    found = {phase: statistics.median(row[phase] for row in rows[1:]) for phase in PHASES}
    return found | {"seconds": statistics.median(walls[1:])}


def exponent(rows: list[dict[str, Any]], size: str, key: str = "seconds") -> float:
    """Return the least-squares slope of log seconds over log size."""
    x = torch.tensor([math.log(row[size]) for row in rows], dtype=torch.float64)
    y = torch.tensor([math.log(row[key]) for row in rows], dtype=torch.float64)
    return float(((x - x.mean()) * (y - y.mean())).sum() / (x - x.mean()).square().sum())


def last_exponent(rows: list[dict[str, Any]], size: str) -> float:
    """Return the slope between the two largest sizes, which constant costs affect least."""
    return exponent(sorted(rows, key=lambda row: row[size])[-2:], size)


def main() -> None:
    """Parse the command line and run the measurements."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("overrides", nargs="*", help="configuration keys, as on the command line of a run")
    parser.add_argument(
        "--objects", type=int, nargs="*", default=[1, 6, 21], help="at the loop's images of each"
    )
    parser.add_argument(
        "--images", type=int, nargs="*", default=[25, 50, 100, 200], help="of each of six objects"
    )
    parser.add_argument("--repeats", type=int, default=3)
    add_device(parser)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--store", type=Path, default=Path("outputs/store"), help="fields are kept here")
    parser.add_argument("--out", type=Path, default=Path("outputs/benchmarks/outer.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    trainer = "trainer=" + ("cpu" if arguments.device.type == "cpu" else "gpu")
    overrides = [*SMALL_FIELDS, trainer, f"paths.store={arguments.store}", *arguments.overrides]
    with initialize_config_dir(str(conf_directory()), version_base="1.3"):
        context = Context.of(build(compose("config", overrides)))
    usual = context.experiment.loop.outer.images_per_object
    grid = dict.fromkeys([(count, usual) for count in arguments.objects] + [(6, n) for n in arguments.images])
    print(
        f"{'objects':>7}{'images':>7}"
        + "".join(f"{phase:>11}" for phase in PHASES)
        + f"{'all':>8}{'steps':>7}"
    )
    rows = []
    for count, images in grid:
        forget_peak(context.graph.device)
        module = loop(context, count, images)
        row = {"objects": count, "images": images, **measure(module, arguments.repeats)}
        row["steps"] = module.records[-1].products
        row |= gpu(context.graph.device)
        rows.append(row)
        shown = "".join(f"{row[phase]:11.2f}" for phase in PHASES)
        print(f"{count:7}{images:7}{shown}{row['seconds']:8.2f}{row['steps']:7}", flush=True)
    slopes = {}
    for size, held in (("objects", ("images", usual)), ("images", ("objects", 6))):
        chosen = [row for row in rows if row[held[0]] == held[1]]
        if len(chosen) > 1:
            slopes[size] = {"all": exponent(chosen, size), "largest two": last_exponent(chosen, size)}
            print(f"seconds grow with {size} to the power {slopes[size]['all']:.2f}, "
                  f"{slopes[size]['largest two']:.2f} between the largest two")  # fmt: skip
    result = {
        "machine": machine(context.graph.device),
        "overrides": arguments.overrides,
        "exponents": slopes,
        "rows": rows,
    }
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
