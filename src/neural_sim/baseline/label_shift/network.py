"""The classifier of bins: one small network for all objects, told which object a crop shows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import cross_entropy, mse_loss

from neural_sim.baseline.label_shift.crops import BOX_NUMBERS, Augmentation, Crops, plain
from neural_sim.ranges import Positive, PositiveInt, validated

_WIDTHS = (24, 48, 64, 96)
_FEATURES = 96
_OF_BOX = 24


@dataclass(frozen=True)
class Known:
    """Crops of renders, whose scene parameters are known.

    Attributes:
        crops: the crops.
        cells: combination of bins of each crop.
        weights: weights of the lights in each crop; no columns if the light is fixed.
    """

    crops: Crops
    cells: Int[Tensor, "n"]
    weights: Float[Tensor, "n lights"]

    def select(self, index: Tensor) -> Known:
        """Select some crops."""
        return Known(self.crops.select(index), self.cells[index], self.weights[index])


class PerObject(nn.Module):
    """A linear layer with separate weights for each object."""

    def __init__(self, objects: int, inputs: int, outputs: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.randn(objects, outputs, inputs) / math.sqrt(inputs))
        self.bias = nn.Parameter(torch.zeros(objects, outputs))

    def forward(self, values: Float[Tensor, "n i"], labels: Int[Tensor, "n"]) -> Float[Tensor, "n o"]:
        """Apply each object's layer to its crops."""
        return torch.einsum("noi,ni->no", self.weight[labels], values) + self.bias[labels]


class BinNetwork(nn.Module):
    """A network from a crop, its box and its object to logits of the cells and weights of the lights.

    All objects share the convolutions; each has its own scale and shift of their last features, its own layer to read
    its boxes, and its own last layer.
    """

    @staticmethod
    def drawn(objects: int, cells: int, lights: int, generator: torch.Generator) -> BinNetwork:
        """Return an untrained network."""
        with torch.random.fork_rng([]):
            torch.manual_seed(int(torch.randint(2**31, (), generator=generator)))
            return BinNetwork(objects, cells, lights)

    def __init__(self, objects: int, cells: int, lights: int) -> None:
        super().__init__()
        self.cells, self.lights = cells, lights
        layers: list[nn.Module] = []
        for i, (inputs, outputs) in enumerate(zip((3, *_WIDTHS), _WIDTHS, strict=False)):
            size = 5 if i == 0 else 3
            stride = 1 if i == len(_WIDTHS) - 1 else 2
            layers += [
                nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False),
                nn.BatchNorm2d(outputs),
                nn.ReLU(),
            ]
        self.convolutions = nn.Sequential(*layers)
        self.joined = nn.Linear(_WIDTHS[-1] * 16, _FEATURES)
        self.style = nn.Embedding(objects, 2 * _FEATURES)
        nn.init.zeros_(self.style.weight)
        self.box = PerObject(objects, BOX_NUMBERS, _OF_BOX)
        self.last = PerObject(objects, _FEATURES + _OF_BOX, cells + lights)

    def forward(
        self,
        seen: Float[Tensor, "n 3 side side"],
        boxes: Float[Tensor, "n numbers"],
        labels: Int[Tensor, "n"],
    ) -> tuple[Float[Tensor, "n cells"], Float[Tensor, "n lights"], Float[Tensor, "n features"]]:
        """Return logits of the cells, weights of the lights, and the features from which both are computed."""
        if not self.lights:  # the exposure of photographs differs from that of renders and must not matter
            apart = seen - seen.mean((1, 2, 3), keepdim=True)
            seen = apart / (apart.square().mean((1, 2, 3), keepdim=True).sqrt() + 0.01)
        image = self.joined(self.convolutions(seen).flatten(1))
        scale, shift = self.style(labels).chunk(2, -1)
        features = torch.cat([image * (1.0 + scale) + shift, self.box(boxes, labels)], -1).relu()
        outputs = self.last(features, labels)
        return outputs[:, : self.cells], outputs[:, self.cells :], features


@validated
@dataclass(frozen=True)
class Fitting:
    """How the network is trained.

    Args:
        epochs: number of passes over all crops.
        batch_size: largest number of crops in a step.
        learning_rate: peak learning rate of AdamW, with a one-cycle schedule.
        weight_decay: decoupled weight decay.
    """

    epochs: PositiveInt = 12
    batch_size: PositiveInt = 64
    learning_rate: Positive = 4e-3
    weight_decay: Positive = 1e-2

    def __call__(
        self,
        known: Known,
        network: BinNetwork,
        augmentation: Augmentation,
        generator: torch.Generator,
    ) -> None:
        """Train the network in place on augmented crops."""
        steps = self.epochs * math.ceil(len(known.crops) / self.batch_size)
        optimiser = torch.optim.AdamW(
            network.parameters(), self.learning_rate, weight_decay=self.weight_decay
        )
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, self.learning_rate, total_steps=steps)
        network.train()
        for _ in range(self.epochs):
            order = torch.randperm(len(known.crops), generator=generator)
            for rows in order.tensor_split(steps // self.epochs):
                part = known.select(rows)
                seen, boxes = augmentation(part.crops, generator)
                logits, weights, _ = network(seen, boxes, part.crops.labels)
                loss = cross_entropy(logits, part.cells) if network.cells > 1 else logits.sum() * 0.0
                if part.weights.shape[1]:
                    loss = loss + 10.0 * mse_loss(weights, part.weights)
                optimiser.zero_grad(set_to_none=True)
                loss.backward()
                optimiser.step()
                schedule.step()


@dataclass(frozen=True)
class Outputs:
    """A network's outputs on crops: logits of the cells, guesses of the weights of the lights, and features.

    Guesses from other sources may be added to these.
    """

    logits: Float[Tensor, "*guesses n cells"]
    weights: Float[Tensor, "n lights"]
    features: Float[Tensor, "n features"]

    def __len__(self) -> int:
        return len(self.features)

    def averaged(self, views: Int[Tensor, "n"]) -> Outputs:
        """Average the outputs of each view: crops with equal ``views`` are one observation, made more than once."""
        found, index, counts = views.unique(return_inverse=True, return_counts=True)
        if len(found) == len(views):
            return self
        mean = (index == torch.arange(len(found))[:, None]).double() / counts[:, None]
        return Outputs(mean @ self.logits, mean @ self.weights, mean @ self.features)


@torch.no_grad()
def outputs_of(network: BinNetwork, crops: Crops) -> Outputs:
    """Apply the network to unchanged crops; the result is float64."""
    network.eval()
    seen, boxes = plain(crops)
    rows = torch.arange(len(crops)).split(256)
    parts = [network(seen[part], boxes[part], crops.labels[part]) for part in rows]
    return Outputs(*(torch.cat(part).double() for part in zip(*parts, strict=True)))
