"""Estimate psi from a target's labelled boxes under label shift, in seconds and without a detector.

    estimate(scene, validation, psi, settings, generator, groups, whole) -> Estimate

A small classifier of bins (``network``), and another that uses only the size of boxes (``calibration``), are trained on
renders of all bins, from a pool that is rendered once. Both classify the target's boxes, and so does a comparison with
the renders, for poses (``comparison``), which alone reads the poses of photographs. Expectation maximisation over their
calibrated posterior (``mixture``) gives the distribution of every object and factor, with an interval for each bin;
weights of lights come from matching moments (``moments``). A factor of ``Estimate.psi`` moves only if the target
differs significantly from the present psi, there are enough boxes, these look like renders (``evidence``), the
classifier recognises renders, and the estimate is precise enough.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.baseline.label_shift.crops import crops_of, views_of
from neural_sim.baseline.label_shift.evidence import FactorEstimate
from neural_sim.baseline.label_shift.mixture import Cells
from neural_sim.baseline.label_shift.network import BinNetwork
from neural_sim.baseline.label_shift.reading import Reader
from neural_sim.baseline.label_shift.renders import known_crops, parted, pool_for, with_bank
from neural_sim.baseline.label_shift.settings import LabelShift
from neural_sim.synthesis.scene import Scene
from neural_sim.types import LabelledImages

Groups = Mapping[str, Mapping[str, Sequence[Sequence[int]]]]
"""Groups of bins, numbered from 1, that look the same because an object is symmetric, by object and factor."""


@dataclass(frozen=True)
class Estimate:
    """The distributions that the target's boxes show.

    Attributes:
        factors: the estimates of all factors, object by object.
        psi: the present psi, in which estimates replace the factors that move.
        images: number of crops of renders, those for training and those held out.
        seconds: duration.
        cpu_seconds: processor seconds by phase: pool, images, network, evidence.
    """

    factors: tuple[FactorEstimate, ...]
    psi: Float[Tensor, "objects K"]
    images: int = 0
    seconds: float = 0.0
    cpu_seconds: Mapping[str, float] = field(default_factory=dict)


@dataclass
class Clock:
    """Processor seconds by phase."""

    spent: dict[str, float] = field(default_factory=dict)
    last: float = field(default_factory=time.process_time)

    def __call__(self, what: str) -> None:
        """End the phase ``what``."""
        now = time.process_time()
        self.spent[what], self.last = self.spent.get(what, 0.0) + now - self.last, now


def estimate(
    scene: Scene,
    validation: LabelledImages,
    psi: Float[Tensor, "objects K"],
    settings: LabelShift,
    generator: torch.Generator,
    groups: Groups | None = None,
    whole: bool = False,
) -> Estimate:
    """Estimate psi from the boxes of ``validation``.

    Args:
        scene: a scene of pooled renders (``pool_of``), or one of subjects from which a pool can be rendered.
        validation: labelled images of the target.
        psi: the present psi.
        settings: settings of the estimate.
        generator: the source of all random numbers.
        groups: bins that look the same; None: every bin looks different.
        whole: read whole images instead of boxes, for ``task=classification``.
    """
    clock, begun = Clock(), time.perf_counter()
    reader = trained_reader(scene, validation, settings, generator, whole, clock)
    found, moved = [], psi.detach().cpu().double().clone()
    for label, name in enumerate(scene.names):
        own, moved[label] = reader.read(label, name, moved[label], (groups or {}).get(name, {}))
        found += own
    clock("evidence")
    images, seconds = len(reader.training.crops) + len(reader.held.crops), time.perf_counter() - begun
    return Estimate(tuple(found), moved, images, seconds, clock.spent)


def trained_reader(
    scene: Scene,
    validation: LabelledImages,
    settings: LabelShift,
    generator: torch.Generator,
    whole: bool = False,
    clock: Clock | None = None,
) -> Reader:
    """Train the classifier on renders; return the reader of the boxes of ``validation``. See ``estimate``."""
    clock = clock or Clock()
    pool = pool_for(scene, settings.per_bin, generator)
    clock("pool")
    sides = parted(with_bank(pool, settings.backgrounds, generator), settings.held_out)
    training, held = (known_crops(part, settings.compositions, generator, whole) for part in sides)
    clock("images")
    distribution = scene.distribution
    cells = Cells(tuple(f.bins for f in distribution.binned))
    network = BinNetwork.drawn(len(scene.names), cells.count, distribution.lights, generator)
    augmentation = settings.augmentation
    if distribution.lights:  # random exposures would hide the light, which is to be estimated
        augmentation = replace(augmentation, exposure=0.0)
    images = validation.to("cpu")
    target, views = crops_of(images, whole), views_of(images, whole)
    renders = None if whole else sides[0]  # the place of the object in a whole image is unknown
    reader = Reader(settings, distribution, network, renders, training, held, target, views, generator)
    if not reader.compares:
        settings.fitting(training, network, augmentation, generator)
    clock("network")
    return reader
