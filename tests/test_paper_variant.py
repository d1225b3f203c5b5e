"""`+variant=paper scale=paper` beside what the paper says, line by line of its LaTeX source."""

import pytest
from hydra import compose, initialize_config_dir

from neural_sim.main import build, conf_directory

LEARNED = {"pose_gap": "pose", "zoom_gap": "zoom", "illumination_gap": "illumination"}
EVERY = tuple(LEARNED)
SUBSTITUTES_NERF_W = 'l. 847: "we substitute vanilla NeRF model with NeRF-w"'
PAPER = [
    # key, value, experiments, the paper
    ("views.count", 100, EVERY, 'l. 675: "using 100 images with different camera pose and zoom factors"'),
    ("unlearned.rho_deg", [0.0, 360.0], EVERY, r"l. 518: \rho_j ~ U[0, 360]"),
    ("unlearned.phi_deg", [0.0, 360.0], EVERY, r"l. 489: \phi_j in [0, 360]"),
    ("field.field._target_", "neural_sim.field.mlp.MLPField", EVERY[:2], "l. 279: NeRF, as in nerf-pytorch"),
    ("field.field.depth", 8, EVERY[:2], "l. 279: NeRF"),
    ("field.field.width", 256, EVERY[:2], "l. 279: NeRF"),
    ("field.field.coarse_samples", 64, EVERY[:2], "l. 279: NeRF"),
    ("field.field.fine_samples", 128, EVERY[:2], "l. 279: NeRF"),
    ("field.field._target_", "neural_sim.field.appearance.AppearanceField", EVERY[2:], SUBSTITUTES_NERF_W),
    ("field.field.code_size", 48, EVERY[2:], "l. 633: NeRF in the Wild"),
    ("renderer._target_", "neural_sim.renderer.nerf.NerfRenderer", EVERY[:2], "l. 279: NeRF"),
    ("renderer._target_", "neural_sim.renderer.nerf_w.NerfWRenderer", EVERY[2:], SUBSTITUTES_NERF_W),
    ("parameter.pose.bins", 8, EVERY[:1], 'l. 796: "we divide the object pose space into k = 8 bins"'),
    ("parameter.pose.axis", "polar", EVERY[:1], r"l. 489: optimising over \phi, \rho uniform"),
    ("parameter.pose.other_range_deg", None, EVERY[:1], "l. 518, from unlearned.rho_deg"),
    ("parameter.pose.temperature", 0.1, EVERY[:1], "l. 686, 1296"),
    ("parameter.zoom.temperature", 0.1, EVERY[1:2], "l. 686, 1296"),
    ("bin_mean", "linear", EVERY, r"l. 514: b = \sum_i y_i B_i"),
    ("gradient._target_", "neural_sim.gradient.pathwise.PathwiseEstimator", EVERY, "l. 443, Eq. 3"),
    ("gradient.mode", "reverse", EVERY, 'l. 598: "two forward passes over NeRF rendering"'),
    (
        "solver.linear._target_",
        "neural_sim.solver.cg.ConjugateGradient",
        EVERY,
        "l. 342: conjugate gradients",
    ),
    ("outer.loop_layers", 0, EVERY, 'l. 685: "we fix the backbone during training"'),
    ("detector.backbone.architecture", "resnet50", EVERY, "l. 684: RetinaNet (Lin et al. 2017)"),
    ("detector.anchors.strides", [8, 16, 32, 64, 128], EVERY, "l. 684: RetinaNet"),
    ("detector.anchors.ratios", [0.5, 1.0, 2.0], EVERY, "l. 684: RetinaNet"),
    ("detector.activation", "relu", EVERY, "l. 684: RetinaNet"),
    ("detector.losses.box", "l1", EVERY, "l. 684: RetinaNet, as in Detectron2"),
    ("detector.head.normalisation", "none", EVERY, "l. 684: RetinaNet"),
    ("outer.images_per_object", 50, EVERY, 'l. 686: "we render 50 images for each object class"'),
    ("outer.epochs", 2, EVERY, 'l. 686: "and train RetinaNet for two epochs"'),
    ("outer.start", "previous", EVERY, "l. 686: two epochs an iteration, so it goes on"),
    ("outer.train_first", True, EVERY, "l. 686: in each iteration"),
    ("outer.steps.final_step", 1.0, EVERY, "l. 1299: one learning rate"),
    ("outer.adjoint.curvature_images", 0, EVERY, "l. 332, Eq. 2: the Hessian of L_train, on all images"),
    ("outer.pool_per_bin", 0, EVERY, "l. 686: images are rendered in each iteration"),
    ("outer.steps.update._target_", "neural_sim.parameter.update.SGD", EVERY, "l. 1299: SGD with momentum"),
    ("outer.steps.update.momentum", 0.9, EVERY, "l. 1299"),
    ("target.test_per_object", 100, EVERY, 'l. 813, 852: "600 images (100 images per object)", 2,100 of 21'),
    ("target.test_per_biased_object", 100, EVERY, "l. 813, 852"),
]


def composed(*overrides):
    with initialize_config_dir(str(conf_directory()), version_base="1.3"):
        return compose("config", list(overrides))


@pytest.fixture(scope="module")
def experiments():
    made = {name: build(composed(f"+experiment={name}", "+variant=paper", "scale=paper")) for name in EVERY}
    return {name: experiment.config for name, experiment in made.items()}


def value(config, key):
    for part in key.split("."):
        config = config[part]
    return config


@pytest.mark.parametrize("row", PAPER, ids=lambda row: f"{row[0]} {row[2][0]}")
def test_the_variant_is_what_the_paper_says(experiments, row):
    key, expected, where, source = row
    for name in where:
        assert value(experiments[name], key) == expected, f"{name}: {source}"


@pytest.mark.parametrize("name", EVERY)
def test_views_cover_every_distance_that_is_rendered(experiments, name):
    """l. 675: views of different pose and zoom, one set for all experiments."""
    config = experiments[name]
    near, far = config["views"]["distance_range"]
    rendered = [config["unlearned"]["distance"], value(experiments["zoom_gap"], "parameter.zoom.range")]
    assert near == min(low for low, _ in rendered) and far == max(high for _, high in rendered)
    assert config["views"]["held_out"] > 0  # on top of the 100


def test_anchors_have_three_scales_an_octave_from_32_to_512_pixels(experiments):
    detector = experiments["pose_gap"]["detector"]
    sizes = [size for level in detector["anchors"]["sizes"] for size in level]
    # torchvision takes the whole part.
    assert sizes == [int(32 * 2**level * 2 ** (third / 3)) for level in range(5) for third in range(3)]
    assert detector["anchors"]["reference"] is None


def _differences(one, other, where=""):
    """The keys, with dots, in which two configurations differ."""
    if not (isinstance(one, dict) and isinstance(other, dict)):
        return set() if one == other else {where}
    return {
        found
        for key in one.keys() | other.keys()
        for found in _differences(one.get(key), other.get(key), f"{where}.{key}".lstrip("."))
    }


@pytest.mark.parametrize("baseline", ["auto_sim", "lts", "ns"])
@pytest.mark.parametrize("name", EVERY)
def test_another_method_gets_everything_but_the_method(name, baseline):
    arguments = [f"+experiment={name}", "+variant=paper", "scale=paper"]
    if baseline == "lts":  # whose trainings are compared
        arguments.append("outer.start=warm")
    paper, other, plain = (
        build(composed(*overrides)).config
        for overrides in (
            arguments,
            (f"baseline={baseline}", *arguments),
            (f"baseline={baseline}", f"+experiment={name}", "scale=paper"),
        )
    )
    assert other["baseline"]["name"] == baseline
    method = {key.split(".")[0] for key in _differences(paper, other)}
    assert method <= {
        "baseline",
        "gradient",
        "outer",
        "bin_mean",
        "bin_floor",
        "light_constraint",
        "parameter",
    }
    # And the method itself is the one that it is without the variant.
    for group in ("baseline", "gradient", "solver"):
        assert other[group] == plain[group]
    training = {"outer.epochs", "outer.start", "outer.learning_rate", "outer.loop_layers"}
    outer = {key for key in _differences(plain, other) if key.startswith("outer.")}
    assert {key for key in outer if not key.startswith("outer.steps.")} <= training
    assert all(value(other, key) == value(paper, key) for key in (*training, "outer.steps._target_"))


def test_what_the_command_line_names_is_taken():
    made = build(composed("+variant=paper", "field=grid", "detector=tiny", "unlearned.rho_deg=[-45,45]"))
    assert made.config["field"]["field"]["_target_"].endswith("GridField")
    assert made.config["detector"]["backbone"]["architecture"] == "tiny"
    assert made.imaging.distribution.ranges["rho"][1] == pytest.approx(0.7853981633974483)
