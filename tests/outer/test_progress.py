"""The line that an iteration tells: its parts come from the record, and only those that there are."""

from dataclasses import replace

import pytest

from neural_sim.outer.certificate import Certificate
from neural_sim.outer.progress import duration, iteration_line
from neural_sim.outer.records import IterationRecord
from neural_sim.outer.steps import Verdict
from neural_sim.outer.way import TakenBack


def record(loss, **more):
    empty = {key: {} for key in ("probabilities", "entropies", "seconds", "verdicts", "taken_back")}
    lists = {key: [] for key in ("gradient_norms", "gradient_errors", "scores")}
    numbers = dict.fromkeys(("images", "detector_steps", "products", "images_without_box"), 0)
    plain = IterationRecord(
        **empty,
        **lists,
        **numbers,
        validation_loss=loss,
        training_loss=0.1,
        certificate=None,
        cpu_seconds=1.0,
    )
    return replace(plain, **more)


def certificate(doubts=(), **actions):
    by_factor = {name: dict(zip(("pose", "zoom"), both, strict=False)) for name, both in actions.items()}
    return Certificate(None, None, list(doubts), {}, by_factor)


def verdicts(**accepted):
    return {name: Verdict(own, 0.1, 0.1, 0.01) for name, own in accepted.items()}


def test_a_step_is_told_in_words():
    first = record(0.6164)
    steps = certificate(
        can=("skipped", "kept"), mug=("shrunk",), drill=("waited", "skipped"), box=("skipped",)
    )
    second = record(0.5330, verdicts=verdicts(pitcher=True, drill=True, mug=False), certificate=steps)
    assert iteration_line([first, second], 10, 24.4, 190.0) == (
        "psi 2/10: validation loss 0.533 (0.616 at the start); accepted pitcher, drill; rejected mug; tries can, mug; "
        "waiting: drill; no signal: 1; 24 s, about 3 min left"
    )


def test_the_last_one_says_what_goes_back_and_no_time_that_is_left():
    last = record(0.5, taken_back={"mug": TakenBack(kept=1, accepted=3, gain=0.1)})
    told = iteration_line([record(0.6), last], 2, 100.0, None)
    assert told.endswith("mug goes back to its best psi (1 of 3 accepted steps kept); 2 min")


def test_a_loop_that_ends_early_says_why():
    told = iteration_line([record(0.6), record(0.5)], 9, 24.0, None)
    assert told.endswith("; 24 s; the loop ends here, because no step is left to try")
    doubted = record(0.5, certificate=certificate(["residual"], mug=("stopped",)))
    told = iteration_line([record(0.6), doubted], 9, 24.0, None)
    assert told.endswith(
        "; derivative not trusted: residual; 24 s; the loop ends here, because the derivative is not trusted"
    )


def test_a_round_without_a_derivative_and_a_derivative_that_is_not_trusted():
    assert iteration_line([record(0.5)], 3, 2.0, 4.0) == "psi 1/3: validation loss 0.500; 2 s, about 4 s left"
    doubted = record(0.5, certificate=certificate(["residual"], mug=("skipped",)))
    assert "; derivative not trusted: residual; 2 s" in iteration_line([doubted], 3, 2.0, 4.0)
    kept = record(0.5, certificate=certificate(["residual"], mug=("taken",), can=("shrunk",)))
    assert "; derivative not trusted: residual; tries mug, can; 2 s" in iteration_line([kept], 3, 2.0, 4.0)


@pytest.mark.parametrize(
    ("seconds", "said"),
    [(0.4, "0 s"), (99.4, "99 s"), (99.6, "2 min"), (5940, "99 min"), (6000, "1 h 40 min"), (7200, "2 h")],
)
def test_durations(seconds, said):
    assert duration(seconds) == said
