"""Cut-outs behind and in front of objects: where they are, what they hide, and what stays differentiable."""

import numpy as np
import pytest
import torch
from PIL import Image

from neural_sim.field.grid import GridField
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.synthesis import distractors as distractors_module
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.distractors import Cover, Distractors
from neural_sim.synthesis.export.images import ImageSource
from neural_sim.synthesis.layout import Layout
from neural_sim.synthesis.scene import Scene
from neural_sim.synthesis.subjects import FieldSubject
from neural_sim.synthesis.synthesizer import Nuisance, Synthesizer
from neural_sim.types import PinholeCamera

CAMERA = PinholeCamera(24, 16, 0.7)
RED = (255, 0, 0)


@pytest.fixture
def folder(tmp_path):
    """A red disc in a clear green surround, and an opaque blue bar."""
    y, x = np.mgrid[:40, :40] - 19.5
    disc = np.zeros((40, 40, 4), np.uint8)
    disc[..., 1], inside = 255, x**2 + y**2 < 18**2
    disc[inside] = (*RED, 255)
    Image.fromarray(disc).save(tmp_path / "disc.png")
    (tmp_path / "more").mkdir()
    Image.new("RGBA", (60, 10), (0, 0, 255, 255)).save(tmp_path / "more" / "bar.png")
    return tmp_path


@pytest.fixture
def scene_with():
    """A scene of two blocks, by its distractors."""

    def block(seed):
        field = GridField().eval()
        field.reset(torch.ones(4, 4, 4, dtype=torch.bool), torch.full((3,), -0.6), 0.3)
        noise = torch.randn(field.table.shape, generator=seeded(seed))
        with torch.no_grad():
            field.table.copy_(noise + 1.0)
        return field.requires_grad_(False)

    def scene(distractors):
        synthesizer = Synthesizer(ProceduralClutter(), shift=0.1, distractors=distractors)
        camera, distribution = PinholeCamera(32, 32, 0.7), SceneDistribution.of([Pose(bins=4)])
        subjects = tuple(FieldSubject(name, block(i), NerfRenderer()) for name, i in (("a", 1), ("b", 2)))
        return Scene(subjects, camera, synthesizer, distribution)

    return scene


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("most", [1700, 700, 1])
def test_no_more_pictures_are_kept_than_the_memory_is_for(folder, most, monkeypatch):
    wanted = Distractors(folder).draw(20, 16, 24, seeded())
    monkeypatch.setattr(distractors_module, "KEPT", most)
    distractors = Distractors(folder)
    for part, whole in zip(distractors.draw(20, 16, 24, seeded()), wanted, strict=True):
        assert torch.equal(part.rgb, whole.rgb) and torch.equal(part.opacity, whole.opacity)
    kept = [picture.width * picture.height for picture in distractors._pictures.values()]
    assert len(kept) == 1 or sum(kept) <= most


def test_numbers_sizes_and_sides_are_as_asked_for(folder):
    distractors = Distractors(folder, count=(1, 1), size=(0.5, 0.5), front=0.4)
    behind, front = distractors.draw(400, 16, 24, seeded())
    shown = [(part.opacity > 0.5).flatten(1).sum(1) for part in (behind, front)]
    in_front = (shown[1] > 0) & (shown[0] == 0)
    assert not ((shown[0] > 0) & (shown[1] > 0)).any(), "each image has one"
    assert float(in_front.double().mean()) == pytest.approx(0.4, abs=3.5 * (0.24 / 400) ** 0.5)
    whole = torch.cat([part.opacity.flatten(1).sum(1) for part in (behind, front)])
    # Half of 16 pixels: a disc of 0.9 times that diameter, or a bar of 8 x 1; at the edges less.
    disc = np.pi * (18 / 40 * 8) ** 2
    assert float(whole.max()) == pytest.approx(disc, rel=0.05)
    assert ((whole - 8.0).abs() < 1e-3).any()


def test_colours_are_premultiplied_and_clear_ones_do_not_enter(folder):
    (folder / "more" / "bar.png").unlink()
    _, front = Distractors(folder, count=(3, 3), front=1.0).draw(50, 16, 24, seeded())
    torch.testing.assert_close(front.rgb[..., 0], front.opacity, atol=2 / 255, rtol=0)
    assert float(front.rgb[..., 1].max()) <= 2 / 255, "the clear surround's green"
    assert float(front.opacity.max()) <= 1.0 and float(front.rgb.min()) >= 0.0


def test_covers_go_over_images_like_any_layer():
    rgb, opacity = torch.rand(2, 4, 5, 3, dtype=torch.float64), torch.rand(2, 4, 5, dtype=torch.float64)
    images = torch.rand(2, 3, 4, 5, dtype=torch.float64)
    made = Cover(rgb, opacity).over(images)
    assert float(made[1, 2, 3, 4]) == pytest.approx(
        float(rgb[1, 3, 4, 2] + (1 - opacity[1, 3, 4]) * images[1, 2, 3, 4]), abs=1e-15
    )


def test_equal_generators_give_equal_covers_and_none_draw_no_numbers(folder):
    first, again = (Distractors(folder).draw(5, 16, 24, seeded(3)) for _ in range(2))
    assert all(torch.equal(a.rgb, b.rgb) for a, b in zip(first, again, strict=True))
    for unused in (Distractors(), Distractors(folder, count=(0, 0))):
        generator = seeded(3)
        assert unused.draw(5, 16, 24, generator) is None
        assert torch.equal(generator.get_state(), seeded(3).get_state())


def _nuisance(front, n=1, objects=None):
    shifts = torch.zeros((n, 2) if objects is None else (n, objects, 2), dtype=torch.long)
    return Nuisance(torch.full((n, 3, 16, 24), 0.5), shifts, None, front)


def _square(x0, x1):
    opacity = torch.zeros(1, 16, 24)
    opacity[:, 4:12, x0:x1] = 1.0
    return opacity


@pytest.mark.parametrize("several", [False, True])
def test_what_is_in_front_cuts_boxes_and_takes_them_away(several):
    synthesizer = Synthesizer(ProceduralClutter(), minimum_area=4, min_visibility=0.3)
    opacity = _square(6, 14)
    for hidden, box in ((10, [10.0, 4.0, 14.0, 12.0]), (13, None), (0, [6.0, 4.0, 14.0, 12.0])):
        cover = _square(0, hidden)
        front = Cover(cover[..., None] * torch.tensor([1.0, 0.0, 0.0]), cover)
        rgb = opacity[..., None].expand(-1, -1, -1, 3)
        if several:
            layout = Layout(torch.tensor([[0]]), torch.zeros(1, 1))
            made = synthesizer.compose_several(
                rgb[:, None],
                opacity[:, None],
                torch.ones(1, 1),
                layout,
                _nuisance(front, objects=1),
                torch.zeros(1, dtype=torch.long),
            )
        else:
            made = synthesizer.compose(rgb, opacity, _nuisance(front), 0, torch.zeros(1, dtype=torch.long))
        assert made.labels.tolist() == [[0 if box else -1]]
        assert box is None or made.boxes[0, 0].tolist() == box
        colours = made.images[0, :, 6]
        assert colours[:, :hidden].tolist() == [[1.0] * hidden, [0.0] * hidden, [0.0] * hidden]
        assert float(colours[0, 14]) == 0.5


def test_images_stay_differentiable_behind_what_hides_them():
    generator = seeded(1)
    cover = torch.rand(1, 16, 24, generator=generator, dtype=torch.float64)
    front = Cover(0.4 * cover[..., None].expand(-1, -1, -1, 3), cover)
    synthesizer = Synthesizer(ProceduralClutter(), minimum_area=1)
    rgb, opacity = torch.rand(1, 16, 24, 3, dtype=torch.float64), torch.rand(1, 16, 24, dtype=torch.float64)
    rgb.requires_grad_()
    images = synthesizer.compose(rgb, opacity, _nuisance(front), 0, torch.zeros(1, dtype=torch.long)).images
    (slope,) = torch.autograd.grad(images[:, 1].sum(), rgb)
    torch.testing.assert_close(slope[..., 1], 1.0 - cover)


def test_a_training_set_has_them_and_its_probes_too(scene_with, folder):
    scene = scene_with(Distractors(folder, count=(2, 2), size=(0.5, 0.9), front=1.0))
    psi = torch.zeros(2, 4)
    with_them = scene.training_set(psi, 6, seeded()).images
    without = scene_with(Distractors()).training_set(psi, 6, seeded()).images
    assert not torch.equal(with_them.images, without.images)
    assert with_them.present.sum() <= without.present.sum()
    probes, _ = scene.probes(0, "pose", 2, psi, seeded())
    assert ((probes.images[:, 0] > 0.95) & (probes.images[:, 1] < 0.05)).any(), "a red disc in front"


def test_exported_masks_leave_out_what_is_hidden(scene_with, folder):
    psi, scenes = torch.zeros(2, 4), {}
    for name, distractors in (
        ("bare", Distractors()),
        ("hidden", Distractors(folder, (3, 3), (0.6, 0.9), 1.0)),
    ):
        source = ImageSource(scene_with(distractors), psi, PinholeCamera(48, 48, 0.7), (100.0, 100.0), 0)
        scenes[name] = [source.image(number) for number in range(6)]
    lost = 0
    for bare, hidden in zip(scenes["bare"], scenes["hidden"], strict=True):
        for a, b in zip(bare.objects, hidden.objects, strict=True):
            assert np.array_equal(a.full, b.full) and not (b.visible & ~a.visible).any()
            lost += int((a.visible & ~b.visible).sum())
        assert not (hidden.depth[bare.depth == 0.0]).any()
    assert lost > 0


def test_files_without_an_alpha_channel_are_named(tmp_path):
    with pytest.raises(ValueError, match="no picture"):
        Distractors(tmp_path)
    Image.new("RGB", (8, 8)).save(tmp_path / "plain.png")
    with pytest.raises(ValueError, match=r"plain\.png: want a picture with an alpha channel, got mode RGB"):
        Distractors(tmp_path, count=(1, 1)).draw(1, 16, 24, seeded())
    (tmp_path / "plain.png").write_bytes(b"no picture")
    with pytest.raises(ValueError, match=r"plain\.png: not a readable image"):
        Distractors(tmp_path, count=(1, 1)).draw(1, 16, 24, seeded())
