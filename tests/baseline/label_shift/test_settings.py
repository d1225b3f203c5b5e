"""Settings that depend on the target."""

from dataclasses import replace

import pytest

from neural_sim.baseline.label_shift.crops import Augmentation
from neural_sim.baseline.label_shift.settings import LabelShift


@pytest.mark.parametrize(("rendered", "roll_deg"), [(True, 10.0), (False, 180.0)])
def test_photographs_are_read_at_any_roll_and_renders_upright(rendered, roll_deg):
    found = LabelShift().for_target(rendered)
    assert (found.photographs, found.augmentation.roll_deg) == (not rendered, roll_deg)
    assert found == LabelShift(photographs=not rendered, augmentation=Augmentation(roll_deg=roll_deg))


def test_what_the_user_sets_stays():
    upright = LabelShift(photographs=False, augmentation=Augmentation(roll_deg=20.0))
    assert upright.for_target(rendered=False) == upright
    as_if_photographed = replace(upright, photographs=True, augmentation=Augmentation())
    assert as_if_photographed.for_target(rendered=True).augmentation.roll_deg == 180.0
