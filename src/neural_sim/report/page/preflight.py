"""preflight.html, which says whether an optimisation is worthwhile, from what is known beforehand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch

from neural_sim.baseline.label_shift.evidence import MOVING, FactorEstimate
from neural_sim.detector.protocol import Score
from neural_sim.documents import write_whole
from neural_sim.outer.preflight import ExpectedGains, PhotographGain, equivalent
from neural_sim.report.figures import Thumbnails
from neural_sim.report.page import pictures, render
from neural_sim.report.page.pictures import picture
from neural_sim.report.page.psi import shown_chart
from neural_sim.report.page.verdict import listed
from neural_sim.report.page.weak_bins import BinScore, by_object, weaknesses
from neural_sim.target.mismatch import Mismatch
from neural_sim.types import LabelledImages

FILE = "preflight.html"
SHOWN = 18
"""Number of images shown of each set."""


@dataclass(frozen=True)
class Preflight:
    """The evidence before an optimisation, and what it says.

    Args:
        experiment: name of the experiment.
        names: names of the objects.
        foreseen: expected gains of every object and factor.
        level: family-wise significance level at which they count.
        bins: scores of the initial distribution's detector by bin of the validation images.
        mismatches: statistics of renders and of the target.
        settings: settings that would match them.
        distance_factor: factor on camera distances that would match the sizes of boxes; None: they agree.
        labelled: gains from labelled photographs in training, by their number; empty if none are for training.
        score: the kind of score.
        shown: the estimate from the target's boxes.
        follows: whether the loop's first step goes to this estimate.
        caution: a warning to show first; empty: none.
    """

    experiment: str
    names: tuple[str, ...]
    foreseen: tuple[ExpectedGains, ...]
    level: float
    bins: tuple[BinScore, ...]
    mismatches: tuple[Mismatch, ...]
    settings: Mapping[str, str]
    distance_factor: float | None
    labelled: tuple[PhotographGain, ...] = ()
    score: Score = "AP"
    shown: tuple[FactorEstimate, ...] = ()
    follows: bool = False
    caution: str = ""

    @property
    def moved(self) -> list[str]:
        """Objects that the loop's first step would move, because the target's boxes do not show what psi says."""
        moving = [one.name for one in self.shown if one.finding in MOVING]
        return list(dict.fromkeys(moving)) if self.follows else []

    @property
    def promising(self) -> list[ExpectedGains]:
        """Objects and factors with a significant derivative (Holm's step-down procedure, 1979), largest gain first."""
        ordered = sorted(self.foreseen, key=lambda f: f.p_value)
        kept: list[ExpectedGains] = []
        for place, one in enumerate(ordered):
            if one.p_value > self.level / (len(ordered) - place):
                break
            kept.append(one)
        return sorted(kept, key=lambda f: -f.step)

    @property
    def verdict(self) -> str:
        """A sentence that says whether an optimisation is worth it."""
        return f"{self.caution} {self._verdict}" if self.caution else self._verdict

    @property
    def _verdict(self) -> str:
        names = list(dict.fromkeys(f.name for f in self.promising))
        if self.moved:
            derivatives = (
                f"derivatives would move {listed(names)}" if names else "derivatives alone would move nothing"
            )
            return (
                f"Worth a run: your target shows {listed(self.moved)} differently from how they are rendered now. The "
                f"first step goes to what it shows, and is kept if training on it scores better; {derivatives}."
            )
        if not names:
            return (
                "Not worth optimising as it is configured: no object's derivative can be distinguished from zero, so "
                "the loop would not know where to go."
            )
        return (
            f"Worth optimising: {listed(names)} would gain. A first step of the trust region lowers the outer loss by "
            f"{self.gain:.3f} to first order."
        )

    @property
    def gain(self) -> float:
        """Expected fall of L_val from a first step of all promising objects and factors."""
        return sum(f.step for f in self.promising)

    @property
    def worth(self) -> str:
        """One or two sentences on how many labelled photographs gain as much."""
        if not self.labelled:
            return (
                "How many labelled photographs a first step is worth is not known: none are set aside for training "
                "(target.train_fraction, or target.train_per_object of rendered targets)."
            )
        tried = "; ".join(
            f"{g.photographs} lower it by {g.fall:.3f}" + ("" if g.error is None else f" ± {g.error:.3f}")
            for g in self.labelled
        )
        sentence = f"Labelled photographs, added to training images of the initial distribution: {tried}."
        if not self.promising:
            return sentence
        count = equivalent(self.labelled, self.gain)
        most = max(g.photographs for g in self.labelled)
        equal = f"more than {most}" if count is None else f"about {max(1, round(count))}"
        return f"A first step is worth {equal} of them. {sentence}"

    def summary(self) -> str:
        """Return the printed summary."""
        lines = [
            self.verdict,
            self.worth,
            *(one.sentence for one in self.shown),
            f"{'object':<14}{'factor':<14}{'p':>9}{'step':>9}{'error':>9}  best bin",
        ]
        for f in self.foreseen:
            gains = [
                (gain, error, number)
                for number, (gain, error) in enumerate(zip(f.by_bin, f.by_bin_error, strict=True), 1)
                if gain is not None and error is not None
            ]
            best, error, number = max(gains, key=lambda one: one[0])
            gain = f"{number} ({best:+.4f} ± {error:.4f} for {f.moved:.0%} of its images)"
            lines.append(
                f"{f.name[:13]:<14}{f.factor[:13]:<14}{f.p_value:>9.2g}{f.step:>9.4f}{f.step_error:>9.4f}  {gain}"
            )
        for score in self.weak:
            lines.append(
                f"weak: {score.name} from bin {score.bin}, {self.score} {100 * score.last:.1f} on {score.images} images"
            )
        for m in self.differing:
            lines.append(f"differs: {m.name}, target {m.target:.3g}, synthesised {m.synthesised:.3g}")
        for advice in self.advice:
            lines.append(f"would reduce the difference: {advice}")
        return "\n".join(lines)

    @property
    def weak(self) -> list[BinScore]:
        """The bins where most could be gained."""
        return [weakness.score for weakness in weaknesses(self.bins, 3)]

    @property
    def differing(self) -> list[Mismatch]:
        """The statistics with a large and significant difference."""
        return [m for m in self.mismatches if m.counts]

    @property
    def advice(self) -> list[str]:
        """Settings that would reduce the differences."""
        lines = [f"'{key}={value}'" for key, value in self.settings.items()]
        if self.distance_factor is not None:
            keys = "unlearned.distance, or parameter=[zoom] to learn it"
            lines.append(f"camera distances times {self.distance_factor:.2f} ({keys})")
        return lines


def write_preflight_page(
    report: Preflight, target: LabelledImages, synthesised: LabelledImages, folder: Path, bins: Thumbnails
) -> Path:
    """Write preflight.html, with evenly spaced images of both sets side by side and the pictures ``bins``."""
    sides = {
        called: pictures.labelled(
            images, torch.linspace(0, len(images) - 1, min(SHOWN, len(images))).long().tolist(), report.names
        )
        for called, images in (
            ("The target's validation images", target),
            ("Synthesised images", synthesised),
        )
    }
    known = [abs(gain) for f in report.foreseen for gain in f.by_bin if gain is not None]
    largest = max(known, default=0.0) or 1.0
    thumbnails = {
        (name, factor): [picture(image) for image in images]
        for name, own in bins.items()
        for factor, images in own.items()
    }
    path = folder / FILE
    text = render.page(
        "preflight.html", title=f"{report.experiment}: preflight", report=report, sides=sides, largest=largest,
        columns=max(len(one.by_bin) for one in report.foreseen),
        shown=[(shown_chart(one), one) for one in report.shown],
        bins=by_object(report.bins), promising=report.promising, thumbnails=thumbnails,
    )  # fmt: skip
    return write_whole(path, text)
