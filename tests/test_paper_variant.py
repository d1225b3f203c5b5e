"""`+variant=paper scale=paper` beside what the paper says, line by line of its LaTeX source."""

import re
from pathlib import Path

import pytest
from composing import composed

from neural_sim.main import build

LEARNED = {"pose_gap": "pose", "zoom_gap": "zoom", "illumination_gap": "illumination"}
EVERY = tuple(LEARNED)
NERF = (279, r"NeRF \cite{mildenhall2020nerf,lin2020nerfpytorch}")
NERF_W = (847, "we substitute vanilla NeRF model with NeRF-w")
RETINANET = (684, r"We use RetinaNet \cite{lin2017focal}")
FIFTY = (686, "In each optimization iteration, we render 50 images for each object class")
TWO_EPOCHS = (686, "and train RetinaNet for two epochs")
TEMPERATURE = (686, r"we use Gumble-softmax temperature $\tau=0.1$")
SGD = (1299, r"We used stochastic gradient descent with momentum for $\psi$ parameter updates")
HUNDRED = (813, "The test set has 600 images (100 images per object)")
PAPER = [
    # key, value, experiments, line of paper.tex and what it has there
    ("views.count", 100, EVERY, 675, "using 100 images with different camera pose and zoom factors"),
    ("unlearned.rho_deg", [0.0, 360.0], EVERY, 518, r"\poseb_j\sim\mathcal{U}[0,360]"),
    ("unlearned.phi_deg", [0.0, 360.0], EVERY, 489, r"\posea_j \in [0, 360]"),
    ("field.field._target_", "neural_sim.field.mlp.MLPField", EVERY[:2], *NERF),
    ("field.field.depth", 8, EVERY[:2], *NERF),
    ("field.field.width", 256, EVERY[:2], *NERF),
    ("field.field.coarse_samples", 64, EVERY[:2], *NERF),
    ("field.field.fine_samples", 128, EVERY[:2], *NERF),
    ("field.field._target_", "neural_sim.field.appearance.AppearanceField", EVERY[2:], *NERF_W),
    ("field.field.code_size", 48, EVERY[2:], 633, "takes as input an appearance embedding"),
    ("renderer._target_", "neural_sim.renderer.nerf.NerfRenderer", EVERY[:2], *NERF),
    ("renderer._target_", "neural_sim.renderer.nerf_w.NerfWRenderer", EVERY[2:], *NERF_W),
    ("parameter.pose.bins", 8, EVERY[:1], 796, "we divide the object pose space into $k$= 8 bins"),
    ("parameter.pose.axis", "polar", EVERY[:1], 489, r"while keeping $\poseb$ fixed to be uniform"),
    ("parameter.pose.other_range_deg", None, EVERY[:1], 518, r"\poseb_j\sim\mathcal{U}[0,360]"),
    ("parameter.pose.temperature", 0.1, EVERY[:1], *TEMPERATURE),
    ("parameter.pose.temperature", 0.1, EVERY[:1], 1296, "have used a parameter value of $0.1$"),
    ("parameter.zoom.temperature", 0.1, EVERY[1:2], *TEMPERATURE),
    ("bin_mean", "linear", EVERY, 514, r"\sum_i y_i \bar{B}_i^{ce}$ as the approximate bin center"),
    ("gradient._target_", "neural_sim.gradient.pathwise.PathwiseEstimator", EVERY, 443,
     r"\frac{\partial}{\partial\psi}\bigg[\frac{\partial l(x_i, \hat{\theta}(\psi_{t}))}{\partial\theta}\bigg]"),
    ("gradient.mode", "reverse", EVERY, 598, "where we do two forward passes over NeRF rendering"),
    ("solver.linear._target_", "neural_sim.solver.cg.ConjugateGradient", EVERY, 342,
     "is computed using the conjugate gradient method"),
    ("light_constraint", "affine", EVERY[2:], 634, r"where $\sum_i \psi_i =1$"),
    ("outer.loop_layers", 0, EVERY, 685, "we fix the backbone during training"),
    ("outer.objective._target_", "neural_sim.outer.objective.Loss", EVERY, 311, r"\hat{\theta}(\psi) \in"),
    ("detector.backbone.architecture", "resnet50", EVERY, *RETINANET),
    ("detector.anchors.strides", [8, 16, 32, 64, 128], EVERY, *RETINANET),
    ("detector.anchors.ratios", [0.5, 1.0, 2.0], EVERY, *RETINANET),
    ("detector.activation", "relu", EVERY, *RETINANET),
    ("detector.losses.box", "l1", EVERY, *RETINANET),
    ("detector.head.normalisation", "none", EVERY, *RETINANET),
    ("outer.images_per_object", 50, EVERY, *FIFTY),
    ("outer.epochs", 2, EVERY, *TWO_EPOCHS),
    ("outer.start", "previous", EVERY, *TWO_EPOCHS),
    ("outer.train_first", True, EVERY, *FIFTY),
    ("outer.steps.final_step", 1.0, EVERY, 1299, "learning rates of 1$e$-5"),
    ("outer.adjoint.curvature_images", 0, EVERY, 335, r"\mathcal{H}(\hat{\theta}(\psi_{t}), \psi)^{-1}"),
    ("outer.pool_per_bin", 0, EVERY, *FIFTY),
    ("outer.steps.update._target_", "neural_sim.parameter.update.SGD", EVERY, *SGD),
    ("outer.steps.update.momentum", 0.9, EVERY, 1299, "momentum value of 0.9"),
    ("target.test_per_object", 100, EVERY, *HUNDRED),
    ("target.test_per_object", 100, EVERY, 852, "The test set has 2100 images (100 images per object)"),
    ("target.test_per_biased_object", 100, EVERY, *HUNDRED),
]  # fmt: skip


@pytest.fixture(scope="module")
def experiments():
    made = {name: build(composed(f"+experiment={name}", "+variant=paper", "scale=paper")) for name in EVERY}
    return {name: experiment.config for name, experiment in made.items()}


def value(config, key):
    for part in key.split("."):
        config = config[part]
    return config


@pytest.mark.parametrize("row", PAPER, ids=lambda row: f"{row[0]} {row[2][0]} {row[3]}")
def test_the_variant_is_what_the_paper_says(experiments, row):
    key, expected, where, line, quote = row
    for name in where:
        assert value(experiments[name], key) == expected, f"{name}: l. {line}, {quote}"


@pytest.mark.parametrize("row", PAPER, ids=lambda row: f"{row[0]} {row[3]}")
def test_the_paper_says_so(paper_source, row):
    _, _, _, line, quote = row
    assert quote in paper_source[line - 1]


def test_the_page_of_differences_quotes_the_paper(paper_source):
    page = (Path(__file__).parents[1] / "docs" / "paper.md").read_text(encoding="utf-8")
    quotes = re.findall(r'"([^"]+)" \(l\. (\d+)', page)
    assert len(quotes) > 20
    assert [each for each in quotes if each[0] not in paper_source[int(each[1]) - 1]] == []


def test_the_papers_own_command_has_its_objects_and_its_bias():
    """l. 813: images from bin 1 against all other bins, in pitcher and driller."""
    pose = composed("+experiment=pose_bin1_ycb", "+variant=paper", "scale=paper").parameter.pose
    others = {"initial": {"modes": [2, 3, 4, 5, 6, 7, 8]}, "target": {"dominant": 1}}
    assert pose.biased == {"019_pitcher_base": others, "035_power_drill": others}


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
