"""Distances that no parameter draws, and those in metres: which objects they fit."""

import pytest

from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.parameter.unlearned import Unlearned
from neural_sim.parameter.zoom import Zoom

METRES = Unlearned(distance=(0.4, 0.8), distance_unit="metres")


def test_the_unit_is_that_of_what_draws_the_distance():
    assert SceneDistribution.of([Pose()]).distance_unit == "radii"
    assert SceneDistribution.of([Pose()], METRES).distance_unit == "metres"
    assert SceneDistribution.of([Zoom()], METRES).distance_unit == "radii"
    assert SceneDistribution.of([Zoom(range=(0.3, 0.9), unit="metres")]).distance_unit == "metres"
    assert SceneDistribution.of([Zoom(by="focal_length", range=(0.5, 2.0))], METRES).distance_unit == "metres"


def test_radii_are_asked_for_in_metres_alone():
    assert SceneDistribution.of([Pose()]).radii({"can": None}) is None
    assert SceneDistribution.of([Pose()], METRES).radii({"can": 0.1, "mug": 0.3}) == (0.1, 0.3)


def test_objects_of_unknown_size_or_too_large_are_named():
    distribution = SceneDistribution.of([Pose()], METRES)
    with pytest.raises(ValueError, match=r"nothing gives the size of mug: set objects\.size"):
        distribution.radii({"can": 0.1, "mug": None})
    with pytest.raises(ValueError, match=r"0\.4 m from mug, of radius 0\.39 m.* more than 0\.41 m"):
        distribution.radii({"can": 0.1, "mug": 0.39})
    with pytest.raises(ValueError, match=r"0\.3 m from mug"):
        SceneDistribution.of([Zoom(range=(0.3, 0.9), unit="metres")], METRES).radii({"mug": 0.3})


def test_a_distance_within_an_object_is_refused():
    with pytest.raises(
        ValueError, match=r"unlearned\.distance: want more than 1 object radius, got \[1\.0, 2\.0\]"
    ):
        Unlearned(distance=(1.0, 2.0))
    assert Unlearned(distance=(1.0, 2.0), distance_unit="metres").distance == (1.0, 2.0)
