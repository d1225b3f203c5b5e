"""A pool has the fewest renders of each combination of bins that give every bin its number; few are ever floats."""

import math
from dataclasses import replace

import pytest
import torch

from neural_sim.parameter.factor import BinnedFactor
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.parameter.unlearned import Unlearned
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.pool import PooledSubject, pool_cells, pool_of
from neural_sim.synthesis.scene import CHUNK, Scene
from neural_sim.synthesis.subjects import RenderedSubject
from neural_sim.synthesis.synthesizer import Synthesizer
from neural_sim.types import Maps, PinholeCamera


@pytest.mark.parametrize("per_bin", [1, 4, 5, 7])
@pytest.mark.parametrize("bins", [(4,), (3, 2), (2, 5), (4, 2, 3)])
def test_every_bin_has_at_least_the_renders_that_are_asked_for_and_no_more_than_it_takes(bins, per_bin):
    coordinates = ("phi", "rho", "distance")
    factors = [BinnedFactor(c, c, count, 1.0, 2.0) for c, count in zip(coordinates, bins, strict=False)]
    cells, per_cell = pool_cells(factors, per_bin)
    assert cells == math.prod(bins)
    scarcest = min(cells // count for count in bins)  # combinations that hold a bin of the finest factor
    assert scarcest * per_cell >= per_bin > scarcest * (per_cell - 1)
    assert pool_cells([], per_bin) == (1, per_bin)


@pytest.mark.parametrize("several", [(1, 1), (2, 2)])
def test_renders_of_a_pool_stay_in_eight_bits_until_images_are_composed(several, generator, monkeypatch):
    distribution = SceneDistribution.of([Pose(bins=4)])
    draw = distribution.at_bins(
        {"pose": torch.arange(4).repeat_interleave(3)}, distribution.draw_noise(12, generator)
    )
    subjects = tuple(
        PooledSubject(name, torch.randint(256, (4, 3, 24, 24, 4), generator=generator).byte(), draw)
        for name in ("lamp", "cup")
    )
    synthesizer = Synthesizer(ProceduralClutter(), objects_per_image=several)
    scene = Scene(subjects, PinholeCamera(24, 24, 0.7), synthesizer, distribution)

    def drawn():
        psi = distribution.uniform.expand(2, -1)
        return scene.training_set(psi, 5, torch.Generator().manual_seed(1))

    stored, take = drawn(), PooledSubject.draw
    assert all(part.rgb.dtype == part.opacity.dtype == torch.uint8 for part in stored.objects)

    def opened(subject, *arguments):
        part = take(subject, *arguments)
        return replace(part, rgb=part.rgb.float() / 255, opacity=part.opacity.float() / 255)

    monkeypatch.setattr(PooledSubject, "draw", opened)
    as_floats = drawn()
    assert torch.equal(stored.images.images, as_floats.images.images)
    assert torch.equal(stored.images.boxes, as_floats.images.boxes)
    part = stored.objects[0]
    assert part.dtype == part.maps().rgb.dtype == torch.float32
    assert torch.equal(part.maps(torch.tensor([2])).opacity, as_floats.objects[0].opacity[2:3])


class Seen(RenderedSubject):
    """A subject whose opacity says from where it is seen, and which remembers how many views it rendered at a time."""

    def __init__(self):
        super().__init__("seen", radius=0.25)
        object.__setattr__(self, "counts", [])

    def maps(self, camera, camera_to_world, weights=None):
        self.counts.append(len(camera_to_world))
        opacity = (0.5 + 0.5 * camera_to_world[:, 2, 2])[:, None, None].expand(
            -1, camera.height, camera.width
        )
        return Maps(torch.zeros(*opacity.shape, 3), opacity)


def test_a_pool_is_rendered_in_chunks_and_holds_the_renders_of_its_draws():
    subject, camera = Seen(), PinholeCamera(2, 1, 0.7)
    distribution = SceneDistribution.of(
        [Pose(bins=4)], Unlearned(distance=(0.5, 0.7), distance_unit="metres")
    )
    scene = Scene((subject,), camera, Synthesizer(ProceduralClutter()), distribution)
    (pooled,) = pool_of(scene, 40, torch.Generator().manual_seed(0)).subjects
    assert subject.counts == [64, 64, 32] and max(subject.counts) <= CHUNK
    assert pooled.drawn.radius == 0.25 and pooled.maps.shape == (4, 40, 1, 2, 4)
    wanted = scene.render(0, pooled.drawn).opacity
    assert (pooled.maps.flatten(0, 1)[..., 3] / 255 - wanted).abs().max() <= 0.5 / 255 + 1e-6
