"""Choices of any two groups: refused when the experiment is built, in one line, or run through."""

import itertools
import re

import numpy as np
import pytest
from composing import composed
from documented_data import backgrounds, captures, labels

from neural_sim.configuration import conf_directory
from neural_sim.main import context_of
from neural_sim.tasks.walk import walk

CONF = conf_directory()


def files(group):
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


CLASSIFIERS = [name for name in files("detector") if name.startswith("classifier")]
GROUPS = {
    "baseline": [f"baseline={name}" for name in files("baseline")],
    "detector": [
        f"task=classification detector={name}" if name in CLASSIFIERS else f"detector={name}"
        for name in files("detector")
    ],
    "field": [f"field={name}" for name in files("field")],
    "gradient": [f"gradient={name}" for name in files("gradient")],
    "solver": [f"solver={name}" for name in files("solver")],
    "damping": [f"solver/damping={name}" for name in files("solver/damping")],
    "renderer": [f"renderer={name}" for name in files("renderer")],
    "parameter": [
        f"parameter=[{names}]" for names in ("pose", "zoom", "illumination", "pose,zoom,illumination")
    ],
    "steps": [f"outer/steps={name}" for name in files("outer/steps")],
    "adjoint": [f"outer/adjoint={name}" for name in files("outer/adjoint")],
    "objective": ["", "outer/objective=loss"],
    "start": ["outer.start=fresh", "outer.start=warm", "outer.start=previous"],
    "warm": ["training.warm_start=uniform", "training.warm_start=initial outer.train_first=false"],
    "objects": ["objects=procedural", "objects=photos objects.root={captures}"],
    "target": ["target=rendered", "target=coco target.annotations={labels} target.limit=8"],
    "camera": [f"camera={name}" for name in files("camera")],
    "synthesis": ["synthesis=clutter", "synthesis=photos synthesis.background.root={backgrounds}"],
    "gap": ["gap=disjoint", "gap=uniform", "gap=same"],
}
"""By group its choices, with what a choice needs; an empty one is the method's own."""
SMALL = [
    "scale=smoke", "progress=false", "objects.names=[can,mug]", "views.count=16", "views.held_out=2",
    "views.image_size=24", "views.supersample=1", "views.backend=raycast", "budget.grid.steps=8",
    "budget.grid.resolution=64", "budget.grid.refine_steps=[2]", "budget.grid.prune_steps=[4]",
    "budget.mlp.steps=4", "budget.mlp.width=8", "budget.mlp.coarse_samples=4", "budget.mlp.fine_samples=4",
    "training.image_size=48", "training.images_per_object=4", "training.warm_epochs=1", "training.cold_epochs=1",
    "training.batch_size=8", "outer.iterations=2", "outer.images_per_object=4", "outer.epochs=1",
    "outer.least_steps=0", "outer.pool_per_bin=1", "stages=[psi,evaluate]",
]  # fmt: skip


LIT = ("field=grid_w", "field=paper_nerf_w")
REWARDED = ("baseline=lts", "baseline=response")
REFUSED = {
    "lights": (
        lambda a, b: a == "renderer=nerf" and a != b and "illumination" in b,
        "parameter.illumination: want renderer=nerf_w",
    ),
    "codes": (
        lambda a, b: (
            (a == "renderer=nerf_w" or "illumination" in a) and b.startswith("field=") and b not in LIT
        ),
        "renderer=nerf_w needs a field with appearance codes",
    ),
    "going on": (
        lambda a, b: a == "outer.start=previous" and (b in REWARDED or b == "outer/steps=trust_region"),
        "compares trainings",
    ),
    "not judged": (
        lambda a, b: a == "baseline=neural_sim" and b == "outer/steps=free",
        "outer/first_step: a training must accept or reject the proposal",
    ),
    "untrained": (
        lambda a, b: "train_first=false" in a and b in ("outer/steps=trust_region", "outer/adjoint=unrolled"),
        "train_first=true",
    ),
    "uniform start": (
        lambda a, b: "train_first=false" in a and b.startswith("training.warm_start=uniform"),
        "training.warm_start=initial",
    ),
    "dense": (
        lambda a, b: a == "solver=exact" and "detector=" in b and b != "detector=micro",
        "solver=exact",
    ),
    "no camera": (
        lambda a, b: a == "camera=from_target" and b == "target=rendered",
        "camera=from_target needs a target with a camera of its own",
    ),
}  # fmt: skip
"""Pairs of choices that are refused, and what the line says."""


def refused(a, b):
    return any(rule(*pair) for rule, _ in REFUSED.values() for pair in ((a, b), (b, a)))


def covering(groups, refused):
    """Rows, a choice of every group each, that have every pair of choices at least once but those ``refused``.

    Greedy: a row begins with a pair that no row has yet, and takes, group by group, what adds most new pairs.
    """
    names, random = list(groups), np.random.default_rng(0)
    cells = [(name, choice) for name in names for choice in groups[name]]
    missing = {
        frozenset(pair)
        for pair in itertools.combinations(cells, 2)
        if pair[0][0] != pair[1][0] and not refused(*(choice for _, choice in pair))
    }
    rows = []
    while missing:
        best, gained = None, 0
        for seed in random.permutation(sorted(tuple(sorted(pair)) for pair in missing))[:12]:
            row = {str(name): str(choice) for name, choice in seed}
            for name in random.permutation([name for name in names if name not in row]):
                fits = [c for c in groups[name] if not any(refused(c, other) for other in row.values())]
                if not fits:
                    break
                news = [sum(frozenset([(name, c), cell]) in missing for cell in row.items()) for c in fits]
                row[str(name)] = fits[int(np.argmax(news))]
            new = sum(frozenset(pair) in missing for pair in itertools.combinations(row.items(), 2))
            if len(row) == len(names) and new > gained:
                best, gained = row, new
        if best is None:
            raise AssertionError(f"no row has any of {[sorted(pair) for pair in missing]}")
        missing -= {frozenset(pair) for pair in itertools.combinations(best.items(), 2)}
        rows.append(best)
    return rows


class Data(dict):
    """Paths that choices name, made when one does."""

    def __init__(self, root):
        super().__init__()
        self.root = root

    def __missing__(self, name):
        make = {"captures": captures, "labels": labels, "backgrounds": backgrounds}[name]
        self[name] = make(self.root / name / "labels.json" if name == "labels" else self.root / name)
        return self[name]


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """Where rows run, on one store, and the data that they name."""
    root = tmp_path_factory.mktemp("pairs")
    return root, Data(root)


def configuration(room, row):
    root, data = room
    words = [word.format_map(data) for choice in row for word in choice.split()]
    paths = [f"paths.store={root / 'store'}", f"paths.mlflow={root / 'mlflow.db'}"]
    return composed(*words, *SMALL, *paths)


EXAMPLES = [
    ("not judged", ["baseline=neural_sim", "outer/steps=free"]),
    ("lights", ["parameter=[illumination]", "renderer=nerf"]),
    ("codes", ["renderer=nerf_w", "field=mlp"]),
    ("going on", ["baseline=lts", "outer.start=previous"]),
    ("going on", ["outer/steps=trust_region", "outer.start=previous"]),
    (
        "untrained",
        ["outer/adjoint=unrolled", "outer.train_first=false", "outer/steps=free outer/first_step=derivative"],
    ),
    ("dense", ["baseline=auto_sim", "solver=exact", "detector=tiny"]),
    ("no camera", ["camera=from_target", "target=rendered"]),
]


@pytest.mark.parametrize(
    ("rule", "words"), EXAMPLES, ids=lambda value: value if isinstance(value, str) else ""
)
def test_what_does_not_go_together_is_refused_at_the_start_in_one_line(room, rule, words):
    with pytest.raises(ValueError, match=re.escape(REFUSED[rule][1])) as caught:
        _ = context_of(configuration(room, words), room[0] / "unused")[0].graph.learned
    assert "\n" not in str(caught.value)


def test_every_rule_of_what_is_refused_has_an_example():
    assert {rule for rule, _ in EXAMPLES} == set(REFUSED) - {"uniform start"}


@pytest.mark.slow
@pytest.mark.parametrize("part", range(8))
def test_all_other_pairs_run_through(room, part):
    """Two iterations of the loop and three scored detectors for each row of the covering array."""
    rows = covering(GROUPS, refused)
    assert len(rows) < 130
    failed = []
    for number, row in list(enumerate(rows))[part::8]:
        folder = room[0] / f"row_{number}"
        folder.mkdir()
        try:
            context, tasks = context_of(configuration(room, row.values()), folder)
            walk(context, tasks)
            results = context.results(context.graph.learned)
            assert bool(results.last.isfinite().all())
        except Exception as error:  # all of them are wanted at once: a part takes minutes
            failed.append(f"{' '.join(row.values())}: {type(error).__name__}: {error}")
    assert not failed, "\n".join(failed)
