"""The psi loop on a small scene: it replays, records, and moves psi against the derivative."""

import copy
import dataclasses
import math

import pytest
import torch
from small_loop import small_loop

from neural_sim.detector.cached_set import CachedSet
from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Head
from neural_sim.gradient.estimators import ReinforceEstimator, StratifiedEstimator
from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.outer.derivative import bound_losses, object_images
from neural_sim.outer.loop import learn_psi
from neural_sim.outer.steps import FreeSteps
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import HardDraws, RelaxedDraws, SceneDistribution
from neural_sim.parameter.update import Mirror
from neural_sim.parameter.zoom import Zoom
from neural_sim.synthesis.pool import pool_of
from neural_sim.types import PinholeCamera

CAMERA = PinholeCamera(32, 32, math.radians(40.0))

ESTIMATORS = [
    PathwiseEstimator(),
    PathwiseEstimator("reverse"),
    StratifiedEstimator(probes_per_bin=2),
    ReinforceEstimator(),
]


@pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda e: type(e).__name__ + getattr(e, "mode", ""))
def test_the_loop_records_every_iteration_and_moves_psi(scene, estimator):
    module = small_loop(scene, estimator)
    learned = learn_psi(module)
    assert len(learned.records) == 2
    first = learned.records[0]
    assert first.probabilities["pose"] == [[0.25] * 4] * 2
    assert first.entropies["pose"] == pytest.approx([math.log(4)] * 2)
    assert math.isfinite(first.validation_loss) and first.certificate.adjoint.damping > 0
    assert {"render", "train", "hypergradient", "hypergradient_solve"} <= set(first.seconds)
    assert all(record.cpu_seconds > 0.0 for record in learned.records)
    assert torch.isfinite(learned.last).all() and (learned.last != 0).any()
    assert (learned.last.abs() <= 2 * module.settings.steps.update.max_step).all()


@pytest.mark.parametrize("start", ["fresh", "previous"])
@pytest.mark.parametrize("train_first", [False, True])
def test_the_first_hypergradient_is_taken_at_the_warm_start_unless_it_trains_first(scene, start, train_first):
    module = small_loop(scene, StratifiedEstimator(probes_per_bin=2), start=start, train_first=train_first)
    warm, objective = module.inner.warm_start, module.inner.objective
    at_warm_start = float(objective.of_outputs(objective.outputs(warm)))
    first, second = learn_psi(module).records
    batches = 12 // 4
    assert (first.detector_steps, second.detector_steps) == (batches * train_first, batches)
    assert (first.validation_loss == at_warm_start) is not train_first
    assert math.isfinite(first.training_loss)


def test_the_same_seed_gives_the_same_psi_bit_for_bit(scene):
    runs = [learn_psi(small_loop(scene, StratifiedEstimator(probes_per_bin=2))).last for _ in range(2)]
    assert torch.equal(*runs)


def test_the_backbone_stays_frozen(scene):
    module = small_loop(scene, ReinforceEstimator())
    before = {name: value.clone() for name, value in module.inner.detector.split(module.theta)[0].items()}
    learn_psi(module)
    after = module.inner.detector.split(module.theta)[0]
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_replaying_noise_and_nuisance_gives_the_same_images(scene):
    generator = torch.Generator().manual_seed(3)
    psi = torch.tensor([0.5, -0.2, 0.1, 0.0])
    rendered = scene.training_set(psi.expand(2, -1), 4, generator, RelaxedDraws())
    part, images = rendered.objects[1], rendered.images.select(rendered.rows[1])
    draw = scene.distribution.relaxed(psi, part.noise)
    torch.testing.assert_close(draw.phi, part.draw.phi)
    again = rendered.compose[1](part.rgb, part.opacity)
    assert torch.equal(again.images, images.images) and torch.equal(again.boxes, images.boxes)


@pytest.mark.parametrize("bin_mean", ["linear", "circular"])
def test_forward_and_reverse_mode_agree_through_the_loops_own_binding(scene, bin_mean):
    """The scene's tangents, and the paper's second forward through the path that the loop binds, in float64."""
    subjects = tuple(
        dataclasses.replace(subject, field=copy.deepcopy(subject.field).double()) for subject in scene.fields
    )
    distribution = SceneDistribution.of([Pose(bins=4, temperature=1.0, bin_mean=bin_mean)])
    wide = dataclasses.replace(scene, subjects=subjects, distribution=distribution)
    generator = torch.Generator().manual_seed(1)
    detector = RetinaNet(2, 32, anchors=Anchors(sizes=((10,), (18,)), reference=32), head=Head(8, 1))
    params = {name: value.double() for name, value in detector.init(generator).items()}
    backbone, trainable = detector.split(params)
    vector = {
        name: torch.randn(value.shape, generator=generator).double() for name, value in trainable.items()
    }
    psi = torch.randn(2, 4, generator=generator, dtype=torch.float64)
    forward = PathwiseEstimator(mode="forward")
    rendered = wide.training_set(psi, 4, generator, forward.draws)
    assert all(set(part.tangents) == {"phi"} for part in rendered.objects)
    losses = bound_losses(CachedSet.of(detector, backbone, rendered.images), backbone, None)
    weights = torch.full((8,), 0.125, dtype=torch.float64)
    for held in object_images(wide, rendered, psi, weights).values():
        bare = dataclasses.replace(held, path=dataclasses.replace(held.path, tangents=None))
        for patch_size in (64, 10**6):
            reverse = PathwiseEstimator(mode="reverse", patch_size=patch_size)
            found = [
                estimator.estimate(losses, trainable, vector, batch, {}).value
                for estimator, batch in ((forward, held), (reverse, bare))
            ]
            assert found[0].dtype == torch.float64 and float(found[1].norm()) > 0.0
            assert float((found[0] - found[1]).norm() / found[1].norm()) < 1e-8


@pytest.mark.parametrize("pooled", [True, False])
def test_training_sets_have_the_expected_number_of_images_of_every_bin_unless_draws_are_independent(
    scene, pooled
):
    generator = torch.Generator().manual_seed(0)
    scene = pool_of(scene, 1, generator) if pooled else scene

    def counts(how):
        drawn = scene.training_set(torch.zeros(2, 4), 40, generator, how)
        return torch.stack([part.draw.bins[:, 0].bincount(minlength=4) for part in drawn.objects])

    assert (counts(HardDraws()) == 10).all()
    assert not (counts(HardDraws(explore=True)) == 10).all()


def test_the_mode_says_whether_the_first_render_carries_tangents(scene):
    for mode, carried in (("forward", True), ("reverse", False)):
        module = small_loop(scene, PathwiseEstimator(mode=mode))
        drawn = module.inner.draw(torch.zeros(2, 4), module.numbers)
        assert all((part.tangents is not None) is carried for part in drawn.objects)


def test_probes_cover_every_bin_equally(scene):
    images, draw = scene.probes(0, "pose", 3, torch.zeros(2, 4), torch.Generator().manual_seed(0))
    assert draw.bins[:, 0].tolist() == images.bins.tolist() == [b for b in range(4) for _ in range(3)]
    assert torch.equal(scene.distribution.bins_of(draw), draw.bins)


@pytest.mark.parametrize("pooled", [True, False])
def test_probes_show_the_same_scenes_in_every_bin(scene, pooled):
    generator = torch.Generator().manual_seed(0)
    scene = pool_of(scene, 4, generator) if pooled else scene
    images, draw = scene.probes(0, "pose", 8, torch.zeros(2, 4), generator)
    for same in (draw.rho, draw.distance, images.images[:, :, 0, 0], images.images[:, :, -1, -1]):
        table = same.unflatten(0, (4, 8))
        assert torch.equal(table, table[:1].expand_as(table))
        assert len(same[:8].unique(dim=0)) > 1
    place = draw.phi.view(4, 8) - torch.pi / 2 * torch.arange(4)[:, None]
    torch.testing.assert_close(place, place[:1].expand(4, 8))


def test_cached_losses_equal_losses_from_images(scene):
    generator = torch.Generator().manual_seed(0)
    detector = RetinaNet(2, 32, anchors=Anchors(sizes=((10,), (18,)), reference=32), head=Head(8, 1))
    backbone, trainable = detector.split(detector.init(generator))
    images = scene.training_set(torch.zeros(2, 4), 4, generator).images
    cached = CachedSet.of(detector, backbone, images)
    targets = detector.assign(images.boxes, images.labels)
    direct = detector.per_image_loss(trainable, detector.features(backbone, images.images), targets)
    torch.testing.assert_close(cached.losses(trainable, torch.arange(8)), direct, rtol=1e-4, atol=1e-5)
    total = sum(term(trainable) for term in cached.mean_terms(chunk_size=3))
    torch.testing.assert_close(total, direct.mean(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda e: type(e).__name__ + getattr(e, "mode", ""))
def test_every_factor_of_a_product_is_learned(scene, estimator):
    joint = SceneDistribution.of([Pose(bins=3), Zoom(bins=2)])
    scene = dataclasses.replace(scene, distribution=joint)
    module = small_loop(
        scene, estimator, 1, psi=torch.zeros(2, 5), pool_per_bin=2, steps=FreeSteps(Mirror(shrink=False))
    )
    learned = learn_psi(module)
    assert set(learned.records[0].probabilities) == {"pose", "zoom"}
    certificate = learned.records[0].certificate
    for name in ("a", "b"):
        assert set(certificate.p_values[name]) == set(certificate.actions[name]) == {"pose", "zoom"}
        assert all(0.0 < p <= 1.0 for p in certificate.p_values[name].values())
    assert all((part.abs().amax(-1) > 0.0).all() for part in joint.split(learned.last).values())


def test_the_pool_holds_every_combination_of_bins(scene):
    joint = SceneDistribution.of([Pose(bins=3), Zoom(bins=2)])
    generator, psi = torch.Generator().manual_seed(0), torch.zeros(5)
    pool = pool_of(dataclasses.replace(scene, distribution=joint), 4, generator)
    held = pool.subjects[0].drawn
    assert len(held) == 2 * 6  # 4 a bin of the finest factor: 2 in each of 3 x 2 cells
    assert torch.equal(joint.bins_of(held), held.bins)
    drawn = pool.draw(1, psi, 200, generator).draw
    assert torch.equal(joint.bins_of(drawn), drawn.bins)
    probes = pool.probes(1, "zoom", 5, psi.expand(2, -1), generator)[1]
    assert probes.bins[:, 1].tolist() == [0] * 5 + [1] * 5
