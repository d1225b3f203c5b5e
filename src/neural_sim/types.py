"""Frozen dataclasses that pass tensors between packages, and can only select, move and join what they hold."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Rays:
    """Rays in the object's frame; ``directions`` are unit vectors, so that distances are Euclidean."""

    origins: Float[Tensor, "*rays 3"]
    directions: Float[Tensor, "*rays 3"]


@dataclass(frozen=True)
class PinholeCamera:
    """A pinhole camera without distortion or skew.

    ``width`` and ``height`` are in pixels. ``field_of_view`` is 2 atan(height / (2 f_y)) in radians, the vertical field
    of view if the principal point is in the middle. ``aspect`` is f_x / f_y, 1 for square pixels. ``centre`` is the
    principal point (x, y) in pixels from the image's upper left corner, where the first pixel has its centre at
    (0.5, 0.5); None: the image's centre. ``neural_sim.cameras.opencv_camera`` makes one from a camera matrix.
    """

    width: int
    height: int
    field_of_view: float
    aspect: float = 1.0
    centre: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(f"camera: width and height must be at least 1, got {self.width} x {self.height}")
        if not 0.0 < self.field_of_view < torch.pi:
            raise ValueError(f"camera: field_of_view must lie in (0, pi) radians, got {self.field_of_view}")
        if not 0.0 < self.aspect < float("inf"):
            raise ValueError(f"camera: aspect (f_x / f_y) must be positive and finite, got {self.aspect}")
        if self.centre is not None and not torch.tensor(self.centre).isfinite().all():
            raise ValueError(f"camera: the principal point must be finite, got {self.centre}")


@dataclass(frozen=True)
class PosedViews:
    """Views of one object with their cameras, the training set of a radiance field.

    ``images`` are RGBA with straight (not premultiplied) alpha in [0, 1]; ``camera_to_world`` follows OpenGL
    (x right, y up, looking along -z) in the object's normalised frame (unit sphere round the origin).
    ``light_weights`` are each view's weights over the anchor lights; None: one light for all views, or unknown lights
    (photographs). ``known`` marks the pixels that a photograph shows (None: all); alpha is 0 at the others, where it
    does not mean background.
    """

    images: Float[Tensor, "views height width 4"]
    camera_to_world: Float[Tensor, "views 4 4"]
    camera: PinholeCamera
    light_weights: Float[Tensor, "views k"] | None = None
    known: Bool[Tensor, "views height width"] | None = None

    def __len__(self) -> int:
        return self.images.shape[0]

    def select(self, index: Tensor) -> PosedViews:
        """Select views."""
        weights = None if self.light_weights is None else self.light_weights[index]
        known = None if self.known is None else self.known[index]
        return PosedViews(self.images[index], self.camera_to_world[index], self.camera, weights, known)

    def to(self, device: torch.device) -> PosedViews:
        """Copy the tensors to ``device``."""
        weights = None if self.light_weights is None else self.light_weights.to(device)
        known = None if self.known is None else self.known.to(device)
        return PosedViews(
            self.images.to(device), self.camera_to_world.to(device), self.camera, weights, known
        )


@dataclass(frozen=True)
class Maps:
    """The rendered maps, premultiplied colour and opacity: values, tangents or cotangents."""

    rgb: Float[Tensor, "n h w 3"]
    opacity: Float[Tensor, "n h w"]

    @property
    def rgba(self) -> Float[Tensor, "n h w 4"]:
        """Colour and opacity in one array."""
        return torch.cat([self.rgb, self.opacity[..., None]], -1)


@dataclass(frozen=True)
class LabelledImages:
    """Images with boxes. Rows of ``boxes`` whose label is -1 are padding.

    ``images`` are in [0, 1]; ``boxes`` are (x0, y0, x1, y1) in pixels, the image spanning [0, width] x [0, height];
    ``labels`` are class indices from 0. ``bins`` are the bins, from 0, of the first binned factor of p_psi, one for
    each image or one for each box (-1: unknown), for reports only.
    """

    images: Float[Tensor, "images 3 height width"]
    boxes: Float[Tensor, "images boxes 4"]
    labels: Int[Tensor, "images boxes"]
    bins: Int[Tensor, "images *each"]

    def __len__(self) -> int:
        return self.images.shape[0]

    def select(self, index: Tensor | slice) -> LabelledImages:
        """Select images."""
        return LabelledImages(self.images[index], self.boxes[index], self.labels[index], self.bins[index])

    def to(self, device: torch.device | str) -> LabelledImages:
        """Copy the tensors to ``device``."""
        return LabelledImages(*(getattr(self, f.name).to(device) for f in fields(LabelledImages)))

    @property
    def present(self) -> Bool[Tensor, "images boxes"]:
        """Which rows of ``boxes`` are boxes rather than padding."""
        return self.labels >= 0

    @staticmethod
    def concatenate(parts: list[LabelledImages]) -> LabelledImages:
        """Join sets of equal image size; boxes are padded to the longest list among them.

        If any set has a bin for each box, so has the result: the bin of a whole image is repeated for its boxes.

        Raises:
            ValueError: there are no sets.
        """
        if not parts:
            raise ValueError("concatenate: got no image sets, want at least one")
        most, each = max(part.boxes.shape[1] for part in parts), any(part.bins.ndim == 2 for part in parts)

        def pad(part: LabelledImages) -> LabelledImages:
            missing = most - part.boxes.shape[1]
            boxes = torch.nn.functional.pad(part.boxes, (0, 0, 0, missing))
            labels = torch.nn.functional.pad(part.labels, (0, missing), value=-1)
            bins = part.bins
            if each:
                rows = bins if bins.ndim == 2 else torch.where(part.present, bins[:, None], -1)
                bins = torch.nn.functional.pad(rows, (0, missing), value=-1)
            return LabelledImages(part.images, boxes, labels, bins)

        padded = [pad(part) for part in parts]
        joined = {f.name: torch.cat([getattr(p, f.name) for p in padded]) for f in fields(LabelledImages)}
        return LabelledImages(**joined)


@dataclass(frozen=True)
class SceneDraw:
    """Scene parameters V of one object's images, drawn from p_psi (paper, Sec. 3.1, Tool 1).

    ``phi`` and ``rho`` are the two pose angles in radians. ``distance`` is the camera's distance from the origin, in
    the unit of ``radius``, the object's radius: object radii if that is 1, else metres. ``magnification`` is the focal
    length in units of the camera's (None: 1). ``bins`` are the indices, from 0, of the drawn bins (of relaxed draws,
    those with the largest weight), with a column for each binned factor of p_psi. ``weights`` are those of the anchor
    lights (None: the light is fixed); if they are projections of Gaussian draws, ``explored`` are these draws. The
    numbers may carry gradients with respect to psi.
    """

    phi: Float[Tensor, "images"]
    rho: Float[Tensor, "images"]
    distance: Float[Tensor, "images"]
    bins: Int[Tensor, "images factors"]
    magnification: Float[Tensor, "images"] | None = None
    weights: Float[Tensor, "images lights"] | None = None
    explored: Float[Tensor, "images lights"] | None = None
    radius: float = 1.0

    def __len__(self) -> int:
        return self.phi.shape[0]

    def select(self, index: Tensor | slice) -> SceneDraw:
        """Select images."""
        values = {f.name: getattr(self, f.name) for f in fields(SceneDraw) if f.name != "radius"}
        chosen = {name: value[index] for name, value in values.items() if value is not None}
        return SceneDraw(**chosen, radius=self.radius)
