"""Who shares an image: counts, classes, and what follows where one of them is fixed."""

import itertools
import math

import pytest
import torch

from neural_sim.synthesis.layout import ObjectCount, draw_layout, own_labels


def test_every_image_has_its_own_class_and_different_others():
    own = own_labels([40, 50, 60, 70])
    layout = draw_layout(own, 4, ObjectCount(1, 3), torch.Generator().manual_seed(0))
    assert torch.equal(layout.labels[:, 0], own) and layout.labels.shape == (220, 3)
    for row in layout.labels.tolist():
        shown = [label for label in row if label >= 0]
        assert len(set(shown)) == len(shown) and row[: len(shown)] == shown
    rows, columns = layout.places(2)
    assert torch.equal(layout.labels[rows, columns], torch.full((len(rows),), 2))
    assert len(rows) == int((layout.labels == 2).sum()) == len(rows.unique())


def test_an_empty_image_has_no_class_at_all():
    layout = draw_layout(own_labels([300, 300]), 2, ObjectCount(0, 1), torch.Generator().manual_seed(0))
    empty = (layout.labels < 0).all(1)
    assert 0.4 < float(empty.double().mean()) < 0.6


@pytest.mark.parametrize(("fewest", "most"), [(1, 3), (0, 2), (2, 2)])
def test_sets_given_one_class_are_those_of_all_images_that_show_it(fewest, most):
    """By enumeration: a set S of c classes has probability 1 / (number of counts) / C(4, c) in the training set, whose
    images have equally many own classes; given class 1, in proportion among the sets that hold it."""
    classes, count, draws = 4, ObjectCount(fewest, most), 40_000
    sets = {
        frozenset(chosen): 1.0 / (most - fewest + 1) / math.comb(classes, c)
        for c in range(fewest, most + 1)
        for chosen in itertools.combinations(range(classes), c)
    }
    generator = torch.Generator().manual_seed(0)

    def frequencies(layout):
        rows = [frozenset(label for label in row if label >= 0) for row in layout.labels.tolist()]
        return {chosen: rows.count(chosen) / len(rows) for chosen in set(rows)}

    everything = frequencies(draw_layout(own_labels([draws // 4] * 4), classes, count, generator))
    for chosen, probability in sets.items():
        error = (probability * (1.0 - probability) / draws) ** 0.5
        assert abs(everything.get(chosen, 0.0) - probability) < 5.0 * error
    holding = {chosen: probability for chosen, probability in sets.items() if 1 in chosen}
    total = sum(holding.values())
    assert total == pytest.approx(count.mean / classes)
    own = torch.full((draws,), 1)
    given = frequencies(draw_layout(own, classes, count, generator, present=True))
    assert set(given) <= set(holding)
    for chosen, probability in holding.items():
        expected = probability / total
        assert abs(given.get(chosen, 0.0) - expected) < 5.0 * (expected / draws) ** 0.5


def test_more_objects_than_classes_are_refused():
    with pytest.raises(ValueError, match="at most 2, the number of objects"):
        draw_layout(own_labels([1, 1]), 2, ObjectCount(1, 3), torch.Generator())
