"""Several objects an image: the estimators' derivative against enumeration of all classes, orders and bins."""

import dataclasses
import itertools

import pytest
import torch

from neural_sim.gradient.base import Losses, Probes
from neural_sim.gradient.estimators import ReinforceEstimator, StratifiedEstimator
from neural_sim.outer.derivative import object_images
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import HARD, SceneDistribution
from neural_sim.synthesis.assembly import RenderedObject
from neural_sim.synthesis.synthesizer import Synthesizer

DOUBLE = torch.float64
OBJECTS, BINS, SIZE = 3, 2, 4
PSI = torch.tensor([[0.4, -0.3], [-0.8, 0.5], [0.1, 0.9]], dtype=DOUBLE)


class Plain:
    """A dark grey wall."""

    def draw(self, n, height, width, generator, device="cpu"):
        return torch.full((n, 3, height, width), 0.2, dtype=DOUBLE)


class Painted:
    """Renders that depend on the object and its bin alone."""

    def __init__(self):
        generator = torch.Generator().manual_seed(3)
        self.opacity = torch.rand(OBJECTS, BINS, SIZE, SIZE, generator=generator, dtype=DOUBLE)
        colour = torch.rand(OBJECTS, BINS, SIZE, SIZE, 3, generator=generator, dtype=DOUBLE)
        self.rgb = colour * self.opacity[..., None]

    def in_place_of_the_fields(self, scene):
        subjects = tuple(
            PaintedSubject(name, *maps)
            for name, *maps in zip(scene.names, self.rgb, self.opacity, strict=True)
        )
        return dataclasses.replace(scene, subjects=subjects)


@dataclasses.dataclass(frozen=True)
class PaintedSubject:
    """One painted object."""

    name: str
    rgb: torch.Tensor
    opacity: torch.Tensor
    device = torch.device("cpu")

    def _at(self, draw):
        bins = draw.bins[:, 0]
        return RenderedObject(draw, self.rgb[bins], self.opacity[bins])

    def draw(self, camera, distribution, psi, count, generator, how=HARD):
        noise = distribution.draw_noise(count, generator, DOUBLE)
        return self._at(distribution.hard(psi, noise))

    def probe(self, camera, distribution, factor, per_bin, psi, generator):
        return self._at(distribution.probes(factor, per_bin, psi, generator, DOUBLE))


@pytest.fixture
def several(scene):
    def made(counts):
        return dataclasses.replace(
            scene,
            subjects=tuple(dataclasses.replace(scene.fields[0], name=name) for name in "abc"),
            distribution=SceneDistribution.of([Pose(bins=BINS, floor=0.0)]),
            synthesizer=Synthesizer(Plain(), shift=0.0, minimum_area=1.0, objects_per_image=counts),
            camera=dataclasses.replace(scene.camera, width=SIZE, height=SIZE),
        )

    return made


def score(images):
    """What an image is worth: not additive in its objects, so that neighbours and order matter."""
    weights = torch.linspace(-1.0, 2.0, images[0].numel(), dtype=DOUBLE).view_as(images[0])
    return ((images * weights).flatten(1).sum(1) / 10.0).square()


def enumerated(painted, counts, psi):
    """The mean score of an image: over numbers of objects, sets of classes, orders and bins."""
    p, total = psi.softmax(-1), torch.zeros((), dtype=DOUBLE)
    fewest, most = counts
    for count in range(fewest, most + 1):
        chains = list(
            itertools.permutations(range(OBJECTS), count)
        )  # a set and an order of it, the nearest first
        for chain in chains:
            for bins in itertools.product(range(BINS), repeat=count):
                image = Plain().draw(1, SIZE, SIZE, None)[0]
                for label, chosen in reversed(list(zip(chain, bins, strict=True))):
                    cover = painted.opacity[label, chosen]
                    image = painted.rgb[label, chosen].movedim(-1, 0) + (1.0 - cover) * image
                chance = torch.stack(
                    [torch.ones_like(total), *(p[o, b] for o, b in zip(chain, bins, strict=True))]
                )
                total = total + chance.prod() * score(image[None])[0] / len(chains) / (most - fewest + 1)
    return total


def truth(painted, counts):
    psi = PSI.clone().requires_grad_()
    return torch.autograd.grad(enumerated(painted, counts, psi), psi)[0]


def lossy(values):
    """Losses whose derivative along v = 1 by the only parameter are ``values``."""
    return lambda params, index: params["scale"] * values[index]


ONE = {"scale": torch.ones((), dtype=DOUBLE)}


@pytest.mark.parametrize("counts", [(1, 2), (1, 3), (0, 2), (2, 3)])
def test_the_stratified_derivative_is_that_of_enumeration(several, counts):
    painted = Painted()
    scene = painted.in_place_of_the_fields(several(counts))
    generator, per_bin = torch.Generator().manual_seed(0), 4000
    expected = truth(painted, counts)
    rendered = scene.training_set(PSI, 3000, generator, HARD)
    weights = torch.full((len(rendered),), 1.0 / len(rendered), dtype=DOUBLE)
    held = object_images(scene, rendered, PSI, weights)
    for label, name in enumerate(scene.names):
        # The part of the images that show the object; its expectation is that of the derivative.
        share = counts[0] + counts[1]
        assert float(held[name].weights.sum()) == pytest.approx(0.5 * share / OBJECTS, rel=0.05)
        images, draw = scene.probes(label, "pose", per_bin, PSI, generator)
        probes = {"pose": Probes(torch.arange(len(images)), draw.bins[:, 0])}
        losses = Losses(lossy(score(rendered.images.images)), lambda *_: None, lossy(score(images.images)))
        found = StratifiedEstimator(per_bin).estimate(losses, ONE, ONE, held[name], probes)
        weighed = found.value * 0.5 * share / OBJECTS / held[name].weights.sum()
        assert float((weighed - expected[label]).norm()) < 4.0 * float(found.standard_error.norm())
        assert float(found.standard_error.norm()) < 0.1 * float(expected.norm())


@pytest.mark.parametrize("counts", [(0, 3)])
@pytest.mark.slow
def test_the_score_functions_derivative_is_that_of_enumeration(several, counts):
    painted, generator = Painted(), torch.Generator().manual_seed(1)
    scene = painted.in_place_of_the_fields(several(counts))
    expected = truth(painted, counts)
    rendered = scene.training_set(PSI, 800, generator, HARD)
    weights = torch.full((len(rendered),), 1.0 / len(rendered), dtype=DOUBLE)
    losses = Losses(lossy(score(rendered.images.images)), lambda *_: None)
    for label, held in enumerate(object_images(scene, rendered, PSI, weights).values()):
        found = ReinforceEstimator().estimate(losses, ONE, ONE, held, {})
        error = float(found.standard_error.norm())
        assert float((found.value - expected[label]).norm()) < 4.0 * error < 0.6 * float(expected.norm())


def test_images_are_made_again_of_one_objects_maps(several):
    """Composed again of the same maps they are the same; of others, only where the object shows, and as if drawn so."""
    scene = Painted().in_place_of_the_fields(several((1, 3)))
    rendered = scene.training_set(PSI, 20, torch.Generator().manual_seed(0), HARD)
    part, rows = rendered.objects[1], rendered.rows[1]
    again = rendered.compose[1](part.rgb, part.opacity)
    assert torch.equal(again.images, rendered.images.images[rows])
    assert torch.equal(again.boxes, rendered.images.boxes[rows])
    gone = rendered.compose[1](torch.zeros_like(part.rgb), torch.zeros_like(part.opacity))
    assert not bool((gone.labels == 1).any()) and bool((again.labels == 1).any())
    rgb, opacity = (values.clone().requires_grad_() for values in (part.rgb, part.opacity))
    moved = tuple(
        torch.randn(v.shape, generator=torch.Generator().manual_seed(1), dtype=DOUBLE) for v in (rgb, opacity)
    )

    def along(step):
        images = rendered.compose[1](rgb + step * moved[0], opacity + step * moved[1]).images
        return score(images).sum()

    slopes = torch.autograd.grad(along(0.0), (rgb, opacity))
    derivative = sum(float((slope * by).sum()) for slope, by in zip(slopes, moved, strict=True))
    assert derivative == pytest.approx(float((along(1e-6) - along(-1e-6)).detach()) / 2e-6, rel=1e-6)


def test_an_image_shows_each_object_once_at_most(several):
    with pytest.raises(ValueError, match="at most 3, the number of objects"):
        several((1, 4)).training_set(PSI, 4, torch.Generator())
