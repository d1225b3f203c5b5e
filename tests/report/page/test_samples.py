"""samples.html: what is in a data set, and some of its images."""

import re

import numpy as np
from PIL import Image

from neural_sim.report.page.samples import write_samples_page
from neural_sim.synthesis.export.masks import run_lengths


def record(root, number, *labels, labelled=True):
    (root / "images").mkdir(exist_ok=True)
    file = f"images/{number:06d}.png"
    Image.new("RGB", (40, 30), (90, 90, 90)).save(root / file)
    mask = np.zeros((30, 40), dtype=bool)
    mask[5:15, 10:30] = True
    item = {"labelled": labelled, "box_visible": [10, 5, 20, 10], "mask_visible": run_lengths(mask)}
    return {"number": number, "file": file, "objects": [{**item, "label": label} for label in labels]}


def test_the_page_counts_labels_and_shows_images(tmp_path):
    records = [record(tmp_path, 0, 0, 1), record(tmp_path, 1), record(tmp_path, 2, 1, labelled=False)]
    page = write_samples_page(tmp_path, records, ["can", "mug"], {"train": records[:2], "val": records[2:]})
    source = re.sub(r"<style>.*?</style>", "", page.read_text(), flags=re.DOTALL)
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", source))
    assert "3 images: 2 for training, 1 for validation; 2 show no labelled object." in text
    assert "can 1 0 14" in text and "mug 1 1 14" in text  # the root of 20 x 10
    assert "0: can, mug" in text and "1: no object" in text
    sources = re.findall(r'src="([^"]*)"', page.read_text())
    assert len(sources) == 3 and all(source.startswith("data:image/jpeg") for source in sources)
    alone = write_samples_page(tmp_path, records[:1], ["can", "mug"], {}).read_text()
    assert "1 image, without a split." in alone
    empty = write_samples_page(tmp_path, records[:2], ["can", "mug"], {}).read_text()
    assert "2 images, without a split; 1 shows no labelled object." in empty
