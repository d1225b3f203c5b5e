"""Every choice of every group makes an experiment: what the command line offers can be built."""

import dataclasses
import itertools

import pytest
from composing import composed

from neural_sim.baseline.base import Fixed, HypergradientLoop
from neural_sim.baseline.label_shift.settings import LabelShift
from neural_sim.gradient.estimators import ReinforceEstimator, StratifiedEstimator
from neural_sim.gradient.implicit import Implicit
from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.main import UserError, build, conf_directory
from neural_sim.outer.certificate import Trust
from neural_sim.outer.inner import pooled
from neural_sim.outer.objective import Loss
from neural_sim.outer.steps import FreeSteps
from neural_sim.parameter.product import HardDraws
from neural_sim.parameter.update import SGD, Mirror
from neural_sim.stages.graph import Graph

CONF = conf_directory()
BASELINES = sorted(path.stem for path in (CONF / "baseline").glob("*.yaml"))
LOOPS = ("neural_sim", "neural_sim_paper", "lts")
PARAMETERS = ("[pose]", "[zoom]", "[pose,zoom]", "[pose,zoom,illumination]")
EXPERIMENTS = sorted(
    {path.stem for path in (CONF / "experiment").glob("*.yaml") if "paths.data" not in path.read_text()}
    - {
        "stress",
        "compare",
        "illumination_interpolation",
        "nerf_vs_mesh",
        "sfm_vs_nerf",
        "detection_gallery",
        "experiments_table",
    }
)  # those of embedded objects, some of which are biased; tests/test_experiments.py has all


def experiment(*overrides):
    return build(composed(*overrides))


@pytest.mark.parametrize(
    ("baseline", "parameter"),
    [(b, p) for b, p in itertools.product(BASELINES, PARAMETERS) if b in LOOPS or p == PARAMETERS[-1]],
)
def test_every_baseline_takes_every_parameter(baseline, parameter):
    """Parameters by themselves with a method of each kind; the others with all of them at once."""
    lights = ["renderer=nerf_w"] if "illumination" in parameter else []
    made = experiment(f"baseline={baseline}", f"parameter={parameter}", *lights)
    assert made.loop.method.name == baseline
    assert ",".join(made.imaging.distribution.names) == parameter.strip("[]")


@pytest.mark.parametrize(("name", "gap"), itertools.product(EXPERIMENTS, ("disjoint", "uniform", "same")))
def test_every_experiment_has_biased_objects_at_every_gap(name, gap):
    made = experiment(f"+experiment={name}", f"gap={gap}")
    assert made.run.name == name and made.imaging.distribution.biased
    names = list(made.imaging.distribution.biased)
    initial, target = (made.imaging.distribution.psi(which, names) for which in ("initial", "target"))
    equal = [bool((a - b).abs().max() < 1e-9) for a, b in zip(initial, target, strict=True)]
    assert all(equal) if gap == "same" else not any(equal)


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_the_papers_variant_takes_every_experiment(name):
    made = experiment(f"+experiment={name}", "+variant=paper")
    assert made.loop.method.name == "neural_sim_paper" and isinstance(made.loop.gradient, PathwiseEstimator)
    poses = [node for what, node in made.config["parameter"].items() if what == "pose"]
    assert all(node["bin_mean"] == "linear" for node in poses)


def test_auto_sim_differs_from_neural_sim_by_its_estimator_and_steps_alone():
    plain, auto_sim = (experiment(f"baseline={name}") for name in ("neural_sim_derivative", "auto_sim"))
    assert isinstance(auto_sim.loop.method, HypergradientLoop)
    assert isinstance(plain.loop.gradient, StratifiedEstimator)
    assert isinstance(auto_sim.loop.gradient, ReinforceEstimator)
    for group in ("solver", "detector", "training", "parameter", "synthesis"):
        assert plain.config[group] == auto_sim.config[group]
    steps = {
        "objective": Loss(), "adjoint": Implicit(), "steps": FreeSteps(Mirror(2.0, max_step=1.0)),
        "trust": Trust(on_untrusted="shrink"),
    }  # fmt: skip
    assert auto_sim.loop.outer == dataclasses.replace(plain.loop.outer, **steps)
    assert experiment("baseline=auto_sim", "outer.steps.update.max_step=2").loop.outer.steps.update == Mirror(
        2.0, max_step=2.0
    )


def _differences(one, other, where=""):
    """The keys, with dots, in which two configurations differ."""
    if not (isinstance(one, dict) and isinstance(other, dict)):
        return set() if one == other else {where}
    return {
        found
        for key in one.keys() | other.keys()
        for found in _differences(one.get(key), other.get(key), f"{where}.{key}".lstrip("."))
    }


PAIRS = [
    ("neural_sim_derivative", "neural_sim_pathwise"),
    ("neural_sim_derivative", "neural_sim_reinforce"),
    ("neural_sim_pathwise", "neural_sim_reinforce"),
    ("neural_sim_paper", "auto_sim_paper"),
]


@pytest.mark.parametrize("scale", ["smoke", "quick", "paper"])
@pytest.mark.parametrize("pair", PAIRS, ids="-".join)
def test_estimators_are_compared_in_one_loop(pair, scale):
    one, other = (experiment(f"baseline={name}", f"scale={scale}") for name in pair)
    differ = _differences(one.config, other.config)
    assert {"baseline.name", "gradient._target_"} <= differ
    assert all(key == "baseline.name" or key.startswith("gradient.") for key in differ)
    assert type(one.loop.gradient) is not type(other.loop.gradient)
    for made, name in ((one, pair[0]), (other, pair[1])):
        wanted = {
            "neural_sim_derivative": StratifiedEstimator, "neural_sim_paper": PathwiseEstimator,
            "neural_sim_pathwise": PathwiseEstimator,
        }  # fmt: skip
        assert isinstance(made.loop.gradient, wanted.get(name, ReinforceEstimator))


def test_neural_sim_reads_the_target_before_it_follows_derivatives():
    plain, derivative = (experiment(f"baseline={name}") for name in ("neural_sim", "neural_sim_derivative"))
    reads = {
        "first_step": LabelShift(per_bin=48),
        "patience": 2,
        "trust": Trust(level=0.01),
    }
    assert plain.loop.outer == dataclasses.replace(derivative.loop.outer, **reads)


@pytest.mark.parametrize("scale", ["smoke", "quick", "paper"])
def test_the_papers_method_is_what_the_paper_says_at_every_scale(scale):
    made = experiment(
        "baseline=neural_sim_paper", f"scale={scale}", "parameter=[pose,zoom,illumination]", "renderer=nerf_w"
    )
    assert made.loop.gradient.mode == "reverse"
    assert all(
        factor.floor == 0.0 and factor.bin_mean == "linear" for factor in made.imaging.distribution.binned
    )
    assert all(factor.temperature == 0.1 for factor in made.imaging.distribution.binned)
    assert made.imaging.distribution.factor("illumination").constraint == "affine"
    outer = made.loop.outer
    assert (outer.epochs, outer.start, outer.train_first, outer.steps.final_step) == (
        2,
        "previous",
        True,
        1.0,
    )
    assert (outer.adjoint.curvature_images, outer.pool_per_bin, outer.trust.on_untrusted) == (0, 0, "keep")
    assert outer.images_per_object == (6 if scale == "smoke" else 50)
    for update in (outer.steps.update, outer.steps.light_update):
        assert isinstance(update, SGD) and (update.momentum, update.max_step) == (0.9, None)


@pytest.mark.parametrize("key", ["update", "light_update"])
def test_a_bad_step_is_refused_with_its_place(key):
    with pytest.raises(UserError, match=f"outer.steps.{key}.learning_rate: want more than 0, got 0"):
        experiment("outer/steps=free", f"outer.steps.{key}.learning_rate=0")


def test_lights_are_explored_where_a_method_scores_its_draws_alone():
    lights = ["parameter=[pose,illumination]", "renderer=nerf_w"]
    explores = {"auto_sim", "neural_sim_reinforce", "auto_sim_paper"}
    hard = {*explores, "neural_sim", "lts", "ns", "oracle"}
    for name in hard:
        made = experiment(f"baseline={name}", *lights)
        assert Graph(made).learned.draws == HardDraws(explore=name in explores)
        assert not pooled(made.loop.outer, Graph(made).learned.draws, made.imaging.distribution)
    made = experiment("baseline=lts")  # no light moves: images come from a pool
    assert pooled(made.loop.outer, Graph(made).learned.draws, made.imaging.distribution)


def test_lights_want_a_renderer_that_knows_them():
    with pytest.raises(UserError, match="renderer=nerf_w with 6 anchors, got one fixed light"):
        experiment("parameter=[illumination]")
    with pytest.raises(UserError, match="got 4 anchor lights"):
        experiment("parameter=[illumination]", "renderer=nerf_w", "views.lights.rig.anchors=4")


def test_what_is_fixed_says_which_distribution():
    kinds = {name: experiment(f"baseline={name}").loop.method for name in ("ns", "oracle")}
    assert kinds == {"ns": Fixed("ns", "initial"), "oracle": Fixed("oracle", "target")}


@pytest.mark.parametrize("baseline", ["lts", "response"])
def test_what_compares_trainings_refuses_one_detector_that_goes_on(baseline):
    with pytest.raises(ValueError, match=f"baseline={baseline} compares trainings.*add outer.start=warm"):
        experiment(f"baseline={baseline}", "+variant=paper")
    made = experiment(f"baseline={baseline}", "+variant=paper", "outer.start=warm")
    assert made.loop.outer.start == "warm" and made.loop.method.name == baseline


@pytest.mark.parametrize(
    "override", ["score_at=3", "score_at=[2]", "score_at=[0]", "baseline.rounds=0", "gap=wide"]
)
def test_bad_choices_are_refused_by_name(override):
    with pytest.raises(UserError, match=override.split("=")[0].split(".")[-1]):
        experiment("baseline=lts", "+experiment=zoom_gap", override)
