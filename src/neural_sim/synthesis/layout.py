"""Which objects share an image, and which is in front: not part of p_psi, and drawn before anything is rendered.

The number of objects in an image is uniform in a range. Their classes differ, and each set of a given size is equally
likely. Every image has a class of its own, so that all classes get equally many images; the others follow at random.
Only an image of no objects does not show its own class.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class ObjectCount:
    """The number of objects in an image, uniform from ``fewest``, which may be 0, to ``most``."""

    fewest: int = 1
    most: int = 1

    def check(self, classes: int) -> None:
        """Raise ``ValueError`` if an image may have more objects than there are classes."""
        if self.most > classes:
            raise ValueError(
                f"synthesis.objects_per_image: want at most {classes}, the number of objects, got {self.most}"
            )

    @property
    def mean(self) -> float:
        """Mean number of objects in an image."""
        return 0.5 * (self.fewest + self.most)

    def draw(self, n: int, generator: torch.Generator, present: bool = False) -> Int[Tensor, "n"]:
        """Draw the numbers of objects in n images; if ``present``, in images that show one given class.

        An image of c objects shows that class with a probability proportional to c; hence, among the images that show
        it, the probability of c objects is proportional to c.
        """
        numbers = torch.arange(self.fewest, self.most + 1)
        weights = numbers.double() if present else torch.ones(len(numbers), dtype=torch.float64)
        return numbers[torch.multinomial(weights, n, replacement=True, generator=generator)]


@dataclass(frozen=True)
class Layout:
    """The classes of n images, and which object is in front.

    ``labels`` are the classes in each image, -1 for none; column 0 has the image's own class, if it shows any. If two
    objects are equally distant, the one with the smaller ``order``, in [0, 1), is in front.
    """

    labels: Int[Tensor, "n most"]
    order: Float[Tensor, "n most"]

    def __len__(self) -> int:
        return len(self.labels)

    def select(self, index: Tensor) -> Layout:
        """Return the layout of some of the images."""
        return Layout(self.labels[index], self.order[index])

    def places(self, label: int) -> tuple[Int[Tensor, "m"], Int[Tensor, "m"]]:
        """Return the images (rows) and columns in which a class appears, at most once in an image."""
        row, column = (self.labels == label).nonzero().unbind(1)
        return row, column


def draw_layout(
    own: Int[Tensor, "n"], classes: int, count: ObjectCount, generator: torch.Generator, present: bool = False
) -> Layout:
    """Draw the layout of images whose own classes are ``own``; for ``present`` see ``ObjectCount.draw``.

    Raises:
        ValueError: ``count`` allows more objects in an image than there are classes.
    """
    count.check(classes)
    counts = count.draw(len(own), generator, present)
    keys = torch.rand((len(own), classes), generator=generator)
    keys[torch.arange(len(own)), own] = -1.0
    labels = keys.argsort(1)[:, : count.most]
    labels = torch.where(torch.arange(count.most) < counts[:, None], labels, -1)
    return Layout(labels, torch.rand(labels.shape, generator=generator))


def own_labels(counts: Sequence[int]) -> Int[Tensor, "n"]:
    """Return labels class by class, as many of each as ``counts`` says."""
    return torch.arange(len(counts)).repeat_interleave(torch.tensor(list(counts)))
