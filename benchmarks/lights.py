"""Which way an illumination should move: by blends of light in every image, by proportions of images, and in truth.

`python benchmarks/lights.py` writes docs/numerics.md. `+experiment=illumination_gap scale=quick`: on the way from the
initial to the target weights, a detector is trained as the psi loop trains it; its validation loss is the truth.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_dir

from neural_sim.detector.cached import CachedSet
from neural_sim.documents import replace_section
from neural_sim.gradient.base import MixedDerivative
from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.main import build, conf_directory
from neural_sim.outer.inner import InnerLoop
from neural_sim.report.provenance import machine
from neural_sim.studies.frozen import FrozenLoop, State
from neural_sim.tasks.context import Context

WAY = (0.0, 0.2, 0.4, 0.7, 1.0)


def at(context: Context, part: float, seeds: int, per_light: int) -> dict[str, Any]:
    """Validation loss at a point of the way, and its slopes along the way as both derivatives predict them."""
    start, target = context.graph.psi("initial"), context.graph.psi("target")
    psi, way = torch.lerp(start, target, part), target - start
    x, graph, results, rows = context.experiment, context.graph, context.results, []
    scene, detector = results(graph.scene), graph.warm_start.build()
    warm_start, validation = results(graph.warm_start).params, results(graph.targets).val
    for seed in range(seeds):
        generator = torch.Generator().manual_seed(seed)
        inner = InnerLoop(scene, detector, warm_start, validation, x.loop.outer, x.training, generator)
        images = inner.draw(psi).images
        inner.train(CachedSet.of(inner.detector, inner.backbone, images))
        state = State(scene, inner.detector, inner.theta, psi)
        loop = FrozenLoop.at(state, images, validation, x.loop.solver, generator)
        blends = loop.pathwise(PathwiseEstimator(), x.loop.outer.images_per_object, generator)
        proportions = loop.truth(per_light, generator)
        rows.append([inner.validation_loss(), *predicted(blends, way), *predicted(proportions, way)])
    table = torch.tensor(rows)
    spread = table.std(0) if seeds > 1 else torch.full_like(table[0], math.nan)
    keys = ("loss", "blend", "blend_error", "proportion", "proportion_error")
    return {"part": part, "loss_error": float(spread[0]) / math.sqrt(seeds)} | dict(
        zip(keys, table.mean(0).tolist(), strict=True)
    )


def predicted(found: list[MixedDerivative], way: torch.Tensor) -> tuple[float, float]:
    """dL_val along the way: minus the objects' derivatives, each object's images being one part of the training set."""
    slopes = [-float(part.value.double() @ way[label]) for label, part in enumerate(found)]
    errors = [float((part.standard_error.double() * way[label]).norm()) for label, part in enumerate(found)]
    return sum(slopes) / len(found), math.hypot(*errors) / len(found)


INTRODUCTION = """    python benchmarks/lights.py --seeds {seeds} --per-light {per_light}

`illumination_gap` at `scale=quick`: the biased objects' weights are interpolated between the initial lights (0) and
the target's (1). Columns: validation loss of the detector trained there, mean of {seeds}; its slope along the whole
segment, as predicted by the derivative by the blend of lights in every image (`gradient=pathwise`), and by the
derivative by the proportions of images under each light (`gradient=stratified`, {per_light} scenes under all six).

| interpolation | validation loss | predicted by blends | by proportions |
|---|---|---|---|
"""


def report(rows: list[dict[str, Any]], seeds: int, per_light: int) -> str:
    return INTRODUCTION.format(seeds=seeds, per_light=per_light) + "\n".join(
        f"| {row['part']:g} | {row['loss']:.3f} ± {row['loss_error']:.3f} "
        f"| {row['blend']:+.3f} ± {row['blend_error']:.3f} | {row['proportion']:+.3f} ± {row['proportion_error']:.3f} |"
        for row in rows
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("overrides", nargs="*", help="configuration keys, as on the command line of a run")
    parser.add_argument("--seeds", type=int, default=3, help="detectors trained at each point")
    parser.add_argument("--per-light", type=int, default=24)
    parser.add_argument("--docs", type=Path, default=Path("docs/numerics.md"))
    parser.add_argument("--json", type=Path, default=Path("outputs/benchmarks/lights.json"))
    arguments = parser.parse_args()
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    with initialize_config_dir(str(conf_directory()), version_base="1.3"):
        overrides = ["+experiment=illumination_gap", "scale=quick", "progress=false", *arguments.overrides]
        context = Context.of(build(compose("config", overrides)))
    rows = [at(context, part, arguments.seeds, arguments.per_light) for part in WAY]
    found = {"machine": machine(), "seeds": arguments.seeds, "rows": rows}
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    arguments.json.write_text(json.dumps(found, indent=1))
    print(text := report(rows, arguments.seeds, arguments.per_light))
    replace_section(arguments.docs, "Lights", text)


if __name__ == "__main__":
    main()
