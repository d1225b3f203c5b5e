"""What derivatives foretell, against what training does: where psi loops start, after a first step, where they end.

`python benchmarks/foretold.py` runs the loops and writes docs/numerics.md. At each psi it takes the response
of training (`outer.response`) and three derivatives, all under the same random numbers, several times over.
"""

from __future__ import annotations

import argparse
import copy
import json
import logging
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from foretold_report import SEEDS, WAYS, report
from hydra import compose, initialize_config_dir
from jaxtyping import Float
from torch import Tensor

from neural_sim.documents import replace_section
from neural_sim.main import build, conf_directory
from neural_sim.outer.module import SimulatorModule
from neural_sim.outer.response import centred_cosine, response
from neural_sim.report.provenance import machine
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.tasks.context import Context

Measured = dict[str, Float[Tensor, "objects K"]]


def context_of(overrides: list[str]) -> Context:
    with initialize_config_dir(str(conf_directory()), version_base="1.3"):
        return Context.of(build(compose("config", ["progress=false", *overrides])))


def visited(trajectory: Float[Tensor, "n objects K"]) -> dict[str, Float[Tensor, "objects K"]]:
    """Where a loop started, was after its first step, and ended. No step: the start alone."""
    moved = [psi for psi in trajectory if not torch.equal(psi, trajectory[0])]
    places = {"after one step": moved[0], "end": trajectory[-1]} if moved else {}
    return {"start": trajectory[0], **places}


def measured(
    context: Context, psi: Float[Tensor, "objects K"], seed: int, first_order: AdjointSolver
) -> Measured:
    """By ``response`` and each of ``WAYS``: the rise of an object's score, or of L_val with the other sign, by the
    part of its images that moves to each bin.
    """
    stage = replace(context.graph.learned, initial=psi, seed=seed)
    loop = stage.loop(context.results)
    if not isinstance(loop, SimulatorModule):
        raise ValueError("foretold: wants a method that follows the hypergradient")
    distribution = context.experiment.imaging.distribution
    parts = distribution.split(psi)
    scale = distribution.join({f.name: f.log_slopes(parts[f.name]).exp() for f in distribution.factors})
    found = {"response": response(loop.inner, psi).value}
    own = loop.inner.settings
    exact, implicit = (
        replace(own, unrolled=replace(own.unrolled, floor=0.0)),
        replace(own, adjoint="implicit"),
    )
    settings, solvers = (own, exact, implicit, implicit), (loop.solver, loop.solver, loop.solver, first_order)
    for way, how, solver in zip(WAYS, settings, solvers, strict=True):
        inner = copy.copy(loop.inner)
        inner.settings = how
        loop = SimulatorModule(inner, psi, loop.estimator, solver)
        slopes = loop.derivative().psi_gradients
        found[way] = -torch.stack([slopes[name] for name in loop.scene.names]) / scale
    return found


def correlations(repeats: list[Measured], label: int) -> dict[str, float]:
    """Over one object's bins: of the response and of the unrolled derivative under two seeds, and of each way with the
    response of its own seed.
    """
    rows = [{way: values[label] for way, values in held.items()} for held in repeats]

    def between_seeds(way: str) -> float:
        return fmean(centred_cosine(a[way], b[way]) for a, b in combinations(rows, 2))

    return {"two seeds": between_seeds("response"), SEEDS: between_seeds(WAYS[0])} | {
        way: fmean(centred_cosine(row[way], row["response"]) for row in rows) for way in WAYS
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("overrides", nargs="*", help="configuration keys, as on the command line of a run")
    parser.add_argument("--experiments", nargs="+", default=["pose_gap", "multi_modal"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[100, 101, 102, 103])
    parser.add_argument("--repeats", type=int, default=2, help="seeds of the trainings at each psi")
    parser.add_argument("--docs", type=Path, default=Path("docs/numerics.md"))
    parser.add_argument("--json", type=Path, default=Path("outputs/benchmarks/foretold.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    rows: list[dict[str, Any]] = []
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    for experiment in arguments.experiments:
        for seed in arguments.seeds:
            overrides = [*arguments.overrides, f"+experiment={experiment}", f"seed={seed}"]
            context = context_of(overrides)
            first_order = context_of([*overrides, "solver=identity"]).experiment.loop.solver
            names, biased = context.graph.names, context.experiment.imaging.distribution.biased
            for place, psi in visited(context.results(context.graph.learned).trajectory).items():
                repeats = [
                    measured(context, psi, 1000 * seed + repeat, first_order)
                    for repeat in range(arguments.repeats)
                ]
                for name in biased:
                    found = correlations(repeats, names.index(name))
                    rows.append(
                        {"experiment": experiment, "seed": seed, "place": place, "object": name, **found}
                    )
                    print(rows[-1], flush=True)
            arguments.json.write_text(json.dumps({"machine": machine(), "rows": rows}, indent=1))
    replace_section(arguments.docs, "Foretold", report(rows, vars(arguments)))


if __name__ == "__main__":
    main()
