"""Labelled images, composed of renders of one object each; they can be composed again from other renders."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from neural_sim.parameter.product import RelaxedDraws, SceneNoise
from neural_sim.synthesis.layout import Layout
from neural_sim.synthesis.synthesizer import Nuisance, Synthesizer
from neural_sim.types import LabelledImages, Maps, SceneDraw

PIXELS = 2**22
"""Number of pixels of all layers of the images that are composed together, which bounds the memory."""

Compose = Callable[[Float[Tensor, "m h w 3"], Float[Tensor, "m h w"]], LabelledImages]


@dataclass(frozen=True)
class RenderedObject:
    """m renders of one object alone: premultiplied colour and opacity, and the scene parameters of each render.

    Renders from a pool stay in 8 bits, a quarter of the memory, until ``maps`` are needed to compose images.
    ``noise`` reproduces the draw; it is None if that is not possible, as for pools, probes and pictures. ``relaxed`` is
    None for hard draws. ``tangents``, if rendered, are the maps' derivatives with respect to the named numbers of the
    draw.
    """

    draw: SceneDraw
    rgb: Float[Tensor, "m h w 3"] | UInt8[Tensor, "m h w 3"]
    opacity: Float[Tensor, "m h w"] | UInt8[Tensor, "m h w"]
    noise: SceneNoise | None = None
    relaxed: RelaxedDraws | None = None
    tangents: Mapping[str, Maps] | None = None

    def __len__(self) -> int:
        return len(self.draw)

    @property
    def bins(self) -> Int[Tensor, "m"]:
        """Bins of the first binned factor, for reports; -1 if no factor is binned."""
        bins = self.draw.bins
        return bins[:, 0] if bins.shape[1] else torch.full((len(bins),), -1)

    @property
    def dtype(self) -> torch.dtype:
        """Data type of ``maps``."""
        return self.rgb.dtype if self.rgb.is_floating_point() else torch.float32

    def maps(self, index: Int[Tensor, "k"] | None = None) -> Maps:
        """Return the maps of some of the renders, None: of all, with values from 0 to 1."""
        there = slice(None) if index is None else index.to(self.rgb.device)
        rgb, opacity = self.rgb[there], self.opacity[there]
        return (
            Maps(rgb, opacity) if rgb.is_floating_point() else Maps(rgb.float() / 255, opacity.float() / 255)
        )

    def select(self, index: Int[Tensor, "k"]) -> RenderedObject:
        """Return some of the renders, without what would reproduce or differentiate them."""
        there = index.to(self.rgb.device)
        return RenderedObject(self.draw.select(index), self.rgb[there], self.opacity[there])


@dataclass(frozen=True)
class RenderedImages:
    """Labelled images with the renders they are made of, class by class.

    ``rows[c]`` are the images that show ``objects[c]``, one for each of its renders. ``compose[c]`` makes these images
    again from other maps of that object, with everything else unchanged; it is differentiable in the maps.
    """

    images: LabelledImages
    objects: tuple[RenderedObject, ...]
    rows: tuple[Int[Tensor, "_"], ...]
    compose: tuple[Compose, ...]

    def __len__(self) -> int:
        return len(self.images)

    def without_maps(self) -> RenderedImages:
        """Return the images without the maps they were composed of, which take more memory than the images.

        Empty maps replace them. They are clones, because an empty view would keep all of the memory.
        """
        objects = tuple(
            replace(part, rgb=part.rgb[:0].clone(), opacity=part.opacity[:0].clone()) for part in self.objects
        )
        return replace(self, objects=objects, compose=())


def one_each(
    objects: Sequence[RenderedObject],
    nuisances: Sequence[Nuisance],
    labels: Sequence[int],
    synthesizer: Synthesizer,
) -> RenderedImages:
    """Compose one image from every render, object by object; ``labels`` are the objects' classes."""
    images, rows, compose, first = [], [], [], 0
    for part, nuisance, label in zip(objects, nuisances, labels, strict=True):

        def again(
            rgb: Tensor,
            opacity: Tensor,
            nuisance: Nuisance = nuisance,
            label: int = label,
            bins: Tensor = part.bins,
        ) -> LabelledImages:
            return synthesizer.compose(rgb, opacity, nuisance, label, bins)

        with torch.no_grad():
            maps = part.maps()
            images.append(again(maps.rgb, maps.opacity))
        rows.append(torch.arange(first, first + len(part)))
        compose.append(again)
        first += len(part)
    return RenderedImages(LabelledImages.concatenate(images), tuple(objects), tuple(rows), tuple(compose))


@dataclass(frozen=True)
class Shared:
    """Images of several objects. Layer l of image i shows render number ``place[i, l]`` of its object; -1: nothing."""

    objects: tuple[RenderedObject, ...]
    layout: Layout
    place: Int[Tensor, "n layers"]
    nuisance: Nuisance
    bins: Int[Tensor, "n"]
    synthesizer: Synthesizer

    @staticmethod
    def of(
        objects: Sequence[RenderedObject],
        layout: Layout,
        nuisance: Nuisance,
        synthesizer: Synthesizer,
    ) -> Shared:
        """Combine ``objects`` into images; each class's renders are in the order in which ``layout`` shows it."""
        place = torch.full_like(layout.labels, -1)
        own = torch.full((len(layout),), -1)
        for label, part in enumerate(objects):
            rows, columns = layout.places(label)
            if len(rows) != len(part):
                raise ValueError(f"layout: want {len(rows)} renders of class {label}, got {len(part)}")
            place[rows, columns] = torch.arange(len(rows))
            mine = columns == 0
            own[rows[mine]] = part.bins[mine].to(own)
        return Shared(tuple(objects), layout, place, nuisance, own, synthesizer)

    def composed(self) -> RenderedImages:
        """Compose all images."""
        count = range(len(self.objects))
        high, wide = self.objects[0].opacity.shape[1:]
        together = max(1, PIXELS // (self.layout.labels.shape[1] * high * wide))
        with torch.no_grad():
            parts = [self.images(rows) for rows in torch.arange(len(self.layout)).split(together)]
        rows = tuple(self.layout.places(label)[0] for label in count)
        return RenderedImages(
            LabelledImages.concatenate(parts),
            self.objects,
            rows,
            tuple(self._again(label) for label in count),
        )

    def images(
        self, rows: Int[Tensor, "m"], columns: Int[Tensor, "m"] | None = None, maps: Maps | None = None
    ) -> LabelledImages:
        """Compose the images ``rows``; ``maps``, if given, replace layer ``columns[i]`` of the i-th."""
        labels, place = self.layout.labels[rows], self.place[rows]
        like = self.objects[0]
        size = (*place.shape, *like.opacity.shape[1:])
        rgb, opacity = (like.rgb.new_zeros(of, dtype=like.dtype) for of in ((*size, 3), size))
        distance = torch.zeros(place.shape, dtype=torch.float64)
        for label, part in enumerate(self.objects):
            here = labels == label
            index, there = place[here], here.to(rgb.device)
            own = part.maps(index)
            rgb[there], opacity[there] = own.rgb, own.opacity
            distance[here] = part.draw.distance.detach().double()[index]
        if columns is not None and maps is not None:
            layer = (torch.arange(len(rows), device=rgb.device), columns.to(rgb.device))
            rgb, opacity = rgb.index_put(layer, maps.rgb), opacity.index_put(layer, maps.opacity)
        return self.synthesizer.compose_several(
            rgb,
            opacity,
            distance,
            Layout(labels, self.layout.order[rows]),
            self.nuisance.select(rows),
            self.bins[rows],
        )

    def _again(self, label: int) -> Compose:
        rows, columns = self.layout.places(label)
        return lambda rgb, opacity: self.images(rows, columns, Maps(rgb, opacity))

    def repeated(self, index: Int[Tensor, "m"], label: int, part: RenderedObject) -> Shared:
        """Return the images ``index``; the renders of ``part`` (class ``label``), in order, replace their column 0."""
        place = self.place[index].clone()
        place[:, 0] = torch.arange(len(index))
        objects = [part if i == label else other for i, other in enumerate(self.objects)]
        return replace(
            self,
            objects=tuple(objects), layout=self.layout.select(index), place=place,
            nuisance=self.nuisance.select(index), bins=part.bins.to(self.bins),
        )  # fmt: skip
