"""What an early end of the adjoint solve and fewer curvature images cost the hypergradient, beside its own noise.

`python benchmarks/tolerance.py` writes docs/numerics.md. `+experiment=pose_gap scale=quick`: pyramid and head freshly
trained on images from the initial and from the target distribution. The objects' derivatives form one vector.
"""

from __future__ import annotations

import argparse
import json
import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from jaxtyping import Float
from torch import Tensor

from neural_sim.detector.cached import CachedSet
from neural_sim.detector.training import train_detector
from neural_sim.gradient.hypergradient import InnerProblem
from neural_sim.main import build, conf_directory
from neural_sim.outer.frozen import FrozenLoop
from neural_sim.outer.probing import ProbeSet
from neural_sim.report.machine import machine
from neural_sim.report.section import replace_section
from neural_sim.solver.flatten import unflatten
from neural_sim.solver.hvp import HessianOperator, gradient
from neural_sim.solver.lanczos import Krylov, lanczos
from neural_sim.stages.context import Context

STEPS = (4, 6, 8, 10, 12, 14, 16, 18, 20, 24, 30)
SUBSETS = (16, 32, 64, 128)


@dataclass(frozen=True)
class State:
    """A trained detector with its inner problem, its validation gradient b, and the probes that score any v."""

    inner: InnerProblem
    b: Float[Tensor, "m"]
    loop: FrozenLoop
    probed: ProbeSet

    def derivative(self, v: Float[Tensor, "m"]) -> tuple[Float[Tensor, "p"], Float[Tensor, "p"]]:
        """d/dpsi <dL_train/dtheta, v> of all objects, and its standard errors over probes."""
        held = replace(self.loop, vector=unflatten(v, self.inner.params))
        found = held.over_strata(self.probed)
        return torch.cat([part.value for part in found]), torch.cat([part.standard_error for part in found])

    def krylov(self, subset: Tensor | None, steps: int) -> Krylov:
        operator = HessianOperator(self.inner.terms(subset), self.inner.params, retain_graph=True)
        found = lanczos(operator, self.b, steps).krylov
        if found is None:
            raise ValueError("tolerance: the Hessian is not finite")
        return found


def state(context: Context, which: str, seed: int) -> State:
    generator = torch.Generator().manual_seed(seed)
    outer, training, detector, psi = (
        context.experiment.loop.outer,
        context.experiment.training,
        context.graph.warm_start.build(),
        context.graph.psi(which),
    )
    backbone = detector.split(context.results(context.graph.warm_start).params)[0]
    cached = CachedSet.of(
        detector,
        backbone,
        context.results(context.graph.scene).training_set(psi, outer.images_per_object, generator).images,
    )
    theta, _ = train_detector(
        detector, {**detector.init(generator), **backbone}, cached, generator,
        replace(training.of(outer.epochs), learning_rate=outer.learning_rate),
    )  # fmt: skip
    trainable = detector.split(theta)[1]
    validation = CachedSet.of(detector, backbone, context.results(context.graph.targets).val)
    loop = FrozenLoop(
        context.results(context.graph.scene), detector, backbone, trainable, {}, psi, "not solved"
    )
    probed = loop.probes(context.experiment.loop.gradient.probes_per_bin, generator)
    inner = InnerProblem(trainable, cached.losses, torch.full((len(cached),), 1.0 / len(cached)))
    return State(inner, gradient(validation.mean_terms(), trainable), loop, probed)


def shortened(krylov: Krylov, steps: int) -> Krylov:
    """The space that as many products would have searched."""
    beyond = krylov.basis[steps] * krylov.tridiagonal[steps - 1, steps].to(krylov.basis)
    return Krylov(krylov.basis[:steps], krylov.tridiagonal[:steps, :steps], krylov.size, beyond)


def compare(at: State, v: Tensor, truth: Tensor) -> dict[str, float]:
    found, error = at.derivative(v)
    return {
        "error": float((found - truth).norm() / truth.norm()),
        "of s.e.": float((found - truth).norm() / error.norm()),
        "cosine": float(found @ truth / found.norm() / truth.norm()),
    }


def measure(context: Context, which: str, seeds: int) -> dict[str, Any]:
    at = state(context, which, 0)
    damping, random = context.experiment.loop.solver.damping, torch.Generator().manual_seed(1)
    whole = at.krylov(None, 40)

    def damped(subset: Tensor | None) -> float:
        terms = at.inner.terms(subset)
        operator = HessianOperator(terms, at.inner.params, retain_graph=True)
        return damping.choose(operator, at.b, random).value

    value = damped(None)
    truth, error = at.derivative(whole.search(value).value)  # pyright: ignore[reportOptionalMemberAccess]
    steps = []
    for count in STEPS:
        search = shortened(whole, count).search(value)
        if search is not None:
            residual = float(search.residual.norm() / at.b.norm())
            steps.append({"products": count, "residual": residual, **compare(at, search.value, truth)})
    subsets = []
    for count in SUBSETS:
        for _ in range(seeds):
            subset = torch.randperm(len(at.inner.weights), generator=random)[:count]
            search = at.krylov(subset, 20).search(damped(subset))
            if search is not None:
                subsets.append({"images": count, **compare(at, search.value, truth)})
    return {
        "distribution": which, "damping": value, "noise": float(error.norm() / truth.norm()),
        "images": len(at.inner.weights), "steps": steps, "subsets": subsets,
    }  # fmt: skip


INTRODUCTION = """    python benchmarks/tolerance.py

The loop of `scale=quick` (`detector=tiny`, six objects, 96 px, stratified), pyramid and head trained anew. The
hypergradient after m products of the damped solve on all training images, against 40 products at the same
lambda: its error relative to itself (*error*) and to its standard error over the probes (*of s.e.*). Below, the
curvature of a random part of the training images, 20 products, each part with a lambda of its own: mean (worst)."""
COLUMNS = {"residual": ".0e", "error": ".3f", "of s.e.": ".2f", "cosine": ".4f"}


def row(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def report(found: dict[str, Any]) -> str:
    lines = [INTRODUCTION]
    for part in found["states"]:
        lines += [
            "",
            f"Images from the {part['distribution']} distribution, lambda {part['damping']:.2g}; the standard error is "
            f"{part['noise']:.0%} of the hypergradient.",
            "",
            row(["products", *(str(one["products"]) for one in part["steps"])]),
            "|---" * (len(part["steps"]) + 1) + "|",
        ]
        lines += [
            row([key, *(format(one[key], form) for one in part["steps"])]) for key, form in COLUMNS.items()
        ]
        lines += ["", row([f"of {part['images']} images", "error", "of s.e.", "cosine"]), "|---|---|---|---|"]
        for count in sorted({one["images"] for one in part["subsets"]}):
            chosen = [one for one in part["subsets"] if one["images"] == count]
            cells = [str(count)]
            for key, worst in (("error", max), ("of s.e.", max), ("cosine", min)):
                values = [one[key] for one in chosen]
                cells.append(f"{sum(values) / len(values):.3f} ({worst(values):.3f})")
            lines.append(row(cells))
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("overrides", nargs="*", help="configuration keys, as on the command line of a run")
    parser.add_argument(
        "--seeds", type=int, default=4, help="random parts of the training images of each size"
    )
    parser.add_argument("--docs", type=Path, default=Path("docs/numerics.md"))
    parser.add_argument("--json", type=Path, default=Path("outputs/benchmarks/tolerance.json"))
    arguments = parser.parse_args()
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    with initialize_config_dir(str(conf_directory()), version_base="1.3"):
        overrides = ["+experiment=pose_gap", "scale=quick", "progress=false", *arguments.overrides]
        context = Context.of(build(compose("config", overrides)))
    states = [measure(context, which, arguments.seeds) for which in ("initial", "target")]
    found = {"machine": machine(), "seeds": arguments.seeds, "states": states}
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    arguments.json.write_text(json.dumps(found, indent=1))
    print(text := report(found))
    replace_section(arguments.docs, "Tolerance", text)


if __name__ == "__main__":
    main()
