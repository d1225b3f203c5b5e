"""A detector small enough for a dense Hessian, trained on two objects, to compare solvers with a dense reference."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch

from neural_sim.detector.cached_set import CachedSet
from neural_sim.detector.protocol import Detector
from neural_sim.detector.training import Optimisation, train_detector
from neural_sim.field.grid import GridField
from neural_sim.gradient.base import Params
from neural_sim.gradient.estimators import importance_weights
from neural_sim.gradient.implicit import InnerProblem
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.solver.hvp import Term
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.scene import Scene
from neural_sim.synthesis.subjects import FieldSubject
from neural_sim.synthesis.synthesizer import Synthesizer
from neural_sim.types import LabelledImages, PinholeCamera

BINS = 4
PSI = torch.tensor([[0.0, 1.0, 0.0, -0.5], [0.5, 0.0, 1.5, 0.0]], dtype=torch.float64)
SIZE = 32


def small_scene() -> Scene:
    """Make a scene of two textured blocks in front of clutter, at 32 pixels."""

    def block(seed: int) -> GridField:
        field = GridField().eval()
        field.reset(torch.ones(4, 4, 4, dtype=torch.bool), torch.full((3,), -0.6), 0.3)
        noise = torch.randn(field.table.shape, generator=torch.Generator().manual_seed(seed))
        with torch.no_grad():
            field.table.copy_(noise + 1.0)
        return field.requires_grad_(False)

    camera = PinholeCamera(SIZE, SIZE, math.radians(40.0))
    synthesizer = Synthesizer(ProceduralClutter(), shift=0.1)
    distribution = SceneDistribution.of([Pose(bins=BINS)])
    subjects = tuple(FieldSubject(name, block(seed), NerfRenderer()) for name, seed in (("a", 1), ("b", 2)))
    return Scene(subjects, camera, synthesizer, distribution)


def trained_problem(make: Callable[..., Detector], images: int = 40) -> tuple[InnerProblem, list[Term]]:
    """Train a detector on ``images`` of each object; return its inner problem and L_val.

    The inner problem has one image per bin and object, weighted by the probability of the bin divided by the number of
    objects. Both are in float64.
    """
    generator, scene = torch.Generator().manual_seed(0), small_scene()
    detector = make(num_classes=2, image_size=SIZE)
    drawn = scene.training_set(PSI, images, generator).images
    validation = scene.training_set(PSI.flip(-1), 8, generator).images
    probes = [scene.probes(label, "pose", 1, PSI, generator)[0] for label in range(2)]
    params, _ = train_detector(
        detector, detector.init(generator), drawn, generator,
        Optimisation(40, batch_size=16, learning_rate=1e-2, weight_decay=1e-2),
    )  # fmt: skip
    backbone, warm = detector.split(params)
    held = CachedSet.of(detector, backbone, LabelledImages.concatenate(probes)).double()
    factor = scene.distribution.binned[0]
    p = [factor.log_probabilities(psi).exp() for psi in PSI]
    weights = torch.cat([importance_weights(each, torch.arange(BINS), 0.5) for each in p])
    problem = InnerProblem(as_double(warm), held.losses, weights)
    return problem, CachedSet.of(detector, backbone, validation).double().mean_terms()


def as_double(params: Params) -> Params:
    """Return the parameters in float64."""
    return {name: value.double() for name, value in params.items()}
