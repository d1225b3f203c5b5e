"""Experiments that ask one question of fields and detectors from the store, in place of the stages of a run."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from neural_sim.artifacts import Artifacts
from neural_sim.experiment import Experiment
from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.outer.still import StillLoop
from neural_sim.outer.temperatures import Temperatures
from neural_sim.report import figures
from neural_sim.report.interpolation import Interpolation, interpolation_figure
from neural_sim.report.temperatures import report_temperatures
from neural_sim.report.tracking import tracking_uri
from neural_sim.synthesis.scene import join


def interpolate_lights(experiment: Experiment, interpolation: Interpolation, folder: Path) -> None:
    """The figure of ``+experiment=illumination_interpolation``, and how little opacity changed, in ``folder``."""
    made, rig = Artifacts(experiment), experiment.views.rig
    if rig is None:
        raise ValueError("interpolation: want renderer=nerf_w, the light is fixed")
    fields = dict(zip(made.names, made.scene.fields, strict=True))
    camera = experiment.views.camera(interpolation.image_size)
    ways = interpolation.ways(fields, made.scene.lit_renderer, camera, rig.anchors)
    first, last = interpolation.ends
    title = f"From light {first} to light {last}"
    figures.save(interpolation_figure(ways, title), folder / "figures" / "interpolation.png")
    changes = {name: way.opacity_change for name, way in ways.items()}
    (folder / "interpolation.json").write_text(json.dumps({"opacity_change": changes}, indent=1))
    print(f"largest change of opacity: {max(changes.values()):.1e}\nresults: {folder}")


def vary_temperature(experiment: Experiment, temperatures: Temperatures, folder: Path) -> None:
    """``+experiment=gumbel_temperature``: draws, bias and variance at every temperature, at the initial psi and the
    warm-started detector, to ``folder`` and MLflow."""
    if not isinstance(experiment.gradient, PathwiseEstimator):
        raise ValueError("temperatures: want gradient=pathwise, no other estimator relaxes its draws")
    begun, made, images = time.time(), Artifacts(experiment), experiment.outer.images_per_object
    psi, generator = made.psi("initial"), torch.Generator().manual_seed(experiment.seed)
    drawn = join(made.scene.training_set(psi, images, generator))
    theta, validation = made.warm_start(), made.targets["val"]
    loop = StillLoop.at(
        made.scene, made.detector, theta, psi, drawn, validation, experiment.solver, generator
    )
    rows, truths = temperatures.measure(loop, experiment.gradient, images, experiment.seed)
    uri = tracking_uri(experiment.mlflow)
    named = experiment.name, experiment.seed, experiment.config
    run = report_temperatures(rows, truths, *named, uri, folder, begun)
    print(f"v {loop.solve}; {time.time() - begun:.0f} s\nresults: {folder}\n{run.where}")


STUDIES: dict[str, Callable[[Experiment, Any, Path], None]] = {
    "interpolation": interpolate_lights,
    "temperatures": vary_temperature,
}
"""By the top-level key of the configuration that asks for them."""
