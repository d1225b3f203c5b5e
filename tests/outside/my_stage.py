"""A stage from outside the package, the brightness of an object's views, and a task that pulls and writes it."""

import json
from dataclasses import dataclass
from typing import ClassVar

from neural_sim.stages.stage import Stage
from neural_sim.stages.views import ViewsStage
from neural_sim.tasks.context import Task


@dataclass(frozen=True)
class BrightnessStage(Stage[float]):
    phase: ClassVar[str] = "views"
    kind: ClassVar[str] = "brightness"

    views: ViewsStage
    above: float

    @property
    def title(self):
        return f"brightness of {self.views.object}"

    def make(self, results):
        images = results(self.views).images
        return float((images[..., :3].mean(-1) > self.above).float().mean())


@dataclass(frozen=True)
class Brightness(Task):
    above: float = 0.5

    def __post_init__(self):
        if not 0.0 <= self.above <= 1.0:
            raise ValueError(f"brightness.above must lie in [0, 1], got {self.above}")

    def reads(self, context):
        return [BrightnessStage(views, self.above) for views in context.graph.views]

    def run(self, context):
        found = {stage.views.object: context.results(stage) for stage in self.reads(context)}
        (context.folder / "brightness.json").write_text(json.dumps(found))
