"""Which runs share their digests: methods that are scored alike, seeds of one method; and which do not."""

import pytest
import torch
from composing import composed
from omegaconf import OmegaConf

from neural_sim.report.identity import all_values, differences, headings, identity, scored_values
from neural_sim.types import LabelledImages

CODE = {"scoring": "a" * 12, "method": "b" * 12}
FILES = {"objects": {"pitcher": "1" * 64, "drill": "2" * 64}}


def config(*overrides):
    return OmegaConf.to_container(composed(*overrides), resolve=True)


def images(value=0.5, edge=4.0, label=0):
    boxes, labels = torch.tensor([[[1.0, 1.0, edge, 4.0]]]), torch.tensor([[label]])
    return LabelledImages(torch.full((1, 3, 4, 4), value), boxes, labels, torch.zeros(1).long())


def of(*overrides, files=FILES, code=CODE, test=None):
    return identity(config(*overrides), files, code, images() if test is None else test)


@pytest.mark.parametrize("experiment", ["pose_gap", "zoom_gap", "illumination_gap"])
def test_every_method_is_scored_alike(experiment):
    own = f"+experiment={experiment}"
    methods = [
        "baseline=lts",
        "baseline=auto_sim",
        "baseline=response",
        "baseline=neural_sim_paper",
        "gradient=reinforce",
    ]
    found = [
        of(own),
        *(of(own, method) for method in methods),
        of(own, "outer.iterations=3", "solver=minres"),
    ]
    assert len({held["scoring"] for held in found}) == 1
    assert len({held["configuration"] for held in found}) == len(found)


def test_all_seeds_of_a_method_are_runs_of_the_same_settings():
    first = of("+experiment=pose_gap")
    for override in (
        "seed=4", "score_at=[1,3]", "progress=false", "paths.store=elsewhere", "trainer=gpu", "model.onnx=true",
        "viewer.port=1",
    ):  # fmt: skip
        other = of("+experiment=pose_gap", override)
        assert (other["scoring"], other["configuration"]) == (first["scoring"], first["configuration"])


@pytest.mark.parametrize(
    "override",
    [
        "scale=smoke", "views.count=99", "field=mlp", "renderer.rays_per_chunk=4096", "+synthesis.background.grain=0.5",
        "unlearned.distance=[2,3]", "target.test_per_object=99", "detector=micro", "training.cold_epochs=29",
        "gap=uniform", "parameter.pose.biased.drill.target=uniform", "parameter=[pose,zoom]", "parameter.pose.bins=4",
        "camera.field_of_view_deg=50",
    ],
)  # fmt: skip
def test_what_ap_depends_on_is_not_compared_across(override):
    first, other = of("+experiment=pose_gap"), of("+experiment=pose_gap", override)
    assert other["scoring"] != first["scoring"]
    key = override.lstrip("+").split("=")[0]
    told = differences(scored_values(other), scored_values(first))
    assert told and (key in ("scale", "gap", "parameter") or key.split(".")[0] in told)


def test_contents_code_and_test_set_have_a_say():
    first = of("+experiment=pose_gap")
    files = {"objects": {"pitcher": "9" * 64, "drill": "2" * 64}}
    other = of("+experiment=pose_gap", files=files)
    assert other["scoring"] != first["scoring"]
    assert differences(scored_values(other), scored_values(first)) == (
        "contents of objects.pitcher is 99999999, not 11111111"
    )
    swapped = of("+experiment=pose_gap", files={"objects": dict(reversed(FILES["objects"].items()))})
    assert swapped["scoring"] != first["scoring"]  # classes are numbered in the objects' order
    edited = of("+experiment=pose_gap", code={**CODE, "scoring": "c" * 12})
    assert edited["scoring"] != first["scoring"] and edited["configuration"] == first["configuration"]
    moved = of("+experiment=pose_gap", code={**CODE, "method": "c" * 12})
    assert moved["scoring"] == first["scoring"] and moved["configuration"] != first["configuration"]
    assert differences(all_values(moved), all_values(first)) == "code of the method is cccccccc, not bbbbbbbb"
    sets = [images(), images(value=0.6), images(edge=3.5), images(label=1)]
    assert len({of("+experiment=pose_gap", test=test)["test_set"] for test in sets}) == len(sets)


def test_differences_are_named_with_both_values_and_counted():
    here, there = {"a": 1, "b": 2, "c": 3, "d": [4], "only": 5}, {"a": 1, "b": 3, "c": 4, "d": [5]}
    assert differences(here, there) == "b is 2, not 3; c is 3, not 4; d is [4], not [5] and 1 more"
    assert differences(there, here).startswith("b is 3, not 2")
    assert differences(here, here) == ""
    assert headings([here, {**here, "b": 7}]) == ["b=2", "b=7"]
    assert headings([here]) == [""]
    assert (
        differences({"x": 1, "field._target_": "A"}, {"x": 2})
        == "field._target_ is A, not absent; x is 1, not 2"
    )
