"""The table of what the checker has proven."""

from flint import arb

from cosim.analysis.witnesses import WitnessedStatement, Witnesses
from cosim.output.witness_report import witness_table
from noack_check.proof import Bound, Proof
from noack_check.sentences import sentences


def proof() -> Proof:
    in_the_limit = [Bound("x", arb(3), arb(1), False), Bound("x[1]", arb(3), arb(0.5), False)]
    return Proof(arb(1), (Bound("x", arb(3), arb(2), True), *in_the_limit), arb(0.25), arb(0.25), True)


def test_the_table_has_bounds_from_the_start_on_and_in_the_limit() -> None:
    whole = proof()
    short = whole._replace(bounds=whole.bounds[:1], inter_event=None, first_event=None)
    statements = [
        WitnessedStatement("own", "schedule", {}, whole),
        WitnessedStatement("own", "ideal", {}, short),
        WitnessedStatement("box", "ideal", None, None, "none was found"),
    ]
    table = witness_table(Witnesses({"name": "loop"}, statements))
    assert table is not None
    rows = {row[0]: row[1:] for row in table.rows}
    assert rows["bound of ‖x‖"] == ["3.0", "3.0"]
    assert rows["+ without decay"] == ["2.0", "2.0"]
    assert rows["bound of ‖x‖ in the limit"] == ["1.0", "-"]
    assert rows["bound of |x_2| in the limit"] == ["0.5", "-"]
    assert rows["inter-event time, s"] == ["0.25", "-"]


def test_states_are_counted_from_1_as_in_all_of_noack() -> None:
    assert "|x_2| ≤ 0.5 in the limit" in list(sentences(proof()))
