"""A small data set, which the tests of the export share."""

from neural_sim.synthesis.export.dataset import DataSet


def data_of(boxes, root, **changes):
    made = boxes()
    settings = {"count": 7, "formats": ("coco", "yolo", "bop"), "image_format": "png", "scene_size": 4,
                "farthest": 700.0, **changes}  # fmt: skip
    return DataSet(made.source, root, made.models, {"seed": 3, "psi": {"tall": [0.5]}}, **settings)
