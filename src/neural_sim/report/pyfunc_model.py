"""A saved detector as MLflow's pyfunc: MLflow runs this file to load the model, so that nothing is pickled."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mlflow
import numpy as np
import pandas as pd
from mlflow.pyfunc import PythonModel  # pyright: ignore[reportPrivateImportUsage]
from PIL import Image
from typing_extensions import override

from neural_sim.detector.saved_detector import DOCUMENT, SavedDetector, detect
from neural_sim.documents import read_json

COLUMNS = ("image", "label", "score", "x0", "y0", "x1", "y1")


class PhotographDetector(PythonModel):
    """Maps RGB photographs of one size, uint8 [n, h, w, 3], to a table with one row per detection.

    Rows are sorted by image and falling score: the image's number from 0, the class name, the score, the box in the
    photograph's pixels.
    """

    @override
    def load_context(self, context: Any) -> None:
        folder = Path(context.artifacts["weights"]).parent
        # MLflow runs a model's code (this file), so users who load it already trust it, and with it the detector's.
        named = read_json(folder / DOCUMENT)["detector"]["class"]
        self.saved = SavedDetector.load(folder, named.replace(":", "."))

    @override
    def predict(self, context: Any, model_input: Any, params: Any = None) -> pd.DataFrame:
        pixels = np.asarray(model_input, dtype=np.uint8)
        if pixels.ndim != 4 or pixels.shape[-1] != 3:
            raise ValueError(f"detector: want RGB photographs [n, h, w, 3], got shape {list(pixels.shape)}")
        names = self.saved.class_names
        rows = [
            (number, names[label], score, *box)
            for number, found in enumerate(detect(self.saved, [Image.fromarray(image) for image in pixels]))
            for label, score, box in zip(
                *(found[key].tolist() for key in ("labels", "scores", "boxes")), strict=True
            )
        ]
        table = pd.DataFrame(rows, columns=list(COLUMNS))
        kinds = {"image": np.int64, "label": str, **dict.fromkeys(COLUMNS[2:], np.float64)}
        return table.astype(kinds)


mlflow.models.set_model(PhotographDetector())
