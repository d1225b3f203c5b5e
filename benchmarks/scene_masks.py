"""Masks computed from the geometry of a scene, compared with true masks.

The photographs are renders of an object on a table in a room: two embedded objects and, with `--root ../shared/ycb`, a
scanned one. `--noise` is the standard deviation of the recorded camera positions, relative to the distance. Overlap is
the intersection over union of masks thresholded at a half; PSNR is measured on held-out photographs for fields from
these masks and from the true ones, each over the foreground of its own masks. `--capture` is a folder of real
photographs with cameras instead, whose masks are compared with those in `--polygons`, a COCO file.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from captures import on_a_table
from training_views import quick_psnr

from neural_sim.field.scene.recipe import SceneMasks
from neural_sim.objects.mesh import ObjectMesh
from neural_sim.objects.photos import Photos
from neural_sim.objects.pictures import Pictures
from neural_sim.objects.procedural import Procedural
from neural_sim.objects.ycb import YCB
from neural_sim.report.provenance import machine

HELD_OUT = 4


def overlaps(truth: dict[str, np.ndarray], pictures: Pictures) -> dict[str, float]:
    """Compute the overlap of masks with the true ones, by photograph, for photographs that have a true mask."""
    values = {}
    for frame in pictures.capture.frames:
        true = truth.get(frame.image.name)
        if true is not None:
            mask = pictures.rgba(frame)[..., 3].numpy() > 0.5
            values[frame.image.name] = float((mask & true).sum() / max(1, (mask | true).sum()))
    return values


def polygons(file: Path) -> dict[str, np.ndarray]:
    """Return masks from the polygons in a COCO file, by photograph."""
    coco = json.loads(file.read_text())
    drawn = {image["id"]: Image.new("L", (image["width"], image["height"])) for image in coco["images"]}
    for annotation in coco["annotations"]:
        for outline in annotation["segmentation"]:
            ImageDraw.Draw(drawn[annotation["image_id"]]).polygon(outline, fill=255)
    return {image["file_name"]: np.asarray(drawn[image["id"]]) > 127 for image in coco["images"]}


def measure_real(options: argparse.Namespace) -> dict[str, float | str]:
    """Compare the masks of a real capture with polygons."""
    source = Photos(options.capture, masks="scene", scene=SceneMasks())
    (name,) = source.names()
    spent = time.process_time()
    pictures = source.pictures(name)
    cpu = time.process_time() - spent
    values = overlaps(polygons(options.polygons), pictures)
    print({photo: round(value, 3) for photo, value in values.items()})
    worst = min(values.values())
    return {
        "object": name,
        "overlap": float(np.median([*values.values()])),
        "worst": worst,
        "cpu_seconds": cpu,
    }


def psnr(source: Photos, name: str, pictures: Pictures, size: int) -> float:
    """Return the PSNR of a field fitted in 240 steps, over the foreground of held-out photographs."""
    views = source.views(name, 1000, HELD_OUT, size, pictures)
    return quick_psnr(views, len(source.split(name, 1000, HELD_OUT)[1]))


def measure(item: ObjectMesh, options: argparse.Namespace) -> dict[str, float | str]:
    """Return the table row of one object."""
    with tempfile.TemporaryDirectory() as folder:
        return measure_in(Path(folder), item, options)


def measure_in(folder: Path, item: ObjectMesh, options: argparse.Namespace) -> dict[str, float | str]:
    """Return the table row of one object, with its photographs in a folder."""
    truth = on_a_table(
        folder, item, count=options.photos, width=options.size[0], height=options.size[1],
        exposure=0.05, pose_noise=options.noise, suffix=".jpg",
    )  # fmt: skip
    source = Photos(folder, [item.name], masks="scene", scene=SceneMasks())
    began, spent = time.perf_counter(), time.process_time()
    pictures = source.pictures(item.name)
    seconds, cpu = time.perf_counter() - began, time.process_time() - spent
    true_masks = {
        frame.image.name: np.asarray(Image.open(truth.folder / "truth" / f"{frame.image.stem}.png")) > 127
        for frame in pictures.capture.frames
    }
    values = [*overlaps(true_masks, pictures).values()]
    (truth.folder / "truth").rename(truth.folder / "masks")
    true = Photos(folder, [item.name], masks="files")
    fields = [psnr(source, item.name, pictures, 96), psnr(true, item.name, true.pictures(item.name), 96)]
    return {
        "object": item.name, "overlap": float(np.median(values)), "worst": min(values), "psnr": fields[0],
        "psnr_true_masks": fields[1], "seconds": seconds, "cpu_seconds": cpu,
    }  # fmt: skip


def main() -> None:
    """Parse the command line and run the measurements."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", help="a folder in the YCB layout, for the drill")
    parser.add_argument("--photos", type=int, default=40)
    parser.add_argument("--size", type=int, nargs=2, default=(200, 150), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("--objects", nargs="*", default=["can", "mug"], help="embedded ones")
    parser.add_argument("--capture", type=Path, help="a folder of real photographs instead of all these")
    parser.add_argument("--polygons", type=Path, help="of --capture: a COCO file")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    items = Procedural(options.objects).load() if options.objects else []
    items += YCB(options.root, ["035"]).load() if options.root else []
    rows = []
    for row in [measure_real(options)] if options.capture else (measure(item, options) for item in items):
        rows.append(row)
        print({key: round(x, 3) if isinstance(x, float) else x for key, x in rows[-1].items()}, flush=True)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print(f"largest memory: {peak:.0f} MB")
    if options.json:
        options.json.write_text(json.dumps({"rows": rows, "memory_mb": peak, "machine": machine()}, indent=1))


if __name__ == "__main__":
    main()
