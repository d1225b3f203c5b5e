"""The psi loop of methods with a derivative: train, differentiate, step, then train to accept or reject the step."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from neural_sim.detector.trajectory import Recording
from neural_sim.gradient.hypergradient import Hypergradient
from neural_sim.outer.certificate import Certificate, certify
from neural_sim.outer.first_step import FirstStep, read_objects, with_guesses
from neural_sim.outer.inner import InnerLoop, Trained
from neural_sim.outer.loop import OuterLoop
from neural_sim.outer.objective import Objective
from neural_sim.outer.records import Cost, Outcome
from neural_sim.outer.steps import LearnedObjects, PValues, Steps, Verdict
from neural_sim.outer.trust_region import TrustRegion, TrustRegionSteps
from neural_sim.outer.way import Way
from neural_sim.randomness import stream

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Derived:
    """The derivative of a training at psi, and the p-values of the derivatives that steps follow; see ``Steps``."""

    trained: Trained
    result: Hypergradient
    p_values: PValues


class GradientLoop(OuterLoop, ABC):
    """The loop of methods that follow a derivative; a subclass computes it in ``_derivative``.

    One Lightning training step is one outer iteration.

    With a trust region, an iteration begins by accepting or rejecting the last step, if any: it trains at the new psi
    with the random numbers of the training before that step. The last iteration does nothing else. Before the first
    derivative, the loop tries the psi that ``first`` proposes, if any. Objects with an estimate then stay where they
    are, unless it was rejected. The loop ends early if no object is left to move, or after
    ``outer.patience`` iterations without a step to try. At the end, with
    ``steps.take_back``, every object that was free to move returns to the best psi that it has had.
    """

    def __init__(
        self,
        inner: InnerLoop,
        psi: Float[Tensor, "objects K"],
        generator: torch.Generator,
        first: FirstStep | None = None,
    ) -> None:
        super().__init__(inner, psi, inner.settings.iterations, generator)
        self.first = first
        self.objects = learned_objects(inner)
        self._labels = list(self.objects.labels)
        steps = self.settings.steps
        self._judges = isinstance(steps, TrustRegion)
        self._takes_back = isinstance(steps, TrustRegion) and steps.take_back
        self._idle = 0
        self.numbers = replace(self.numbers, common=self._judges)
        start = self.psi[self._labels]
        self.steps: Steps = self.settings.steps.begin(self.objects, start, self.settings.iterations)
        self._recording: Recording | None = None
        self._before = psi.new_zeros(0, 0)
        self._way = Way.begin(self.objects.names, start)
        self._offered, self._settled = False, frozenset[str]()
        self._folds: list[Objective] = []
        self._before_folds = generator.get_state()
        self._stopped = False
        self._trained: Trained | None = None  # at psi, with the present random numbers, to be differentiated

    @override
    def training_step(self, batch: int, batch_idx: int) -> None:
        """Judge the last step, differentiate a training, and take the next step."""
        last = self._judges and len(self.records) + 1 == self.rounds
        trained, verdicts, certificate, result = None, {}, None, None
        if not self.records:
            self._offer()
        if last or self.steps.pending:
            trained, verdicts = self._judge()
            self.psi.data[self._labels] = self.steps.reported
        if not self.records:
            self._settle(verdicts)
        if self._stopped:
            trained = trained or self._trained_once()
        elif trained is None or not last:
            derived = self._derive()
            trained, result = derived.trained, derived.result
            certificate = self._step(derived)
            self._idle = self._idle + 1 if self._judges and not self.steps.pending else 0
            self._stopped = self._idle == self.settings.patience
        best = self._way.best() if self._takes_back and (last or self._stopped) else {}
        scores = trained.scores if result is None else self._before
        outcome = Outcome(verdicts, {name: back for name, (_, back) in best.items()})
        self.record(trained, scores.sum(1), outcome, certificate, result)
        self.psi.data[self._labels] = self.steps.reported
        for name, (stay, _) in best.items():
            self.psi.data[self.scene.names.index(name)] = stay.psi
        self.trajectory.append(self.psi.detach().clone())

    def _offer(self) -> None:
        """Move to the psi that the first step proposes, after a training at the initial psi for comparison.

        That training also shows which of the objects without an estimate the detector does not find.
        """
        steps = self.steps
        if self.first is None or not isinstance(steps, TrustRegionSteps):
            return
        with self.timed("first_step"):
            scene, images = self.inner.pool or self.scene, self.inner.objective.images
            numbers = stream(0, "common first step", self.numbers.generator)
            proposal = self.first.propose(scene, images, self.psi.detach().clone(), numbers)
            offered = steps.offer(proposal).pending
        self.charge(Cost(images=proposal.images))
        self.shown = proposal.shown
        for one in self.shown:
            _log.info("first step: %s", one.sentence)
        unread = set(self.objects.names) - read_objects(self.shown)
        if not offered and not steps.offer(with_guesses(proposal, unread, self.scene)).pending:
            return
        trained = self.train_on(self.psi, None if offered else self._recording)
        with self.timed("judge"):
            unseen = trained.unseen
        unfound = {name for name in unread if unseen[self.scene.names.index(name)]}
        proposal = with_guesses(proposal, unfound, self.scene)
        self.shown = proposal.shown
        for one in self.shown:
            if one.guessed:
                _log.info("first step: %s", one.sentence)
        tried = steps.offer(proposal)
        if not tried.pending:
            self._trained = trained
            return
        self._before, self._offered = trained.scores, True
        self._saw(self._before, self.objects.names)
        self.steps = tried
        self.psi.data[self._labels] = tried.reported

    def _settle(self, verdicts: Mapping[str, Verdict]) -> None:
        """Hold still the objects that have an estimate from the first step; if these are all objects, the loop ends.

        A rejected estimate does not count. The objects held do not return to an earlier psi at the end either: if the
        estimate moved them, a pair of trainings has already judged that, and the target's boxes are better evidence
        than scores that scatter between trainings.
        """
        steps, rejected = self.steps, {name for name, verdict in verdicts.items() if not verdict.accepted}
        settled = read_objects(self.shown) - rejected
        if settled and isinstance(steps, TrustRegionSteps):
            self._stopped = settled >= set(self.objects.names)
            self.steps = steps.held(settled)
            self._way, self._settled = self._way.settled(settled), frozenset(settled)

    def _trained_once(self) -> Trained:
        """Train at psi, to record its score."""
        trained = self._at_psi()
        self._saw(trained.scores, self.objects.names)
        return trained

    def _at_psi(self, recording: Recording | None = None) -> Trained:
        """Train at psi, unless that was done already."""
        trained, self._trained = self._trained or self.train_on(self.psi, recording), None
        return trained

    def _judge(self) -> tuple[Trained, dict[str, Verdict]]:
        """Train at psi, and accept or reject the step that led there."""
        trained, verdicts = self._at_psi(), {}
        with self.timed("judge"):
            scores = trained.scores
            if self.steps.pending:
                self.steps, verdicts = self.steps.judge(self._before, scores)
        for name, verdict in verdicts.items():
            if verdict.accepted:
                self._way = self._way.moved(name, self.psi[self.scene.names.index(name)].detach())
        rejected = [name for name, verdict in verdicts.items() if not verdict.accepted]
        self._saw(scores, [name for name in self.objects.names if name not in rejected])
        return trained, verdicts

    def _saw(self, scores: Float[Tensor, "classes images"], names: Iterable[str]) -> None:
        """Record the named objects' scores in a training at their present psi."""
        for name in names:
            self._way = self._way.seen(name, float(scores[self.scene.names.index(name)].sum()))

    def _derive(self) -> Derived:
        """Compute the derivative at psi, from one training, or from several in a trust region's first iteration."""
        first = not self.records
        for trial in range(self.settings.steps.trainings if first else 1):
            if trial or not first or self._offered:
                self.renew()  # so that the noise of single trainings averages out over the derivatives
            trained, result = self._differentiated()
            self.steps, p_values = self.steps.observe(result)
        return Derived(trained, result, p_values)

    def _differentiated(self) -> tuple[Trained, Hypergradient]:
        """Train at psi, and differentiate that training.

        A derivative that is compared with the response uses all validation images, as the response does.
        """
        with self.timed("probes"):
            self._prepare()
        if not self.records and not self.settings.train_first:
            # The warm start was trained at this psi, with more images and steps than an iteration.
            trained = self.charged(self.inner.untrained(self.psi, self.numbers, self.theta))
        else:
            trained = self._at_psi(self._recording)
        with self.timed("judge"):
            self._before = trained.scores
        self._saw(self._before, self.objects.names)
        objective = self.inner.objective if self._certifies else self._fold()
        with self.timed("hypergradient"):
            result = self._derivative(trained, objective)
        for phase, spent in result.seconds.items():
            name = f"hypergradient_{phase}"
            self._seconds[name] = self._seconds.get(name, 0.0) + spent
        self.charge(Cost(products=result.products))
        return trained, result

    def _step(self, derived: Derived) -> Certificate:
        """Certify the derivative, and take the steps of psi that the certificate allows."""
        cosine, trust = None, self.settings.trust
        with self.timed("certify"):
            if self._certifies:
                cosine = self._cosine(derived.result)
        certificate = certify(
            derived.result,
            derived.p_values,
            self.objects.names,
            self.scene.distribution.names,
            trust,
            self.settings.adjoint,
            cosine,
        )
        self.steps = self.steps.propose(certificate, trust.shrink)
        return certificate.waiting(self.steps.waiting).without(self._settled)

    @property
    def free(self) -> LearnedObjects:
        """The learned objects whose psi is not settled; derivatives are computed for them alone."""
        names = [name for name in self.objects.names if name not in self._settled]
        return replace(self.objects, names=names, labels=[self.scene.names.index(name) for name in names])

    @property
    def _certifies(self) -> bool:
        """Return whether this iteration compares its derivative with the response of training."""
        every = self.settings.certify_every
        return every > 0 and (len(self.records) + 1) % every == 0

    def _fold(self) -> Objective:
        """Take the next part of L_val, so that the scatter of derivatives includes the choice of validation images."""
        count = self.settings.steps.folds
        if count == 1:
            return self.inner.objective
        if not self._folds:
            self._before_folds = self.numbers.generator.get_state()
            self._folds = self.inner.objective.folds(count, self.numbers.generator)
        return self._folds.pop()

    def derivative(self) -> Hypergradient:
        """Compute the derivative at psi as an iteration does, from new images and a new training; psi does not move."""
        self._prepare()
        trained = self.inner.train(self.psi, self.numbers, self.theta, self._recording)
        self.theta = trained.theta
        return self._derivative(trained, self.inner.objective)

    @override
    def on_train_batch_start(self, batch: int, batch_idx: int) -> int | None:
        return -1 if self._stopped else None

    @property
    @override
    def ended(self) -> bool:
        return self._stopped or super().ended

    @override
    def state(self) -> dict[str, Any]:
        given = ("settings", "objects")
        return {
            **super().state(),
            "steps": {name: value for name, value in vars(self.steps).items() if name not in given},
            "before": self._before,
            "way": dict(self._way.stays),
            "offered": self._offered,
            "settled": sorted(self._settled),
            "folds": len(self._folds),
            "before_folds": self._before_folds,
            "stopped": self._stopped,
            "idle": self._idle,
        }

    @override
    def restore(self, state: Mapping[str, Any]) -> None:
        self._before_folds = state["before_folds"]
        if state["folds"]:  # folds are popped from the end: the first ones are left
            self.numbers.generator.set_state(self._before_folds)
            count = self.settings.steps.folds
            self._folds = self.inner.objective.folds(count, self.numbers.generator)[: state["folds"]]
        super().restore(state)
        self.steps = replace(self.steps, **state["steps"])  # pyright: ignore[reportArgumentType]
        self._before, self._way = state["before"], Way(state["way"])
        self._offered, self._settled = state["offered"], frozenset(state["settled"])
        self._stopped, self._idle = state["stopped"], state["idle"]

    def _prepare(self) -> None:
        """Draw what the derivative needs in addition to the training images."""

    @abstractmethod
    def _derivative(self, trained: Trained, objective: Objective) -> Hypergradient:
        """Compute the objective's derivative with respect to psi; it is zero for objects that are not ``free``."""

    def _cosine(self, result: Hypergradient) -> float | None:
        """Compute the cosine of the derivative with an independent reference; None if there is none."""
        return None


def learned_objects(inner: InnerLoop) -> LearnedObjects:
    """Choose the objects whose psi moves: those requested, otherwise all that validation images show.

    An object that none of them shows affects L_val only where it is mistaken for another, which says nothing about its
    best psi. A trust region leaves it out even if it is requested: it has no score by which a step could be accepted.

    Raises:
        ValueError: no validation image shows an object.
    """
    names, wanted = inner.scene.names, inner.settings.learned
    labels = [label for label, name in enumerate(names) if wanted is None or name in wanted]
    if wanted is None or isinstance(inner.settings.steps, TrustRegion):
        unseen = [names[label] for label in labels if label not in inner.shown]
        labels = [label for label in labels if label in inner.shown]
        if not labels:
            raise ValueError(
                "the target's validation images show none of the objects, so psi cannot be learned"
            )
        if unseen:
            _log.warning(
                "no validation image shows these objects, so their psi stays as it is: %s", ", ".join(unseen)
            )
    return LearnedObjects([names[label] for label in labels], labels, inner.scene.distribution)
