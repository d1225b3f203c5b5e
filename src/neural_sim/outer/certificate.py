"""Quality of each iteration's hypergradient, the conditions that it fails, and what happens to the steps.

An iteration makes one step for each object and each factor of psi. The solve and the hypergradient as a whole concern
all of them; whether a derivative differs significantly from zero is tested for each.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from neural_sim.gradient.hypergradient import Hypergradient
from neural_sim.outer.settings import OnUntrusted, Trust
from neural_sim.solver.base import Status

Action = Literal["kept", "shrunk", "waited", "skipped", "stopped"]
_ACTIONS: Mapping[OnUntrusted, Action] = {
    "shrink": "shrunk", "keep": "kept", "skip": "skipped", "stop": "stopped"
}  # fmt: skip


Actions = dict[str, dict[str, Action]]
"""What happens to the steps, by object and factor. A trusted step waits where a checked loop does not take it yet."""


@dataclass(frozen=True)
class Certificate:
    """Quality of one iteration's hypergradient.

    ``stationarity`` is ``|dL_train/dtheta|`` (nan where none was assumed) and ``validation_norm`` ``|dL_val/dtheta|``.
    ``curvature_min`` and ``curvature_max`` are the undamped operator's extreme Ritz values, ``condition`` the damped
    operator's condition number (nan without an estimated spectrum, inf where it is not positive definite).
    ``sensitivity`` is the hypergradient's relative change from lambda to 2 lambda (nan unless ``solver.sensitivity``).
    ``cosine`` is with the response of training, nan where that was not measured. ``doubts`` names the
    conditions on the whole hypergradient that fail. ``p_values``, by object and factor, are those of the null that a
    derivative is zero: this iteration's, or, for checked steps, of the average over iterations that steps follow.
    ``actions`` has the learned objects; a step is kept if no condition fails and its derivative is significant. What
    waited is recorded by :meth:`waiting`.
    """

    stationarity: float
    validation_norm: float
    solver_status: str
    solver_steps: int
    solver_residual: float
    damping: float
    damping_raises: int
    curvature_min: float
    curvature_max: float
    condition: float
    sensitivity: float
    cosine: float
    doubts: list[str]
    p_values: dict[str, dict[str, float]]
    actions: Actions

    @property
    def stopped(self) -> bool:
        """Whether the loop ends here."""
        return "stopped" in self._taken

    @property
    def void(self) -> bool:
        """Whether this iteration's derivative is discarded, also from the momentum."""
        return self.stopped or (bool(self.doubts) and not self._taken & {"shrunk", "kept"})

    def waiting(self, steps: Collection[tuple[str, str]]) -> Certificate:
        """This certificate with the trusted ones among ``steps``, of an object and a factor, as waited."""
        actions: Actions = {
            name: {
                factor: "waited" if action == "kept" and (name, factor) in steps else action
                for factor, action in by_factor.items()
            }
            for name, by_factor in self.actions.items()
        }
        return replace(self, actions=actions)

    @property
    def _taken(self) -> set[Action]:
        return {action for by_factor in self.actions.values() for action in by_factor.values()}


def certify(
    result: Hypergradient,
    p_values: Mapping[str, Mapping[str, float]],
    names: Sequence[str],
    factors: Sequence[str],
    cosine: float,
    trust: Trust,
    on_untrusted: OnUntrusted,
) -> Certificate:
    """The certificate of an iteration's hypergradient.

    No step follows a gradient that is not finite. A derivative is insignificant where its p-value is above
    ``trust.level``; one that was not tested counts as significant.

    Args:
        result: the hypergradient.
        p_values: of the derivatives that steps follow, by object and factor.
        names, factors: the learned objects and the factors of psi.
        cosine: with the response of training, nan if not measured.
        trust, on_untrusted: the conditions, and what happens where they fail.
    """
    finite = all(bool(gradient.isfinite().all()) for gradient in result.psi_gradients.values())
    doubts = _doubts(result, cosine, trust) + ([] if finite else ["not finite"])
    if doubts:
        action = _ACTIONS[on_untrusted]
        if not finite and action in ("shrunk", "kept"):
            action = "skipped"
        actions: Actions = {name: dict.fromkeys(factors, action) for name in names}
    else:
        actions = _by_signal(p_values, names, factors, trust.level, on_untrusted)
    spectrum, solution = result.damping.spectrum, result.solution
    return Certificate(
        stationarity=result.stationarity,
        validation_norm=result.validation_norm,
        solver_status=solution.status.name,
        solver_steps=solution.steps,
        solver_residual=solution.residual,
        damping=result.damping.value,
        damping_raises=result.damping_raises,
        curvature_min=spectrum.smallest if spectrum else math.nan,
        curvature_max=spectrum.largest if spectrum else math.nan,
        condition=result.damping.condition,
        sensitivity=result.sensitivity,
        cosine=cosine,
        doubts=doubts,
        p_values={name: dict(by_factor) for name, by_factor in p_values.items()},
        actions=actions,
    )


def _by_signal(
    p_values: Mapping[str, Mapping[str, float]],
    names: Sequence[str],
    factors: Sequence[str],
    level: float | None,
    on_untrusted: OnUntrusted,
) -> Actions:
    """Keep the steps of significant derivatives. An object at its optimum has none, and is no reason to stop the
    others: ``stop`` skips its step, and ends the loop where no step is left.
    """
    otherwise: Action = "skipped" if on_untrusted == "stop" else _ACTIONS[on_untrusted]
    limit = math.inf if level is None else level
    actions: Actions = {
        name: {f: "kept" if p_values.get(name, {}).get(f, 0.0) <= limit else otherwise for f in factors}
        for name in names
    }
    if on_untrusted == "stop" and not any("kept" in by_factor.values() for by_factor in actions.values()):
        return {name: dict.fromkeys(factors, "stopped") for name in names}
    return actions


def _doubts(result: Hypergradient, cosine: float, trust: Trust) -> list[str]:
    """Names of the conditions that the whole hypergradient fails; nan fails none."""
    solution = result.solution
    # solver=identity never iterates: whoever chooses it accepts its residual.
    residual = 0.0 if solution.status is Status.APPROXIMATE else solution.residual
    failed = {
        "solver": solution.status in (Status.NEGATIVE_CURVATURE, Status.NON_FINITE),
        "residual": _above(residual, trust.max_residual),
        "stationarity": _above(result.stationarity, trust.max_stationarity),
        "sensitivity": _above(result.sensitivity, trust.max_sensitivity),
        "cosine": _above(-cosine, None if trust.min_cosine is None else -trust.min_cosine),
    }
    return [name for name, holds in failed.items() if holds]


def _above(value: float, limit: float | None) -> bool:
    return limit is not None and value > limit


def line(certificate: Certificate, iteration: int, iterations: int, validation_loss: float) -> str:
    """One line for the log, p-values by factor, object by object."""
    c = certificate
    tested = {factor: [p[factor] for p in c.p_values.values()] for p in c.p_values.values() for factor in p}
    actions = Counter(action for by_factor in c.actions.values() for action in by_factor.values())
    parts = [
        f"psi {iteration}/{iterations} val {validation_loss:.4f}",
        f"|dval| {c.validation_norm:.2g}",
        *_adjoint(c),
        *([] if math.isnan(c.sensitivity) else [f"2 lambda {c.sensitivity:.0%}"]),
        *(f"p {factor} {'/'.join(f'{p:.2g}' for p in values)}" for factor, values in tested.items()),
        *([] if math.isnan(c.cosine) else [f"cos {c.cosine:.2f}"]),
        ", ".join(f"{action} {count}" for action, count in actions.items())
        + (f" ({', '.join(c.doubts)})" if c.doubts else ""),
    ]
    return "; ".join(parts)


def _adjoint(c: Certificate) -> list[str]:
    """The adjoint, for the log; only a solve has a residual and a spectrum."""
    method = f"{c.solver_status} {c.solver_steps} steps"
    if math.isnan(c.stationarity):
        return [method]
    return [
        f"|dtrain| {c.stationarity:.2g}",
        f"{method} res {c.solver_residual:.1g}",
        f"H [{c.curvature_min:.2g}, {c.curvature_max:.3g}] lambda {c.damping:.2g} cond {c.condition:.3g}",
    ]


def untrusted(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Counts over recorded iterations: steps (one for each object and factor), trusted ones that waited, untrusted
    ones, what happened to these and why (failed conditions, or ``signal``: no significance), objects' steps that were
    judged, and those that were rejected; and every measured cosine.
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
        "cosines": [c["cosine"] for c in certificates if not math.isnan(c["cosine"])],
    }
