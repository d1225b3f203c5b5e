"""The size of views depends on what the objects are made of."""

import pytest
from composing import composed


@pytest.mark.parametrize(
    ("overrides", "size"),
    [
        ((), 96),
        (("objects=photos", "objects.root=x"), 160),
        (("objects=co3d", "objects.root=x"), 160),
        (("objects=photos", "objects.root=x", "views.image_size=128"), 128),
    ],
)
def test_views_of_photographs_are_larger_unless_told(overrides, size):
    assert composed("scale=quick", *overrides).views.image_size == size
