"""A scene of two small textured blocks, seen in four pose bins."""

import math

import pytest
import torch

from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Head
from neural_sim.detector.training import Training
from neural_sim.field.grid import GridField
from neural_sim.outer.inner import InnerLoop, LoopInputs
from neural_sim.outer.loop import RewardLoop
from neural_sim.outer.settings import Outer
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.scene import Scene
from neural_sim.synthesis.subjects import FieldSubject
from neural_sim.synthesis.synthesizer import Synthesizer
from neural_sim.types import PinholeCamera


def _block(seed):
    field = GridField().eval()
    field.reset(torch.ones(4, 4, 4, dtype=torch.bool), torch.full((3,), -0.6), 0.3)
    noise = torch.randn(field.table.shape, generator=torch.Generator().manual_seed(seed))
    with torch.no_grad():
        field.table.copy_(noise + 1.0)
    return field.requires_grad_(False)


@pytest.fixture(scope="module")
def scene():
    synthesizer = Synthesizer(ProceduralClutter(), shift=0.1)
    distribution = SceneDistribution.of([Pose(bins=4)])
    camera = PinholeCamera(32, 32, math.radians(40.0))
    subjects = tuple(FieldSubject(name, _block(seed), NerfRenderer()) for name, seed in (("a", 1), ("b", 2)))
    return Scene(subjects, camera, synthesizer, distribution)


@pytest.fixture
def reward_loop(scene):
    generator = torch.Generator().manual_seed(0)
    detector = RetinaNet(2, 32, anchors=Anchors(sizes=((10,), (18,)), reference=32), head=Head(8, 1))
    validation = scene.training_set(torch.zeros(2, 4), 3, generator).images
    settings = Outer(iterations=2, images_per_object=6, epochs=1, pool_per_bin=2)
    inputs = LoopInputs(detector, detector.init(torch.Generator().manual_seed(1)), validation)

    def make(method):
        generator = torch.Generator().manual_seed(2)
        inner = InnerLoop.prepare(
            scene, inputs, settings, Training(batch_size=4, weight_decay=0.0), generator
        )
        return RewardLoop(inner, torch.zeros(2, 4), method, generator)

    return make
