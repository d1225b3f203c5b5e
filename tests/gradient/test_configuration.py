"""What the command line makes of the pathwise estimator's choices, each one override away."""

import pytest
from composing import composed

from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.main import UserError, build
from neural_sim.parameter.product import RelaxedDraws


def experiment(*overrides):
    return build(composed(*overrides))


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("gradient.mode=forward", RelaxedDraws(tangents=True)),
        ("gradient.mode=reverse", RelaxedDraws()),
    ],
)
def test_each_choice_is_one_override(override, expected):
    assert experiment("gradient=pathwise", override).loop.gradient.draws == expected


def test_the_papers_method_is_its_plain_form():
    paper = experiment("baseline=neural_sim_paper")
    assert paper.loop.gradient == PathwiseEstimator(mode="reverse")
    assert paper.loop.gradient.draws == RelaxedDraws()
    assert paper.imaging.distribution.factors[0].bin_mean == "linear"


@pytest.mark.parametrize("override", ["gradient.mode=sideways", "gradient.patch_size=0"])
def test_other_choices_are_refused_by_name(override):
    with pytest.raises(UserError, match=override.split("=")[0]):
        experiment("gradient=pathwise", override)
