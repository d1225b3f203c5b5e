"""The certificate of an iteration's hypergradient: its quality, the conditions that it fails, and what steps follow.

An iteration has one step for each object and each factor of psi. Conditions on the solve, and on the hypergradient as a
whole, concern all steps; whether the derivative differs significantly from zero is tested for each step.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt, Le, Lt

from neural_sim.gradient.hypergradient import Hypergradient, ImplicitAdjoint, UnrolledAdjoint
from neural_sim.gradient.implicit import Implicit
from neural_sim.gradient.significance import SMALLEST
from neural_sim.gradient.unrolled import Unrolled
from neural_sim.ranges import validated

OnUntrusted = Literal["shrink", "keep", "skip"]
Action = Literal["kept", "waited", "taken", "shrunk", "skipped"]
"""The fate of a step: trusted ones are ``kept``, or ``waited``; the other words are for steps that are not trusted."""
_ACTIONS: Mapping[OnUntrusted, Action] = {"shrink": "shrunk", "keep": "taken", "skip": "skipped"}
Actions = dict[str, dict[str, Action]]
"""The action on each step, by object and factor. A trusted step ``waited`` if the trust region does not take it yet."""


@validated
@dataclass(frozen=True)
class Trust:
    """``outer.trust``: when a step of psi is trusted, and what happens to one that is not.

    The adjoint's own conditions are settings of ``outer.adjoint``.

    Args:
        level: significance level of the test whether an object's derivative with respect to a factor is zero (free
            steps: see ``gradient.significance``; trust region: ``outer.evidence``); None: not tested.
        min_cosine: smallest cosine of the hypergradient with the finite-difference response of training (needs
            ``outer.certify_every``); None: no limit.
        on_untrusted: what happens to steps that fail: those of one object and factor if the derivative is not
            significant, all steps if the whole hypergradient fails. ``keep`` takes them in full, as the paper does.
        shrink: fraction of an untrusted step that is taken under ``on_untrusted=shrink``.
    """

    level: Annotated[float, Ge(SMALLEST), Lt(1)] | None = 0.1
    min_cosine: Annotated[float, Ge(-1), Le(1)] | None = 0.0
    on_untrusted: OnUntrusted = "skip"
    shrink: Annotated[float, Gt(0), Lt(1)] = 0.25


@dataclass(frozen=True)
class ImplicitQuality:
    """The recorded numbers of an ``ImplicitAdjoint``; None for those that were not measured.

    Three numbers come from an estimated spectrum: ``curvature_min`` and ``curvature_max`` are the undamped operator's
    extreme Ritz values, ``condition`` is the damped operator's condition number (inf if it is not positive definite).
    """

    stationarity: float
    validation_norm: float
    solver_status: str
    solver_steps: int
    solver_residual: float
    damping: float
    damping_raises: int
    curvature_min: float | None
    curvature_max: float | None
    condition: float | None

    @staticmethod
    def of(adjoint: ImplicitAdjoint) -> ImplicitQuality:
        """Summarise a solve."""
        solution, damping = adjoint.solution, adjoint.damping
        return ImplicitQuality(
            stationarity=adjoint.stationarity,
            validation_norm=adjoint.validation_norm,
            solver_status=solution.status.name,
            solver_steps=solution.steps,
            solver_residual=solution.residual,
            damping=damping.value,
            damping_raises=adjoint.damping_raises,
            curvature_min=damping.spectrum.smallest if damping.spectrum else None,
            curvature_max=damping.spectrum.largest if damping.spectrum else None,
            condition=damping.condition if damping.spectrum else None,
        )

    def parts(self) -> list[str]:
        """Describe the solve for the log."""
        spectrum = ""
        if self.curvature_min is not None:
            spectrum = f"H [{self.curvature_min:.2g}, {self.curvature_max:.3g}] "
        condition = "" if self.condition is None else f" cond {self.condition:.3g}"
        return [
            f"|dval| {self.validation_norm:.2g}",
            f"|dtrain| {self.stationarity:.2g}",
            f"{self.solver_status} {self.solver_steps} steps res {self.solver_residual:.1g}",
            f"{spectrum}lambda {self.damping:.2g}{condition}",
        ]


@dataclass(frozen=True)
class UnrolledQuality:
    """The recorded numbers of an ``UnrolledAdjoint``."""

    validation_norm: float
    reversed_steps: int

    def parts(self) -> list[str]:
        """Describe the reversed training for the log."""
        return [f"|dval| {self.validation_norm:.2g}", f"reversed {self.reversed_steps} steps"]


Quality = ImplicitQuality | UnrolledQuality


@dataclass(frozen=True)
class Certificate:
    """Quality of one iteration's hypergradient.

    Attributes:
        adjoint: quality of the adjoint; None if the derivative comes from comparing trainings.
        cosine: cosine with the finite-difference response of training; None if that was not measured.
        doubts: names of the failed conditions on the whole hypergradient.
        p_values: p-values, by object and factor, of the null hypothesis that the derivative is zero. They test this
            iteration's derivative or, for trust-region steps, the average over iterations that the steps follow.
            Like ``actions``, they leave out objects whose psi is settled.
        actions: what happens to steps. A step is ``kept`` if no condition fails and its derivative is significant;
            ``waiting`` then marks the kept steps that wait. A step that is not trusted is ``taken`` in full under
            ``on_untrusted=keep``.
    """

    adjoint: Quality | None
    cosine: float | None
    doubts: list[str]
    p_values: dict[str, dict[str, float]]
    actions: Actions

    @property
    def void(self) -> bool:
        """Return whether this iteration's derivative is discarded; it then does not enter the momentum either."""
        found = {action for by_factor in self.actions.values() for action in by_factor.values()}
        return bool(self.doubts) and not found & {"shrunk", "taken"}

    def waiting(self, steps: Collection[tuple[str, str]]) -> Certificate:
        """Mark as waiting those kept steps that are among ``steps`` (pairs of object and factor)."""
        actions: Actions = {
            name: {
                factor: "waited" if action == "kept" and (name, factor) in steps else action
                for factor, action in by_factor.items()
            }
            for name, by_factor in self.actions.items()
        }
        return replace(self, actions=actions)

    def without(self, names: Collection[str]) -> Certificate:
        """Leave out the named objects, whose psi is settled."""
        actions, p_values = (
            {name: each for name, each in by_name.items() if name not in names}
            for by_name in (self.actions, self.p_values)
        )
        return replace(self, actions=actions, p_values=p_values)


def certify(
    result: Hypergradient,
    p_values: Mapping[str, Mapping[str, float]],
    names: Sequence[str],
    factors: Sequence[str],
    trust: Trust,
    adjoint: Unrolled | Implicit,
    cosine: float | None = None,
) -> Certificate:
    """Certify an iteration's hypergradient.

    No step follows a gradient that is not finite. A derivative is insignificant if its p-value is above
    ``trust.level``; one that was not tested counts as significant.

    Args:
        result: the hypergradient.
        p_values: p-values of the derivatives that steps follow, by object and factor.
        names: the learned objects.
        factors: the factors of psi.
        trust: the conditions, and what happens if they fail.
        adjoint: the adjoint's own conditions.
        cosine: cosine with the finite-difference response of training; None if not measured.
    """
    finite = all(bool(gradient.isfinite().all()) for gradient in result.gradients.values())
    doubts = _adjoint_doubts(result, adjoint)
    if cosine is not None and trust.min_cosine is not None and cosine < trust.min_cosine:
        doubts.append("cosine")
    if not finite:
        doubts.append("not finite")
    if doubts:
        action = _ACTIONS[trust.on_untrusted]
        if not finite and action in ("shrunk", "taken"):
            action = "skipped"
        actions: Actions = {name: dict.fromkeys(factors, action) for name in names}
    else:
        actions = _by_signal(p_values, names, factors, trust)
    return Certificate(
        adjoint=_quality(result),
        cosine=cosine,
        doubts=doubts,
        p_values={name: dict(by_factor) for name, by_factor in p_values.items()},
        actions=actions,
    )


def _adjoint_doubts(result: Hypergradient, settings: Unrolled | Implicit) -> list[str]:
    adjoint = result.adjoint
    if isinstance(adjoint, ImplicitAdjoint) and isinstance(settings, Implicit):
        return settings.doubts(adjoint)
    if isinstance(adjoint, UnrolledAdjoint) and isinstance(settings, Unrolled):
        return settings.doubts(adjoint)
    return []


def _quality(result: Hypergradient) -> Quality | None:
    adjoint = result.adjoint
    if isinstance(adjoint, ImplicitAdjoint):
        return ImplicitQuality.of(adjoint)
    return None if adjoint is None else UnrolledQuality(adjoint.validation_norm, adjoint.steps)


def _by_signal(
    p_values: Mapping[str, Mapping[str, float]], names: Sequence[str], factors: Sequence[str], trust: Trust
) -> Actions:
    """Keep the steps whose derivative is significant."""
    otherwise = _ACTIONS[trust.on_untrusted]
    limit = math.inf if trust.level is None else trust.level
    return {
        name: {f: "kept" if p_values.get(name, {}).get(f, 0.0) <= limit else otherwise for f in factors}
        for name in names
    }


def line(certificate: Certificate, iteration: int, iterations: int, validation_loss: float) -> str:
    """Describe an iteration in one line for the log, with p-values by factor and, within it, by object."""
    c = certificate
    tested = {factor: [p[factor] for p in c.p_values.values()] for p in c.p_values.values() for factor in p}
    actions = Counter(action for by_factor in c.actions.values() for action in by_factor.values())
    parts = [
        f"psi {iteration}/{iterations} val {validation_loss:.4f}",
        *([] if c.adjoint is None else c.adjoint.parts()),
        *(f"p {factor} {'/'.join(f'{p:.2g}' for p in values)}" for factor, values in tested.items()),
        *([] if c.cosine is None else [f"cos {c.cosine:.2f}"]),
        ", ".join(f"{action} {count}" for action, count in actions.items())
        + (f" ({', '.join(c.doubts)})" if c.doubts else ""),
    ]
    return "; ".join(parts)


def untrusted(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Count what happened to the steps of recorded iterations.

    ``steps`` counts all steps, one for each certified iteration, object and factor; ``waited`` counts the trusted ones
    that waited, ``untrusted`` those that were not trusted. ``actions`` counts what happened to the latter, ``doubts``
    why they were not trusted: the failed conditions, or ``signal`` for a derivative that is not significant. ``judged``
    counts objects' steps that a training accepted or rejected, ``rejected`` only the rejected ones. ``taken_back`` has
    the ``TakenBack`` of each object that the loop returned to an earlier psi. ``cosines`` lists every measured cosine.
    """
    certificates = [record["certificate"] for record in records if record["certificate"]]
    actions = [
        (action, certificate["doubts"] or ["signal"])
        for certificate in certificates
        for by_factor in certificate["actions"].values()
        for action in by_factor.values()
    ]
    doubted = [(action, doubts) for action, doubts in actions if action not in ("kept", "waited")]
    accepted = [verdict["accepted"] for record in records for verdict in record["verdicts"].values()]
    return {
        "steps": len(actions),
        "waited": sum(action == "waited" for action, _ in actions),
        "untrusted": len(doubted),
        "actions": dict(Counter(action for action, _ in doubted)),
        "doubts": dict(Counter(doubt for _, doubts in doubted for doubt in doubts)),
        "judged": len(accepted),
        "rejected": accepted.count(False),
        "taken_back": {name: back for record in records for name, back in record["taken_back"].items()},
        "cosines": [c["cosine"] for c in certificates if c["cosine"] is not None],
    }
