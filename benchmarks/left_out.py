"""What each omission saves, and the error that it costs: `python benchmarks/left_out.py`.

Everything that `results.json` lists under `left_out` and that is no mere look-up, undone one at a time on `pose_gap` at
`scale=quick`: in fitting a field, in rendering it, in one hypergradient. Errors of images are against a render with
nothing left out, of fields the held-out PSNR, of hypergradients |g - g_all| beside the probes' standard error |s|.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import logging
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from render import measure as measure_render
from render import variants
from tolerance import State, shortened, state
from torch import Tensor

from neural_sim.field.pool import build_pool
from neural_sim.gradient.mixed import scores
from neural_sim.main import build, conf_directory
from neural_sim.outer.probing import ProbeSet
from neural_sim.report.machine import machine
from neural_sim.solver.flatten import unflatten
from neural_sim.solver.hvp import HessianOperator
from neural_sim.stages.context import Context
from neural_sim.stages.field import FieldStage
from neural_sim.synthesis.pool import ImagePool

Row = dict[str, Any]


def clocked(work: Callable[[], Any], repeats: int = 3) -> tuple[float, Any]:
    """Median seconds, and the last result."""
    spent, found = [], None
    for _ in range(repeats):
        begun = time.perf_counter()
        found = work()
        spent.append(time.perf_counter() - begun)
    return statistics.median(spent), found


def field_of(context: Context, name: str) -> FieldStage:
    """The stage of one object's field."""
    return next(stage for stage in context.graph.fields if stage.views.object == name)


def fields(context: Context, name: str) -> list[Row]:
    """A field of one object as configured, with rays from every pixel, and with a colour head that sees directions."""
    stage, device = field_of(context, name), torch.device("cpu")
    views, recipe, held_out = context.results(stage.views), stage.recipe, stage.views.held_out

    def fit(changed: Any) -> dict[str, float]:
        return changed.fit(views, held_out, device)[1][-1]

    def with_head() -> Any:
        field = recipe.field()
        return type(field)(**{**field.settings(), "features": 8, "head_width": 16})

    plain = fit(recipe)
    headed = fit(dataclasses.replace(recipe, field=with_head))
    generator = torch.Generator().manual_seed(0)
    near, every = (len(build_pool(views, border, generator)) for border in (2, None))
    return [
        {"omission": "as configured", "seconds": plain["seconds"], "error": f"{plain['psnr']:.2f} dB"},
        {"omission": "view-dependent colour, undone", "seconds": headed["seconds"],
         "error": f"{headed['psnr']:.2f} dB"},
        {"omission": "rays far from silhouettes", "fraction": 1.0 - near / every, "error": "none"},
    ]  # fmt: skip


def renders(context: Context, name: str) -> list[Row]:
    """The final quality with each omission undone, and the lower qualities."""
    stage = field_of(context, name)
    field, views = context.results(stage).field, context.results(stage.views)
    rows = []
    for label, renderer in variants(["final", "normal", "draft"], True).items():
        found = measure_render(field, renderer, views, context.experiment.training.image_size, 3)
        error = f"opacity {found['opacity_error']:.1e}, colour {found['colour_psnr']:.1f} dB"
        rows.append({"omission": label, "seconds": found["milliseconds"] / 1e3, "error": error})
    return rows


def loops(context: Context) -> list[Row]:
    """One hypergradient with each omission of the loop put in, against one without any."""
    at, outer, random = (
        state(context, "initial", 0),
        context.experiment.loop.outer,
        torch.Generator().manual_seed(1),
    )
    damping = context.experiment.loop.solver.damping
    count = len(at.inner.weights)

    def solve(subset: Tensor | None, residual: float) -> tuple[float, Tensor]:
        """Seconds of the products that the solve needs, and its solution."""
        operator = HessianOperator(at.inner.terms(subset), at.inner.params, retain_graph=True)
        value, space = damping.choose(operator, at.b, random).value, at.krylov(subset, 40)
        for steps in range(2, 40):
            search = shortened(space, steps).search(value)
            if search is not None and float(search.residual.norm() / at.b.norm()) <= residual:
                return steps * clocked(lambda: operator(at.b))[0], search.value
        raise ValueError(f"left_out: 40 products do not reach a residual of {residual}")

    whole, v = solve(None, 1e-3)
    truth, error = at.derivative(v)
    few = torch.randperm(count, generator=random)[: outer.curvature_images]
    part, v_few = solve(few, 1e-3)
    early, v_early = solve(None, context.experiment.loop.solver.rtol)
    rows = [
        {"omission": "nothing", "seconds": whole, "error": "0"},
        {"omission": f"{count - len(few)} of {count} curvature images", "seconds": part,
         "error": beside(at.derivative(v_few)[0], truth, error)},
        {"omission": f"products beyond a residual of {context.experiment.loop.solver.rtol:g}", "seconds": early,
         "error": beside(at.derivative(v_early)[0], truth, error)},
    ]  # fmt: skip
    return rows + probes(context, at, v, truth, error)


def probes(context: Context, at: State, v: Tensor, truth: Tensor, error: Tensor) -> list[Row]:
    """Scores by central differences, and probes from a pool of rendered bins in place of fresh renders."""
    per_bin, vector = context.experiment.loop.gradient.probes_per_bin, unflatten(v, at.inner.params)
    index = torch.cat([probe.index for held in at.probed.probes for probe in held.values()])
    rows = []
    for mode in ("forward", "central_difference"):
        spent, found = clocked(
            lambda mode=mode: scores(at.probed.cached.losses, at.inner.params, vector, index, 64, mode)
        )
        rows.append((spent, found))
    relative = float((rows[1][1] - rows[0][1]).norm() / rows[0][1].norm())
    pool_seconds, pool = clocked(
        lambda: ImagePool.render(
            context.results(context.graph.scene),
            context.experiment.loop.outer.pool_per_bin,
            torch.Generator().manual_seed(2),
        ),
        1,
    )
    loop = at.loop
    fresh, _ = clocked(lambda: loop.probes(per_bin, torch.Generator().manual_seed(3)), 1)
    pooled, held = clocked(
        lambda: ProbeSet.draw(
            context.results(context.graph.scene), loop.detector, loop.backbone, per_bin, loop.psi,
            torch.Generator().manual_seed(3), range(len(context.graph.names)), pool,
        ), 1,
    )  # fmt: skip
    changed = dataclasses.replace(at, probed=held)
    moved, own = changed.derivative(v)
    both = (error.square() + own.square()).sqrt()
    return [
        {"omission": "forward-mode scores", "seconds": rows[0][0], "error": "0"},
        {"omission": "for central differences", "seconds": rows[1][0], "error": f"{relative:.0e} of the scores"},
        {"omission": f"fresh renders of probes (pool: {pool_seconds:.1f} s once)", "seconds": pooled,
         "error": f"{beside(moved, truth, both)} of both; fresh take {fresh:.2f} s"},
    ]  # fmt: skip


def beside(found: Tensor, truth: Tensor, error: Tensor) -> str:
    """|g - g_all| by |s|."""
    return f"{float((found - truth).norm() / error.norm()):.2f} standard errors"


def table(title: str, rows: list[Row]) -> str:
    lines = [f"{title:<58}{'seconds':>9}  error"]
    for row in rows:
        spent = f"{row['seconds']:9.3f}" if "seconds" in row else f"{row['fraction']:8.0%} "
        lines.append(f"  {row['omission']:<56}{spent}  {row['error']}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("overrides", nargs="*", help="configuration keys, as on the command line of a run")
    parser.add_argument("--name", default="pitcher", help="the object whose field is fitted and rendered")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("outputs/benchmarks/left_out.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    with initialize_config_dir(str(conf_directory()), version_base="1.3"):
        overrides = ["+experiment=pose_gap", "scale=quick", "progress=false", *arguments.overrides]
        context = Context.of(build(compose("config", overrides)))
    parts = {
        "one field": fields(context, arguments.name),
        "an image": renders(context, arguments.name),
        "one hypergradient": loops(context),
    }
    for title, rows in parts.items():
        print(table(title, rows), flush=True)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps({"machine": machine(), "parts": parts}, indent=2))


if __name__ == "__main__":
    main()
