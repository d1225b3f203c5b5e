"""A scene that shows given pictures of the objects, such as the views that fields are fitted to, not their fields."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad
from torchvision.transforms.v2.functional import resize

from neural_sim.alpha import premultiplied
from neural_sim.synthesis.assembly import RenderedObject
from neural_sim.synthesis.draws import HARD, Draws
from neural_sim.synthesis.scene import Scene
from neural_sim.types import PosedViews, SceneDraw


@dataclass(frozen=True)
class PictureScene(Scene):
    """A :class:`Scene` that draws among each object's pictures with replacement, whatever psi is.

    ``pictures`` are premultiplied RGBA of the scene's image size, ``seen`` from where they were taken, both by object.
    """

    pictures: tuple[Float[Tensor, "n h w 4"], ...] = ()
    seen: tuple[SceneDraw, ...] = ()

    @staticmethod
    def of(scene: Scene, views: Sequence[PosedViews]) -> PictureScene:
        """Of the views of every object of ``scene``, as large as fits into its images, in their middle.

        Raises:
            ValueError: another number of views than of objects.
        """
        if len(views) != len(scene.names):
            raise ValueError(f"PictureScene: want views of {len(scene.names)} objects, got {len(views)}")
        height, width = scene.camera.height, scene.camera.width
        pictures, seen = [], []
        for label, each in enumerate(views):
            rgba = each.images.to(scene.device(label), scene.dtype(label))
            pictures.append(_fitted(premultiplied(rgba), height, width))
            seen.append(_seen(each, 1.0 if scene.radii is None else scene.radii[label]))
        return PictureScene(
            **{f.name: getattr(scene, f.name) for f in fields(Scene)},
            pictures=tuple(pictures),
            seen=tuple(seen),
        )

    def drawn(
        self, label: int, psi: Float[Tensor, "K"], count: int, generator: torch.Generator, how: Draws = HARD
    ) -> RenderedObject:
        """``count`` of the object's pictures."""
        chosen = torch.randint(len(self.pictures[label]), (count,), generator=generator)
        maps = self.pictures[label][chosen.to(self.device(label))]
        return RenderedObject(self.seen[label].select(chosen), maps[..., :3], maps[..., 3])

    def _bins(self, objects: Sequence[RenderedObject]) -> list[Int[Tensor, "m"]]:
        """Unknown: pictures are not drawn by bins."""
        return [torch.full((len(part),), -1) for part in objects]


def _fitted(maps: Float[Tensor, "n h w 4"], height: int, width: int) -> Float[Tensor, "n height width 4"]:
    """Maps resized to fit into an image, with empty margins."""
    scale = min(height / maps.shape[1], width / maps.shape[2])
    size = [round(scale * maps.shape[1]), round(scale * maps.shape[2])]
    small = resize(maps.movedim(-1, 1), size, antialias=True)
    left, top = (width - size[1]) // 2, (height - size[0]) // 2
    return pad(small, (left, width - size[1] - left, top, height - size[0] - top)).movedim(1, -1)


def _seen(views: PosedViews, radius: float) -> SceneDraw:
    """From where views were taken: angles in radians, distances in the unit of ``radius``, the object's."""
    centres = views.camera_to_world[:, :3, 3].cpu()
    distance, (x, y, z) = centres.norm(dim=-1), centres.unbind(-1)
    none = torch.zeros(len(views), 0, dtype=torch.long)
    return SceneDraw((z / distance).acos(), torch.atan2(y, x), distance * radius, none, radius=radius)
