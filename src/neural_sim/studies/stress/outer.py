"""Stiff outer dynamics: steps in psi at any learning rate and gradient size, and the loop around them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from neural_sim.detector.training import Training
from neural_sim.gradient.base import MixedDerivative
from neural_sim.gradient.implicit import Implicit
from neural_sim.outer.certificate import OnUntrusted, Trust
from neural_sim.outer.inner import InnerLoop, LoopInputs
from neural_sim.outer.loop import learn_psi
from neural_sim.outer.module import SimulatorModule
from neural_sim.outer.objective import Loss
from neural_sim.outer.settings import Outer
from neural_sim.outer.steps import FreeSteps
from neural_sim.parameter import bins as binned
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import HardDraws, SceneDistribution
from neural_sim.parameter.update import SGD, Mirror, Update, UpdateState
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.studies.stress.cases import (
    DOUBLE,
    Check,
    Checks,
    Scope,
    block,
    case,
    eps,
    not_finite,
    small_detector,
)
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.scene import Scene
from neural_sim.synthesis.subjects import FieldSubject
from neural_sim.synthesis.synthesizer import Synthesizer
from neural_sim.types import PinholeCamera

FLOOR, MAX_STEP = 0.005, 0.5
UPDATES: dict[str, Callable[[float], Update]] = {
    "sgd": lambda rate: SGD(learning_rate=rate, max_step=MAX_STEP),
    "mirror": lambda rate: Mirror(learning_rate=rate, max_step=MAX_STEP),
}
RATES = (1e-6, 1e-3, 1.0, 1e3)


@dataclass
class Worst:
    """The worst violations in a run: numbers that are not finite, overlong steps, p off the simplex or floor."""

    not_finite: float = 0.0
    excess: float = 0.0
    off_simplex: float = 0.0

    def see(self, before: Tensor, after: Tensor) -> None:
        """Record the violations of one step."""
        self.not_finite += not_finite(after)
        # psi + step and its difference round by eps |psi| each.
        excess = (after - before).abs() - MAX_STEP - 2 * eps(DOUBLE) * after.abs()
        self.excess = max(self.excess, float(excess.max()))
        p = binned.log_probabilities(after, FLOOR).exp()
        below = float((FLOOR - p).max())
        self.off_simplex = max(self.off_simplex, below, float((p.sum(-1) - 1.0).abs().max()))

    def checks(self, label: str, status: str = "", wanted: tuple[str, ...] = ()) -> Checks:
        """Yield checks of all recorded violations."""
        yield Check(f"psi not finite: {label}", self.not_finite, 0.0, status, wanted)
        yield Check(f"step beyond max_step: {label}", self.excess, 8 * eps(DOUBLE) * MAX_STEP)
        # log p carries eps |psi| of the softmax part (at most 30 nats of it exceed the floor) and k roundings.
        yield Check(f"p off its simplex: {label}", self.off_simplex, (8 + 30) * 8 * eps(DOUBLE))


def slope(psi: Tensor, costs: Tensor) -> Tensor:
    """Return the gradient in psi of each object's mean cost over its bins."""
    leaf = psi.detach().requires_grad_()
    mean = (binned.log_probabilities(leaf, FLOOR).exp() * costs).sum()
    return torch.autograd.grad(mean, leaf)[0]


def run(
    update: Update, psi: Tensor, gradients: Iterable[Callable[[Tensor], Tensor]], error: float, worst: Worst
) -> UpdateState:
    """Step along gradients that depend on psi; their standard errors are ``error`` times their size."""
    state = UpdateState.zeros(psi)
    for of in gradients:
        gradient = of(psi)
        log_p = binned.log_probabilities(psi, FLOOR)
        moved, state = update.step(psi, log_p, gradient, gradient.abs() * error, state)
        worst.see(psi, moved)
        psi = moved
    return state


@case
def learning_rates(scope: Scope) -> Checks:
    """Step at rates from 1e-6 to 1e3 on noisy costs of 1e-6, 1 and 1e6 (one scale per object).

    Runs start from uniform p and from bins 1000 nats below. At every step psi must be finite, p on its simplex and the
    step at most ``max_step``, as ``bound`` promises.
    """
    steps = 300 if scope.full else 40
    costs = scope.normal(3, 8) * torch.tensor([[1e-6], [1.0], [1e6]], dtype=DOUBLE)
    noisy = [
        lambda psi, noise=noise: slope(psi, costs * (1.0 + noise)) for noise in scope.normal(steps, 3, 8)
    ]
    deep = torch.zeros(3, 8, dtype=DOUBLE)
    deep[:, ::2] = -1000.0
    for name, make in UPDATES.items():
        for rate in RATES:
            for where, start in (("uniform", torch.zeros_like(deep)), ("bins at the floor", deep)):
                worst = Worst()
                run(make(rate), start, noisy, 0.1, worst)
                yield from worst.checks(f"{name}, rate {rate:g}, {where}")


@case
def flat_loss(scope: Scope) -> Checks:
    """Step along a gradient of exactly zero with every update, rate and psi: no digit changes."""
    for name, make in UPDATES.items():
        for rate in RATES:
            moved = 0.0
            for psi in (torch.zeros(3, 8, dtype=DOUBLE), 100.0 * scope.normal(3, 8)):
                for error in (0.0, 1.0, math.inf):
                    state, log_p = UpdateState.zeros(psi), binned.log_probabilities(psi, FLOOR)
                    for _ in range(3):
                        none, unknown = torch.zeros_like(psi), torch.full_like(psi, error)
                        after, state = make(rate).step(psi, log_p, none, unknown, state)
                        moved = max(moved, float((after - psi).abs().max()))
            yield Check(f"change of psi: {name}, rate {rate:g}", moved, 0.0)


@case
def cliff(scope: Scope) -> Checks:
    """Step along a single gradient of 1e-300 to 1e300, infinity or NaN, among normal ones.

    The step must be bounded, or refused and counted, and psi must stay finite and bounded in the next 30 steps. Up to
    1e100, squares are finite and the step must be taken; inf and NaN must be refused. In between squares overflow, and
    either is correct.
    """
    costs, shape = scope.normal(3, 8), scope.normal(3, 8)
    for name, make in UPDATES.items():
        for size in (1e-300, 1e30, 1e100, 1e160, 1e300, math.inf, math.nan):

            def edge(psi: Tensor, size: float = size) -> Tensor:
                return size * shape if size < 1e200 else torch.where(shape > 1.0, size, slope(psi, costs))

            def usual(psi: Tensor) -> Tensor:
                return slope(psi, costs)

            worst, gradients = Worst(), [usual] * 4 + [edge] + [usual] * 30
            zero = torch.zeros(3, 8, dtype=DOUBLE)
            refused = sum(run(make(rate), zero, gradients, 0.0, worst).refused for rate in RATES)
            status = "REFUSED" if refused == len(RATES) else "BOUNDED" if refused == 0 else "BOTH"
            wanted = ("BOUNDED",) if size <= 1e100 else ("REFUSED", "BOUNDED", "BOTH")
            if not math.isfinite(size):
                wanted = ("REFUSED",)
            yield from worst.checks(f"{name}, gradient {size:g}", status, wanted)


@dataclass(frozen=True)
class Constant:
    """An estimator that always returns the same number."""

    value: float
    draws: ClassVar[HardDraws] = HardDraws()
    probes_per_bin: ClassVar[int] = 0

    def estimate(self, losses: Any, params: Any, vector: Any, images: Any, probes: Any) -> MixedDerivative:
        """Return the number, with a slope over the bins."""
        shape = torch.linspace(-1.0, 1.0, images.psi.numel(), dtype=images.psi.dtype)
        return MixedDerivative(self.value * shape, torch.zeros_like(shape))


@case
def loop(scope: Scope) -> Checks:
    """Run the whole psi loop on a cube with 4 bins and an estimator that returns NaN, inf, 1e30 or 0.

    Psi must be finite and within the bound of its steps. A gradient that is 0 or not finite must not move psi, and the
    certificate of one that is not finite must say what was done.
    """
    iterations = 2
    trials: tuple[tuple[float, OnUntrusted], ...] = (
        (math.nan, "shrink"), (1e30, "shrink"), (math.nan, "skip"), (math.inf, "shrink"),
        (0.0, "shrink"), (math.nan, "keep"),
    )  # fmt: skip
    for value, choice in trials if scope.full else trials[:2]:
        learned = learn_psi(_module(Constant(value), choice, iterations, scope))
        moved = float(learned.last.abs().max())
        certificate = learned.records[0].certificate
        status = certificate.actions["x"]["pose"] if certificate else ""
        wanted = ("skipped",) if not math.isfinite(value) else ()
        bound = iterations * MAX_STEP * (1 + 4 * eps(DOUBLE)) if value == 1e30 else 0.0
        yield Check(f"psi moved: estimate {value:g}, {choice}", moved, bound, status, wanted)


def _module(estimator: Constant, choice: OnUntrusted, iterations: int, scope: Scope) -> SimulatorModule:
    generator = scope.generator()
    camera = PinholeCamera(32, 32, math.radians(40.0))
    synthesizer = Synthesizer(ProceduralClutter(), shift=0.1)
    subject = FieldSubject("x", block(30.0, half=0.5, cells=4), NerfRenderer())
    scene = Scene((subject,), camera, synthesizer, SceneDistribution.of([Pose(bins=4)]))
    network = small_detector(1)
    psi = torch.zeros(1, 4)
    validation = scene.training_set(psi, 2, generator).images
    settings = Outer(
        iterations=iterations, images_per_object=3, epochs=1, pool_per_bin=1, train_first=False,
        steps=FreeSteps(Mirror(max_step=MAX_STEP)), adjoint=Implicit(), objective=Loss(),
        trust=Trust(on_untrusted=choice),
    )  # fmt: skip
    inputs = LoopInputs(network, network.init(generator), validation)
    training = Training(batch_size=3, weight_decay=0.0)
    inner = InnerLoop.prepare(scene, inputs, settings, training, generator)
    return SimulatorModule(
        inner,
        psi,
        estimator,  # pyright: ignore[reportArgumentType]  (stands in for the estimators of conf/gradient)
        AdjointSolver(max_steps=4),
        generator,
    )
