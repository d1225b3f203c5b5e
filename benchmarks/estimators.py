"""Estimators of the hypergradient's mixed term against two truths: cosine, error, spread and seconds by images.

    python benchmarks/estimators.py --ycb ../shared/ycb

Two embedded objects, and with `--ycb` two YCB objects, at the disjoint start of `pose_gap`: a detector warm-started
there, v solved by the default solver, and everything drawn through the psi loop's own scene and binding. Prints tables,
writes all numbers to outputs/benchmarks/estimators.json and the section "Estimators" of docs/numerics.md. The worlds'
settings can be overridden as on the command line: `training.image_size=96`.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import logging
import time
from pathlib import Path
from typing import Any

import torch
from estimator_runs import (  # the modules beside this one
    COUNTS,
    PATHWISE,
    RELAXED,
    UNIT,
    Result,
    pathwise_result,
    run_pathwise,
    run_reinforce,
    run_stratified,
)
from jaxtyping import Float
from torch import Tensor
from worlds import WORLDS, Truth, hard_truth, make_world

from neural_sim.cameras import orbit
from neural_sim.gradient.pathwise import contract, draw_cotangents
from neural_sim.outer.frozen import FrozenLoop
from neural_sim.report.machine import machine
from neural_sim.report.section import replace_section
from neural_sim.synthesis.motion import pose_rates
from neural_sim.types import Maps, PinholeCamera


def compare(name: str, world: FrozenLoop, repeats: int, truth_images: int) -> dict[str, Any]:
    """Every estimator on one world, with both truths."""
    hard = hard_truth(world, truth_images // world.scene.distribution.size, seed=21)
    base = PATHWISE[RELAXED]
    found, _ = run_pathwise(base.of(world), base.estimator, truth_images // UNIT, seed=22)
    relaxed = Truth(found.mean(0), found.std(0) / len(found) ** 0.5)
    results: dict[str, Result] = {}
    for label, variant in PATHWISE.items():
        # Equal seeds: variants that draw alike see the same images. Reverse mode's numbers are the linear row's.
        rounds = 1 if variant.estimator.mode == "reverse" else repeats
        units = rounds * COUNTS[-1] // UNIT
        found, seconds = run_pathwise(variant.of(world), variant.estimator, units, seed=100)
        results[f"pathwise: {label}"] = pathwise_result(found, seconds)
        print(f"{name}: {label}, {seconds * 1e3:.1f} ms an image", flush=True)
    results |= run_stratified(world, repeats * COUNTS[-1] // world.scene.distribution.size)
    results["reinforce"] = run_reinforce(world, repeats * COUNTS[-1])
    truths = {"hard": hard, "relaxed": relaxed}
    p = world.scene.distribution.probabilities(world.psi)["pose"].float()
    rows = [summary(label, result, count, truths, p) for label, result in results.items() for count in COUNTS]
    return {
        "world": name,
        "objects": list(world.scene.names),
        "solve": world.solve,
        "ceiling": {which: truth.ceiling for which, truth in truths.items()},
        "agreement": cosine(hard.value, relaxed.value).tolist(),
        "truths": {which: truth.value.tolist() for which, truth in truths.items()},
        "rows": rows,
    }


def cosine(a: Tensor, b: Tensor) -> Tensor:
    """Along the last axis; 0 where an estimate is nothing at all."""
    return torch.nn.functional.cosine_similarity(a, b, dim=-1, eps=1e-30)


def summary(
    name: str, result: Result, count: int, truths: dict[str, Truth], p: Float[Tensor, "objects k"]
) -> dict[str, Any]:
    """Mean over repeats and objects; the standard deviation is over repeats, pooled over objects.

    ``cosine_in_p`` compares derivatives by p, which mirror descent follows: those by the logits over p, centred.
    """
    found = result.estimates[count]
    row: dict[str, Any] = {
        "estimator": name, "images": count, "repeats": len(found), "seconds": result.seconds[count],
    }  # fmt: skip
    for which, truth in truths.items():
        near = cosine(found, truth.value)
        row[which] = {
            "cosine": float(near.mean()),
            "cosine_in_p": float(cosine(_by_p(found, p), _by_p(truth.value, p)).mean()),
            "std": float(near.var(0).mean().sqrt()) if len(found) > 1 else None,
            "cosine_by_object": near.mean(0).tolist(),
            "error": float(((found - truth.value).norm(dim=-1) / truth.value.norm(dim=-1)).mean()),
        }
    return row


def _by_p(derivative: Tensor, p: Tensor) -> Tensor:
    ratio = derivative / p
    return ratio - ratio.mean(-1, keepdim=True)


def compare_modes(world: FrozenLoop, size: int = 96, count: int = 8) -> list[dict[str, float | str]]:
    """Seconds an image of the render and its derivative by one number of V, and how far the modes are apart."""
    scene = dataclasses.replace(
        world.scene, camera=PinholeCamera(size, size, world.scene.camera.field_of_view)
    )
    generator = torch.Generator().manual_seed(51)
    draw = scene.distribution.hard(world.psi[0].float(), scene.distribution.draw_noise(count, generator))
    cotangents = Maps(
        torch.randn(count, size, size, 3, generator=generator),
        torch.randn(count, size, size, generator=generator),
    )
    poses = orbit(draw.phi, draw.rho, draw.distance)

    def render() -> dict[str, Tensor]:
        scene.renderer.render(scene.fields[0], scene.camera, poses)
        return {}

    def forward() -> dict[str, Tensor]:
        rates = pose_rates(draw, ("phi",))
        _, moved = scene.renderer.render_with_tangents(scene.fields[0], scene.camera, poses, rates)
        return contract({"phi": moved[0]}, cotangents)

    def reverse(patch: int) -> dict[str, Tensor]:
        render()
        return draw_cotangents(
            lambda rays: scene.renderer.render_rays(scene.fields[0], rays),
            scene.camera,
            draw,
            cotangents,
            patch,
        )

    runs = {"render alone": render, "forward": forward}
    for patch in (64, 512, 4096, count * size**2):
        name = "whole" if patch == count * size**2 else f"patches of {patch} rays"
        runs[f"reverse, {name}"] = lambda patch=patch: reverse(patch)
    rows, found = [], {}
    for name, run in runs.items():
        times = []
        for _ in range(2):
            began = time.process_time()
            found[name] = run()
            times.append(time.process_time() - began)
        row: dict[str, float | str] = {"mode": name, "seconds": min(times) / count}
        if "phi" in found[name]:
            here, reference = found[name]["phi"], found["forward"]["phi"]
            row["difference"] = float((here - reference).norm() / reference.norm())
        rows.append(row)
    return rows


DEFINITIONS = """\
Each estimator gives d/dpsi <dL_train/dtheta, v> of one object's psi from N images, at the disjoint start of
`pose_gap` (0.86 on a bin that has 0.02 in the target), for v solved at a warm-started detector. Derivatives by
centred logits are compared with two references, called truths.

- *Hard*: the derivative over hard bins, g_i = p_i (s_i - sum_j p_j s_j) up to the floor's factor, s_b the mean score
  <dl/dtheta, v> of {per_bin} images of bin b. This is the derivative of the distribution that training images are
  drawn from.
- *Relaxed*: the mean over {truth_images} relaxed draws of the pathwise derivative, circular bin mean, boxes moving with
  the object. This is the derivative of the training loss of relaxed draws, at tau = {temperature}.

Both are estimates; *ceiling* is the expected cosine of the exact vector with each of them. *Cosine* is
the mean over repeats and the two objects, with the standard deviation over repeats (pooled over objects; {repeats}
repeats at N = 128, twice as many at each half; one of the paper's row, whose numbers are those of the linear row).
*In p* is the cosine with the hard truth of derivatives by p, which mirror descent follows. Error is
|g - hard| / |hard|. Seconds are one object's, of CPU time: drawing, rendering and the estimate ({threads} thread of
{cores} cores, load {load:.1f}). Seconds to 0.7: at the smallest N of the table whose mean cosine with the hard truth
reaches that. Below *circular, boxes* each pathwise row changes one setting of it. *Shrunk* is stratified with each
component times max(0, 1 - noise / square), as in the psi update."""


def markdown(worlds: list[dict[str, Any]], modes: list[dict[str, Any]], settings: dict[str, Any]) -> str:
    """The section of docs/numerics.md."""
    parts = [f"    {settings['command']}", DEFINITIONS.format(**settings)]
    for world in worlds:
        parts.append(_world_table(world))
        parts.append(_verdict(world, settings["truth_images"]))
    rows = [
        f"| {row['mode']} | {1e3 * row['seconds']:.0f} | {row['difference']:.0e} |"
        if "difference" in row
        else f"| {row['mode']} | {1e3 * row['seconds']:.0f} | |"
        for row in modes
    ]
    parts.append(
        "Forward against reverse mode, one number of V, 96 px, float32: milliseconds (CPU time) per image of "
        "rendering and of the derivative's contraction with a given cotangent, and the difference from forward mode "
        "(rounding; float64 is tested to 1e-8).\n\n| | ms | relative difference |\n|---|---|---|\n"
        + "\n".join(rows)
    )
    return "\n\n".join(parts)


def _world_table(world: dict[str, Any]) -> str:
    names = list(dict.fromkeys(row["estimator"] for row in world["rows"]))
    columns = [f"hard, N = {n}" for n in COUNTS] + [f"relaxed, N = {n}" for n in (16, 128)]
    columns += ["in p, N = 64", "error, N = 64", "s, N = 64", "s to 0.7"]
    lines = ["| estimator | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    for name in names:
        rows = {row["images"]: row for row in world["rows"] if row["estimator"] == name}
        reached = [row["seconds"] for row in rows.values() if row["hard"]["cosine"] >= 0.7]
        cells = [_cell(rows[n]["hard"]) for n in COUNTS] + [_cell(rows[n]["relaxed"]) for n in (16, 128)]
        cells += [f"{rows[64]['hard'][key]:.2f}" for key in ("cosine_in_p", "error")]
        cells += [f"{rows[64]['seconds']:.2f}", f"{reached[0]:.2f}" if reached else "not by 128"]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    ceilings = {which: ", ".join(f"{c:.2f}" for c in found) for which, found in world["ceiling"].items()}
    agreement = ", ".join(f"{c:.2f}" for c in world["agreement"])
    return (
        f"**{world['world']}** ({', '.join(world['objects'])}; v {world['solve']}). Ceilings: hard {ceilings['hard']}, "
        f"relaxed {ceilings['relaxed']}; cosine of the two truths: {agreement}.\n\n" + "\n".join(lines)
    )


def _verdict(world: dict[str, Any], truth_images: int) -> str:
    """Who is first at 64 images, and whether the truths can tell."""
    rows = [row for row in world["rows"] if row["images"] == 64]
    first = {
        "in logits": max(rows, key=lambda row: row["hard"]["cosine"]),
        "in p": max(rows, key=lambda row: row["hard"]["cosine_in_p"]),
        "by error": min(rows, key=lambda row: row["hard"]["error"]),
    }
    text = "First at N = 64 against the hard truth: " + ", ".join(
        f"{how} {row['estimator']}" for how, row in first.items()
    )
    weak = [which for which, ceilings in world["ceiling"].items() if min(ceilings) < 0.8]
    if weak:
        text += (
            f". {truth_images} images are too few for the {' and the '.join(weak)} truth of every object (ceiling "
            "below 0.8), so cosines with it are uncertain"
        )
    return text + "."


def _cell(held: dict[str, Any]) -> str:
    spread = "" if held["std"] is None else f" ± {held['std']:.2f}"
    return f"{held['cosine']:.2f}{spread}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--ycb", help="a folder in the YCB layout: adds the world of two YCB objects")
    parser.add_argument("--repeats", type=int, default=2, help="at 128 images")
    parser.add_argument("--truth-images", type=int, default=1024, help="an object, for each truth")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("outputs/benchmarks/estimators.json"))
    parser.add_argument("--docs", type=Path, default=Path("docs/numerics.md"))
    parser.add_argument("overrides", nargs="*", help="settings of the worlds, as on the command line")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    asked = {"embedded": WORLDS["embedded"]}
    if arguments.ycb:
        asked["ycb"] = [*WORLDS["ycb"], f"objects.root={arguments.ycb}"]
    began = time.perf_counter()
    worlds = {name: make_world([*overrides, *arguments.overrides]) for name, overrides in asked.items()}
    modes = compare_modes(worlds["embedded"])
    found = [
        compare(name, world, arguments.repeats, arguments.truth_images) for name, world in worlds.items()
    ]
    settings = machine() | {
        "command": " ".join(
            ["python benchmarks/estimators.py", *(["--ycb ../shared/ycb"] if arguments.ycb else [])]
        ),
        "per_bin": arguments.truth_images // worlds["embedded"].bins.bins,
        "truth_images": arguments.truth_images,
        "temperature": worlds["embedded"].bins.temperature,
        "repeats": arguments.repeats,
        "total_seconds": time.perf_counter() - began,
    }
    text = markdown(found, modes, settings)
    print(text)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps({"settings": settings, "modes": modes, "worlds": found}, indent=2))
    replace_section(arguments.docs, "Estimators", text)


if __name__ == "__main__":
    main()
