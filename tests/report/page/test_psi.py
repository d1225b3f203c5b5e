"""The table of steps: what each record and the one after it say."""

from neural_sim.report.page.psi import step_rows


def record(actions, verdicts=None, doubts=()):
    certificate = {
        "actions": {name: {"pose": action} for name, action in actions.items()},
        "p_values": {name: {"pose": 0.01} for name in actions},
        "doubts": list(doubts),
    }
    return {"certificate": certificate, "verdicts": verdicts or {}}


def verdict(accepted):
    return {"accepted": accepted, "expected_gain": 0.1, "measured_gain": 0.12, "error": 0.02}


def test_a_step_is_judged_by_the_next_record():
    records = [
        record({"a": "kept", "b": "skipped"}),
        record({"a": "kept", "b": "kept"}, {"a": verdict(True)}),
        {"certificate": None, "verdicts": {"a": verdict(False), "b": verdict(True)}},
    ]
    first, second = step_rows(records, ["a", "b"])
    assert [cell.kind for cell in first.cells] == ["accepted", "rejected"]
    assert [cell.kind for cell in second.cells] == ["skipped", "accepted"]
    assert [cell.symbol for cell in first.cells] == ["✓", "✗"]
    assert first.cells[0].note == (
        "pose: p = 0.01; expected fall of the outer loss 0.100; measured rise of the object's score 0.120 ± 0.020"
    )


def test_free_steps_are_taken_without_a_verdict_and_doubts_are_named():
    records = [record({"a": "kept"}), record({"a": "waited"}), record({"a": "skipped"}, doubts=["solver"])]
    (row,) = step_rows(records, ["a"])
    assert [cell.kind for cell in row.cells] == ["taken", "waited", "skipped"]
    (forced,) = step_rows([record({"a": "taken"}, doubts=["residual"])], ["a"])
    assert forced.cells[0].kind == "taken" and "doubts: residual" in forced.cells[0].note
    assert "doubts: solver" in row.cells[2].note


def test_objects_that_are_not_learned_and_methods_without_a_derivative_have_no_steps():
    (row,) = step_rows([record({})], ["a"])
    assert [cell.kind for cell in row.cells] == ["none"]
    assert step_rows([{"certificate": None, "verdicts": {}}], ["a"]) == []
