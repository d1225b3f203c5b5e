"""Solvers against dense oracles, the implicit hypergradient against retraining, and what a Hessian product costs.

    python benchmarks/solvers.py [--docs docs/numerics.md] [--json outputs/benchmarks/solvers.json]

Minutes on one core. Everything but the timings, which are the process's own seconds on one thread, is float64 and
deterministic.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from torch import Tensor

from neural_sim.detector.cached import CachedSet
from neural_sim.detector.module import Optimisation
from neural_sim.detector.protocol import Detector
from neural_sim.detector.training import train_detector
from neural_sim.field.grid import GridField
from neural_sim.gradient.base import Probes
from neural_sim.gradient.hypergradient import InnerProblem, hypergradient
from neural_sim.main import conf_directory
from neural_sim.outer.retrained import BinnedProblem, as_double, centred_cosine, finite_difference
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.report.machine import machine
from neural_sim.report.section import replace_section
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.solver.base import LinearSolver
from neural_sim.solver.cg import ConjugateGradient
from neural_sim.solver.damping import FixedDamping, LanczosDamping
from neural_sim.solver.exact import Exact
from neural_sim.solver.flatten import flatten, unflatten
from neural_sim.solver.hvp import HessianOperator, Term, gradient
from neural_sim.solver.identity import Identity
from neural_sim.solver.minres import MinimumResidual
from neural_sim.solver.neumann import Neumann
from neural_sim.solver.newton import Minimum
from neural_sim.solver.nystrom import Nystrom
from neural_sim.solver.operator import Matvec, Shifted
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.scene import Scene
from neural_sim.synthesis.training_set import Synthesizer
from neural_sim.types import LabelledImages, PinholeCamera

DOUBLE = torch.float64
BINS = 4
PSI = torch.tensor([[0.0, 1.0, 0.0, -0.5], [0.5, 0.0, 1.5, 0.0]], dtype=DOUBLE)
BUDGETS = (5, 10, 15, 20, 25, 30, 40, 60, 80)
CONDITIONS = (1.0, 1e2, 1e4, 1e6, 1e8, 1e10, 1e12)
SOLVE = AdjointSolver(rtol=1e-3)
LINEAR: dict[str, LinearSolver] = {
    "cg": ConjugateGradient(),
    "minres": MinimumResidual(),
    "neumann": Neumann(),
    "nystrom": Nystrom(rank=40, sketch="gaussian"),
    "identity": Identity(),
    "exact": Exact(),
}


def small_scene() -> Scene:
    """Two textured blocks before clutter, 32 px."""

    def block(seed: int) -> GridField:
        field = GridField().eval()
        field.reset(torch.ones(4, 4, 4, dtype=torch.bool), torch.full((3,), -0.6), 0.3)
        noise = torch.randn(field.table.shape, generator=torch.Generator().manual_seed(seed))
        with torch.no_grad():
            field.table.copy_(noise + 1.0)
        return field.requires_grad_(False)

    camera = PinholeCamera(32, 32, math.radians(40.0))
    synthesizer = Synthesizer(ProceduralClutter(), shift=0.1)
    return Scene(
        ("a", "b"),
        (block(1), block(2)),
        NerfRenderer(),
        camera,
        synthesizer,
        SceneDistribution.of([Pose(bins=BINS)]),
    )


def detector_of(name: str, classes: int, size: int) -> Detector:
    with initialize_config_dir(str(conf_directory()), version_base="1.3"):
        chosen = compose("config", [f"detector={name}"]).detector
    return instantiate(chosen)(num_classes=classes, image_size=size)


def trained_problem() -> tuple[BinnedProblem, list[Term]]:
    """detector=micro, warm from its usual training, on one image of every bin and object; and L_val, both float64."""
    generator, scene = torch.Generator().manual_seed(0), small_scene()
    detector = detector_of("micro", 2, 32)
    images = scene.training_set(PSI, 40, generator).images
    validation = scene.training_set(PSI.flip(-1), 8, generator).images
    probes = [scene.probes(label, "pose", 1, PSI, generator)[0] for label in range(2)]
    params, _ = train_detector(
        detector, detector.init(generator), images, generator,
        Optimisation(40, batch_size=16, learning_rate=1e-2, weight_decay=1e-2),
    )  # fmt: skip
    backbone, warm = detector.split(params)
    held = CachedSet.of(detector, backbone, LabelledImages.concatenate(probes)).double()
    bins = [Probes(torch.arange(BINS) + label * BINS, torch.arange(BINS)) for label in range(2)]
    problem = BinnedProblem(
        held.losses, bins, scene.distribution.factors[0].log_probabilities, 0.0, as_double(warm)
    )
    return problem, CachedSet.of(detector, backbone, validation).double().mean_terms()


class ForwardOverReverse(AdjointSolver):
    """The same solve on products by forward over reverse mode, which share no graph with the solver's own."""

    def operator(self, terms: Sequence[Term], params: Mapping[str, Tensor]) -> Matvec:
        slope = torch.func.grad(lambda point: sum(term(unflatten(point, params)) for term in terms))
        return lambda vector: torch.func.jvp(slope, (flatten(params),), (vector,))[1]


@dataclass(frozen=True)
class Stationary:
    """The inner problem at its minimiser for PSI, and everything to differentiate through it."""

    problem: BinnedProblem
    validation: list[Term]
    minimum: Minimum

    def implicit(
        self, linear: LinearSolver, rtol: float, steps: int, kind: type[AdjointSolver] = AdjointSolver
    ):
        """Its hypergradient by a linear solver (undamped: the proximal term is inside), as one vector; the account."""
        params = self.minimum.params
        estimates = {str(label): self.problem.estimate(PSI, label, params) for label in range(len(PSI))}
        solver = kind(linear, FixedDamping(0.0, 0), rtol=rtol, max_steps=steps)
        generator = torch.Generator().manual_seed(0)
        found = hypergradient(self.problem.at(PSI, params), self.validation, estimates, solver, generator)
        return torch.cat(list(found.psi_gradients.values())), found

    def retrained(self, step: float = 0.04) -> tuple[Tensor, Tensor, bool]:
        """All objects' central differences at ``step``, and extrapolated from it and half of it (fourth order)."""
        runs = [
            [
                finite_difference(self.problem, self.validation, PSI, label, self.minimum.params, h, 1e-10)
                for label in range(len(PSI))
            ]
            for h in (step, 0.5 * step)
        ]
        plain, half = (torch.cat([part.gradient for part in run]) for run in runs)
        return plain, (4.0 * half - plain) / 3.0, all(part.converged for run in runs for part in run)


def relative(value: Tensor, reference: Tensor) -> float:
    return float((value - reference).norm() / reference.norm())


def lanczos_damping(problem: BinnedProblem, validation: list[Term]) -> float:
    """lambda as ``solver/damping=lanczos`` chooses it at the warm start, in 12 products."""
    params = problem.anchor
    operator = HessianOperator(problem.at(PSI, params).terms(), params, retain_graph=True)
    b = gradient(validation, params)
    return LanczosDamping(lanczos_steps=12).choose(operator, b, torch.Generator().manual_seed(0)).value


def hypergradients() -> list[dict[str, Any]]:
    """Over several lambda: the proximal problem trained to its end, the oracle, retraining, and cg by budget."""
    problem, validation = trained_problem()
    chosen, rows = lanczos_damping(problem, validation), []
    for factor in (1.0, 1.0 / 3.0, 0.1, 1.0 / 30.0):
        proximal = replace(problem, proximal=factor * chosen)
        minimum = proximal.retrain(PSI, proximal.anchor, 1e-9)
        at = Stationary(proximal, validation, minimum)
        oracle, dense = at.implicit(Exact(), 1e-12, 1)
        independent, _ = at.implicit(ConjugateGradient(), 1e-12, 2000, ForwardOverReverse)
        plain, extrapolated, converged = at.retrained()
        low, high = dense.solution.curvature
        halves = zip(plain.view_as(PSI), oracle.view_as(PSI), strict=True)
        # One product of the budget is the true residual's.
        default, spent = at.implicit(SOLVE.linear, SOLVE.rtol, SOLVE.max_steps - 1)
        rows.append({
            "lambda": proximal.proximal, "of_default": factor, "stationarity": minimum.slope,
            "newton_steps": minimum.steps, "products": minimum.products, "converged": minimum.converged and converged,
            "lambda_min": low, "lambda_max": high, "condition": high / low,
            "cosine": min(centred_cosine(*pair) for pair in halves),
            "exact_to_retrained": relative(oracle, extrapolated), "exact_to_iterated": relative(oracle, independent),
            "default_error": relative(default, oracle), "default_products": spent.solution.products,
            "default_status": spent.solution.status.name,
            "error": {n: relative(at.implicit(ConjugateGradient(), 1e-12, n - 1)[0], oracle) for n in BUDGETS},
        })  # fmt: skip
        print(f"lambda {proximal.proximal:.3g}: " + json.dumps(rows[-1]), flush=True)
    return rows


def systems(size: int = 200) -> list[dict[str, Any]]:
    """Every solver on eigenvalues spread evenly in log from 1 to 1 / condition, none or every other one negative."""
    generator = torch.Generator().manual_seed(0)
    basis = torch.linalg.qr(torch.randn(size, size, generator=generator, dtype=DOUBLE)).Q
    truth = torch.randn(size, generator=generator, dtype=DOUBLE)
    rows = []
    for indefinite in (False, True):
        for condition in CONDITIONS:
            values = torch.logspace(0.0, -math.log10(condition), size, dtype=DOUBLE)
            values[1::2] *= -1.0 if indefinite else 1.0
            shift = 0.5 / condition
            bare = basis * (values - shift) @ basis.T
            bare = 0.5 * (bare + bare.T)
            operator = Shifted(lambda v, bare=bare: bare @ v, shift)
            b = operator(truth)
            for name, solver in LINEAR.items():
                began = time.process_time()
                solution = solver.solve(operator, b, rtol=1e-10, max_steps=2000)
                rows.append({
                    "solver": name, "condition": condition, "indefinite": indefinite,
                    "error": relative(solution.value, truth), "residual": solution.residual,
                    "status": solution.status.name, "products": solution.products,
                    "seconds": time.process_time() - began,
                })  # fmt: skip
    return rows


def product_costs(images: int = 64, repeats: int = 7) -> list[dict[str, Any]]:
    """Medians of a curvature product of detector=tiny on cached features, and of the same images' gradient; float32."""
    generator, detector = torch.Generator().manual_seed(0), detector_of("tiny", 6, 96)
    backbone, params = detector.split(detector.init(generator))
    corner = 50 * torch.rand(images, 1, 2, generator=generator)
    side = 20 + 25 * torch.rand(images, 1, 2, generator=generator)
    drawn = LabelledImages(
        torch.rand(images, 3, 96, 96, generator=generator), torch.cat([corner, corner + side], -1),
        torch.randint(0, 6, (images, 1), generator=generator), torch.zeros(images, dtype=torch.long),
    )  # fmt: skip
    held = CachedSet.of(detector, backbone, drawn)
    weights = torch.full((images,), 1.0 / images)
    terms = InnerProblem(params, held.losses, weights).terms()
    rows = []
    for kind, retain in (
        ("reverse_over_reverse", True), ("reverse_over_reverse", False), ("central_difference", False),
    ):  # fmt: skip
        operator = HessianOperator(terms, params, kind, retain)  # pyright: ignore[reportArgumentType]
        vector = gradient(terms, params)
        pairs = [
            (seconds(lambda: gradient(terms, params)), seconds(lambda op=operator, v=vector: op(v)))
            for _ in range(repeats + 1)
        ][1:]
        plain, product = (statistics.median(times) for times in zip(*pairs, strict=True))
        rows.append({"operator": kind, "retain_graph": retain, "gradient": plain, "product": product})
    return rows


def seconds(run: Callable[[], Any]) -> float:
    began = time.process_time()
    run()
    return time.process_time() - began


if __name__ == "__main__":
    from solvers_report import report

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--docs", type=Path, default=Path("docs/numerics.md"))
    parser.add_argument("--json", type=Path, default=Path("outputs/benchmarks/solvers.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    found = {
        "machine": machine(),
        "default": {"rtol": SOLVE.rtol, "max_steps": SOLVE.max_steps},
        "costs": product_costs(),
        "systems": systems(),
        "hypergradients": hypergradients(),
    }
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    arguments.json.write_text(json.dumps(found, indent=1))
    text = report(found)
    print(text)
    replace_section(arguments.docs, "Solvers", text)
