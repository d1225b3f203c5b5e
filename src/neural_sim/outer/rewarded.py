"""The outer loop of methods that see only a reward: draw, train, reward."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from neural_sim.baseline.base import RewardMethod
from neural_sim.outer.inner import InnerLoop, timed
from neural_sim.outer.loop import OuterLoop


class RewardLoop(OuterLoop):
    """One training step is one round. The reward is minus L_val, which varies where AP is still zero."""

    def __init__(self, inner: InnerLoop, psi: Float[Tensor, "objects K"], method: RewardMethod) -> None:
        super().__init__(inner, psi, method.rounds * inner.settings.iterations)
        self.search = method.begin(inner.scene.distribution, self.psi.detach(), inner.generator)

    def training_step(self, batch: int, batch_idx: int) -> None:
        seconds: dict[str, float] = {}
        psi = self.search.ask()
        with timed(seconds, "render", self.inner.device):
            rendered = self.inner.draw(psi)
            images = rendered.images
        with timed(seconds, "features", self.inner.device):
            cached = self.inner.training_set(images)
        with timed(seconds, "train", self.inner.device):
            training_loss = self.inner.train(cached)
        with timed(seconds, "reward", self.inner.device):
            record = self.record(psi, images, training_loss, seconds)
        self.search.tell(-record.validation_loss, [part.draw for part in rendered.objects])
        self.psi.data = self.search.psi.clone()
        self.trajectory.append(self.psi.detach().clone())
