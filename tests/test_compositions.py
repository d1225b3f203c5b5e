"""Every choice of every group makes an experiment: what the command line offers can be built."""

import dataclasses
import itertools

import pytest
from hydra import compose, initialize_config_dir

from neural_sim.baseline.base import Fixed, HypergradientLoop
from neural_sim.gradient.estimators import ReinforceEstimator, StratifiedEstimator
from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.main import UserError, build, conf_directory
from neural_sim.parameter.update import Mirror

CONF = conf_directory()
BASELINES = sorted(path.stem for path in (CONF / "baseline").glob("*.yaml"))
PARAMETERS = ("[pose]", "[zoom]", "[pose,zoom]", "[pose,zoom,illumination]")
EXPERIMENTS = sorted(
    {path.stem for path in (CONF / "experiment").glob("*.yaml") if not path.stem.endswith("_ycb")}
    - {"stress", "compare", "illumination_interpolation"}
)


def experiment(*overrides):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return build(compose("config", list(overrides)))


@pytest.mark.parametrize(("baseline", "parameter"), itertools.product(BASELINES, PARAMETERS))
def test_every_baseline_takes_every_parameter(baseline, parameter):
    lights = ["renderer=nerf_w"] if "illumination" in parameter else []
    made = experiment(f"baseline={baseline}", f"parameter={parameter}", *lights)
    assert made.baseline.name == ("neural_sim" if baseline == "none" else baseline)
    assert ",".join(made.distribution.names) == parameter.strip("[]")


@pytest.mark.parametrize(("name", "gap"), itertools.product(EXPERIMENTS, ("disjoint", "uniform", "same")))
def test_every_experiment_has_biased_objects_at_every_gap(name, gap):
    made = experiment(f"+experiment={name}", f"gap={gap}")
    assert made.name == name and made.distribution.biased
    names = list(made.distribution.biased)
    initial, target = (made.distribution.psi(which, names) for which in ("initial", "target"))
    equal = [bool((a - b).abs().max() < 1e-9) for a, b in zip(initial, target, strict=True)]
    assert all(equal) if gap == "same" else not any(equal)


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_the_papers_variant_takes_every_experiment(name):
    made = experiment(f"+experiment={name}", "+variant=paper")
    assert made.baseline.name == "neural_sim_paper" and isinstance(made.gradient, PathwiseEstimator)
    poses = [node for what, node in made.config["parameter"].items() if what == "pose"]
    assert all(node["bin_mean"] == "linear" for node in poses)


@pytest.mark.parametrize("name", sorted(path.stem for path in (CONF / "experiment").glob("*_ycb.yaml")))
def test_experiments_on_ycb_name_objects_that_exist(name, shared_data):
    made = experiment(f"+experiment={name}", f"objects.root={shared_data / 'ycb'}")
    assert set(made.distribution.biased) <= set(made.objects.names())


def test_auto_sim_differs_from_neural_sim_by_its_estimator_and_steps_alone():
    plain, auto_sim = experiment(), experiment("baseline=auto_sim")
    assert isinstance(auto_sim.baseline, HypergradientLoop)
    assert isinstance(plain.gradient, StratifiedEstimator)
    assert isinstance(auto_sim.gradient, ReinforceEstimator)
    for group in ("solver", "detector", "training", "parameter", "synthesis"):
        assert plain.config[group] == auto_sim.config[group]
    steps = {"train_first": True, "update": Mirror(2.0, max_step=1.0)}
    assert auto_sim.outer == dataclasses.replace(plain.outer, **steps)
    assert experiment("baseline=auto_sim", "outer.update.max_step=2").outer.update == Mirror(
        2.0, max_step=2.0
    )


def test_lights_want_a_renderer_that_knows_them():
    with pytest.raises(UserError, match="renderer=nerf_w with 6 anchors, got one fixed light"):
        experiment("parameter=[illumination]")
    with pytest.raises(UserError, match="got 4 anchor lights"):
        experiment("parameter=[illumination]", "renderer=nerf_w", "views.lights.rig.anchors=4")


def test_what_is_fixed_says_which_distribution():
    kinds = {name: experiment(f"baseline={name}").baseline for name in ("ns", "oracle")}
    assert kinds == {"ns": Fixed("ns", "initial"), "oracle": Fixed("oracle", "target")}


@pytest.mark.parametrize(
    "override", ["score_at=3", "score_at=[2]", "score_at=[0]", "baseline.rounds=0", "gap=wide"]
)
def test_bad_choices_are_refused_by_name(override):
    with pytest.raises(UserError, match=override.split("=")[0].split(".")[-1]):
        experiment("baseline=lts", "+experiment=zoom_gap", override)
