"""How far each psi step may be trusted: what its hypergradient was worth, what speaks against it, what was done.

An iteration makes one step for each object and each factor of psi. Doubts about the solve, or about the hypergradient
as a whole, are about all of them; whether a derivative can be told from zero is asked of each.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from neural_sim.gradient.hypergradient import Hypergradient
from neural_sim.outer.settings import OnUntrusted, Trust
from neural_sim.solver.solution import Status

Action = Literal["kept", "shrunk", "skipped", "stopped"]
_ACTIONS: Mapping[OnUntrusted, Action] = {
    "shrink": "shrunk", "keep": "kept", "skip": "skipped", "stop": "stopped"
}  # fmt: skip


Actions = dict[str, dict[str, Action]]
"""What became of the steps, by object and factor."""


@dataclass(frozen=True)
class Certificate:
    """What is known of one iteration's hypergradient.

    ``stationarity`` is ``|dL_train/dtheta|`` (nan where none was assumed) and ``validation_norm`` ``|dL_val/dtheta|``.
    ``curvature_min`` and ``curvature_max`` are the undamped operator's extreme Ritz values, ``condition`` that of the
    damped one (nan where no spectrum was estimated, inf where it is not positive definite). ``sensitivity`` is the
    hypergradient's relative change from lambda to 2 lambda (nan unless ``solver.sensitivity``). ``cosine`` is with what
    ``outer.certify`` measured, nan where it did not. ``doubts`` names what speaks against all steps. ``p_values``, by
    object and factor, are those of the null that a derivative is zero: this iteration's, or, where steps are checked,
    its average with those of earlier iterations, which steps follow. ``actions`` has the objects whose psi moves; a
    step without doubt and with a significant derivative is kept.
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
        return any(action == "stopped" for held in self.actions.values() for action in held.values())

    @property
    def void(self) -> bool:
        """Whether nothing of this iteration is followed, not even later through the momentum."""
        done = {action for held in self.actions.values() for action in held.values()}
        return self.stopped or (bool(self.doubts) and not done & {"shrunk", "kept"})


def certify(
    result: Hypergradient,
    p_values: Mapping[str, Mapping[str, float]],
    names: Sequence[str],
    factors: Sequence[str],
    cosine: float,
    trust: Trust,
    on_untrusted: OnUntrusted,
) -> Certificate:
    """Judge an iteration's hypergradient; ``names`` are the objects whose psi moves, ``factors`` those of psi, and
    ``p_values`` those of the derivatives that steps follow.

    No step follows a gradient that is not finite. A step is without signal where its p-value is above ``trust.level``;
    where nothing was tested, nothing speaks against it.
    """
    finite = all(bool(gradient.isfinite().all()) for gradient in result.psi_gradients.values())
    found = _doubts(result, cosine, trust) + ([] if finite else ["not finite"])
    if found:
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
        doubts=found,
        p_values={name: dict(found) for name, found in p_values.items()},
        actions=actions,
    )


def _by_signal(
    p_values: Mapping[str, Mapping[str, float]],
    names: Sequence[str],
    factors: Sequence[str],
    level: float | None,
    on_untrusted: OnUntrusted,
) -> Actions:
    """Steps kept where there is signal. An object at its optimum has none, and is no reason to stop the others:
    ``stop`` skips its step, and ends the loop where no step is left."""
    otherwise: Action = "skipped" if on_untrusted == "stop" else _ACTIONS[on_untrusted]
    limit = math.inf if level is None else level
    actions: Actions = {
        name: {f: "kept" if p_values.get(name, {}).get(f, 0.0) <= limit else otherwise for f in factors}
        for name in names
    }
    if on_untrusted == "stop" and not any("kept" in held.values() for held in actions.values()):
        return {name: dict.fromkeys(factors, "stopped") for name in names}
    return actions


def _doubts(result: Hypergradient, cosine: float, trust: Trust) -> list[str]:
    """Names of the demands on all steps that the hypergradient fails; a number that does not exist fails none."""
    solution = result.solution
    # An approximation that was never iterated (solver=identity) was asked for knowing its residual.
    residual = 0.0 if solution.status is Status.APPROXIMATE else solution.residual
    failed = {
        "solver": solution.status in (Status.NEGATIVE_CURVATURE, Status.NON_FINITE, Status.DIVERGED),
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
    done = Counter(action for held in c.actions.values() for action in held.values())
    parts = [
        f"psi {iteration}/{iterations} val {validation_loss:.4f}",
        f"|dval| {c.validation_norm:.2g}",
        *_adjoint(c),
        *([] if math.isnan(c.sensitivity) else [f"2 lambda {c.sensitivity:.0%}"]),
        *(f"p {factor} {'/'.join(f'{p:.2g}' for p in found)}" for factor, found in tested.items()),
        *([] if math.isnan(c.cosine) else [f"cos {c.cosine:.2f}"]),
        ", ".join(f"{action} {count}" for action, count in done.items())
        + (f" ({', '.join(c.doubts)})" if c.doubts else ""),
    ]
    return "; ".join(parts)


def _adjoint(c: Certificate) -> list[str]:
    """How the derivative was taken, for the log: a solve has a residual and a spectrum, other ways have none."""
    taken = f"{c.solver_status} {c.solver_steps} steps"
    if math.isnan(c.stationarity):
        return [taken]
    return [
        f"|dtrain| {c.stationarity:.2g}",
        f"{taken} res {c.solver_residual:.1g}",
        f"H [{c.curvature_min:.2g}, {c.curvature_max:.3g}] lambda {c.damping:.2g} cond {c.condition:.3g}",
    ]


def untrusted(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """How many of the recorded steps, one for each object and factor of an iteration, were not trusted, what was done,
    and why: doubts about all, or no signal. How many steps the next training judged, and how many it undid. And every
    cosine that was measured."""
    held = [record["certificate"] for record in records if record["certificate"]]
    actions = [
        (action, certificate["doubts"] or ["signal"])
        for certificate in held
        for by_factor in certificate["actions"].values()
        for action in by_factor.values()
    ]
    doubted = [(action, doubts) for action, doubts in actions if action != "kept"]
    verdicts = [verdict["accepted"] for record in records for verdict in record["verdicts"].values()]
    return {
        "steps": len(actions),
        "untrusted": len(doubted),
        "actions": dict(Counter(action for action, _ in doubted)),
        "doubts": dict(Counter(doubt for _, doubts in doubted for doubt in doubts)),
        "judged": len(verdicts),
        "undone": verdicts.count(False),
        "cosines": [c["cosine"] for c in held if not math.isnan(c["cosine"])],
    }
