"""Features of a set of images, computed part by part."""

import pytest
import torch

from neural_sim.detector.cached_set import CachedSet
from neural_sim.types import LabelledImages


@pytest.mark.parametrize("sizes", [(5,), (3, 9, 1), (8, 8), (2, 2, 2)])
def test_parts_one_after_the_other_give_what_the_whole_gives_in_the_same_batches(
    tools, generator, monkeypatch, sizes
):
    detector = tools.detector()
    backbone, _ = detector.split(detector.init(generator))
    parts = [tools.images(size, seed, torch.float32) for seed, size in enumerate(sizes)]
    whole = CachedSet.of(detector, backbone, LabelledImages.concatenate(parts))
    batches, features = [], detector.features

    def counted(backbone, images):
        batches.append(len(images))
        return features(backbone, images)

    monkeypatch.setattr(detector, "features", counted)
    streamed = CachedSet.streamed(detector, backbone, iter(parts), batch_size=4)
    assert batches == [4] * (sum(sizes) // 4) + [sum(sizes) % 4] * (sum(sizes) % 4 > 0)
    assert torch.equal(streamed.targets.labels, whole.targets.labels)
    assert torch.equal(streamed.targets.deltas, whole.targets.deltas)
    for one, other in zip(streamed.features, whole.features, strict=True):
        torch.testing.assert_close(one, other)


def test_no_set_at_all_is_refused(tools, generator):
    detector = tools.detector()
    with pytest.raises(ValueError, match="got no image sets"):
        CachedSet.streamed(detector, detector.split(detector.init(generator))[0], iter([]))
