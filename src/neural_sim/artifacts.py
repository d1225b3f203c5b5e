"""What the stages of a run make, each made or found in the store when it is first asked for."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from neural_sim import codec, versions
from neural_sim.baseline.base import Fixed, HypergradientLoop
from neural_sim.cold import train_cold
from neural_sim.detector.metrics import evaluate
from neural_sim.detector.retinanet import Detector, Parameters
from neural_sim.devices import device_of, placed
from neural_sim.experiment import Account, Experiment
from neural_sim.field.base import RadianceField
from neural_sim.field.training import field_from_state, field_state
from neural_sim.methods import outer_loop
from neural_sim.objects.mesh import ObjectMesh
from neural_sim.outer.loop import learn_psi
from neural_sim.outer.records import Cost, IterationRecord
from neural_sim.renderer.views import choose_mesh_renderer
from neural_sim.store import Store, code_version, digest, tensor_digest
from neural_sim.synthesis.scene import RenderedObject, Scene
from neural_sim.target.symmetry import equivalent_bins
from neural_sim.types import LabelledImages


class Artifacts:
    """Results of the stages. A result whose stage was not asked for must be in the store.

    ``on_record`` is called with the record of each iteration of the psi loop when it has ended; never where the loop's
    result is in the store.
    """

    def __init__(
        self, experiment: Experiment, on_record: Callable[[IterationRecord], object] | None = None
    ) -> None:
        self.x, self._on_record = experiment, on_record
        self.store = Store(experiment.store)
        self.account = Account()
        self._held: dict[str, Any] = {}  # by kind and key, so that a result is read once
        self.names: list[str] = experiment.objects.names()
        self.device = device_of(experiment.accelerator)
        unknown = set(experiment.distribution.biased) - set(self.names)
        unknown |= set(experiment.outer.learned or ()) - set(self.names)
        if unknown:
            raise ValueError(f"biased or outer.learned names {sorted(unknown)}, objects are {self.names}")

    @cached_property
    def digests(self) -> dict[str, str]:
        return self.x.objects.digests()

    @cached_property
    def meshes(self) -> dict[str, ObjectMesh]:
        return {item.name: item for item in self.x.objects.load()}

    @cached_property
    def mesh_renderer(self) -> Any:
        return choose_mesh_renderer(self.x.views.backend, self.x.views.supersample)

    def _config(self, *groups: str) -> dict[str, Any]:
        """Groups as configured, with the digests of the files they read where they read any."""
        files = {group: found for group, found in self.files.items() if group in groups}
        return {group: self.x.config[group] for group in groups} | ({"files": files} if files else {})

    @cached_property
    def files(self) -> dict[str, str]:
        """Digests of the photographs and annotations that groups read, by group."""
        sources = {"synthesis": self.x.synthesis.background, "target": self.x.target}
        return {group: held.digest() for group, held in sources.items() if hasattr(held, "digest")}

    def _fetch(
        self, stage: str, kind: str, what: str, key: dict[str, Any], make: Callable[[], Any], keep: bool = True
    ) -> Any:  # fmt: skip
        """A result from the store, or made now if its stage is among those asked for; kept in memory unless told."""

        def make_if_asked() -> Any:
            if stage not in self.x.stages:
                raise ValueError(
                    f"stages: {what} is not in {self.x.store}; run stage {stage} too (got {list(self.x.stages)})"
                )
            return make()

        name = f"{kind} {digest(key)}"
        if name in self._held:
            return self._held[name]
        entry = self.store.fetch(kind, key, make_if_asked)
        self.account.note(stage, entry, what)
        if keep:
            self._held[name] = entry.value
        return entry.value

    # --- views and fields: per object, shared by all runs ---

    def _views_key(self, name: str) -> dict[str, Any]:
        version = code_version(*versions.VIEWS)
        return {"object": self.digests[name], **self._config("views"), "code": version}

    def views(self, name: str) -> Any:
        def make() -> Any:
            return codec.pack_views(self.x.views.render(self.mesh_renderer, self.meshes[name]))

        key = self._views_key(name)
        return self._fetch("views", "views", f"views of {name}", key, make, keep=False)  # large, read once

    def _field_key(self, name: str) -> dict[str, Any]:
        version = code_version(*versions.FIELDS)
        return {"views": self._views_key(name), **self._config("field"), "code": version}

    def field(self, name: str) -> dict[str, Any]:
        """State and history of one object's radiance field."""

        def make() -> Any:
            views = codec.unpack_views(self.views(name))
            fitted, history = self.x.field.fit(views, self.x.views.held_out, self.device)
            return {"field": field_state(fitted), "history": history}

        key = self._field_key(name)
        return self._fetch("field", "field", f"field of {name}", key, make)

    @cached_property
    def scene(self) -> Scene:
        fields: tuple[RadianceField, ...] = tuple(
            field_from_state(self.field(name)["field"]).to(self.device) for name in self.names
        )
        camera = self.x.views.camera(self.x.training.image_size)
        return Scene(
            tuple(self.names), fields, self.x.renderer, camera, self.x.synthesis, self.x.distribution
        )

    # --- distributions and sets ---

    def psi(self, which: str) -> Tensor:
        """Configured logits of all objects: ``initial`` or ``target``."""
        return self.x.distribution.psi(which, self.names)

    def _scene_key(self) -> dict[str, Any]:
        parts, drawn = self._config("renderer", "synthesis", "training"), self.x.distribution
        parts |= {"factors": [factor.drawn for factor in drawn.factors], "ranges": dict(drawn.ranges)}
        fields = [self._field_key(n) for n in self.names]
        return {"fields": fields, "names": self.names, **parts, "code": code_version(*versions.DETECTORS)}

    def _targets_key(self) -> dict[str, Any]:
        return {
            "objects": self.digests, "names": self.names, "seed": self.x.seed,
            **self._config("target", "parameter", "unlearned", "synthesis", "views"),
            "size": self.x.training.image_size,
            "code": code_version(*versions.TARGETS),
        }  # fmt: skip

    @cached_property
    def targets(self) -> dict[str, LabelledImages]:
        """The labelled target set, split into ``val`` (steers psi) and ``test`` (scored once)."""
        camera = self.x.views.camera(self.x.training.image_size)

        def make() -> Any:
            drawn = self.x.distribution, camera, self.x.synthesis, self.x.seed, self.x.views.rig
            made = self.x.target.sets(self.meshes, self.mesh_renderer, *drawn)
            return {name: codec.pack_images(images) for name, images in made.items()}

        entry = self.store.fetch("target", self._targets_key(), make)
        return {name: codec.unpack_images(held) for name, held in entry.value.items()}

    @cached_property
    def symmetric_bins(self) -> dict[str, dict[str, list[list[int]]]]:
        """By object and angle: groups of bins, numbered from 1, that the object's symmetry makes the same."""
        angles = [f.name for f in self.x.distribution.binned if f.coordinate in ("phi", "rho")]
        return {name: {angle: self._equivalent(name, angle) for angle in angles} for name in self.names}

    def _equivalent(self, name: str, angle: str) -> list[list[int]]:
        key = {
            "object": self.digests[name], "factor": angle, **self._config("parameter", "unlearned", "views"),
            "code": code_version(*versions.MESHES_DRAWN, "target", *versions.DISTRIBUTIONS),
        }  # fmt: skip

        def make() -> list[list[int]]:
            camera = self.x.views.camera(48)
            return equivalent_bins(self.meshes[name], self.mesh_renderer, self.x.distribution, angle, camera)

        return [[b + 1 for b in group] for group in self.store.fetch("symmetry", key, make).value]

    # --- detectors ---

    @cached_property
    def detector(self) -> Detector:
        return self.x.detector(num_classes=len(self.names), image_size=self.x.training.image_size)

    def _generator(self, purpose: int) -> torch.Generator:
        return torch.Generator().manual_seed(1_000_003 * (self.x.seed + 1) + purpose)

    def _trained_key(self, psi: Tensor) -> dict[str, Any]:
        """Of what is drawn from psi: by its probabilities, whatever floor or relaxation the method has besides."""
        p = self.x.distribution.probabilities(psi.detach().cpu().double())
        drawn = tensor_digest([(p[name] * 1e12).round() + 0.0 for name in self.x.distribution.names])
        return {"scene": self._scene_key(), **self._config("detector"), "p": drawn, "seed": self.x.seed}

    def warm_start(self) -> Parameters:
        """The detector that the psi loop goes on from; with equal epochs it is also the one scored as ``ns``."""
        return placed(self._warm_start()["params"], self.device)

    def _warm_start(self) -> dict[str, Any]:
        return self._detector(self.psi("initial"), self.x.training.warm_epochs, "warm_start", "warm start")

    def _detector(self, psi: Tensor, epochs: int, stage: str, what: str) -> dict[str, Any]:
        """A detector trained from scratch (``params``), with the same seed whatever the method, and its ``cost``."""
        key = {**self._trained_key(psi), "epochs": epochs, "cold": code_version("cold")}

        def make() -> dict[str, Any]:
            held = self.scene, self.detector, self.x.training, psi, epochs, self._generator(1), self.device
            return train_cold(*held)

        return self._fetch(stage, "detector", what, key, make)

    def learned(self) -> dict[str, Any]:
        """psi before and after every iteration of the method (``trajectory``), the iterations' records, and what was
        spent before the first of them (``before``): the warm start, which every loop's backbone comes from."""
        method = self.x.baseline
        if isinstance(method, Fixed):
            return {
                "trajectory": self.psi(method.which)[None],
                "records": [],
                "before": dataclasses.asdict(Cost()),
            }

        def make() -> Any:
            loop = outer_loop(
                self.x, self.scene, self.detector, self.warm_start(), self.psi("initial"), self.targets["val"],
                self._generator(2),
            )  # fmt: skip
            found = learn_psi(loop, self.x.progress, self._on_record)
            records = [dataclasses.asdict(record) for record in found.records]
            return {
                "trajectory": found.trajectory, "records": records, "before": self._warm_start()["cost"]
            }  # fmt: skip

        groups = ["outer", "parameter"]
        groups += ["gradient", "solver"] if isinstance(method, HypergradientLoop) else ["baseline"]
        key = {
            "warm_start": self._trained_key(self.psi("initial")), "target": self._targets_key(),
            **self._config(*groups),
            "code": code_version(*versions.LOOPS),
        }  # fmt: skip
        return self._fetch("psi", "psi", "psi loop", key, make)

    @property
    def learned_psi(self) -> Tensor:
        """What the method reports."""
        return self.learned()["trajectory"][-1]

    def training_images(self, psi: Tensor) -> list[RenderedObject]:
        """The images that the scored detector trained on, drawn again from the same seed; on the CPU."""
        drawn = self.scene.training_set(psi, self.x.training.images_per_object, self._generator(1))
        return [dataclasses.replace(part, images=part.images.to("cpu")) for part in drawn]

    def scores(self, psi: Tensor, what: str, part: str = "test") -> dict[str, Any]:
        """AP on one part of the target set of a detector trained cold on images from ``psi``, and its detections."""

        def make() -> Any:
            what_trained = f"detector trained on {what}"
            trained = self._detector(psi, self.x.training.cold_epochs, "evaluate", what_trained)
            images = self.targets[part]
            detections = self.detector.predict(placed(trained["params"], self.device), images.images)
            return {"ap": evaluate(detections, images, self.names), "detections": detections}

        trained, epochs = self._trained_key(psi), self.x.training.cold_epochs
        key = {"trained": trained, "epochs": epochs, "part": part, "target": self._targets_key()}
        what_scored = f"{part} scores of the detector trained on {what}"
        return self._fetch("evaluate", "evaluate", what_scored, key, make)

    def validation_ap(self) -> float:
        """AP on ``val`` of the detector trained cold on the learned distribution: what settings are chosen by. ``val``
        has steered psi too, so it is no estimate of AP elsewhere; nothing of ``test`` is in it."""
        return self.scores(self.learned_psi, "learned", "val")["ap"]["ap"]

    def compared(self) -> dict[str, Tensor]:
        """The distributions whose detectors are compared: initial (NS), learned, and the target's own (matched)."""
        return {"ns": self.psi("initial"), "learned": self.learned_psi, "matched": self.psi("target")}

    def scored_iterations(self) -> dict[int, Tensor]:
        """psi by iterations done: at the start, after the parts of all iterations in ``score_at``, at the end."""
        trajectory = self.learned()["trajectory"]
        last = len(trajectory) - 1
        asked = sorted({0, last, *(math.floor(part * last + 0.5) for part in self.x.score_at)})
        return {i: trajectory[i] for i in asked}

    def on_the_way(self) -> dict[str, Tensor]:
        """What :meth:`scored_iterations` adds to :meth:`compared`, by a name for the log."""
        return {f"psi after {i} iterations": psi for i, psi in self.scored_iterations().items()}
