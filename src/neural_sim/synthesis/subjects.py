"""The objects of a scene, which draw and render themselves from their radiance fields or meshes."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import torch
import trimesh
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from neural_sim.alpha import premultiplied
from neural_sim.cameras import cameras_of, orbit
from neural_sim.field.base import RadianceField
from neural_sim.parameter.product import HARD, Draws, RelaxedDraws, SceneDistribution, SceneNoise
from neural_sim.renderer.base import MeshRenderer
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.renderer.nerf_w import NerfWRenderer
from neural_sim.renderer.rig import LightRig
from neural_sim.synthesis.assembly import RenderedObject
from neural_sim.synthesis.motion import light_names, moved_by, pose_rates
from neural_sim.types import Maps, PinholeCamera, Rays, SceneDraw

CPU = torch.device("cpu")


class Subject(Protocol):
    """One object of a scene. It draws itself alone, from p_psi; the scene composes it with others and a background.

    All kinds have exact draws. Only a ``FieldSubject`` has draws with derivatives with respect to psi
    (``RelaxedDraws``); other kinds refuse them with a ``ValueError``.
    """

    @property
    def name(self) -> str:
        """Name of the object, which is its class."""
        ...

    @property
    def device(self) -> torch.device:
        """Device of the maps; the scene parameters are on the CPU."""
        ...

    def draw(
        self,
        camera: PinholeCamera,
        distribution: SceneDistribution,
        psi: Float[Tensor, "K"],
        count: int,
        generator: torch.Generator,
        how: Draws = HARD,
    ) -> RenderedObject:
        """Draw the object ``count`` times from p_psi and render it."""
        ...

    def probe(
        self,
        camera: PinholeCamera,
        distribution: SceneDistribution,
        factor: str,
        per_bin: int,
        psi: Float[Tensor, "K"],
        generator: torch.Generator,
    ) -> RenderedObject:
        """Draw and render the object ``per_bin`` times in every bin of a factor, in the order of the bins.

        Everything else is drawn from p_psi and is the same in all bins. The bins of an illumination are its anchor
        lights.
        """
        ...


@dataclass(frozen=True)
class RenderedSubject(ABC):
    """A subject that can be rendered from every pose.

    Args:
        name: name of the object.
        radius: radius of the bounding sphere in metres, None if unknown; needed for distances in metres.
    """

    name: str
    radius: float | None = dataclasses.field(default=None, kw_only=True)

    @property
    def dtype(self) -> torch.dtype:
        """Data type of the maps."""
        return torch.float32

    @property
    def device(self) -> torch.device:
        """Device of the maps."""
        return CPU

    @abstractmethod
    def maps(
        self,
        camera: PinholeCamera,
        camera_to_world: Float[Tensor, "n 4 4"],
        weights: Float[Tensor, "n lights"] | None = None,
    ) -> Maps:
        """Render views of the object without a background.

        Args:
            camera: camera of all views.
            camera_to_world: its poses in the object's normalised frame (OpenGL axes).
            weights: each view's weights of the anchor lights; None for the object's own light.

        Returns:
            Premultiplied colour and opacity.

        Raises:
            ValueError: the object cannot be rendered, or not under these lights.
        """

    @torch.no_grad()
    def render(
        self,
        camera: PinholeCamera,
        distribution: SceneDistribution,
        draw: SceneDraw,
        noise: SceneNoise | None = None,
    ) -> RenderedObject:
        """Render the object at given scene parameters; ``noise`` is the noise that they were drawn with."""
        draw = self._with_radius(distribution, draw)
        poses = orbit(draw.phi, draw.rho, draw.distance, radius=draw.radius)
        maps = _joined(
            [
                self.maps(own, poses[rows], None if draw.weights is None else draw.weights[rows])
                for own, rows in cameras_of(camera, draw.magnification)
            ]
        )
        return RenderedObject(draw, maps.rgb, maps.opacity, noise)

    def draw(
        self,
        camera: PinholeCamera,
        distribution: SceneDistribution,
        psi: Float[Tensor, "K"],
        count: int,
        generator: torch.Generator,
        how: Draws = HARD,
    ) -> RenderedObject:
        """See ``Subject``."""
        if isinstance(how, RelaxedDraws):
            raise not_differentiable(self.name, how)
        noise = how.noise(distribution, count, generator, self.dtype)
        hard = distribution.hard(psi.detach().to(self.dtype), noise)
        return self.render(camera, distribution, hard, noise)

    def probe(
        self,
        camera: PinholeCamera,
        distribution: SceneDistribution,
        factor: str,
        per_bin: int,
        psi: Float[Tensor, "K"],
        generator: torch.Generator,
    ) -> RenderedObject:
        """See ``Subject``."""
        psi = psi.detach().to(self.dtype)
        return self.render(
            camera, distribution, distribution.probes(factor, per_bin, psi, generator, self.dtype)
        )

    def _with_radius(self, distribution: SceneDistribution, draw: SceneDraw) -> SceneDraw:
        if distribution.distance_unit == "radii":
            return draw
        if self.radius is None:
            raise ValueError(f"{self.name}: distances in metres want the object's size, which is not known")
        return replace(draw, radius=self.radius)


@dataclass(frozen=True)
class FieldSubject(RenderedSubject):
    """A radiance field with its renderer; the only subject whose images have derivatives with respect to psi.

    Args:
        name: name of the object.
        radius: see ``RenderedSubject``.
        field: the field, which may have appearance codes.
        renderer: its renderer; it must support weights of lights if the field has appearance codes.
    """

    field: RadianceField
    renderer: NerfRenderer

    @property
    @override
    def dtype(self) -> torch.dtype:
        return next(self.field.parameters()).dtype

    @property
    @override
    def device(self) -> torch.device:
        return next(self.field.parameters()).device

    @property
    def lit_renderer(self) -> NerfWRenderer:
        """The renderer, which must support weights of lights.

        Raises:
            ValueError: the renderer has no lights.
        """
        if not isinstance(self.renderer, NerfWRenderer):
            raise ValueError(
                f"parameter=illumination wants renderer=nerf_w, got {type(self.renderer).__name__}"
            )
        return self.renderer

    @override
    @torch.no_grad()
    def maps(
        self,
        camera: PinholeCamera,
        camera_to_world: Float[Tensor, "n 4 4"],
        weights: Float[Tensor, "n lights"] | None = None,
    ) -> Maps:
        poses = camera_to_world.to(self.device, self.dtype)
        if weights is None:
            return Maps(*self.renderer.render(self.field, camera, poses))
        return Maps(*self.lit_renderer.render(self.field, camera, poses, weights=weights))

    def surface(
        self,
        camera: PinholeCamera,
        camera_to_world: Float[Tensor, "n 4 4"],
        weights: Float[Tensor, "n lights"] | None = None,
    ) -> tuple[Maps, Float[Tensor, "n h w"]]:
        """Render the maps and the depth along the view axis, see ``NerfRenderer.render_surface``."""
        poses = camera_to_world.to(self.device, self.dtype)
        if weights is None:
            rgb, opacity, depth = self.renderer.render_surface(self.field, camera, poses)
        else:
            rgb, opacity, depth = self.lit_renderer.render_surface(self.field, camera, poses, weights=weights)
        return Maps(rgb, opacity), depth

    def render_rays(
        self, rays: Rays, weights: Float[Tensor, "lights"] | None = None
    ) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"]]:
        """Render rays under one light, differentiably, see ``NerfRenderer.render_rays``."""
        if weights is None:
            return self.renderer.render_rays(self.field, rays)
        return self.lit_renderer.render_rays(self.field, rays, weights=weights)

    @override
    def draw(
        self,
        camera: PinholeCamera,
        distribution: SceneDistribution,
        psi: Float[Tensor, "K"],
        count: int,
        generator: torch.Generator,
        how: Draws = HARD,
    ) -> RenderedObject:
        if not isinstance(how, RelaxedDraws):
            return super().draw(camera, distribution, psi, count, generator, how)
        logits = psi.detach().to(self.dtype)
        noise = how.noise(distribution, count, generator, self.dtype)

        def replay(psi: Tensor) -> SceneDraw:
            return distribution.relaxed(psi, noise)

        with torch.no_grad():
            draw = self._with_radius(distribution, replay(logits))
        names = moved_by(replay, logits) if how.tangents else ()
        if not names and draw.weights is None:
            return replace(self.render(camera, distribution, draw, noise), relaxed=how)
        maps, tangents = self._maps_with_tangents(camera, draw, names)
        return RenderedObject(draw, maps.rgb, maps.opacity, noise, how, tangents)

    def _maps_with_tangents(
        self, camera: PinholeCamera, draw: SceneDraw, names: tuple[str, ...]
    ) -> tuple[Maps, dict[str, Maps]]:
        """Render the maps, and their derivatives with respect to the draw's named numbers and all weights of lights."""
        poses = orbit(draw.phi, draw.rho, draw.distance, radius=draw.radius).to(self.device, self.dtype)
        rates = pose_rates(draw, names).to(poses) if names else poses.new_zeros(0, *poses.shape)
        lights = 0 if draw.weights is None else draw.weights.shape[1]
        weight_rates = torch.eye(lights, dtype=poses.dtype)[:, None].expand(-1, len(draw), -1)

        def rendered(own: PinholeCamera, rows: slice) -> list[Maps]:
            if draw.weights is None:
                maps, moved = self.renderer.render_with_tangents(self.field, own, poses[rows], rates[:, rows])
            else:
                maps, moved = self.lit_renderer.render_with_tangents(
                    self.field, own, poses[rows], rates[:, rows],
                    weights=draw.weights[rows], weight_rates=weight_rates[:, rows],
                )  # fmt: skip
            return [maps, *moved]

        each = [rendered(own, rows) for own, rows in cameras_of(camera, draw.magnification)]
        maps, *moved = (_joined(parts) for parts in zip(*each, strict=True))
        return maps, dict(zip((*names, *light_names(lights)), moved, strict=True))


@dataclass(frozen=True)
class PhotographedField(RenderedSubject):
    """A field under the light of its photographs, with colours and opacity in [0, 1], in float32 on the CPU.

    Args:
        name: name of the object.
        radius: see ``RenderedSubject``.
        field: the field; None for targets that render no object.
        renderer: its renderer.
    """

    field: RadianceField | None = None
    renderer: NerfRenderer = dataclasses.field(default_factory=NerfRenderer)

    @override
    def maps(
        self,
        camera: PinholeCamera,
        camera_to_world: Float[Tensor, "n 4 4"],
        weights: Float[Tensor, "n lights"] | None = None,
    ) -> Maps:
        if self.field is None:
            raise ValueError(f"{self.name}: nothing to render, because this target asked for no field")
        if weights is not None:
            raise ValueError(f"{self.name}: a field of photographs can only be rendered under their light")
        maps = FieldSubject(self.name, self.field, self.renderer).maps(camera, camera_to_world)
        opacity = maps.opacity[..., None]
        colour = torch.where(opacity > 0.0, maps.rgb / opacity.clamp_min(1e-6), 0.0)
        rgba = torch.cat([colour.clamp(0.0, 1.0), opacity.clamp(0.0, 1.0)], -1).float().cpu()
        return _maps_of(premultiplied(rgba))


@dataclass(frozen=True)
class MeshSubject(RenderedSubject):
    """A mesh with its renderer.

    Args:
        name: name of the object.
        radius: see ``RenderedSubject``.
        mesh: the mesh in its normalised frame.
        renderer: its renderer, whose own light applies to draws without weights of lights.
        rig: lights to which draws may give weights; None if the light is fixed.
    """

    mesh: trimesh.Trimesh
    renderer: MeshRenderer
    rig: LightRig | None = None

    @override
    @torch.no_grad()
    def maps(
        self,
        camera: PinholeCamera,
        camera_to_world: Float[Tensor, "n 4 4"],
        weights: Float[Tensor, "n lights"] | None = None,
    ) -> Maps:
        lighting = None
        if weights is not None:
            if self.rig is None:
                raise ValueError(f"{self.name}: its mesh has one fixed light, got weights of lights")
            different = weights.unique(dim=0)
            if len(different) > 1:
                raise ValueError(f"{self.name}: want the same weights of lights for all images of its mesh")
            lighting = self.rig.lighting(different[0]) if len(different) else None
        return _maps_of(premultiplied(self.renderer.render(self.mesh, camera, camera_to_world, lighting)))


def not_differentiable(name: str, how: Draws) -> ValueError:
    """Return the error of a subject that has no draws with derivatives."""
    return ValueError(f"{name}: want hard draws, because only fields are differentiated by psi, got {how}")


def _joined(parts: Sequence[Maps]) -> Maps:
    """Join the maps of consecutive images."""
    if len(parts) == 1:
        return parts[0]
    return Maps(torch.cat([part.rgb for part in parts]), torch.cat([part.opacity for part in parts]))


def _maps_of(rgba: Float[Tensor, "n h w 4"]) -> Maps:
    return Maps(rgba[..., :3], rgba[..., 3])
