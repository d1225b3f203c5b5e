"""Classes of a data set and the objects that they are: mapped, left out, refused."""

import logging

import pytest

from neural_sim.target.classes import ClassMap

OBJECTS = ["can", "mug"]


def test_names_stand_for_themselves_unless_they_are_mapped(caplog):
    classes = ClassMap({"cup": "mug", "dog": None}, "here")
    with caplog.at_level(logging.WARNING):
        assert classes.labels(["cup", "dog", "cat"], OBJECTS) == {"cup": 1, "dog": None}
    assert "here: no class for object can, which gets no score" in caplog.text
    assert ClassMap(None, "here").labels(["mug", "can"], OBJECTS) == {"mug": 1, "can": 0}


def test_a_mapping_names_classes_that_there_are():
    classes = ClassMap({"pig": None, "cup": "mug"}, "here", "predict.categories", ("category", "categories"))
    with pytest.raises(
        ValueError, match=r"^predict\.categories: \['pig'\] are not categories of here, which has \['cup'\]$"
    ):
        classes.check_listed(["cup"])
    classes.check_listed(["pig", "cup", "cow"])


def test_what_is_no_object_is_refused_unless_it_is_left_out():
    mapping = {"cup": "mugg", "dog": None}
    refused = (
        r"^here: classes \['cat', 'cup \(as mugg\)'\] are not objects; objects are .* by target\.classes, "
        r"\{class: object\} or \{class: null\} to leave one out, or set target\.unmatched=leave_out$"
    )
    with pytest.raises(ValueError, match=refused):
        ClassMap(mapping, "here").refuse(["cup", "dog", "cat", "can"], OBJECTS)
    with pytest.raises(ValueError, match=r"or \{class: null\} to leave one out$"):
        ClassMap(mapping, "here", unmatched=None).refuse(["cup"], OBJECTS)
    ClassMap(mapping, "here", unmatched="leave_out").refuse(["cup", "dog", "cat"], OBJECTS)
