"""report.html: self-contained, with every part that the run has, and readable by a browser."""

import dataclasses
import html
import re
import shutil
import subprocess
from html.parser import HTMLParser

import pytest
import torch

from neural_sim.report.page import run_page
from neural_sim.report.page.psi import learned_psi
from neural_sim.report.page.run_page import RunPage, Shown
from neural_sim.report.provenance import Made
from neural_sim.report.run import RunResults
from neural_sim.types import LabelledImages

IMAGES = 24
COMMANDS = {"To compare": "python -m src.main +experiment=compare 'compare.experiments=[gap]'"}


def images(count, each):
    """Squares of two classes, ``each`` of a class in turn."""
    boxes = torch.tensor([[4.0, 4.0, 20.0, 20.0]]).expand(count, 1, 4)
    labels = (torch.arange(count) // each % 2)[:, None]
    return LabelledImages(torch.rand(count, 3, 24, 24), boxes, labels, torch.arange(count) % 2)


def detections(test, hits):
    return [
        {
            "boxes": test.boxes[i] + (0.0 if i % 4 < hits else 18.0),
            "labels": test.labels[i],
            "scores": torch.ones(1),
        }
        for i in range(len(test))
    ]


@pytest.fixture
def shown():
    torch.manual_seed(0)
    test = images(IMAGES, 12)
    found = {which: detections(test, hits) for which, hits in {"ns": 1, "learned": 3, "matched": 4}.items()}
    return Shown(images(12, 6), images(12, 6), test, found)


@pytest.fixture
def results():
    uniform = torch.full((2, 4), 0.25, dtype=torch.float64)
    peaked = torch.tensor([[0.85, 0.05, 0.05, 0.05], [0.25] * 4], dtype=torch.float64)
    certificate = {"p_values": {"mug": {"pose": 0.01}, "can": {"pose": 0.4}}, "doubts": [],
                   "cosine": None, "adjoint": None,
                   "actions": {"mug": {"pose": "kept"}, "can": {"pose": "skipped"}}}  # fmt: skip
    record = {"probabilities": {"pose": uniform.tolist()}, "certificate": certificate, "verdicts": {},
              "images_without_box": 0, "taken_back": {}}  # fmt: skip
    judged = {"mug": {"accepted": True, "expected_gain": 0.1, "measured_gain": 0.2, "error": 0.01}}
    last = {**record, "certificate": None, "verdicts": judged}
    scores = {"ap": 0.5, "ap50": 0.7, "per_class": {"mug": 0.6, "can": 0.4}, "per_class_ap50": {}}
    points = [
        {"iteration": i, "images": 9 * i, "detector_steps": i, "seconds": 2.0 * i, "ap": scores}
        for i in (0, 2)
    ]
    return RunResults(
        "gap", "neural_sim", 3, ("mug", "can"), ("mug",),
        {"initial": {"pose": uniform}, "learned": {"pose": peaked}, "target": {"pose": peaked}}, [record, last],
        {"ns": scores, "learned": scores, "matched": scores}, {}, {"psi": 1.5, "evaluate": 2.5},
        {"peak_memory_mb": 512.0},
        [{"stage": "psi", "what": "the <renderer>", "why": "not needed", "fraction": 0.5, "seconds": None}],
        {"seed": 3}, 0.25, points,
    )  # fmt: skip


class Headings(HTMLParser):
    def __init__(self):
        super().__init__()
        self.found, self.inside = [], False

    def handle_starttag(self, tag, attrs):
        self.inside = tag == "h2"

    def handle_data(self, data):
        if self.inside and data.strip():
            self.found.append(data.strip())


def headings(page):
    parser = Headings()
    parser.feed(page)
    return parser.found


def test_a_page_has_every_part_and_refers_to_no_file_that_is_not_there(results, shown, tmp_path):
    (tmp_path / "results.json").write_text("{}")
    page = RunPage(results, shown).write(COMMANDS, tmp_path).read_text()
    assert headings(page) == [
        "Scores", "What was learned", "What is still weak", "Training images", "Detections on test images",
        "How far to trust it", "What it cost", "Next",
    ]  # fmt: skip
    assert "With one training on each distribution, the learned one gave" in page and "more on mug" in page
    assert "<code>stages=[repeat]</code> trains them again" in page
    assert re.findall(r'href="([^"]*)"', page) == ["results.json"]
    assert all(source.startswith("data:image/") for source in re.findall(r'src="([^"]*)"', page))
    assert "compare.experiments=[gap]" in page and "the &lt;renderer&gt;" in page
    # 6 of 24 images were right before, 18 are now.
    assert all(text in page for text in ("Won (12 of 24)", "Still wrong (6 of 24)", "Right (6 of 24)"))
    assert "Lost (" not in page and 'title="pose: p = 0.01; expected fall of the outer loss 0.100; ' in page


def test_a_page_says_what_the_first_step_was_and_what_was_taken_back(results, shown, tmp_path):
    first, last = results.records
    first = {**first, "verdicts": last["verdicts"]}
    last = {**last, "taken_back": {"mug": {"kept": 1, "accepted": 3, "gain": 0.02}}}
    text = (
        RunPage(dataclasses.replace(results, records=[first, last]), shown)
        .write(COMMANDS, tmp_path)
        .read_text()
    )
    assert "read off the target's boxes" in text and "mug accepted (+0.200 ± 0.010" in text
    assert "mug went back to where it was after 1 of 3 accepted steps" in text


def test_a_page_says_that_photographs_have_an_unknown_distribution(results, shown, tmp_path):
    known = {which: p for which, p in results.probabilities.items() if which != "target"}
    ap = {which: scores for which, scores in results.ap.items() if which != "matched"}
    scored = {which: found for which, found in shown.detections.items() if which != "matched"}
    photographs = dataclasses.replace(results, probabilities=known, ap=ap)
    page = (
        RunPage(photographs, dataclasses.replace(shown, detections=scored))
        .write(COMMANDS, tmp_path)
        .read_text()
    )
    text = re.sub(r'src="[^"]*"|<style>.*?</style>', "", page, flags=re.DOTALL)
    assert "the learned one gave" in text and "The target's is not known: its images are photographs." in text
    assert not re.search("if the target were known|distance|the target's own", text)


def test_a_classification_s_page_speaks_of_accuracy(results, shown, tmp_path):
    """An image is right by its class, wherever its box."""
    moved = {}
    for which, hits in {"ns": 1, "learned": 3, "matched": 4}.items():
        wrong = [int(i % 4 >= hits) for i in range(IMAGES)]
        pairs = zip(shown.detections[which], wrong, strict=True)
        moved[which] = [each | {"labels": (each["labels"] + off) % 2} for each, off in pairs]
    scores = {which: {"accuracy": 0.5, "per_class": s["per_class"]} for which, s in results.ap.items()}
    points = [{**point, "ap": scores["ns"]} for point in results.curve]
    found = dataclasses.replace(results, score="accuracy", ap=scores, curve=points)
    page = RunPage(found, dataclasses.replace(shown, detections=moved)).write(COMMANDS, tmp_path).read_text()
    assert "gave 50.0 points of accuracy more on mug" in page and "Accuracy: the fraction of a class" in page
    assert all(text in page for text in ("Won (12 of 24)", "Still wrong (6 of 24)", "Right (6 of 24)"))
    text = re.sub(r'src="[^"]*"', "", page)
    assert "the best class is the right one" in text and not re.search(r"\bAP\b|average precision", text)


def test_a_run_without_scores_and_without_steps_says_so(results, shown, tmp_path):
    bare = dataclasses.replace(results, ap={}, curve=(), records=[])
    page = RunPage(bare, dataclasses.replace(shown, detections={})).write({}, tmp_path).read_text()
    assert headings(page) == ["Training images", "What it cost", "Next"]
    assert "whether it worked is not known" in page


def test_a_class_that_the_test_set_lacks_has_no_verdict(results, shown, tmp_path):
    one = dataclasses.replace(shown.test, labels=torch.zeros_like(shown.test.labels))
    page = RunPage(results, dataclasses.replace(shown, test=one)).write({}, tmp_path).read_text()
    assert "The other objects" not in page and "on mug" in page


def test_a_test_set_without_a_box_has_no_verdict_either(results, shown, tmp_path):
    nothing = dataclasses.replace(shown.test, labels=torch.full_like(shown.test.labels, -1))
    page = RunPage(results, dataclasses.replace(shown, test=nothing)).write({}, tmp_path).read_text()
    assert "whether it worked is not known" in page


def test_a_curve_is_of_the_objects_that_test_images_show():
    scores = {"ap": 0.5, "per_class": {"mug": 0.5, "can": float("nan")}}
    points = [{"seconds": at, "ap": scores} for at in (0.0, 5.0, 10.0)]
    drawn = [run_page.curve_chart(points, names, {}) for names in (["mug"], ["mug", "can"])]
    assert drawn[0] == drawn[1]


@pytest.mark.slow
@pytest.mark.parametrize("width", [1200, 390])
def test_a_browser_shows_the_page_without_a_sideways_scroll(results, shown, tmp_path, width):
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium")
    page = RunPage(results, shown).write(COMMANDS, tmp_path)
    probe = "<script>document.title = [innerWidth, document.documentElement.scrollWidth, document.images.length, " \
        "[...document.images].filter(i => i.naturalWidth).length].join()</script></body>"  # fmt: skip
    page.write_text(page.read_text().replace("</body>", probe))
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", f"--window-size={width},900", "--dump-dom",
               "--virtual-time-budget=3000", page.as_uri()]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    inner, scroll, count, _ = map(int, re.search(r"<title>([\d,]+)</title>", done.stdout).group(1).split(","))
    assert scroll <= inner and count > 20


def thumbnails(*names):
    return {name: {"pose": torch.randint(0, 256, (4, 8, 8, 3), dtype=torch.uint8)} for name in names}


def test_a_page_says_how_it_was_made_and_warns_of_a_trial(results, shown, tmp_path):
    made = Made("python -m src.main scale=smoke", "smoke", "2026-11-29 03:00", {"processor": "x86", "cores": 2},
                "synthetic test images")  # fmt: skip
    page = RunPage(dataclasses.replace(results, made=made), shown)
    text = page.write({}, tmp_path).read_text()
    assert "2026-11-29 03:00 · scale=smoke · x86, 2 cores" in text and made.command in text
    assert f'<p class="caution">{made.caution}</p>' in text and "its scores mean nothing" in made.caution
    assert "over synthetic test images)" in page.headline and page.headline in html.unescape(text)
    quick = RunPage(dataclasses.replace(results, made=dataclasses.replace(made, scale="quick")), shown)
    assert 'class="caution"' not in quick.write({}, tmp_path).read_text()


def test_every_bin_is_pictured_with_its_share_and_its_score(results, shown, tmp_path):
    one = dataclasses.replace(results, symmetric_bins={"can": {"pose": [[1, 3], [2], [4]]}})
    page = (
        RunPage(one, dataclasses.replace(shown, bins=thumbnails("mug", "can")))
        .write({}, tmp_path)
        .read_text()
    )
    assert page.count('alt="mug from bin') > 4 and page.count('alt="can from bin') >= 4
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", re.sub(r'src="[^"]*"', "", page)))
    # The mug goes from a quarter to 0.85 in bin 1, as in the target; all images of bin 1 are right, half of bin 2.
    assert "bin 1 25 → 85 % (85) AP 38 → 100" in text and "bin 2 25 → 5 % (5) AP 0 → 38" in text
    assert "bin 1 (looks like 3)" in text
    assert re.search(
        r"mug from bin 2 : about 30\.9 AP of this object could be gained\. AP 38 on 6 test images, 50 %", text
    )
    assert "bin 1 has 100; training on the target&#39;s own distribution reaches 100 here" in text


def test_what_was_forgotten_is_told_by_bin_with_its_share(results, shown, tmp_path):
    """Bin 1 of the mug was found before, and is not now."""
    before = [{**each, "boxes": shown.test.boxes[i]} for i, each in enumerate(shown.detections["ns"])]
    after = [
        {**each, "boxes": shown.test.boxes[i] + (18.0 if i < 12 and i % 2 == 0 else 0.0)}
        for i, each in enumerate(before)
    ]
    lost = dataclasses.replace(shown, detections={**shown.detections, "ns": before, "learned": after})
    page = RunPage(results, lost).write({}, tmp_path).read_text()
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]*>", "", page))
    assert "mug from bin 1: AP 100 before, 0 after (a loss of 100 to 100) on 6 test images, 50 %" in text
    assert "went from 25 to 85 %" in text and text.count("before, 0 after") == 1
    p = results.probabilities
    still = dataclasses.replace(results, probabilities={**p, "learned": p["initial"]})
    assert "stayed at 25 %" in RunPage(still, lost).write({}, tmp_path).read_text()


def test_a_curve_is_drawn_of_three_points_or_more_with_labels_that_do_not_meet(results, shown, tmp_path):
    alt = 'alt="AP against seconds"'
    assert alt not in RunPage(results, shown).write({}, tmp_path).read_text()
    points = [{**results.curve[0], "seconds": at} for at in (0.0, 1.0, 50.0, 99.0, 100.0)]
    assert alt in RunPage(dataclasses.replace(results, curve=points), shown).write({}, tmp_path).read_text()
    assert sorted(run_page._apart([0.0, 1.0, 50.0, 99.0, 100.0])) == [1, 2, 4]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"taken_back": {"can": {"kept": 0, "accepted": 2, "gain": 0.1}}}, "went back to its start"),
        ({}, "It did not move: its derivative was never distinguished from zero."),
        ({"verdicts": {"can": {"accepted": False}}}, "It did not move: trainings rejected its steps."),
    ],
)
def test_a_psi_that_stays_or_falls_back_is_commented(results, change, said):
    first, _ = results.records
    own = {"taken_back": {}, "verdicts": {}, "certificate": first["certificate"], **change}
    one = dataclasses.replace(results, records=[{**first, **own}])
    comments = {psi.name: psi.comment for psi in learned_psi(one, {}, [])["pose"]}
    assert said in comments["can"] and comments["mug"] == ""


def test_a_psi_that_leaves_the_target_is_commented(results):
    p = {**results.probabilities, "target": results.probabilities["initial"]}
    (mug, _) = learned_psi(dataclasses.replace(results, probabilities=p), {}, [])["pose"]
    assert mug.comment == "It moved away from the target."
