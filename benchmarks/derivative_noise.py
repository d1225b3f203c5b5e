"""What a derivative's noise is made of: its scatter over trainings at one psi, by the probes that a step scores and the
validation images that it is of, beside what its standard errors say and what it costs. All settings differentiate the
same trainings.

    python benchmarks/derivative_noise.py +experiment=pose_gap_ycb gap=disjoint seed=101
"""

from __future__ import annotations

import argparse
import logging
import time
from dataclasses import dataclass, field, replace

import torch
from hydra import compose, initialize_config_dir
from jaxtyping import Float
from torch import Tensor

from neural_sim.main import build, conf_directory
from neural_sim.outer.descent import GradientLoop
from neural_sim.outer.objective import Objective
from neural_sim.outer.steps import by_p, stacked
from neural_sim.tasks.context import Context


@dataclass
class Setting:
    """The probes of every bin that a step scores, and L_val; one derivative by p, its variance by images and its
    seconds for each training.
    """

    probes: int
    part: str
    objective: Objective
    derivatives: list[Float[Tensor, "objects k"]] = field(default_factory=list)
    variances: list[Float[Tensor, "objects"]] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    @property
    def scatter(self) -> Float[Tensor, "objects"]:
        """Variance of a component over trainings."""
        return torch.stack(self.derivatives).var(0).mean(1)

    @property
    def of_images(self) -> Float[Tensor, "objects"]:
        """What the standard errors say of it."""
        return torch.stack(self.variances).mean(0)


def measure(loop: GradientLoop, settings: list[Setting], trainings: int) -> float:
    """Fill ``settings`` with derivatives by p of the first factor.

    Returns the seconds of the rest of an iteration, on average.
    """
    inner, own, spent = loop.inner, loop.inner.settings, 0.0
    distribution, psi = loop.scene.distribution, loop.psi.detach()
    factor = distribution.factors[0]
    inner.common_numbers = True
    for _ in range(trainings):
        begun = time.perf_counter()
        loop._prepare()
        rendered = inner.draw(loop.psi)
        cached = inner.training_set(rendered.images)
        inner.train(cached, own.unrolled.recording)
        spent += time.perf_counter() - begun
        for setting in settings:
            begun = time.perf_counter()
            inner.differentiated = setting.objective
            inner.settings = loop.settings = replace(
                own, unrolled=replace(own.unrolled, probes_per_step=setting.probes)
            )
            of_psi = stacked(loop._derivative(rendered, cached), loop.scene.names, psi)
            parts = (distribution.split(values)[factor.name] for values in (psi, *of_psi))
            direction, variance = by_p(factor, *parts)
            setting.derivatives.append(direction)
            setting.variances.append(variance.mean(-1))
            setting.seconds.append(time.perf_counter() - begun)
        inner.settings = loop.settings = own
        inner.renew()
    return spent / trainings


def main() -> None:
    """A table in Markdown on the standard output: sums over objects, relative to the first row's scatter."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("overrides", nargs="+", help="configuration keys, as on the command line of a run")
    parser.add_argument("--trainings", type=int, default=6)
    parser.add_argument("--probes", type=int, nargs="+", default=[1, 2, 4])
    asked = parser.parse_args()
    torch.set_num_threads(1)
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    with initialize_config_dir(str(conf_directory()), version_base="1.3"):
        context = Context.of(build(compose("config", asked.overrides)))
    loop = context.graph.learned.loop(context.results)
    if not isinstance(loop, GradientLoop):
        raise SystemExit("want a method that follows the hypergradient")
    whole = loop.inner.objective
    half = whole.folds(2, torch.Generator().manual_seed(7))[0]
    settings = [
        Setting(probes, part, objective)
        for part, objective in (("half", half), ("all", whole))
        for probes in asked.probes
    ]
    rest = measure(loop, settings, asked.trainings)
    first = float(settings[0].scatter.sum())
    print(f"an iteration without the derivative: {rest:.1f} s")
    print(
        "| validation images | probes a step | variance over trainings | of images | s | variance x s of an iteration |"
    )
    print("|---|---|---|---|---|---|")
    cost = first * (rest + sum(settings[0].seconds) / asked.trainings)
    for setting in settings:
        scatter, images = float(setting.scatter.sum()), float(setting.of_images.sum())
        seconds = sum(setting.seconds) / asked.trainings
        print(
            f"| {setting.part} | {setting.probes} | {scatter / first:.2f} | {images / first:.2f} | {seconds:.1f} | "
            f"{scatter * (rest + seconds) / cost:.2f} |"
        )


if __name__ == "__main__":
    main()
