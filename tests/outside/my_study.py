"""A study from outside the package: how far the initial distribution of every object is from the target's."""

from dataclasses import dataclass

from matplotlib.figure import Figure

from neural_sim.documents import markdown_table
from neural_sim.parameter.distributions import total_variation
from neural_sim.tasks.context import Task


@dataclass(frozen=True)
class Distances(Task):
    factor: str = "pose"

    def reads(self, context):
        known = context.experiment.imaging.distribution.names
        if self.factor not in known:
            raise ValueError(f"distances.factor: want one of {list(known)}, got {self.factor}")
        return ()

    def run(self, context):
        graph, distribution = context.graph, context.experiment.imaging.distribution
        start, target = (distribution.probabilities(graph.psi(w))[self.factor] for w in ("initial", "target"))
        found = {name: float(total_variation(start[i], target[i])) for i, name in enumerate(graph.names)}
        figure = Figure(figsize=(4, 3))
        figure.add_subplot().bar(list(found), list(found.values()))
        text = markdown_table(["object", "total variation"], [(k, f"{v:.2f}") for k, v in found.items()])
        context.publish("distances", found, text, {"distances": figure}, found)
