"""A psi loop that runs in a second: two objects, images of 32 pixels, a detector of a few thousand parameters."""

import torch

from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Backbone, Head
from neural_sim.detector.smooth_scores import SmoothAP
from neural_sim.detector.training import Training
from neural_sim.gradient.estimators import StratifiedEstimator
from neural_sim.gradient.implicit import Implicit
from neural_sim.gradient.unrolled import Unrolled
from neural_sim.outer.certificate import Trust
from neural_sim.outer.inner import InnerLoop, LoopInputs, Trained
from neural_sim.outer.module import SimulatorModule
from neural_sim.outer.objective import Loss
from neural_sim.outer.settings import Outer
from neural_sim.outer.steps import FreeSteps
from neural_sim.outer.trust_region import TrustRegion
from neural_sim.parameter.update import Mirror
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.solver.cg import ConjugateGradient
from neural_sim.solver.damping import LanczosDamping

SOLVER = AdjointSolver(ConjugateGradient(), LanczosDamping(lanczos_steps=6), max_steps=6)
TINY = {
    "num_classes": 2, "image_size": 32, "anchors": Anchors(sizes=((10,), (18,)), reference=32), "head": Head(8, 1),
}  # fmt: skip
MICRO = {"backbone": Backbone("micro"), "anchors": Anchors(sizes=((14,), (28,)), reference=48)}


FREE = {
    "objective": Loss(),
    "steps": FreeSteps(Mirror()),
    "adjoint": Implicit(curvature_images=6),
    "train_first": False,
    "trust": Trust(on_untrusted="shrink"),
}
"""The paper's: steps as they come, of the loss, by the implicit derivative."""
EVERY_STEP = TrustRegion(take_back=False)
"""The last psi is the result."""
CHECKED = {
    "objective": SmoothAP(),
    "steps": EVERY_STEP,
    "adjoint": Unrolled(),
    "train_first": True,
    "trust": Trust(level=None, on_untrusted="shrink"),
}
"""The default's, whose steps are taken whether significant or not."""


def small_loop(
    scene,
    estimator,
    iterations=2,
    solver=SOLVER,
    detector=None,
    psi=None,
    shown=slice(None),
    first=None,
    **outer,
):
    generator = torch.Generator().manual_seed(0)
    detector = RetinaNet(**(TINY | (detector or {})))
    psi = torch.zeros(2, 4) if psi is None else psi
    validation = scene.training_set(psi, 3, generator).images.select(shown)  # three of each object
    settings = Outer(iterations=iterations, images_per_object=6, epochs=1, **(FREE | outer))
    inputs = LoopInputs(detector, detector.init(generator), validation)
    training = Training(batch_size=4, weight_decay=0.0)
    inner = InnerLoop.prepare(scene, inputs, settings, training, generator, estimator.draws)
    return SimulatorModule(inner, psi, estimator, solver, generator, first)


def checked_loop(scene, iterations=3, **outer):
    return small_loop(
        scene, StratifiedEstimator(probes_per_bin=2), iterations, pool_per_bin=2, **(CHECKED | outer)
    )


def watch(monkeypatch, cls, name):
    """The arguments of every call of a method, which is called all the same."""
    calls, original = [], getattr(cls, name)

    def watched(self, *arguments, **keywords):
        calls.append((self, arguments, keywords))
        return original(self, *arguments, **keywords)

    monkeypatch.setattr(cls, name, watched)
    return calls


def scored_by(monkeypatch, worth):
    """Let trainings score what ``worth`` says of their psi [objects, K], alike in every validation image."""
    scores = property(lambda trained: worth(trained.psi).double()[:, None].expand(2, 6) / 6)
    monkeypatch.setattr(Trained, "scores", scores)
