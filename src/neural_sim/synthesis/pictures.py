"""Objects shown in scenes by given pictures, such as the views to which their fields are fitted."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad
from torchvision.transforms.v2.functional import resize

from neural_sim.alpha import premultiplied
from neural_sim.parameter.product import HARD, Draws, RelaxedDraws, SceneDistribution
from neural_sim.synthesis.assembly import RenderedObject
from neural_sim.synthesis.subjects import not_differentiable
from neural_sim.types import PinholeCamera, PosedViews, SceneDraw


@dataclass(frozen=True)
class PictureSubject:
    """Pictures of an object, drawn with replacement, whatever psi is.

    Args:
        name: name of the object.
        pictures: premultiplied RGBA with the size of the scene's images.
        seen: the pose from which each picture was taken, without bins.
    """

    name: str
    pictures: Float[Tensor, "n h w 4"]
    seen: SceneDraw

    @staticmethod
    def of(name: str, views: PosedViews, camera: PinholeCamera, radius: float = 1.0) -> PictureSubject:
        """Return a subject made of views, in the middle of images of ``camera`` and as large as fits.

        Args:
            name: name of the object.
            views: the views, on the device of the scene's images.
            camera: camera of the scene's images.
            radius: the object's radius in the unit of the scene's distances.
        """
        fitted = _fitted(premultiplied(views.images), camera.height, camera.width)
        return PictureSubject(name, fitted, _seen(views, radius))

    @property
    def device(self) -> torch.device:
        """Device of the maps."""
        return self.pictures.device

    def draw(
        self,
        camera: PinholeCamera,
        distribution: SceneDistribution,
        psi: Float[Tensor, "K"],
        count: int,
        generator: torch.Generator,
        how: Draws = HARD,
    ) -> RenderedObject:
        """Draw ``count`` of the pictures; psi has no influence."""
        if isinstance(how, RelaxedDraws):
            raise not_differentiable(self.name, how)
        chosen = torch.randint(len(self.pictures), (count,), generator=generator)
        rgba = self.pictures[chosen.to(self.device)]
        return RenderedObject(self.seen.select(chosen), rgba[..., :3], rgba[..., 3])

    def probe(
        self,
        camera: PinholeCamera,
        distribution: SceneDistribution,
        factor: str,
        per_bin: int,
        psi: Float[Tensor, "K"],
        generator: torch.Generator,
    ) -> RenderedObject:
        """Refuse: there are no pictures of a given bin."""
        raise ValueError(f"{self.name}: pictures are not drawn by bins, want a field or a mesh")


def _fitted(maps: Float[Tensor, "n h w 4"], height: int, width: int) -> Float[Tensor, "n height width 4"]:
    """Return maps resized to fit into an image, with empty margins."""
    scale = min(height / maps.shape[1], width / maps.shape[2])
    size = [max(1, round(scale * side)) for side in maps.shape[1:3]]
    small = resize(maps.movedim(-1, 1), size, antialias=True)
    left, top = (width - size[1]) // 2, (height - size[0]) // 2
    return pad(small, (left, width - size[1] - left, top, height - size[0] - top)).movedim(1, -1)


def _seen(views: PosedViews, radius: float) -> SceneDraw:
    """Return the poses of the views: angles in radians, distances in the unit of the object's ``radius``."""
    centres = views.camera_to_world[:, :3, 3].cpu()
    distance, (x, y, z) = centres.norm(dim=-1), centres.unbind(-1)
    none = torch.zeros(len(views), 0, dtype=torch.long)
    return SceneDraw((z / distance).acos(), torch.atan2(y, x), distance * radius, none, radius=radius)
