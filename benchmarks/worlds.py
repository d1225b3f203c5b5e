"""Where estimators of the mixed term are compared: two objects at the disjoint start, their detector, v, and truths."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from hydra import compose, initialize_config_dir
from jaxtyping import Float
from torch import Tensor

from neural_sim.main import build, conf_directory
from neural_sim.outer.frozen import FrozenLoop, centred
from neural_sim.stages.context import Context
from neural_sim.stages.temperatures import frozen_loop

SMALL = [
    "scale=quick", "progress=false", "training.image_size=64", "views.count=68",
    "budget.grid.steps=160", "budget.grid.refine_steps=[50]", "budget.grid.prune_steps=[110]",
    "target.val_per_object=50", "target.test_per_object=1", "target.test_per_biased_object=1",
]  # fmt: skip
WORLDS = {
    "embedded": ["+experiment=pose_gap", "objects.names=[pitcher,drill]"],
    "ycb": ["+experiment=pose_gap_ycb", "objects.names=[019_pitcher_base,035_power_drill]"],
}


def make_world(overrides: list[str]) -> FrozenLoop:
    """Fields and detector from the store, or made now; v by the configured solver."""
    with initialize_config_dir(str(conf_directory()), version_base="1.3"):
        context = Context.of(build(compose("config", [*SMALL, *overrides])))
    return frozen_loop(context, seed=11)


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


def hard_truth(world: FrozenLoop, per_bin: int, seed: int) -> Truth:
    """From ``per_bin`` images of every bin."""
    found = world.truth(per_bin, torch.Generator().manual_seed(seed))
    return Truth(centred(found), torch.stack([part.standard_error for part in found]))
