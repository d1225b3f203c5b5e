"""Small data in the place of the paths that documented commands name: each path stands for one kind of data."""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
import trimesh
from captures import capture
from documented import PAGES, ROOT
from made_photographs import co3d, objectnet, photographs_by_class, rooms
from omegaconf import OmegaConf
from PIL import Image
from posed_scenes import meshes_in_metres, photographs, write_bop, write_ycb_video

from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.saved_detector import SavedDetector
from neural_sim.detector.settings import Backbone, Head
from neural_sim.objects.procedural import Procedural
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.target.ycb_video import CLASSES

COLOURS = np.array(
    [[200, 40, 40], [40, 70, 200], [230, 200, 40], [60, 160, 70], [240, 240, 240], [120, 60, 30]], np.uint8
)


def ycb(root: Path) -> Path:
    """A box with six differently coloured sides for every YCB object that documentation or experiments name."""
    texts = [
        path.read_text(encoding="utf-8") for path in (*PAGES, *(ROOT / "conf" / "experiment").glob("*.yaml"))
    ]
    for number, name in enumerate(sorted(set(re.findall(r"\b0\d\d_[a-z_]+[a-z]\b", " ".join(texts))))):
        folder = root / name / "google_16k"
        folder.mkdir(parents=True)
        extents = 0.04 + 0.03 * ((number + np.arange(3)) % 5)
        corners = trimesh.creation.box(extents)
        lines = ["mtllib textured.mtl", "usemtl material"]
        lines += [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in corners.vertices]
        lines += [f"vt {(side + 0.5) / 6:.5f} 0.5" for side in range(6)]
        for corner, normal in zip(corners.faces, corners.face_normals, strict=True):
            axis = int(np.abs(normal).argmax())
            side = 2 * axis + int(normal[axis] > 0) + 1
            lines.append("f " + " ".join(f"{vertex + 1}/{side}" for vertex in corner))
        (folder / "textured.obj").write_text("\n".join(lines) + "\n")
        (folder / "textured.mtl").write_text("newmtl material\nmap_Kd texture_map.jpg\n")
        stripes = np.roll(COLOURS, number, axis=0)[None].repeat(8, 0).repeat(8, 1)
        Image.fromarray(stripes).save(folder / "texture_map.jpg", quality=95)
    return root


def bop(root: Path) -> Path:
    """Two coloured boxes in millimetres with their diameters."""
    root.mkdir(parents=True)
    info = {}
    for number, extents in enumerate(((60.0, 80.0, 150.0), (90.0, 90.0, 40.0)), 1):
        mesh = _coloured(trimesh.creation.box(extents), number)
        mesh.export(root / f"obj_{number:06d}.ply")
        info[str(number)] = {"diameter": float(np.linalg.norm(extents))}
    (root / "models_info.json").write_text(json.dumps(info))
    return root


def meshes(root: Path) -> Path:
    """A mesh in each of the formats that the documentation names."""
    root.mkdir(parents=True)
    shapes = {
        "block.obj": trimesh.creation.box((0.1, 0.2, 0.3)),
        "rod.ply": trimesh.creation.cylinder(0.05, 0.3),
        "cone.glb": trimesh.creation.cone(0.1, 0.2),
        "ball.stl": trimesh.creation.icosphere(2, 0.1),
    }
    for number, (name, mesh) in enumerate(shapes.items()):
        _coloured(mesh, number).export(root / name)
    return root


def coco(path: Path, names: Sequence[str] = ()) -> Path:
    """Frames of four videos, a folder each, with a box of each of two of six objects, of the embedded ones unless their
    names are given, in every frame."""
    path.parent.mkdir(parents=True, exist_ok=True)
    names, generator = names or Procedural().names(), torch.Generator().manual_seed(1)
    images, annotations = [], []
    for video in range(4):
        folder = path.parent / f"video{video}"
        folder.mkdir()
        wall = ProceduralClutter().draw(1, 110, 130, generator)[0]
        for frame in range(4):
            picture = (255 * wall[:, :90, 3 * frame : 3 * frame + 120]).byte().movedim(0, -1).numpy().copy()
            for slot, label in enumerate((video % len(names), (video + 2) % len(names))):
                left, top = 8 + 55 * slot + 2 * frame, 20 + 10 * slot
                picture[top : top + 40, left : left + 36] = COLOURS[label % 6]
                annotations.append({"id": len(annotations), "image_id": len(images), "category_id": label,
                                    "bbox": [left, top, 36, 40], "area": 1440, "iscrowd": 0,
                                    "pose": video % 8 + 1})  # fmt: skip
            name = f"{folder.name}/{frame:04d}.png"
            Image.fromarray(picture).save(path.parent / name)
            images.append({"id": len(images), "file_name": name, "width": 120, "height": 90, "scene": video})
    categories = [{"id": label, "name": name} for label, name in enumerate(names)]
    camera = {"width": 120, "height": 90, "fx": 150.0, "fy": 150.0, "cx": 59.5, "cy": 44.5}
    document = {"images": images, "annotations": annotations, "categories": categories, "camera": camera}
    path.write_text(json.dumps(document))
    return path


def wild(path: Path) -> Path:
    """:func:`coco` with the paper's six YCB objects."""
    return coco(path, OmegaConf.load(ROOT / "conf" / "experiment" / "detection_gallery.yaml").objects.names)


def blenderproc(root: Path) -> Path:
    """The pictures of :func:`coco` as BlenderProc writes them."""
    coco(root / "coco_data" / "coco_annotations.json")
    return root


def in_the_wild(root: Path) -> Path:
    """Eight photographs of each of the six objects of ycb_in_the_wild in each of eight bins."""
    root.mkdir(parents=True)
    text = (ROOT / "conf" / "experiment" / "ycb_in_the_wild.yaml").read_text(encoding="utf-8")
    names = sorted(set(re.findall(r"\b0\d\d_[a-z_]+[a-z]\b", text)))
    images, annotations, random = [], [], np.random.default_rng(4)
    for number, (label, bin, _) in enumerate(np.ndindex(len(names), 8, 8)):
        picture = random.integers(0, 255, (60, 80, 3), np.uint8)
        left, top = (int(v) for v in random.integers(2, 25, 2))
        picture[top : top + 30, left : left + 40] = COLOURS[label % 6]
        Image.fromarray(picture).save(root / f"{number:04d}.png")
        images.append({"id": number, "file_name": f"{number:04d}.png", "width": 80, "height": 60})
        annotations.append({"id": number, "image_id": number, "category_id": label, "pose": bin + 1,
                            "bbox": [left, top, 40, 30], "area": 1200, "iscrowd": 0})  # fmt: skip
    categories = [{"id": label, "name": name} for label, name in enumerate(names)]
    document = {"images": images, "annotations": annotations, "categories": categories}
    (root / "annotations.json").write_text(json.dumps(document))
    return root


def ycb_video_sample(root: Path, scenes: int = 3) -> Path:
    """Scenes of YCB-Video, two frames each, that show the objects of the documentation and another."""
    meshes = meshes_in_metres({"019_pitcher_base": "pitcher", "035_power_drill": "drill", "025_mug": "mug"})
    write_ycb_video(root, photographs(meshes, scenes, 2), meshes, CLASSES, hdf5=(3,))
    return root


def ycb_video(root: Path) -> Path:
    """Six scenes of YCB-Video, and which are key frames."""
    ycb_video_sample(root, scenes=6)
    (root / "image_sets").mkdir()
    for name, scenes in (("train", range(4)), ("keyframe", range(4, 6))):
        lines = [f"{scene:04d}/{number:06d}\n" for scene in scenes for number in (1, 2)]
        (root / "image_sets" / f"{name}.txt").write_text("".join(lines))
    return root


def bop_scenes(root: Path) -> Path:
    """Six scenes that show the two objects of :func:`bop`."""
    meshes = meshes_in_metres({"obj_000001": "tall_box", "obj_000002": "flat_box"})
    return write_bop(root, photographs(meshes, 6, 2), meshes)


def backgrounds(root: Path) -> Path:
    """Four photographs."""
    root.mkdir(parents=True)
    for number, picture in enumerate(ProceduralClutter().draw(4, 96, 128, torch.Generator().manual_seed(2))):
        pixels = (255 * picture).byte().movedim(0, -1).numpy()
        Image.fromarray(pixels).save(root / f"{number}.jpg")
    return root


def cutouts(root: Path) -> Path:
    """Two half-transparent pictures."""
    root.mkdir(parents=True)
    for number, colour in enumerate(((200, 30, 30, 128), (30, 30, 200, 255))):
        Image.new("RGBA", (40, 20), colour).save(root / f"{number}.png")
    return root


def captures(root: Path) -> Path:
    """Twelve photographs of each of two of the embedded objects, with masks."""
    root.mkdir(parents=True)
    for name, kind in (("can", "transforms"), ("mug", "colmap_text")):
        capture(root, name, count=12, kind=kind, suffix=".jpg")
    return root


def labels(path: Path) -> Path:
    """:func:`coco` with the objects of :func:`captures`."""
    return coco(path, ["can", "mug"])


def coco_photographs(root: Path) -> Path:
    """The pictures of :func:`coco`, in a folder of their own."""
    coco(root / "val.json")
    return root


def trained(root: Path) -> Path:
    """A run's folder with the files of a detector of the embedded objects, which has learned nothing, and a psi."""
    make, names = (
        functools.partial(RetinaNet, backbone=Backbone("micro"), head=Head(8, 1)),
        tuple(Procedural().names()),
    )
    params = make(num_classes=len(names), image_size=(64, 64)).init(torch.Generator().manual_seed(3))
    params["head.classification_head.cls_logits.bias"] += 4.0  # else no score reaches the threshold
    SavedDetector(make, params, names, (64, 64)).save(root)
    learned = {"pose": {"learned": [0.3, *[0.1] * 7]}}
    (root / "results.json").write_text(json.dumps({"psi": dict.fromkeys(names, learned)}))
    return root


def page(path: Path) -> Path:
    """Where a command may write a page, instead of into the documentation."""
    path.parent.mkdir(parents=True)
    return path


MAKERS: dict[str, Callable[[Path], Path]] = {
    "/data/ycb": ycb,
    "../shared/ycb": ycb,
    "../shared/captures": rooms,
    "/data/models": bop,
    "/data/meshes": meshes,
    "/data/captures": captures,
    "/data/rooms": rooms,
    "/data/val.json": coco,
    "/data/wild.json": wild,
    "/data/blenderproc": blenderproc,
    "/data/backgrounds": backgrounds,
    "/data/cutouts": cutouts,
    "/data/YCB_Video": ycb_video,
    "/data/ycbv": bop_scenes,
    "/data/photos": backgrounds,
    "/data/val": coco_photographs,
    "/data/by_class": photographs_by_class,
    "/data/objectnet": objectnet,
    "/data/co3d": co3d,
    "/data/shelf/captures": captures,
    "/data/shelf/labels.json": labels,
    "/data/shelf/new": backgrounds,
    "outputs/shelf/captures": captures,
    "outputs/shelf/labels.json": labels,
    "outputs/shelf/new": backgrounds,
    "docs/experiments.md": page,
    "outputs/runs/pose_gap/2026-11-22_09-00-00": trained,
    "outputs/runs/shelf/2026-11-22_09-00-00": trained,
}
"""What the documentation's paths stand for."""


class MadeData:
    """Data under ``root`` for the paths in commands, each made when it is first asked for."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.made: dict[Callable[[Path], Path], Path] = {}

    @property
    def shared(self) -> Path:
        """A folder for ``paths.data``, with ycb/, ycb_in_the_wild/, ycb_video_sample/ and objectnet/ in it."""
        self.localise("objects.root=../shared/ycb")
        root = self.made[ycb].parent
        parts = (
            (in_the_wild, "ycb_in_the_wild"),
            (ycb_video_sample, "ycb_video_sample"),
            (objectnet, "objectnet"),
        )
        for make, folder in parts:
            if make not in self.made:
                self.made[make] = make(root / folder)
        return root

    def localise(self, word: str) -> str:
        """The word with a documented path replaced by that of made data.

        Raises ``AssertionError`` for a path that stands for no data.
        """
        key, equals, value = word.rpartition("=")
        if value.startswith("../shared/") and value not in MAKERS:
            return f"{key}{equals}{self.shared / value.removeprefix('../shared/')}"
        if value in MAKERS:
            make = MAKERS[value]
            if make not in self.made:
                self.made[make] = make(self.root / make.__name__ / Path(value).name)
            return f"{key}{equals}{self.made[make]}"
        if value.startswith(("/", "~", "../")):
            raise AssertionError(f"{word}: say in {Path(__file__).name} what {value} stands for")
        return word


def with_given_cameras(job: Sequence[str]) -> list[str]:
    """The words of a job, with the cameras of photographs given: made ones are too small for COLMAP."""
    finds = "+experiment=photographs" in job or "objects/poses=colmap" in job
    return [
        *(word for word in job if word != "objects/poses=colmap"),
        *(["objects/poses=given"] if finds else []),
    ]


def _coloured(mesh: trimesh.Trimesh, number: int) -> trimesh.Trimesh:
    colours = COLOURS[(number + np.arange(len(mesh.vertices))) % 6]
    mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=colours)
    return mesh
