"""How far each psi step may be trusted: what its hypergradient was worth, what speaks against it, what was done."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from neural_sim.gradient.hypergradient import Hypergradient
from neural_sim.outer.retrained import Check
from neural_sim.settings import OnUntrusted, Trust
from neural_sim.solver.solution import Status

Action = Literal["kept", "shrunk", "skipped", "stopped"]
_ACTIONS: Mapping[OnUntrusted, Action] = {
    "shrink": "shrunk", "keep": "kept", "skip": "skipped", "stop": "stopped"
}  # fmt: skip


@dataclass(frozen=True)
class Certificate:
    """What is known of one step's hypergradient.

    ``stationarity`` is ``|dL_train/dtheta|`` and ``validation_norm`` ``|dL_val/dtheta|``. ``curvature_min`` and
    ``curvature_max`` are the undamped operator's extreme Ritz values, ``condition`` that of the damped one (nan
    where no spectrum was estimated, inf where it is not positive definite). ``sensitivity`` is the hypergradient's
    relative change from lambda to 2 lambda (nan unless ``solver.sensitivity``). ``signal_to_noise`` has one number
    for each psi component, object by object. ``cosine`` is with a retrained finite difference, nan where none was
    made. ``doubts`` names what failed; none means trusted.
    """

    stationarity: float
    validation_norm: float
    solver_status: str
    solver_steps: int
    solver_residual: float
    damping: float
    raises: int
    curvature_min: float
    curvature_max: float
    condition: float
    sensitivity: float
    signal_to_noise: list[list[float]]
    cosine: float
    doubts: list[str]
    action: Action


def certify(
    result: Hypergradient, names: Sequence[str], check: Check | None, trust: Trust, on_untrusted: OnUntrusted
) -> Certificate:
    """Judge a step's hypergradient; ``names`` orders the objects. No step follows a gradient that is not finite."""
    finite = all(bool(gradient.isfinite().all()) for gradient in result.psi_gradients.values())
    found = _doubts(result, check, trust) + ([] if finite else ["not finite"])
    action: Action = "kept" if not found else _ACTIONS[on_untrusted]
    if not finite and action in ("shrunk", "kept"):
        action = "skipped"
    spectrum, solution = result.damping.spectrum, result.solution
    return Certificate(
        stationarity=result.stationarity,
        validation_norm=result.validation_norm,
        solver_status=solution.status.name,
        solver_steps=solution.steps,
        solver_residual=solution.residual,
        damping=result.damping.value,
        raises=result.raises,
        curvature_min=spectrum.smallest if spectrum else math.nan,
        curvature_max=spectrum.largest if spectrum else math.nan,
        condition=result.damping.condition,
        sensitivity=result.sensitivity,
        signal_to_noise=[result.signal_to_noise[name].tolist() for name in names],
        cosine=check.cosine if check else math.nan,
        doubts=found,
        action=action,
    )


def _doubts(result: Hypergradient, check: Check | None, trust: Trust) -> list[str]:
    """Names of the demands that the hypergradient fails; a number that does not exist fails none."""
    solution = result.solution
    # An approximation that was never iterated (solver=identity) was asked for knowing its residual.
    residual = 0.0 if solution.status is Status.APPROXIMATE else solution.residual
    signal = max((float(snr.max()) for snr in result.signal_to_noise.values()), default=math.inf)
    cosine = check.cosine if check else math.nan
    failed = {
        "solver": solution.status in (Status.NEGATIVE_CURVATURE, Status.NON_FINITE, Status.DIVERGED),
        "residual": _above(residual, trust.max_residual),
        "stationarity": _above(result.stationarity, trust.max_stationarity),
        "sensitivity": _above(result.sensitivity, trust.max_sensitivity),
        "signal": _above(-signal, None if trust.min_signal_to_noise is None else -trust.min_signal_to_noise),
        "cosine": _above(-cosine, None if trust.min_cosine is None else -trust.min_cosine),
    }
    return [name for name, holds in failed.items() if holds]


def _above(value: float, limit: float | None) -> bool:
    return limit is not None and value > limit


def line(certificate: Certificate, iteration: int, iterations: int, validation_loss: float) -> str:
    """One line for the log. Signal-to-noise: the best component of each object."""
    c = certificate
    best = "/".join(f"{max(row):.1f}" for row in c.signal_to_noise)
    parts = [
        f"psi {iteration}/{iterations} val {validation_loss:.4f}",
        f"|dtrain| {c.stationarity:.2g} |dval| {c.validation_norm:.2g}",
        f"{c.solver_status} {c.solver_steps} steps res {c.solver_residual:.1g}",
        f"H [{c.curvature_min:.2g}, {c.curvature_max:.3g}] lambda {c.damping:.2g} cond {c.condition:.3g}",
        *([] if math.isnan(c.sensitivity) else [f"2 lambda {c.sensitivity:.0%}"]),
        f"snr {best}",
        *([] if math.isnan(c.cosine) else [f"cos {c.cosine:.2f}"]),
        c.action if not c.doubts else f"{c.action} ({', '.join(c.doubts)})",
    ]
    return "; ".join(parts)


def untrusted(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """How many of the recorded steps were not trusted, why, what was done, and every cosine that was measured."""
    held = [record["certificate"] for record in records if record["certificate"]]
    doubted = [certificate for certificate in held if certificate["doubts"]]
    return {
        "steps": len(held),
        "untrusted": len(doubted),
        "actions": dict(Counter(certificate["action"] for certificate in doubted)),
        "doubts": dict(Counter(doubt for certificate in doubted for doubt in certificate["doubts"])),
        "cosines": [c["cosine"] for c in held if not math.isnan(c["cosine"])],
    }
