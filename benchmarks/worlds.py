"""Where estimators of the mixed term are compared: two objects at the disjoint start, their detector, v, and truths."""

from __future__ import annotations

import time
from dataclasses import dataclass

import torch
from hydra import compose, initialize_config_dir
from jaxtyping import Float
from torch import Tensor

from neural_sim.artifacts import Artifacts
from neural_sim.detector.cached import CachedSet
from neural_sim.detector.retinanet import Detector, Parameters
from neural_sim.gradient.base import MixedDerivative, Probes
from neural_sim.gradient.hypergradient import InnerProblem, hypergradient
from neural_sim.gradient.mixed import scores
from neural_sim.gradient.stratified import stratified
from neural_sim.main import build, conf_directory
from neural_sim.solver.flatten import unflatten
from neural_sim.synthesis.scene import Scene, join

SMALL = [
    "scale=quick", "progress=false", "training.image_size=64", "views.count=84",
    "budget.grid.steps=160", "budget.grid.refine_steps=[50]", "budget.grid.prune_steps=[110]",
    "target.val_per_object=50", "target.test_per_object=1", "target.test_per_biased_object=1",
]  # fmt: skip
WORLDS = {
    "embedded": ["+experiment=pose_gap", "objects.names=[pitcher,drill]"],
    "ycb": ["+experiment=pose_gap_ycb", "objects.names=[019_pitcher_base,035_power_drill]"],
}


@dataclass(frozen=True)
class World:
    """Two objects, their detector, and the v along which its training loss is differentiated."""

    name: str
    scene: Scene
    detector: Detector
    backbone: Parameters
    trainable: Parameters
    vector: Parameters
    psi: Float[Tensor, "objects k"]
    solve: str


def make_world(name: str, overrides: list[str]) -> World:
    """Fields and detector from the store, or made now; v by the configured solver."""
    with initialize_config_dir(str(conf_directory()), version_base="1.3"):
        made = Artifacts(build(compose("config", [*SMALL, *overrides])))
    backbone, trainable = made.detector.split(made.warm_start())
    psi, generator = made.psi("initial"), torch.Generator().manual_seed(11)
    images = join(made.scene.training_set(psi, made.x.outer.images_per_object, generator))
    weights = torch.full((len(images),), 1 / len(images))
    inner = InnerProblem(trainable, CachedSet.of(made.detector, backbone, images).losses, weights)
    validation = CachedSet.of(made.detector, backbone, made.targets["val"]).mean_terms()
    found = hypergradient(inner, validation, {}, made.x.solver, generator)
    solution = found.solution
    solve = f"{solution.status.name.lower()} in {solution.steps} steps at lambda {found.damping.value:.2g}"
    vector = unflatten(solution.value, trainable)
    return World(name, made.scene, made.detector, backbone, trainable, vector, psi, solve)


@dataclass(frozen=True)
class Truth:
    """A reference per object, centred, with the standard error of its components."""

    value: Float[Tensor, "objects k"]
    standard_error: Float[Tensor, "objects k"]

    @property
    def ceiling(self) -> list[float]:
        """Cosine that the exact vector itself would be expected to have with this estimate of it, per object."""
        noise = self.standard_error.square().sum(-1)
        signal = (self.value.square().sum(-1) - noise).clamp_min(0.0)
        return (signal / (signal + noise)).sqrt().tolist()


def hard_truth(world: World, per_bin: int, seed: int) -> Truth:
    """Sum over bins of (dp_b / dpsi) times the mean score of ``per_bin`` images of bin b."""
    probes, cached, _ = draw_bins(world, per_bin, torch.Generator().manual_seed(seed))
    found = [
        stratified(
            scores(cached.losses, world.trainable, world.vector, probe.index), probe.bins,
            world.psi[label].float(), world.scene.distribution.factors[0].log_probabilities,
        )
        for label, probe in enumerate(probes)
    ]  # fmt: skip
    return Truth(centred(found), torch.stack([part.standard_error for part in found]))


def centred(found: list[MixedDerivative] | list[Tensor]) -> Float[Tensor, "objects k"]:
    """Logits have a free constant: derivatives are compared without their mean."""
    values = torch.stack([part.value if isinstance(part, MixedDerivative) else part for part in found])
    return values - values.mean(-1, keepdim=True)


def draw_bins(
    world: World, per_bin: int, generator: torch.Generator
) -> tuple[list[Probes], CachedSet, float]:
    """Images of every bin of every object, their features, and the seconds an image took."""
    began = time.process_time()
    parts = [
        world.scene.probes(label, "pose", per_bin, world.psi[label], generator)
        for label in range(len(world.scene.names))
    ]
    images = join(parts)
    cached = CachedSet.of(world.detector, world.backbone, images)
    each = len(parts[0].images)
    probes = [
        Probes(torch.arange(each) + label * each, world.scene.distribution.bins_of(part.draw)[:, 0])
        for label, part in enumerate(parts)
    ]
    return probes, cached, (time.process_time() - began) / len(images)
