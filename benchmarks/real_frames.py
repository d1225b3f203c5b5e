"""Read the pose bins of YCB-Video frames with the classifier of label shift, and compare them with the true ones.

The classifier learns from renders of the fields of all objects in the frames, made as in experiment=ycb_video_full:

    as configured   rho within 45 degrees; crops are turned by up to 10 degrees
    all sides       rho within 90 degrees, so that every side is in one bin; crops are turned by any angle
    any roll        the same renders, turned by any angle before boxes are drawn; held-out renders are turned as well
    roll known      the renders of `all sides`, crops turned by up to 10 degrees, frames turned by their true roll
    about the vertical   bins of the turn about the vertical (`axis=azimuth`), cameras held upright, from 30 to 150
                    degrees from above; crops are turned by up to 10 degrees
    about the vertical, any roll   the same renders; crops are turned by any angle

A box is right if its most probable bin is the true one or looks the same by symmetry. `--fewest` is the number of boxes
below which an object is not estimated, 8 by default in runs; boxes of near-duplicate frames count as one. `--width` is
that of the frames in pixels.

    python benchmarks/real_frames.py --shared ../shared
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from PIL import Image
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample

from neural_sim.baseline.label_shift.crops import Augmentation
from neural_sim.baseline.label_shift.estimate import trained_reader
from neural_sim.baseline.label_shift.evidence import MOVING
from neural_sim.baseline.label_shift.reading import Reader
from neural_sim.baseline.label_shift.settings import LabelShift
from neural_sim.configuration import conf_directory
from neural_sim.documents import markdown_table
from neural_sim.main import context_of
from neural_sim.parameter.distributions import merged, total_variation
from neural_sim.pictures import read_picture
from neural_sim.randomness import stream
from neural_sim.report.provenance import machine
from neural_sim.stages.graph import Graph
from neural_sim.stages.shown import groups_of
from neural_sim.synthesis.pool import PooledSubject
from neural_sim.synthesis.scene import Scene
from neural_sim.target.frames import box_of_mask
from neural_sim.target.photographs import Boxes, letterbox, padded
from neural_sim.target.pose_bins import bins_of_poses, viewpoint_of
from neural_sim.target.ycb_video import YcbVideoTarget
from neural_sim.tasks.context import Context
from neural_sim.types import LabelledImages

UPRIGHT = ("parameter.pose.axis=azimuth", "parameter.pose.other_range_deg=[30,150]")
CASES = {
    "as configured": (("unlearned.rho_deg=[-45,45]",), 10.0),
    "all sides": (("unlearned.rho_deg=[-90,90]",), 180.0),
    "any roll": (("unlearned.rho_deg=[-90,90]",), 180.0),
    "roll known": (("unlearned.rho_deg=[-90,90]",), 10.0),
    "about the vertical": (UPRIGHT, 10.0),
    "about the vertical, any roll": (UPRIGHT, 180.0),
}
"""Settings of the renders' poses, and largest turn of the classifier's crops in degrees."""


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


def rolled(pool: Scene, generator: torch.Generator) -> Scene:
    """Return the pool with every render turned by a random angle, as by a camera of random roll."""
    subjects = []
    for subject in pool.subjects:
        assert isinstance(subject, PooledSubject)
        maps = subject.maps.flatten(0, 1).movedim(-1, 1).float()
        height, width = maps.shape[-2:]
        angle = 2.0 * math.pi * torch.rand(len(maps), generator=generator)
        cosine, sine, zero = angle.cos(), angle.sin(), torch.zeros(len(maps))
        matrix = torch.stack([cosine, -sine * height / width, zero, sine * width / height, cosine, zero], -1)
        grid = affine_grid(matrix.view(-1, 2, 3), list(maps.shape), align_corners=False)
        turned = grid_sample(maps, grid, align_corners=False).round().to(torch.uint8)
        subjects.append(replace(subject, maps=turned.movedim(1, -1).reshape(subject.maps.shape)))
    return replace(pool, subjects=tuple(subjects))


def upright(target: YcbVideoTarget, graph: Graph) -> LabelledImages:
    """Return an image for each box, turned about the box so that the camera of its pose has no roll."""
    distribution, size = graph.experiment.imaging.distribution, (graph.camera.height, graph.camera.width)
    (phi,) = distribution.binned
    images, boxes = [], []
    for frame in map(target.reader.frame, target.reader.names):
        photo = read_picture(frame.image).convert("RGB")
        for item in frame.objects:
            if item.box is None or item.mask is None or item.visibility < target.min_visibility:
                continue
            pose = torch.from_numpy(item.object_to_camera)[None]
            seen = viewpoint_of(pose, None, (phi.low, phi.high), distribution.ranges["rho"])
            middle = 0.5 * (item.box[0] + item.box[2]), 0.5 * (item.box[1] + item.box[3])
            angle = math.degrees(float(seen.roll))
            mask = Image.fromarray(item.mask).rotate(angle, center=middle)
            mean = tuple(round(float(value)) for value in np.asarray(photo).mean((0, 1)))
            turned = photo.rotate(angle, Image.Resampling.BILINEAR, center=middle, fillcolor=mean)
            pixels, placing = letterbox(turned, *size)
            images.append(pixels)
            box = torch.tensor([box_of_mask(np.asarray(mask))])
            label = torch.tensor([graph.names.index(item.name)])
            boxes.append(Boxes(placing.boxes(box), label, bins_of_poses(distribution, pose, None)))
    return padded(torch.stack(images), boxes)


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
    return [
        case,
        percent("right"),
        percent("near"),
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
    parser.add_argument("--width", type=int, default=160)
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
        poses, turn = CASES[case]
        began, context = time.process_time(), contexts[poses]
        graph, distribution = context.graph, context.experiment.imaging.distribution
        rendered, generator = context.results(graph.pool), stream(options.seed, "psi")
        generator.set_state(rendered.state)
        pool = rolled(rendered.scene, generator) if case == "any roll" else rendered.scene
        images = upright(target, graph)
        if case != "roll known":
            radii = graph.objects.radii
            size = graph.camera.height, graph.camera.width
            images = target.load(target.reader.names, list(graph.names), *size, distribution, radii)
        settings = LabelShift(fewest=options.fewest, augmentation=Augmentation(roll_deg=turn))
        reader = trained_reader(pool, images, settings, generator)
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
        "case", "right, % (chance; held-out renders)", "or neighbouring", "total variation (uniform)", "findings",
        "psi moved, to worse",
    ]  # fmt: skip
    print("\n" + markdown_table(head, [summary(case, rows) for case, rows in found.items()]))
    document = {"machine": machine(), "cpu_seconds": time.process_time(), "cases": found}
    (options.out / "real_frames.json").write_text(json.dumps(document, indent=1))


if __name__ == "__main__":
    main()
