"""The plan says what a configuration leaves out, and only that."""

import pytest
from hydra import compose, initialize_config_dir

from neural_sim.main import build, conf_directory
from neural_sim.stages.graph import Graph
from neural_sim.stages.plan import plan


def left_out(*overrides):
    with initialize_config_dir(str(conf_directory()), version_base="1.3"):
        experiment = build(compose("config", list(overrides)))
    return {omission.what: omission for omission in plan(Graph(experiment))}


def test_the_default_differentiates_no_render_and_renders_every_bin_once():
    found = left_out("scale=quick")
    assert {"appearance codes", "view-dependent colour", "the renderer's derivative"} <= set(found)
    # 384 renders an object in place of 100 images for each of 11 trainings, two in the first of 10 iterations, and, but
    # for the last, which takes no derivative, 48 probes in each of 8 bins, half of them anew.
    assert found["renders of the loop"].fraction == pytest.approx(1 - 384 / (11 * 100 + 384 + 9 * 192))
    assert "images in Hessian products" not in found
    implicit = left_out("scale=quick", "outer.adjoint=implicit")
    assert implicit["images in Hessian products"].fraction == pytest.approx(1 - 64 / 600)
    assert found["passes of the backbone's frozen stages in the loop's training"].fraction == pytest.approx(
        1 - 1 / 6
    )


def test_a_pool_saves_renders_of_every_object_of_an_image_or_is_not_mentioned():
    found = left_out("scale=quick", "baseline=lts", "synthesis.objects_per_image=[3,6]")
    renders = 4.5 * 2 * 10 * 100  # 4.5 objects in each of 100 images, twice in each of 10 iterations
    assert found["renders of the loop"].fraction == pytest.approx(1 - 384 / renders)
    # 250 images need fewer renders than a pool's 384
    few = left_out("scale=quick", "baseline=auto_sim", "outer.images_per_object=25")
    assert "renders of the loop" not in few


def test_the_papers_gradient_leaves_out_the_boxes_derivative_alone():
    found = left_out("gradient=pathwise")
    assert "the renderer's derivative" not in found and "renders of the loop" not in found
    assert "the boxes' derivative" in found


def test_a_loop_on_drafts_is_said_to_be_one():
    assert "fine renders in the loop" in left_out("outer.quality=draft")
    assert "fine renders in the loop" not in left_out("outer.quality=final")


def test_objects_whose_psi_is_fixed_are_left_out():
    found = left_out("outer.learned=[mug,can]")
    assert found["probes and second derivatives"].fraction == pytest.approx(4 / 6)


def test_what_is_needed_is_not_left_out():
    found = left_out(
        "field.field.head_width=16", "outer.curvature_images=0", "outer.pool_per_bin=0", "outer.epochs=1"
    )
    assert not {
        "view-dependent colour", "images in Hessian products", "renders of the loop",
        "passes of the backbone's frozen stages in the loop's training",
    } & set(found)  # fmt: skip


def test_methods_without_a_hypergradient_say_so():
    assert left_out("baseline=lts")["hypergradients"].fraction == 1.0
    assert "the psi loop" in left_out("baseline=ns") and "hypergradients" not in left_out("baseline=ns")
