"""Entries: newer ones stand for those of the same place, others stay; tables have the columns of all."""

from neural_sim.report.entries import Entry, merged, table


def entry(*place, **cells):
    return Entry(place, {"object": str(place[1]), **cells})


OLD = [entry("zoom", "can", 2, NS="1", LTS="2", matched="3"), entry("pose", "drill", 2, NS="4")]


def test_newer_entries_stand_for_those_of_the_same_place_and_others_stay():
    new = [entry("zoom", "can", 2, NS="5"), entry("zoom", "can", 0, NS="6"), entry("pose", "can", 1, NS="7")]
    found = merged(OLD, new, ["pose", "zoom"])
    assert [e.place for e in found] == [
        ("pose", "can", 1),
        ("pose", "drill", 2),
        ("zoom", "can", 0),
        ("zoom", "can", 2),
    ]
    assert found[3] is new[0] and found[1] is OLD[1], "an entry is replaced whole, with its commits"
    assert merged(OLD, [], ["zoom"]) == (OLD[0],), "an experiment that the row does not have any longer"


def test_a_table_has_the_columns_of_all_entries_and_empty_cells():
    assert table([OLD[1], OLD[0], entry("zoom", "mug", 2, more="8")]).splitlines() == [
        "| object | NS | LTS | matched | more |",
        "|---|---|---|---|---|",
        "| drill | 4 |  |  |  |",
        "| can | 1 | 2 | 3 |  |",
        "| mug |  |  |  | 8 |",
    ]
