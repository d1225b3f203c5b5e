"""The derivative of the training that was run: what it costs, and what each saving adds in error.

`python benchmarks/unrolled.py` writes docs/numerics.md, from one iteration of the psi loop on `+experiment=pose_gap` at
64 px. What the derivative foretells is in `foretold.py`.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from jaxtyping import Float, Int
from torch import Tensor
from unrolled_report import centred, report
from worlds import SMALL

from neural_sim.detector.cached import CachedSet
from neural_sim.detector.protocol import Detector, Parameters
from neural_sim.detector.real import shuffled_passes
from neural_sim.detector.training import TrainingHistory, train_detector
from neural_sim.detector.trajectory import MEGABYTE, Recording, Trajectory
from neural_sim.documents import replace_section
from neural_sim.gradient.accumulated import ProbeGroups, Unrolled, step_weights
from neural_sim.gradient.mixed import scores
from neural_sim.gradient.unrolled import Examples, Product, reversed_steps
from neural_sim.main import build, conf_directory
from neural_sim.report.provenance import machine
from neural_sim.solver.hvp import gradient
from neural_sim.synthesis.pool import ImagePool
from neural_sim.tasks.context import Context
from neural_sim.types import LabelledImages

START = ("+experiment=pose_gap", "gap=uniform")
PER_BIN = 24
ALL = Unrolled(probes_per_step=0, scored_steps=0)
EXACT = replace(ALL, product="reverse_over_reverse")
CENTRAL = replace(ALL, product="central_difference")
DEFAULT = (
    "forward differences, a probe of each bin in every early step and one of 2 or 3 later ones (default)"
)
OTHERS = (
    ("tiny", ("outer.epochs=12",)),
    ("resnet18", ("detector=resnet18", "training.warm_epochs=1")),
)
"""Other trainings whose cost is measured; a warm start of one epoch, since costs do not depend on it."""
PARTS = (0.75, 0.5, 0.25)
FEW = ((2, 1), (1, 1), (1, 2), (1, 4), (1, 7))


@dataclass(frozen=True)
class World:
    """All objects' images of every bin, through the warm start's frozen stages, and what every training starts from."""

    context: Context
    detector: Detector
    pool: CachedSet
    validation: CachedSet
    start: Parameters
    p: Float[Tensor, "objects k"]

    @staticmethod
    def of(overrides: list[str]) -> World:
        with initialize_config_dir(str(conf_directory()), version_base="1.3"):
            context = Context.of(build(compose("config", [*SMALL, *START, *overrides])))
        graph, results = context.graph, context.results
        scene = results(graph.scene)
        generator, psi = torch.Generator().manual_seed(5), graph.psi("initial")
        detector = graph.warm_start.build().in_loop(context.experiment.loop.outer.loop_layers)
        warm = results(graph.warm_start).params
        frozen, _ = detector.split(warm)
        source = ImagePool.render(scene, PER_BIN, generator)
        drawn = [scene.probes(i, "pose", PER_BIN, psi, generator, source)[0] for i in range(len(psi))]
        pool = CachedSet.of(detector, frozen, LabelledImages.concatenate(drawn))
        p = scene.distribution.probabilities(psi)["pose"].float()
        validation = CachedSet.of(detector, frozen, results(graph.targets).val)
        start = {name: value for name, value in warm.items() if name.startswith("backbone.")}
        return World(context, detector, pool, validation, {**detector.init(generator), **start}, p)

    def probes(self, label: int) -> Int[Tensor, "k per_bin"]:
        """Rows of one object's images, bin by bin."""
        bins = self.p.shape[1]
        return (label * bins * PER_BIN + torch.arange(bins * PER_BIN)).view(bins, PER_BIN)

    def rows(self, seed: int) -> Int[Tensor, "n"]:
        """A training set's rows."""
        generator, drawn = torch.Generator().manual_seed(seed), []
        for i, p in enumerate(self.p):
            chosen = torch.rand(self.context.experiment.loop.outer.images_per_object, generator=generator)
            place = torch.randint(PER_BIN, chosen.shape, generator=generator)
            bins = torch.searchsorted(p.cumsum(0), chosen).clamp_max(len(p) - 1)
            drawn.append(self.probes(i)[bins, place])
        return torch.cat(drawn)

    def train(
        self, rows: Tensor, seed: int, recording: Recording | None = None
    ) -> tuple[Parameters, TrainingHistory]:
        """As the psi loop trains; returns the trained part."""
        x, generator = self.context.experiment, torch.Generator().manual_seed(seed)
        theta, history = train_detector(
            self.detector, self.start, self.pool.select(rows), generator,
            replace(x.training.of(x.loop.outer.epochs), learning_rate=x.loop.outer.learning_rate),
            recording=recording,
        )  # fmt: skip
        return self.detector.split(theta)[1], history


@dataclass(frozen=True)
class Walked:
    """One recorded training, and every way back through it."""

    world: World
    label: int
    rows: Tensor
    trained: Parameters
    trajectory: Trajectory

    def scores(self, product: Product, floor: float = ALL.floor) -> Float[Tensor, "steps k per_bin"]:
        """Of every probe of the object in every step, the last step first."""
        world, data = self.world, self.world.pool.select(self.rows)
        slope = gradient(world.validation.mean_terms(), self.trained)
        examples = Examples(data.inputs, data.losses_from)
        table, found = world.probes(self.label), []
        steps = reversed_steps(self.trajectory, examples, self.trained, slope, product, "probes", floor)
        for step in steps:
            along = scores(
                world.pool.losses, step.params, step.along, table.reshape(-1), 96, "central_difference"
            )
            found.append((along - along.mean()).view_as(table))
        return torch.stack(found)


def walked(world: World, label: int, seed: int) -> Walked:
    rows = world.rows(seed)
    trained, history = world.train(rows, seed, Recording())
    if history.trajectory is None:
        raise ValueError("the training was not recorded")
    return Walked(world, label, rows, trained, history.trajectory)


def clock(work: Callable[[], Any]) -> float:
    """Seconds of processor time, which other processes disturb less than those on the wall."""
    begun = time.process_time()
    work()
    return time.process_time() - begun


def costs(world: World, repeats: int, brief: bool = False) -> dict[str, float]:
    """Medians of a training's seconds, and of everything else in trainings beside it; megabytes of what is kept, and
    numbers that are trained. ``brief``: the default way alone.
    """
    rows, found, none = world.rows(0), [], torch.Generator()
    data = world.pool.select(rows)
    examples = Examples(data.inputs, data.losses_from)
    every = ProbeGroups(world.pool.losses, [world.probes(i) for i in range(len(world.p))])
    kept, run = 0, None
    for seed in range(repeats):
        trained, history = world.train(rows, seed, Recording())
        run = history.trajectory
        if run is None:
            raise ValueError("the training was not recorded")
        slope = gradient(world.validation.mean_terms(), trained)
        states = [part for state in run.checkpoints.values() for part in state]
        kept = sum(part.numel() * part.element_size() for part in (*states, *run.gradients.values()))
        bare = replace(run, gradients={})

        def back(how: Unrolled, probes=None, run=run, trained=trained, slope=slope, **wanted) -> float:
            return clock(lambda: how.accumulate(run, examples, trained, slope, none, probes, **wanted))

        once = clock(lambda seed=seed: world.train(rows, seed))
        walks = {DEFAULT: back(Unrolled(), every, wanted="probes")}
        if not brief:
            walks = {
                "recording": clock(lambda seed=seed: world.train(rows, seed, Recording())) - once,
                "forward differences": back(ALL, wanted="probes"),
                "forward differences, gradients computed again": back(ALL, run=bare, wanted="probes"),
                "forward differences, a probe of each bin every step": back(
                    replace(ALL, probes_per_step=1), every, wanted="probes"
                ),
                **walks,
                "central differences": back(CENTRAL),
                "central differences, with derivatives by features": back(CENTRAL, wanted="inputs"),
                "reverse over reverse": back(EXACT),
            }
        found.append({"seconds": once} | {key: spent / once for key, spent in walks.items()})
    if run is None:
        raise ValueError(f"costs: want at least one repeat, got {repeats}")
    medians = {key: float(torch.tensor([row[key] for row in found]).median()) for key in found[0]}
    return medians | {
        "megabytes": kept / MEGABYTE,
        "numbers": float(run.end.numel()),
        "steps": float(len(run)),
    }


def errors(run: Walked, draws: int = 200) -> dict[str, float]:
    """Relative errors of the bins' mean scores against exact products, all probes in all steps."""
    exact = run.scores("reverse_over_reverse")
    means, generator = bin_means(exact), torch.Generator().manual_seed(0)

    def error(values: list[Tensor]) -> float:
        return float(torch.stack([(v - means).norm() / means.norm() for v in values]).square().mean().sqrt())

    products: tuple[Product, ...] = ("forward_difference", "central_difference")
    found = {product.replace("_", " ") + "s": error([bin_means(run.scores(product))]) for product in products}
    whole = run.scores("reverse_over_reverse", floor=0.0)
    found["no floor under AdamW's denominators"] = error([bin_means(whole)])
    found["no floor, without the first two steps"] = error([bin_means(whole[:-2])])
    for count, every in FEW:
        steps = "every step" if every == 1 else f"one step in 1 to {2 * every - 1}"
        drawn = [few(exact, count, every, generator) for _ in range(draws)]
        found[f"{count} of {PER_BIN} probes, {steps}"] = error(drawn)
    for part in PARTS:
        found[f"the last {part:.0%} of the steps"] = error([bin_means(exact, part)])
    spread = exact.sum(0).var(1)
    for count in (24, 48):
        own = float((spread / count).sum().sqrt() / means.norm())
        found[f"(the noise of {count} probes a bin themselves)"] = own
    return found


def bin_means(scored: Float[Tensor, "steps k per_bin"], part: float = 1.0) -> Float[Tensor, "k"]:
    """The derivative of L_val by the bins' shares, from the last part of the steps."""
    return centred(scored[: math.ceil(part * len(scored))].sum(0).mean(1))


def few(
    scored: Float[Tensor, "steps k per_bin"], count: int, every: int, generator: torch.Generator
) -> Float[Tensor, "k"]:
    """The same from the few probes that the walk would have scored."""
    turns, total = shuffled_passes(PER_BIN, count, generator), torch.zeros(scored.shape[1])
    for step, weight in zip(scored, step_weights(len(scored), every, generator), strict=True):
        if weight:
            total += weight * centred(step[:, next(turns)].mean(1))
    return centred(total)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("overrides", nargs="*", help="configuration keys, as on the command line of a run")
    parser.add_argument("--object", default="pitcher", help="whose derivative the errors are of")
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--docs", type=Path, default=Path("docs/numerics.md"))
    parser.add_argument("--json", type=Path, default=Path("outputs/benchmarks/unrolled.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    world = World.of(arguments.overrides)
    outer = world.context.experiment.loop.outer
    spent = {f"tiny, {outer.epochs} epochs": costs(world, arguments.repeats)}
    wrong = errors(walked(world, world.context.graph.names.index(arguments.object), 0))
    print(json.dumps({"costs": spent, "errors": wrong}, indent=1), flush=True)
    for detector, overrides in OTHERS:
        other = World.of([*arguments.overrides, *overrides])
        name = f"{detector}, {other.context.experiment.loop.outer.epochs} epochs"
        spent[name] = costs(other, arguments.repeats, brief=True)
        print(json.dumps(spent[name], indent=1), flush=True)
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    arguments.json.write_text(json.dumps({"machine": machine(), "costs": spent, "errors": wrong}, indent=1))
    settings = {
        "object": arguments.object,
        "repeats": arguments.repeats,
        "per_bin": PER_BIN,
        "default": DEFAULT,
        "images": len(world.p) * outer.images_per_object,
        "epochs": outer.epochs,
    }
    replace_section(arguments.docs, "Unrolled", report(spent, wrong, settings, arguments.overrides))


if __name__ == "__main__":
    main()
