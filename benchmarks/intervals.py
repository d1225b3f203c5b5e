"""How often 95 % intervals of a mean over few seeds contain the truth: Student's with the images' part added (ours),
Student's alone, and the bootstrap over seeds and test images. Scores are normal, with the standard deviations of
docs/results.md, The same training again.

    python benchmarks/intervals.py
"""

from __future__ import annotations

import argparse

import numpy as np

from neural_sim.report.intervals import Estimate, over_images, over_seeds, over_seeds_and_images


def bootstrapped(values: np.ndarray, over: float, draws: int, random: np.random.Generator) -> Estimate:
    """Seeds resampled, and the images of each anew."""
    chosen = values[random.integers(len(values), size=(draws, len(values)))]
    return over_images(float(values.mean()), (chosen + random.normal(0.0, over, chosen.shape)).mean(1))


def main() -> None:
    """A table in Markdown on the standard output."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--between", type=float, default=1.6, help="standard deviation between trainings")
    parser.add_argument("--over-images", type=float, default=0.9, help="standard error over test images")
    parser.add_argument("--runs", type=int, default=4000)
    parser.add_argument("--draws", type=int, default=300)
    asked = parser.parse_args()
    print(
        "| seeds | test images | ours | width | Student alone | width | bootstrap | width |",
        "|---" * 8 + "|",
        sep="\n",
    )
    for shared in (False, True):
        for seeds in (2, 3, 5):
            cells = row(asked.between, asked.over_images, seeds, shared, asked.runs, asked.draws)
            print(
                f"| {seeds} | {'the same' if shared else 'their own'} | " + " | ".join(cells) + " |",
                flush=True,
            )


def row(between: float, over: float, seeds: int, shared: bool, runs: int, draws: int) -> list[str]:
    """Coverage and mean width of each interval."""
    random, found = np.random.default_rng(seeds), []
    for _ in range(runs):
        images = random.normal(0.0, over, 1 if shared else seeds)
        values = random.normal(0.0, between, seeds) + images
        resampled = values + random.normal(0.0, over, (draws, 1 if shared else seeds))
        estimates = (
            over_seeds_and_images(values, resampled),
            over_seeds(values),
            bootstrapped(values, over, draws, random),
        )
        found.append(
            [((e.low or 0.0) <= 0.0 <= (e.high or 0.0), (e.high or 0.0) - (e.low or 0.0)) for e in estimates]
        )
    mean = np.asarray(found, dtype=float).mean(0)
    return [cell for covered, width in mean for cell in (f"{covered:.0%}", f"{width:.1f}")]


if __name__ == "__main__":
    main()
