"""Images per second and memory of an export, by image size, objects per image and format.

    python benchmarks/export.py

Fits fields to the embedded objects, then writes data sets to a temporary folder. Times cover drawing, rendering,
composing, encoding and writing the images, but not the fits and the final annotations.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import torch
from machine import memory_mb
from training_views import fit, load_objects, training_views

from neural_sim.cameras import reframed
from neural_sim.field.base import RadianceField
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.report.provenance import machine
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.export.dataset import ImageFormat, ImageWriter, each
from neural_sim.synthesis.export.images import ImageSource
from neural_sim.synthesis.scene import Scene
from neural_sim.synthesis.subjects import FieldSubject
from neural_sim.synthesis.synthesizer import Synthesizer
from neural_sim.types import PinholeCamera


def source_of(fields: dict[str, RadianceField]) -> ImageSource:
    """Return a source of images with uniform poses around the objects, at 2.4 to 4 radii, as in a run."""
    distribution = SceneDistribution.of([Pose()])
    camera = PinholeCamera(96, 96, math.radians(40.0))
    subjects = tuple(FieldSubject(name, field, NerfRenderer()) for name, field in fields.items())
    scene = Scene(subjects, camera, Synthesizer(ProceduralClutter()), distribution)
    psi = torch.zeros(len(fields), distribution.size, dtype=torch.float64)
    return ImageSource(scene, psi, camera, (100.0,) * len(fields), 0)


def sized(source: ImageSource, width: int, height: int, objects: int) -> ImageSource:
    """Return the source with another image size and number of objects per image."""
    synthesizer = replace(source.scene.synthesizer, objects_per_image=(objects, objects))
    camera = reframed(source.scene.camera, width, height)
    return replace(source, camera=camera, scene=replace(source.scene, synthesizer=synthesizer))


def measured(
    source: ImageSource, count: int, workers: int, bop: bool, image_format: ImageFormat
) -> dict[str, float]:
    """Measure seconds and CPU seconds per image, without the first image of each process, which includes its start."""
    with tempfile.TemporaryDirectory() as folder:
        writer = ImageWriter(source, Path(folder), image_format, 1000 if bop else None, 0.01)
        first = max(workers, 1)
        made = each(writer, list(range(count + first)), workers, Path(folder))
        for _ in range(first):
            next(made)
        begun, used = time.perf_counter(), time.process_time()
        size = sum(len(json.dumps(record)) for record in made)
        seconds = time.perf_counter() - begun
        own = time.process_time() - used
        files = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
    row = {"seconds": seconds / count, "images_per_second": count / seconds, "record_kb": size / count / 1e3,
           "files_kb": files / (count + first) / 1e3}  # fmt: skip
    return row | ({} if workers else {"cpu_seconds": own / count})


def _alone(queue, *arguments) -> None:
    made = measured(*arguments)
    queue.put(made | {"peak_mb": memory_mb()[1]})


def in_process(*arguments) -> dict[str, float]:
    """Call ``measured`` in a separate process and add the peak memory of that process."""
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    process = context.Process(target=_alone, args=(queue, *arguments))
    process.start()
    made = queue.get()
    process.join()
    return made


def main() -> None:
    """Parse the command line and run the measurements."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", help="a folder in the YCB layout; without it the embedded objects")
    parser.add_argument("--names", nargs="*")
    parser.add_argument("--steps", type=int, default=240)
    parser.add_argument("--views", type=int, default=96, help="pixels a side")
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument("--sizes", nargs="*", default=["640x480", "1280x960"])
    parser.add_argument("--objects", type=int, nargs="*", default=[1, 6])
    parser.add_argument("--workers", type=int, nargs="*", default=[0, 2])
    parser.add_argument("--image-format", choices=["jpg", "png"], default="jpg")
    parser.add_argument("--bop", action="store_true", help="with depth and masks")
    parser.add_argument("--out", type=Path, default=Path("outputs/benchmarks/export.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    fields = {
        item.name: fit(training_views(item, arguments.views, 84), arguments.steps)
        for item in load_objects(arguments.root, arguments.names)
    }
    rows = []
    print(f"{'size':>10}{'objects':>8}{'workers':>8}{'images/s':>10}{'cpu s':>8}{'peak MB':>9}{'kB':>7}")
    base = source_of(fields)
    for size in arguments.sizes:
        width, height = map(int, size.split("x"))
        for objects in arguments.objects:
            source = sized(base, width, height, min(objects, len(fields)))
            for workers in arguments.workers:
                asked = (source, arguments.count, workers, arguments.bop, arguments.image_format)
                row = measured(*asked) if workers else in_process(*asked)
                rows.append({"size": size, "objects": objects, "workers": workers, **row})
                print(
                    f"{size:>10}{objects:8}{workers:8}{row['images_per_second']:10.2f}"
                    f"{row.get('cpu_seconds', math.nan):8.3f}{row.get('peak_mb', math.nan):9.0f}"
                    f"{row['files_kb']:7.0f}",
                    flush=True,
                )
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps({"machine": machine(), "bop": arguments.bop, "rows": rows}, indent=2))


if __name__ == "__main__":
    main()
