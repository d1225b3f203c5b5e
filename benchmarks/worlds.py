"""A small psi loop at its start, for the benchmarks of its parts."""

from __future__ import annotations

from hydra import compose, initialize_config_dir

from neural_sim.main import build, conf_directory
from neural_sim.studies.frozen import FrozenLoop
from neural_sim.tasks.context import Context

SMALL = [
    "scale=quick", "progress=false", "training.image_size=64", "views.count=68",
    "budget.grid.steps=160", "budget.grid.refine_steps=[50]", "budget.grid.prune_steps=[110]",
    "target.val_per_object=50", "target.test_per_object=1", "target.test_per_biased_object=1",
]  # fmt: skip


def make_world(overrides: list[str]) -> FrozenLoop:
    """Fields and detector from the store, or made now; v by the configured solver."""
    with initialize_config_dir(str(conf_directory()), version_base="1.3"):
        context = Context.of(build(compose("config", [*SMALL, *overrides])))
    return FrozenLoop.of(context, seed=11)
