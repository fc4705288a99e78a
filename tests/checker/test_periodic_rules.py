"""Periodic rules: witnesses, false witnesses, and runs."""

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from flint import arb, fmpq

from noack.core.balls import matrix, number
from noack.proof.elaborate.errors import RejectedError
from noack.proof.elaborate.hybrid_system import Edge, Model
from noack.proof.elaborate.loop import Loop, Times
from noack.proof.statement_proof import prove_statement
from tests.checker.changes import DOCUMENTS, accepted
from tests.checker.changes import LOOPS as OTHER_LOOPS
from tests.checker.completed import completed
from tests.checker.loops import PERIODIC, SCHEDULE, periodic
from tests.checker.proofs import Proved, proved
from tests.checker.runs import exceeded

EXACT, SHORT = PERIODIC["exact"], PERIODIC["short"]


@pytest.fixture(scope="module", params=PERIODIC)
def found(request: pytest.FixtureRequest) -> Proved:
    return proved(f"periodic_{request.param}")


def test_runs_stay_below_the_bounds(found: Proved) -> None:
    loop, witness = found.loop, found
    rng = np.random.default_rng(1)
    for _ in range(3):
        assert exceeded(loop, witness.proof, rng, 6.0) == []


def test_runs_come_near_the_bounds(found: Proved) -> None:
    loop, witness = found.loop, found
    rng = np.random.default_rng(1)
    shares = {"x": 0.9, "e_c": 0.15}
    bounds = tuple(
        b._replace(decaying=b.decaying * number(shares[b.output]))
        for b in witness.proof.bounds
        if b.output in shares
    )
    smaller = witness.proof._replace(bounds=bounds)
    assert {each.output for _ in range(4) for each in exceeded(loop, smaller, rng, 6.0)} == {"x", "e_c"}


def test_updates_may_be_on_their_way_for_more_than_a_period() -> None:
    document = proved("periodic_short").document
    assert document["later"] == 1
    with pytest.raises(RejectedError, match="later"):
        prove_statement(SHORT, {**document, "later": 0})


CHANGES: dict[str, Callable[[Loop], Loop]] = {
    "period x 2": lambda loop: loop._replace(
        times=loop.times._replace(least_period=2 * loop.times.least_period, period=2 * loop.times.period)
    ),
    "period 5 % longer": lambda loop: loop._replace(
        times=loop.times._replace(period=loop.times.period * fmpq(21, 20))
    ),
    "one loss more": lambda loop: loop._replace(losses=loop.losses + 1),
    "longer delays": lambda loop: loop._replace(times=loop.times._replace(delay=fmpq(1, 4))),
    "later start": lambda loop: loop._replace(times=loop.times._replace(start=fmpq(1, 4))),
    "larger start": lambda loop: loop._replace(start=loop.start * number(1.01)),
    "another plant": lambda loop: loop._replace(B=loop.B * number(1.05)),
    "a disturbance": lambda loop: loop._replace(pushes=matrix([[0.0], [1.0]]), sizes=(arb(0.01),)),
}
REASONS = {
    "period x 2": "at motion/0 lost/",
    "period 5 % longer": "at motion/0 lost/",
    "one loss more": "at edge/[12] lost, lost/",
    "longer delays": "at motion/0 lost/|^more events than 1 may happen in '0 later'",
    "later start": "at motion/0 lost/|^more events than 0 may happen in 'start, 0 later'",
    "larger start": "at start$",
    "another plant": "at motion/0 lost/",
    "a disturbance": "at motion/0 lost/",
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_witness_proves_nothing_about_another_loop(found: Proved, change: str) -> None:
    loop, witness = found.loop, found
    other = CHANGES[change](loop)
    later = witness.document["later"] if other.times.least_period < other.times.delay else 0
    with pytest.raises(RejectedError, match=REASONS[change]):
        prove_statement(other, completed(other, {**witness.document, "later": later}))


@pytest.mark.parametrize(
    ("pieces", "reason"),
    [
        *((pieces, "at motion/0 lost/") for pieces in (1, 2, 3)),
        *((pieces, "unknown matrix, or not one of this size") for pieces in (5, 8)),
        (0, "^pieces: below 1"),
        *((pieces, "^pieces: not a whole number") for pieces in (-1, 65, True, 4.0, "4", None)),
    ],
)
def test_another_number_of_nodes_is_rejected(found: Proved, pieces: object, reason: str) -> None:
    loop, witness = found.loop, found
    if loop is SHORT and pieces in (1, 2, 3) and pieces is not True:
        pytest.skip("its edges begin and end at the same nodes as with 4")
    with pytest.raises(RejectedError, match=reason):
        prove_statement(loop, {**witness.document, "pieces": pieces})


def test_the_sensors_error_and_its_assumed_size_are_rejected(found: Proved) -> None:
    """In the model x_s is not reset by an update that is lost: its error is not that of the sensor."""
    loop, witness = found.loop, found
    document: Any = copy.deepcopy(witness.document)
    document["bounds"][0]["output"] = "e_s"
    with pytest.raises(RejectedError, match="e_s"):
        prove_statement(loop, document)
    with pytest.raises(RejectedError, match="errors: not with a periodic rule"):
        prove_statement(loop, {**witness.document, "errors": {"decaying": 1.0, "constant": 0.0}})


def test_a_form_at_another_node_is_rejected(found: Proved) -> None:
    """As if an event came at another time."""
    loop, witness = found.loop, found
    document: Any = copy.deepcopy(witness.document)
    forms = document["bounds"][0]["matrices"]
    last = max(int(name.rpartition(" ")[2]) for name in forms if name.startswith("P/0 lost"))
    forms[f"P/0 lost, {last}"] = forms[f"P/0 lost, {last - 1}"]
    with pytest.raises(RejectedError, match=r"at motion/0 lost/"):
        prove_statement(loop, document)


# The model.


def times_of(model: Model, part: str) -> list[list[tuple[float, float]]]:
    """Return the times of both clocks at the edges with some name."""
    return [_times(model, edge) for edge in model.edges if part in edge.name]


def _times(model: Model, edge: Edge) -> list[tuple[float, float]]:
    source, target = model.locations[edge.source].nodes, model.locations[edge.target].nodes
    return [(round(float(source[i]), 9), round(float(target[k]), 9)) for i, k in edge.pairs]


@pytest.mark.parametrize("pieces", [1, 2, 7, 64])
def test_events_come_at_the_period_and_inputs_before_their_delay(pieces: int) -> None:
    model = Model(periodic(fmpq(29, 100), fmpq(3, 10)), arb(0), arb(1), pieces=pieces)
    for name in ("lost, sent", "lost, lost"):
        for times in times_of(model, name):
            assert {begin for begin, _ in times} >= {0.29, 0.3}
            assert all(begin >= 0.29 and end == 0 for begin, end in times)
    for times in times_of(model, "all lost"):
        assert {begin for begin, _ in times} >= {0, 0.02}
        assert all(begin == end <= 0.02 for begin, end in times)


def test_nodes_are_close_only_where_an_edge_begins_or_ends() -> None:
    least = fmpq(299_999_999, 10**9)
    model = Model(periodic(least, fmpq(3, 10)), arb(0), arb(1), pieces=4)
    nodes = [float(node) for node in model.locations[0].nodes]
    assert np.diff(nodes).min() > 1e-3
    assert nodes[-1] == pytest.approx(0.3, rel=1e-15)
    # an event at the least period is one from the node before it on
    assert {begin for begin, _ in times_of(model, "0 lost, sent")[0]} == {round(t, 9) for t in nodes[-2:]}


def test_a_later_event_shortens_the_time_that_an_update_has_left() -> None:
    loop = SHORT._replace(times=SHORT.times._replace(start=fmpq(1, 50)))
    model = Model(loop, arb(0), arb(1), later=1, later_at_start=1, pieces=4)
    ends = {place.name: float(place.nodes[-1]) for place in model.locations}
    assert ends["0 later"] == ends["start, 0 later"] == ends["0 lost"] == pytest.approx(0.02)
    assert ends["1 later"] == ends["start, 1 later"] == pytest.approx(0.005)
    assert all(begin >= 0.015 for begin, _ in times_of(model, "0 later, event")[0])


# Wrong loops.

WRONG = {
    "a period of 0 at least": Times(*SCHEDULE[:5], fmpq(0), fmpq(1)),
    "least and largest exchanged": Times(*SCHEDULE[:5], fmpq(2), fmpq(1)),
    "events between tests": Times(*SCHEDULE[:5], fmpq(1, 1000), fmpq(1)),
    "a negative period": Times(*SCHEDULE[:5], fmpq(-2), fmpq(-1)),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_periods_are_rejected(name: str) -> None:
    document = {"rate": 0.0, "bounds": []}
    with pytest.raises(RejectedError, match=r"^loop: times: "):
        prove_statement(EXACT._replace(times=WRONG[name]), document)


def test_ideal_conditions_have_a_witness() -> None:
    proof = proved("periodic_ideal").proof
    (bound,) = proof.bounds
    assert 1.0 <= float(bound.decaying.mid()) < 1.5
    assert proof.rate > 0


@pytest.mark.deep
@pytest.mark.parametrize("name", PERIODIC)
@pytest.mark.parametrize("change", [*DOCUMENTS, *OTHER_LOOPS])
def test_what_is_accepted_of_changed_witnesses_is_true(name: str, change: str) -> None:
    """Random runs stay within what was accepted."""
    loop, document = PERIODIC[name], proved(f"periodic_{name}").document
    for seed in range(3):
        rng, other = np.random.default_rng(seed), copy.deepcopy(document)
        changed = OTHER_LOOPS[change](loop, rng) if change in OTHER_LOOPS else loop
        if change in DOCUMENTS:
            DOCUMENTS[change](other, rng)
        if (proof := accepted(changed, other)) is None:
            continue
        for _ in range(3):
            assert exceeded(changed, proof, rng, 6.0) == []
