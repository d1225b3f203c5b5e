"""Learn which poses to render with your own renderer, using the psi loop as a library without configuration files.

The renderer here draws cubes with painted faces. Put yours in its place: the loop asks it for colour and opacity at
given camera poses and needs no derivatives.

    python examples/own_renderer.py
"""

from __future__ import annotations

import argparse
import logging
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from neural_sim.baseline.label_shift.settings import LabelShift
from neural_sim.cameras import rays
from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors
from neural_sim.detector.training import Training, train_detector
from neural_sim.gradient.estimators import StratifiedEstimator
from neural_sim.outer.first_step import WhatTheTargetShows
from neural_sim.outer.inner import InnerLoop, LoopInputs
from neural_sim.outer.loop import learn_psi
from neural_sim.outer.module import SimulatorModule
from neural_sim.outer.settings import Outer
from neural_sim.parameter.distributions import total_variation
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.solver.cg import ConjugateGradient
from neural_sim.solver.damping import LanczosDamping
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.scene import Scene
from neural_sim.synthesis.subjects import RenderedSubject
from neural_sim.synthesis.synthesizer import Synthesizer
from neural_sim.types import Maps, PinholeCamera

SIZE = 48
BINS = 8


@dataclass(frozen=True)
class PaintedCube(RenderedSubject):
    """A cube inside the unit sphere with a different colour on each face: the renderer to replace with yours."""

    colours: Tensor  # [6, 3], colours of the faces -x, -y, -z, +x, +y, +z

    def maps(self, camera: PinholeCamera, camera_to_world: Tensor, weights: Tensor | None = None) -> Maps:
        """Intersect the ray of every pixel with the cube; see ``RenderedSubject.maps``."""
        bundle = rays(camera, camera_to_world)
        half = 1.0 / math.sqrt(3.0)
        near = (-half * bundle.directions.sign() - bundle.origins) / bundle.directions
        far = (half * bundle.directions.sign() - bundle.origins) / bundle.directions
        entry, axis = near.max(-1)
        opacity = (entry < far.amin(-1)).float()
        positive = bundle.directions.gather(-1, axis[..., None])[..., 0] < 0
        return Maps(self.colours[axis + 3 * positive] * opacity[..., None], opacity)


def main() -> None:
    """Learn psi for two cubes, and print its distance from the target distribution before and after."""
    parser = argparse.ArgumentParser(description="Learn which poses to render with a renderer of your own.")
    parser.add_argument("--iterations", type=int, default=4, help="iterations of the psi loop")
    parser.add_argument(
        "--images", type=int, default=100, help="images per object in each training of the loop"
    )
    parser.add_argument("--steps", type=int, default=100, help="smallest number of steps in each training")
    parser.add_argument("--renders", type=int, default=48, help="renders per object and bin")
    parser.add_argument("--epochs", type=int, default=15, help="epochs of the warm start")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)  # no tips
    generator = torch.Generator().manual_seed(0)

    # p_psi has eight bins of poses and starts with most of its mass on bin 7. The target mostly shows bin 3, which the
    # loop has to find from 100 labelled images per object; here they are drawn from `target` instead of photographed.
    distribution = SceneDistribution.of([Pose(bins=BINS, initial={"dominant": 7}, target={"dominant": 3})])
    cubes = (
        PaintedCube("warm", torch.rand(6, 3, generator=generator) * torch.tensor([1.0, 0.6, 0.4])),
        PaintedCube("cold", torch.rand(6, 3, generator=generator) * torch.tensor([0.4, 0.7, 1.0])),
    )
    camera = PinholeCamera(SIZE, SIZE, math.radians(45.0))
    scene = Scene(cubes, camera, Synthesizer(ProceduralClutter(), shift=0.1), distribution)
    initial, target = (distribution.psi(which, scene.names) for which in ("initial", "target"))
    validation = scene.training_set(target, 100, generator).images

    # Every training starts from a backbone that has seen the objects from all sides.
    detector = RetinaNet(len(cubes), SIZE, anchors=Anchors(sizes=((14,), (28,)), reference=SIZE))
    training = Training(batch_size=16)
    uniform = scene.training_set(torch.zeros_like(initial), 2 * options.images, generator).images
    started, _ = train_detector(
        detector, detector.init(generator), uniform, generator, training.of(options.epochs)
    )

    # The first psi to try is estimated from the target's boxes; the derivative of each training then proposes the next.
    # A training accepts or rejects every step, object by object.
    reading = LabelShift()
    settings = Outer(
        iterations=options.iterations,
        images_per_object=options.images,
        least_steps=options.steps,
        pool_per_bin=options.renders,
        first_step=reading,
    )
    inputs = LoopInputs(detector, started, validation)
    inner = InnerLoop.prepare(scene, inputs, settings, training, generator)
    # The solver is not used: the default derivative solves no linear system.
    solver = AdjointSolver(ConjugateGradient(), LanczosDamping())
    first = WhatTheTargetShows(reading)
    loop = SimulatorModule(inner, initial, StratifiedEstimator(probes_per_bin=16), solver, generator, first)
    learned = learn_psi(loop)

    wanted = distribution.probabilities(target)["pose"]
    for when, psi in (("before", initial), ("after", learned.last)):
        distances = total_variation(distribution.probabilities(psi)["pose"], wanted)
        each = ", ".join(f"{name} {value:.2f}" for name, value in zip(scene.names, distances, strict=True))
        print(f"total variation to the target's poses, {when}: {each}")


if __name__ == "__main__":
    main()
