"""Made-up finished runs whose scores are known, as read back from MLflow and as files that a run leaves."""

from __future__ import annotations

import numpy as np

from neural_sim.report.runs import FinishedRun, Group
from neural_sim.report.score_table import THRESHOLDS, Matches
from neural_sim.studies.experiments.results import Setting

IMAGES = 60
BUDGET = {
    "views": {"count": 84, "image_size": 96},
    "training": {"image_size": 96},
    "outer": {"iterations": 7},
}
GROUPS = ("objects", "views", "field", "renderer", "synthesis", "unlearned", "target", "detector", "training")


def matches(fraction: float, seed: int = 0) -> Matches:
    """One box an image, a fraction of them found at every overlap and nothing else: AP is about that fraction."""
    random = np.random.default_rng(seed)
    found = np.sort(random.permutation(IMAGES)[: round(fraction * IMAGES)])
    correct = np.ones((len(found), len(THRESHOLDS)), dtype=bool)
    return Matches(found, correct, np.ones(IMAGES, dtype=int))


def dominant(bin: int, bins: int = 8) -> list[float]:
    return [1.0 - 0.02 * (bins - 1) if b == bin else 0.02 for b in range(1, bins + 1)]


def results(experiment, method, seed, gap="disjoint", initial=4, target=1, learned=None, **more):
    """results.json of a run of two biased objects, whose learned pose is nearly the target's."""
    goal, start = dominant(target), [0.125] * 8 if gap == "uniform" else dominant(initial)
    p = {"initial": goal if gap == "same" else start, "target": goal, "learned": learned or goal}
    away = {
        which: 0.5 * sum(abs(a - b) for a, b in zip(p[which], goal, strict=True))
        for which in ("initial", "learned")
    }
    config = {
        **{group: {"size": 1} for group in GROUPS},
        "parameter": {"pose": {"gap": gap, "biased": {"mug": {"target": target}, "can": {"target": target}}}},
        "budget": BUDGET,
        "trainer": {"accelerator": "cpu"},
    }
    return {
        "experiment": experiment, "gap": gap, "method": method, "seed": seed, "biased": ["can", "mug"],
        "psi": {name: {"pose": p} for name in ("can", "mug")}, "curve": [{"images": 30, "seconds": 9.0}],
        "total_variation": {name: {"pose": away} for name in ("can", "mug")}, "symmetric_bins": {},
        "scoring": f"{gap} {target}", "configuration": f"{method} {gap} {target}", "test_set": f"images of {seed}",
        "config": config, "files": {"objects": {"can": "1" * 64, "mug": "2" * 64}},
        "code": {"scoring": "a" * 12, "method": "b" * 12},
        "iterations": [{"seconds": {"train": 2.0, "hypergradient": 3.0, "hypergradient_solve": 1.0}}],
        "seconds": {"field": 1.0}, "left_out": [{"stage": "field", "seconds": 5.0}, {"stage": "views", "seconds": 9.0}],
        **more,
    }  # fmt: skip


def finished(ap, **arguments):
    """A run by AP: ``ap`` maps ns, learned and matched to that of can and of mug."""
    made = results(**arguments)
    outcomes = {w: [matches(f, i) for i, f in enumerate(each)] for w, each in ap.items()}
    return FinishedRun(made, read=lambda: outcomes)


def setting(experiment="gap", gap="disjoint", target=1, methods=(("neural_sim", 0.75),), seeds=(0,), **more):
    """A setting whose methods have an AP each; ns has 0.25 (can) and 0.5 (mug), matched 0.9."""
    runs = tuple(
        finished({"ns": (0.25, 0.5), "learned": (ap, ap), "matched": (0.9, 0.9)},
                 experiment=experiment, gap=gap, target=target, method=method, seed=seed, **more)
        for method, ap in methods for seed in seeds
    )  # fmt: skip
    return Setting.of(Group(experiment, f"{experiment}, {gap}", "", runs), "neural_sim", draws=20)
