"""Compare methods that learn from rewards on a simulated reward: ``python benchmarks/reward_methods.py``.

As in pose_gap, two of six objects start at another bin than their target's. The score of an object is concave in the
probabilities of its target's bins, and trainings scatter as they do at scale=quick. The table shows the gain in mean
score after a number of trainings, and the remaining total variation of the two objects from their target.
"""

from __future__ import annotations

import argparse

import torch

from neural_sim.baseline.lts import LearningToSimulate
from neural_sim.documents import markdown_table
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution

SCATTER = 0.026
"""Standard deviation of the mean score of six objects between trainings on the same distribution."""
METHODS = {
    "lts": LearningToSimulate(),
    "lts, baseline=leave_one_out": LearningToSimulate(baseline="leave_one_out"),
    "lts, rewarded=object": LearningToSimulate(rewarded="object"),
    "lts_by_object": LearningToSimulate(rewarded="object", baseline="leave_one_out"),
}


def gained(method: LearningToSimulate, trainings: int, seed: int) -> tuple[float, float]:
    """Run a method; return its gain in mean score, and the distance of the biased objects from their target."""
    factor = Pose(bins=8, floor=0.005).factors[0]
    scene = SceneDistribution((factor,), {})
    start, target = (torch.full((6, 8), 0.125, dtype=torch.float64) for _ in range(2))
    for p, bins in ((start, (6, 2)), (target, (2, 6))):
        for row, bin_ in enumerate(bins):
            p[row] = 0.02
            p[row, bin_] = 0.86

    def scores(psi: torch.Tensor) -> torch.Tensor:
        p = factor.p_of(psi)
        return 1.1 * (target * p / (p + 0.1)).sum(1)

    psi = factor.psi_of(start)
    search = method.begin(scene, psi, torch.Generator().manual_seed(seed))
    noise = torch.Generator().manual_seed(10_000 + seed)
    for _ in range(trainings):
        own = scores(search.ask())
        own = own + SCATTER * 6**0.5 * torch.randn(6, generator=noise, dtype=torch.float64)
        search.tell(float(own.mean()), own)
    distance = 0.5 * (factor.p_of(search.psi) - target).abs().sum(1)[:2].mean()
    return float((scores(search.psi) - scores(psi)).mean()), float(distance)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=16)
    parser.add_argument("--trainings", type=int, nargs="+", default=[20, 60, 200])
    arguments = parser.parse_args()
    rows = []
    for name, method in METHODS.items():
        cells = [name]
        for trainings in arguments.trainings:
            found = torch.tensor([gained(method, trainings, seed) for seed in range(arguments.seeds)])
            (score, distance), error = found.mean(0).tolist(), float(found[:, 0].std()) / len(found) ** 0.5
            cells.append(f"{score:.3f} ± {error:.3f} ({distance:.2f})")
        rows.append(cells)
    print(markdown_table(["", *(f"{count} trainings" for count in arguments.trainings)], rows))


if __name__ == "__main__":
    main()
