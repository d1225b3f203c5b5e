import pytest
import torch
from torchvision.models.detection._utils import BoxCoder, Matcher
from torchvision.ops import box_iou

from neural_sim.detector.losses import BACKGROUND


def test_assign_is_torchvisions_matcher_image_by_image(tools):
    detector = tools.detector(image_size=96, anchors={"sizes": ((16, 24), (40, 64)), "reference": 96})
    generator = torch.Generator().manual_seed(3)
    corner = torch.rand(40, 3, 2, generator=generator, dtype=torch.float64) * 60
    boxes = torch.cat([corner, corner + 5 + torch.rand(40, 3, 2, generator=generator).double() * 30], dim=-1)
    labels = torch.randint(0, 3, (40, 3), generator=generator)
    labels[:10, 2] = -1
    labels[:4] = -1
    targets = detector.assign(boxes, labels)
    anchors, matcher = detector.anchors.double(), Matcher(0.5, 0.4, allow_low_quality_matches=True)
    seen = set()
    for image in range(40):
        kept = labels[image] >= 0
        if not kept.any():
            assert (targets.labels[image] == BACKGROUND).all()
            continue
        match = matcher(box_iou(boxes[image][kept], anchors))
        wanted = torch.where(match >= 0, labels[image][kept][match.clamp(min=0)], match)
        assert torch.equal(targets.labels[image], wanted)
        seen |= set(match.sign().tolist()) | {int(match.min())}
        foreground = match >= 0
        code = BoxCoder((1.0,) * 4).encode_single(boxes[image][kept][match[foreground]], anchors[foreground])
        torch.testing.assert_close(targets.deltas[image][foreground], code, rtol=1e-12, atol=1e-13)
        assert (targets.deltas[image][~foreground] == 0).all()
    assert {-2, -1, 1} <= seen


def test_images_without_boxes_and_without_rows(tools, images):
    detector = tools.detector()
    targets = detector.assign(images.boxes, images.labels)
    assert (targets.labels[-1] == BACKGROUND).all()
    assert (targets.labels[0] >= 0).any()
    none = detector.assign(torch.zeros(2, 0, 4), torch.zeros(2, 0, dtype=torch.long))
    assert none.labels.shape == (2, len(detector.anchors))
    assert (none.labels == BACKGROUND).all()


def test_deltas_carry_the_boxes_gradient(tools, images):
    boxes = images.boxes.clone().requires_grad_()
    deltas = tools.detector().assign(boxes, images.labels).deltas
    (gradient,) = torch.autograd.grad(deltas.sum(), boxes)
    assert torch.isfinite(gradient).all()
    assert (gradient[0, 0] != 0).any()
    assert (gradient[images.labels < 0] == 0).all()


def test_bad_boxes_and_labels_are_refused(tools):
    detector = tools.detector()
    with pytest.raises(ValueError, match=r"x0 < x1"):
        detector.assign(torch.tensor([[[4.0, 4.0, 4.0, 9.0]]]), torch.tensor([[0]]))
    with pytest.raises(ValueError, match="below 3, got 3"):
        detector.assign(torch.tensor([[[4.0, 4.0, 8.0, 9.0]]]), torch.tensor([[3]]))
