import numpy as np
import pytest
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from neural_sim.objects.mesh import ObjectMesh, normalise
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.base import MeshRenderer
from neural_sim.renderer.lighting import Lighting
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.scene import Scene
from neural_sim.synthesis.subjects import MeshSubject
from neural_sim.synthesis.synthesizer import Synthesizer
from neural_sim.target.rendered import RenderedTarget
from neural_sim.types import PinholeCamera, SceneDraw

CAMERA = PinholeCamera(32, 32, 0.7)


class Sphere:
    """The unit sphere's silhouette in closed form: half-opaque grey within its cone, whatever the mesh."""

    name, supersample = "sphere", 1

    def __init__(self) -> None:
        self.calls: list[int] = []

    def render(
        self,
        mesh: trimesh.Trimesh,
        camera: PinholeCamera,
        camera_to_world: Float[Tensor, "n 4 4"],
        lighting: Lighting | None = None,
    ) -> Float[Tensor, "n h w 4"]:
        self.calls.append(len(camera_to_world))
        distance = camera_to_world[:, :3, 3].norm(dim=-1).float()
        focal = 0.5 * camera.height / np.tan(0.5 * camera.field_of_view)
        radius = focal / (distance.square() - 1).sqrt()
        centre = torch.arange(camera.height) + 0.5 - camera.height / 2
        inside = (centre[:, None] ** 2 + centre**2).sqrt() < radius[:, None, None]
        return torch.stack([0.5 * torch.ones_like(inside, dtype=torch.float32)] * 3 + [0.75 * inside], -1)


@pytest.fixture(scope="module")
def meshes() -> dict[str, ObjectMesh]:
    return {name: normalise(trimesh.creation.box(), name, "test") for name in ("can", "mug")}


@pytest.fixture
def synthesizer() -> Synthesizer:
    return Synthesizer(ProceduralClutter(octaves=1, contrast=0.0, shapes=0, grain=0.0), shift=0.0)


def named(meshes: dict[str, ObjectMesh], renderer: MeshRenderer | None = None) -> dict[str, MeshSubject]:
    return {name: MeshSubject(name, item.mesh, renderer or Sphere()) for name, item in meshes.items()}


def scene_of(
    meshes: dict[str, ObjectMesh], synthesizer: Synthesizer, renderer: MeshRenderer | None = None
) -> Scene:
    subjects = tuple(named(meshes, renderer).values())
    return Scene(subjects, CAMERA, synthesizer, SceneDistribution.of([Pose()]))


def draw_at(distances: list[float]) -> SceneDraw:
    distance = torch.tensor(distances)
    zero = torch.zeros_like(distance)
    return SceneDraw(zero + 1.0, zero, distance, torch.arange(len(distance))[:, None])


def test_images_boxes_and_labels_of_spheres(
    meshes: dict[str, ObjectMesh], synthesizer: Synthesizer, generator: torch.Generator
) -> None:
    draws = [draw_at([2.5, 3.0, 4.0]), draw_at([3.5])]
    made = scene_of(meshes, synthesizer).images(draws, generator)
    replayed = torch.Generator().manual_seed(0)
    plain = torch.cat([synthesizer.draw_nuisance(n, CAMERA, replayed).backgrounds for n in (3, 1)])
    assert made.labels[:, 0].tolist() == [0, 0, 0, 1]
    assert made.bins.tolist() == [0, 1, 2, 0]
    for row, distance in enumerate((2.5, 3.0, 4.0, 3.5)):
        radius = 16 / np.tan(0.35) / (distance**2 - 1) ** 0.5
        want = torch.tensor([16 - radius, 16 - radius, 16 + radius, 16 + radius]).clamp(0, 32)
        assert (made.boxes[row, 0] - want).abs().max() <= 1.0
        background = plain[row, :, 0, 0]
        torch.testing.assert_close(made.images[row, :, 0, 0], background)
        # Straight alpha: 0.75 of the object's 0.5 and a quarter of what lies behind.
        torch.testing.assert_close(made.images[row, :, 16, 16], 0.375 + 0.25 * background)


def test_many_views_come_in_chunks_and_lost_objects_without_boxes(
    meshes: dict[str, ObjectMesh], synthesizer: Synthesizer, generator: torch.Generator
) -> None:
    renderer = Sphere()
    draws = [draw_at([3.0] * 70), draw_at([500.0])]
    made = scene_of(meshes, synthesizer, renderer).images(draws, generator)
    assert renderer.calls == [64, 6, 1]
    assert made.labels[:, 0].tolist() == [0] * 70 + [-1]


def test_a_draw_per_object_is_wanted(
    meshes: dict[str, ObjectMesh], synthesizer: Synthesizer, generator: torch.Generator
) -> None:
    with pytest.raises(ValueError, match="got 1 draws for 2 objects"):
        scene_of(meshes, synthesizer).images([draw_at([3.0])], generator)


def test_sets_follow_the_target_distribution_and_share_nothing(
    meshes: dict[str, ObjectMesh], synthesizer: Synthesizer
) -> None:
    pose = SceneDistribution.of([Pose(biased={"mug": {"target": {"dominant": 3}}})])
    target = RenderedTarget(val_per_object=30, test_per_object=20, test_per_biased_object=40)
    made = target.sets(named(meshes), pose, CAMERA, synthesizer, 5)
    again = target.sets(named(meshes), pose, CAMERA, synthesizer, 5)
    other = target.sets(named(meshes), pose, CAMERA, synthesizer, 6)
    assert (len(made["val"]), len(made["test"])) == (60, 20 + 40)
    assert torch.equal(made["test"].images, again["test"].images)
    assert not torch.equal(made["val"].images, other["val"].images)
    mug = made["test"].labels[:, 0] == 1
    counts = torch.bincount(made["test"].bins[mug], minlength=8)
    assert counts.max() >= 26  # 40 draws with probability 0.86: below 26 in one of a million runs
    colours = {name: {tuple(c.tolist()) for c in part.images[:, :, 0, 0]} for name, part in made.items()}
    assert not colours["val"] & colours["test"]


def test_fewer_than_one_image_is_refused() -> None:
    with pytest.raises(ValueError, match=r"RenderedTarget\.val_per_object: want at least 1, got 0"):
        RenderedTarget(val_per_object=0)


def test_images_for_training_are_others_and_change_none_that_is_scored(
    meshes: dict[str, ObjectMesh], synthesizer: Synthesizer
) -> None:
    counts = {"val_per_object": 4, "test_per_object": 3, "test_per_biased_object": 3}
    pose = SceneDistribution.of([Pose()])
    without, made = (
        RenderedTarget(**counts, train_per_object=n).sets(named(meshes), pose, CAMERA, synthesizer, 5)
        for n in (0, 7)
    )
    assert set(without) == {"val", "test"} and len(made["train"]) == 14
    assert all(torch.equal(made[part].images, without[part].images) for part in without)
    colours = [{tuple(c.tolist()) for c in part.images[:, :, 0, 0]} for part in made.values()]
    assert not any(one & other for i, one in enumerate(colours) for other in colours[i + 1 :])
    with pytest.raises(ValueError, match=r"RenderedTarget\.train_per_object: want at least 0, got -1"):
        RenderedTarget(train_per_object=-1)
