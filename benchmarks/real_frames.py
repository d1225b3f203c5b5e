"""Read the pose bins of YCB-Video frames as label shift does, and compare them with the true ones.

Renders of the fields of all objects in the frames are made as in experiment=ycb_video_full:

    as configured        bins over the poles, rho within 45 degrees
    all sides            rho within 90 degrees, so that every side is in one bin
    about the vertical   bins of the turn about the vertical (`axis=azimuth`), from 30 to 150 degrees from above
    the same, upright    cameras held upright (`roll_deg=15`)
    the same, as renders read like boxes of a rendered target, by the network, the size of boxes and the comparison

A box is right if its most probable bin is the true one or looks the same by symmetry. `--fewest` is the number of boxes
below which an object is not estimated, 8 by default in runs; boxes of near-duplicate frames count as one. `--width` is
that of the frames in pixels.

    python benchmarks/real_frames.py --shared ../shared
"""

from __future__ import annotations

import argparse
import json
import logging
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from torch import Tensor

from neural_sim.baseline.label_shift.crops import Augmentation
from neural_sim.baseline.label_shift.estimate import trained_reader
from neural_sim.baseline.label_shift.evidence import MOVING
from neural_sim.baseline.label_shift.reading import Reader
from neural_sim.baseline.label_shift.settings import LabelShift
from neural_sim.configuration import conf_directory
from neural_sim.documents import markdown_table
from neural_sim.main import context_of
from neural_sim.parameter.distributions import merged, total_variation
from neural_sim.randomness import stream
from neural_sim.report.provenance import machine
from neural_sim.stages.shown import groups_of
from neural_sim.target.ycb_video import YcbVideoTarget
from neural_sim.tasks.context import Context

VERTICAL = ("parameter.pose.axis=azimuth", "parameter.pose.other_range_deg=[30,150]")
READ = LabelShift(photographs=True)
CASES = {
    "as configured": (("unlearned.rho_deg=[-45,45]",), READ),
    "all sides": (("unlearned.rho_deg=[-90,90]",), READ),
    "about the vertical": (VERTICAL, READ),
    "the same, upright": (VERTICAL, replace(READ, augmentation=Augmentation(roll_deg=15.0))),
    "the same, as renders": (VERTICAL, replace(READ, photographs=False)),
}
"""Settings of the renders' poses, and of the estimate."""


def context_for(options: argparse.Namespace, names: list[str], poses: Sequence[str]) -> Context:
    """Return the context of the experiment with these objects and settings of their poses."""
    overrides = [
        "+experiment=ycb_video_full", "baseline=label_shift", "progress=false", f"seed={options.seed}",
        f"paths.data={options.shared}", f"objects.names=[{','.join(names)}]", *poses,
        "parameter.pose.biased=null", "training.real.mode=none", "target.train_fraction=null",
        f"paths.store={options.out / 'store'}", f"baseline.per_bin={options.per_bin}",
        f"camera.width={options.width}",
    ]  # fmt: skip
    with initialize_config_dir(str(conf_directory()), version_base="1.3"):
        return context_of(compose("config", overrides), options.out)[0]


def near(told: Tensor, true: Tensor, groups: Sequence[Sequence[int]], bins: int, most: int) -> Tensor:
    """Return which bins are at most ``most`` steps from one that looks like the true one."""
    alike = torch.eye(bins, dtype=torch.bool)
    for group in groups:
        own = torch.tensor(group) - 1
        alike[own[:, None], own] = True
    close = alike.clone()
    for step in range(1, most + 1):
        close |= alike.roll(step, 1) | alike.roll(-step, 1)
    return close[true, told]


def read(
    reader: Reader, truth: Tensor, label: int, name: str, psi: Tensor, groups: Sequence[Sequence[int]]
) -> dict[str, Any]:
    """Return how well an object's boxes and held-out renders were read, and what was made of it."""
    every_box = replace(reader, views=torch.arange(len(reader.target)))
    seen, held, cells = every_box.posteriors(label, psi)
    (found,), _ = reader.read(label, name, psi, {"pose": groups})
    bins = seen.shape[1]
    own, start = truth[reader.target.labels == label], torch.tensor(found.start)
    shown = torch.bincount(own, minlength=bins) / len(own)
    every = torch.arange(bins).repeat(len(own))
    row: dict[str, Any] = {"object": name, "boxes": len(own), "true": dict(Counter((own + 1).tolist()))}
    row["told"] = dict(Counter((seen.argmax(-1) + 1).tolist()))
    for called, most in (("right", 0), ("near", 1)):
        close = partial(near, groups=groups, bins=bins, most=most)
        row[called] = int(close(seen.argmax(-1), own).sum())
        row[f"{called} by chance"] = float(close(every, own.repeat_interleave(bins)).float().sum()) / bins
        row[f"{called}, held out"] = float(close(held.argmax(-1), cells).float().mean())
    for called, p in (("estimate", torch.tensor(found.p)), ("start", start)):
        row[called] = float(total_variation(merged(p, groups), merged(shown.to(p), groups)))
    row |= {key: getattr(found, key) for key in ("p", "finding", "strange", "p_value", "doubt", "accuracy")}
    return row | {"moves": found.finding in MOVING}


def summary(case: str, rows: list[dict[str, Any]]) -> list[str]:
    """Return a case's line of the table."""
    boxes, moved = sum(row["boxes"] for row in rows), [row for row in rows if row["moves"]]

    def total(key: str) -> float:
        return sum(row[key] for row in rows)

    def percent(key: str) -> str:
        by_chance, held_out = total(f"{key} by chance") / boxes, total(f"{key}, held out") / len(rows)
        return f"{total(key) / boxes:.0%} ({by_chance:.0%}; {held_out:.0%})"

    findings = Counter(row["finding"] for row in rows)
    believed = [row for row in rows if row["finding"] != "fits no render"]
    kept = max(sum(row["boxes"] for row in believed), 1)
    return [
        case,
        percent("right"),
        percent("near"),
        ", ".join(f"{sum(row[key] for row in believed) / kept:.0%}" for key in ("right", "near")),
        f"{total('estimate') / len(rows):.2f} ({total('start') / len(rows):.2f})",
        ", ".join(f"{count} {finding}" for finding, count in findings.items()),
        f"{len(moved)}, {sum(row['estimate'] > row['start'] for row in moved)}",
    ]


def _shown(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"bin {b}: {count}" for b, count in value.items())
    return f"{value:.2f}" if isinstance(value, float) else str(value)


def main() -> None:
    """Parse the command line and run the measurements."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--shared", type=Path, default=Path("../shared"))
    parser.add_argument("--out", type=Path, default=Path("outputs/benchmarks/real_frames"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--per-bin", type=int, default=48)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--fewest", type=int, default=1)
    parser.add_argument("--cases", nargs="*", default=list(CASES), choices=list(CASES), metavar="CASE")
    options = parser.parse_args()
    options.out, options.shared = options.out.resolve(), options.shared.resolve()
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    torch.set_num_threads(1)
    target = YcbVideoTarget(root=options.shared / "ycb_video_sample", every=1)
    frames = list(map(target.reader.frame, target.reader.names))
    names = sorted({item.name for frame in frames for item in frame.objects if item.box is not None})
    contexts = {
        poses: context_for(options, names, poses) for poses in {CASES[case][0] for case in options.cases}
    }
    found: dict[str, list[dict[str, Any]]] = {}
    for case in options.cases:
        poses, settings = CASES[case]
        began, context = time.process_time(), contexts[poses]
        graph, distribution = context.graph, context.experiment.imaging.distribution
        rendered, generator = context.results(graph.pool), stream(options.seed, "psi")
        generator.set_state(rendered.state)
        size = graph.camera.height, graph.camera.width
        images = target.load(target.reader.names, list(graph.names), *size, distribution, graph.objects.radii)
        settings = replace(settings, fewest=options.fewest).for_target(rendered=False)
        reader = trained_reader(rendered.scene, images, settings, generator)
        groups = groups_of(graph.shown.symmetries, context.results)
        truth = images.bins[images.present]
        found[case] = [
            read(reader, truth, label, name, distribution.uniform, groups[name]["pose"])
            for label, name in enumerate(graph.names)
        ]
        keys = [
            "object",
            "boxes",
            "true",
            "told",
            "right",
            "near",
            "estimate",
            "finding",
            "strange",
            "accuracy",
        ]
        print(f"\n{case}, {time.process_time() - began:.0f} CPU seconds\n")
        print(markdown_table(keys, [[_shown(row[key]) for key in keys] for row in found[case]]), flush=True)
    head = [
        "case", "right, % (chance; held-out renders)", "or neighbouring", "of objects that look like renders",
        "total variation (uniform)", "findings",
        "psi moved, to worse",
    ]  # fmt: skip
    print("\n" + markdown_table(head, [summary(case, rows) for case, rows in found.items()]))
    document = {"machine": machine(), "cpu_seconds": time.process_time(), "cases": found}
    (options.out / "real_frames.json").write_text(json.dumps(document, indent=1))


if __name__ == "__main__":
    main()
