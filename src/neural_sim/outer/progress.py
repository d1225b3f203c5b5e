"""The line that each iteration of the loop prints: what happened, in words, and the time left."""

from __future__ import annotations

from collections.abc import Sequence

from neural_sim.outer.certificate import Certificate
from neural_sim.outer.records import IterationRecord

_STEPS = ("kept", "taken", "shrunk")


def iteration_line(
    records: Sequence[IterationRecord], iterations: int, seconds: float, left: float | None
) -> str:
    """Describe the last iteration in one line: L_val, the verdict on the last steps, what moves next, and the time.

    Args:
        records: all records so far.
        iterations: number of iterations of the whole loop.
        seconds: duration of the iteration.
        left: estimated seconds for the remaining iterations; None: the loop ends with this one.
    """
    last = records[-1]
    start = f" ({records[0].validation_loss:.3f} at the start)" if len(records) > 1 else ""
    parts = [f"psi {len(records)}/{iterations}: validation loss {last.validation_loss:.3f}{start}"]
    for word, accepted in (("accepted", True), ("rejected", False)):
        if names := [name for name, verdict in last.verdicts.items() if verdict.accepted == accepted]:
            parts.append(f"{word} {', '.join(names)}")
    if last.certificate is not None:
        parts.extend(_next_steps(last.certificate))
    parts.extend(
        f"{name} goes back to its best psi ({back.kept} of {back.accepted} accepted steps kept)"
        for name, back in last.taken_back.items()
    )
    time = duration(seconds)
    if left is not None:
        time += f", about {duration(left)} left"
    elif len(records) < iterations:
        doubted = last.certificate is not None and last.certificate.doubts
        why = "the derivative is not trusted" if doubted else "no step is left to try"
        time += f"; the loop ends here, because {why}"
    return "; ".join([*parts, time])


def _next_steps(certificate: Certificate) -> list[str]:
    """Name the objects that move now and those that wait, and count those without a significant derivative."""
    actions = {name: set(by_factor.values()) for name, by_factor in certificate.actions.items()}
    moving = [name for name, taken in actions.items() if taken & set(_STEPS)]
    tries = [f"tries {', '.join(moving)}"] if moving else []
    if certificate.doubts:
        return [f"derivative not trusted: {', '.join(certificate.doubts)}", *tries]
    waiting = [name for name, taken in actions.items() if "waited" in taken and name not in moving]
    still = len(actions) - len(moving) - len(waiting)
    return [
        *tries,
        *([f"waiting: {', '.join(waiting)}"] if waiting else []),
        *([f"no signal: {still}"] if still else []),
    ]


def duration(seconds: float) -> str:
    """Format a duration: 24 s, 3 min, 2 h 5 min."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 100:
        return f"{minutes} min"
    return f"{minutes // 60} h" + (f" {minutes % 60} min" if minutes % 60 else "")
