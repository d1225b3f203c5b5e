"""Task ``sample``: write data to try the program with: captures, meshes and labelled pictures of a run's objects."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from PIL import Image
from torch import Tensor
from typing_extensions import override

from neural_sim.cameras import focal_lengths
from neural_sim.configuration import UserError
from neural_sim.documents import read_json, write_json
from neural_sim.ranges import PositiveInt, validated
from neural_sim.stages.stage import Stage
from neural_sim.stages.views import Meshes, ViewsStage
from neural_sim.synthesis.export.coco import write_coco
from neural_sim.synthesis.export.folder import opencv_entry
from neural_sim.tasks.context import Context, Task
from neural_sim.types import LabelledImages, PosedViews


@validated
@dataclass(frozen=True)
class SampleTask(Task):
    """A folder with ``captures``, ``meshes``, ``labels.json`` with its pictures, and ``new``, pictures without labels.

    The captures are the run's views of each object, with the cameras in ``transforms.json`` and masks as alpha. The
    labelled pictures are the validation set of the run's target, the new ones its test set.

    Args:
        folder: the folder, which must not exist yet.
        frames: number of labelled pictures in each of the folders that stand for videos.
    """

    folder: str = "outputs/shelf"
    frames: PositiveInt = 10

    @override
    def reads(self, context: Context) -> Iterable[Stage[Any]]:
        if self._root.exists():
            raise UserError(f"sample.folder: {self._root} exists; want a new folder, or delete that one")
        graph = context.graph
        if not isinstance(graph.objects, Meshes) or not graph.experiment.imaging.target.renders:
            raise UserError("stages=[sample] renders its data: want objects from meshes and target=rendered")
        return [*graph.views, graph.targets]

    @property
    def _root(self) -> Path:
        return Path(self.folder).expanduser()

    @override
    def run(self, context: Context) -> None:
        graph, targets = context.graph, context.results(context.graph.targets)
        # Built elsewhere and moved at the end, so that a folder that exists is complete.
        made = context.folder / "sample"
        shutil.rmtree(made, ignore_errors=True)
        for stage in context.shown(graph.views, "views"):
            self._write_capture(made / "captures" / stage.object, stage, context.results(stage))
        (made / "meshes").mkdir()
        for name, item in cast(Meshes, graph.objects).items.items():  # as ``reads`` has made sure
            item.mesh.copy().apply_transform(item.transform).export(made / "meshes" / f"{name}.glb")
        self._write_labels(made, targets.val, graph.names, opencv_entry(graph.camera))
        (made / "new").mkdir()
        for number, image in enumerate(targets.test.images):
            _save(image.movedim(0, -1), made / "new" / f"{number:03d}.png")
        self._root.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(made, self._root)
        counts = (
            f"{len(graph.names)} objects, {len(targets.val)} labelled pictures, {len(targets.test)} new ones"
        )
        print(f"{counts}\nsample data: {self._root}")

    def _write_capture(self, folder: Path, stage: ViewsStage, views: PosedViews) -> None:
        (folder / "images").mkdir(parents=True)
        frames = []
        for number, (image, pose) in enumerate(zip(views.images, views.camera_to_world, strict=True)):
            name = f"images/{number:03d}.png"
            _save(image, folder / name)
            frames.append({"file_path": name, "transform_matrix": pose.tolist()})
        (fx, fy), camera = focal_lengths(views.camera), views.camera
        lens = {"camera_model": "PINHOLE", "w": camera.width, "h": camera.height, "fl_x": fx, "fl_y": fy}
        write_json(folder / "transforms.json", {**lens, "up": [0.0, 0.0, 1.0], "frames": frames})

    def _write_labels(
        self, folder: Path, images: LabelledImages, names: tuple[str, ...], camera: dict[str, float]
    ) -> None:
        """Write COCO with ``self.frames`` pictures in each folder, as if they were frames of several videos."""
        document = read_json(whole := write_coco(images, names, folder / "labels"))
        for number, entry in enumerate(document["images"]):
            video = f"video{number // self.frames + 1:02d}"
            (folder / video).mkdir(exist_ok=True)
            own = f"{video}/{number % self.frames:03d}.png"
            shutil.move(whole.parent / entry["file_name"], folder / own)
            del entry["bin"]  # unknown for photographs, which these stand for
            entry["file_name"] = own
        shutil.rmtree(whole.parent)
        write_json(folder / "labels.json", {**document, "camera": camera})


def _save(image: Tensor, path: Path) -> None:
    Image.fromarray(image.mul(255.0).round().byte().numpy()).save(path)
