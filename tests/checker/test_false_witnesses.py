"""Documents that prove something false, or loops that are none: each violates one condition of the proof.

Eight conditions are easily left out. Tests here and in :mod:`tests.checker.test_gains` violate each alone:

1. While updates are on their way more of them are missing than are lost in a row:
   `test_later_events_are_those_that_tests_allow`.
2. The errors that a proof assumes are those that it proves: `tests.checker.test_assumed_errors`, and
   `test_errors_of_different_units_are_assumed_large_enough`; by gains their loop has a gain below 1:
   `test_a_loop_gain_above_1_is_rejected`.
3. An update arrives when the first input that is computed from it acts:
   `test_an_update_is_on_its_way_until_an_input_from_it_acts`, and "a delay but that of the network" of
   `test_a_proof_that_leaves_out_a_condition_is_exceeded_by_runs`.
4. A step over an exact grid with an age of the input needs a convex form. There is no such proof here: ages
   are in flows, at any time.
5. What decays and what does not are two units: `test_a_constant_disturbance_needs_constant_bounds`.
6. All nodes and edges, and multipliers of at least 0: `test_edges_hold_at_each_node`, "one loss more" of
   `test_witnesses.test_a_witness_proves_nothing_about_another_loop`,
   `test_forms_decay_faster_than_the_threshold`, `test_a_multiplier_is_a_number_of_at_least_0`.
7. Updates arrive within the time between two events, too:
   `test_apart.test_a_time_for_less_is_not_one_for_more`; by forms the drift is bounded whatever arrives.
8. Before the first input nothing acts, and events may come:
   `test_a_start_in_which_an_event_may_come_is_rejected`, `test_the_start_has_as_many_events_as_tests`. A
   remainder on a region is enclosed: `tests.checker.test_equations_of_documents`.
"""

import copy
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from flint import arb, fmpq

from noack.core.balls import identity, matrix, number, zeros
from noack.proof.elaborate.errors import RefusedError
from noack.proof.elaborate.loop import Loop, Rule
from noack.proof.elaborate.scenario import _checked
from noack.proof.loop_document import LoopDocument, Naming, NoDocumentError
from noack.proof.search.results import Assumptions
from noack.proof.statement_proof import prove_by_forms
from noack.theory.witnesses.assumptions import inter_event_s
from tests.checker.completed import completed
from tests.checker.loops import (
    IDEAL,
    SCHEDULE,
    changed,
    double_integrator,
    pushed,
    relative,
    until_due,
    with_rule,
)
from tests.checker.proofs import UNTIL_IT_ACTS, Proved, proved
from tests.checker.quiet_starts import is_quiet
from tests.checker.rejections import failing, rejects
from tests.checker.runs import exceeded

Document = dict[str, Any]
DEFAULT = double_integrator()


@pytest.fixture(scope="module")
def witness() -> Proved:
    return proved("double_integrator")


# Loops whose numbers are balls or contradict each other.


def test_a_level_counts_beside_a_floor_at_rate_0() -> None:
    """With a rate of 0, f₁ = f₂ = 1, but c² f₁² + f² f₂² is not f² f₂²: x is driven by errors up to c."""
    sizes = []
    for name in ("rate_0_floor", "rate_0"):
        found = proved(name)
        assert found.document["rate"] == 0
        drift = next(bound for bound in found.proof.bounds if bound.output == "drift")
        sizes.append(math.hypot(float(drift.decaying.mid()), float(drift.constant.mid())))
    assert sizes[0] > 0.9 * sizes[1]


@pytest.mark.parametrize("field", ["half_A", "half_B"])
def test_a_half_width_that_is_a_ball_around_0_is_not_left_out(field: str) -> None:
    ball = identity(2) * arb(0, 0.3) if field == "half_A" else matrix([[1.0], [1.0]]) * arb(0, 0.3)
    ideal = proved("ideal")
    rejects(ideal.loop._replace(**{field: ball}), ideal.document, "loop: half-width")


WRONG: dict[str, Callable[[Loop], Loop]] = {
    "negative floor": lambda loop: loop._replace(rule=loop.rule._replace(floor=arb(-5))),
    "ball as level": lambda loop: loop._replace(rule=loop.rule._replace(level=arb(0, 1))),
    "ball as floor": lambda loop: loop._replace(rule=loop.rule._replace(floor=arb(0, 1))),
    "infinite gain": lambda loop: loop._replace(gain=loop.gain * arb("inf")),
    "not a number": lambda loop: loop._replace(start=loop.start * arb("nan")),
    "a disturbance without size": lambda loop: loop._replace(pushes=matrix([[0.0], [1.0]])),
    "a negative size": lambda loop: loop._replace(pushes=matrix([[0.0], [1.0]]), sizes=(arb(-1),)),
    "a billion losses": lambda loop: loop._replace(losses=10**9),
    "less than no losses": lambda loop: loop._replace(losses=-1),
    "two comparisons at once": lambda loop: loop._replace(
        times=loop.times._replace(least_period=fmpq(1), period=fmpq(1))
    ),
    "rare and frequent tests": lambda loop: loop._replace(times=loop.times._replace(least_sampling=fmpq(1))),
    "negative delay": lambda loop: loop._replace(times=loop.times._replace(delay=fmpq(-1))),
    "another shape": lambda loop: loop._replace(half_B=zeros(1, 1)),
    "no states": lambda loop: loop._replace(A=zeros(0, 0)),
}


@pytest.mark.parametrize("change", WRONG)
def test_a_loop_that_is_none_is_rejected(witness: Proved, change: str) -> None:
    rejects(WRONG[change](DEFAULT), witness.document, "^loop: ")


def test_a_rule_that_holds_at_once_after_an_event_needs_tests_at_intervals() -> None:
    """Its event sets e := 0, but not x: that the rule is silent between events would be false."""
    ideal = proved("ideal")
    loop = with_rule(ideal.loop, positive=matrix([[1, 0, 1, 0], [0, 0, 0, 1]]))
    rejects(loop, ideal.document, "at once after an event")


def test_a_weight_without_inverse_is_rejected(witness: Proved) -> None:
    rejects(DEFAULT._replace(weight=matrix([[1, 0], [0, 0]])), witness.document, "inverse")


# The sensor's error between two tests.


def slow_model(floor: float = 0.01) -> Loop:
    """Return ẋ = −0.05x + d, |d| ≤ 1, tested each 0.5 s: the threshold decays, and the drift does not."""
    loop = double_integrator(IDEAL._replace(sampling=fmpq(1, 2), least_sampling=fmpq(1, 2)))
    rule = Rule(matrix([[0.0, 1.0]]), zeros(0, 2), number(0.5), number(0.01), number(floor))
    A, none, one = matrix([[-0.05]]), zeros(1, 1), identity(1)
    return loop._replace(
        A=A, B=one, half_A=none, half_B=none, model_A=A, model_B=one, gain=none, weight=one,
        start=one, rule=rule, pushes=one, sizes=(arb(1),), noise=zeros(1, 0), losses=0,
    )  # fmt: skip


SLOW_DRIFT: dict[str, Any] = {
    "output": "drift",
    "decay": 0.0536,
    "matrices": {"X": [[4.95993e-11]], "Q/0 lost": [[7.99425e-06]]},
    "numbers": {
        "c1/0 lost": 0.000121906, "c2/0 lost": 0.000113734, "a/0 lost": 1.21795e-05,
        "level 1": 0.000122908, "level 2": 1.00012,
        "m/flow/0 lost/0/signal 0": 6.0942e-06, "m/flow/0 lost/1/signal 0": 4.1006e-06,
        "m/output/0 lost/0/signal 0": 1.0, "m/output/0 lost/1/signal 0": 1.0,
        "m/edge/0 lost, delivered/0 0/0": 3.99396e-06, "m/edge/0 lost, delivered/0 0/1": 4.00014e-06,
        "m/edge/0 lost, delivered/1 0/0": 1.00046e-06, "m/edge/0 lost, delivered/1 0/1": 3.89911e-07,
    },
}  # fmt: skip
SLOW = {"rate": 0.01, "later": 0, "later_at_start": 0, "bounds": [SLOW_DRIFT]}


def test_errors_of_different_units_are_assumed_large_enough() -> None:
    """|e|² ≤ a² f₁² + b² f₂² needs more than the threshold for a, and what the drift adds in 0.5 s for b."""
    uses = {"m/output/0 lost/0/0": 1e-9}
    slow = {**SLOW, "bounds": [{**SLOW_DRIFT, "numbers": {**SLOW_DRIFT["numbers"], **uses}}]}
    for size in (0.501, 0.68):
        errors = {"decaying": size, "constant": size}
        rejects(slow_model(), {**slow, "errors": errors}, "the fact 'bound of e' does not hold here")
    proof = prove_by_forms(slow_model(), {**slow, "errors": {"decaying": 0.72, "constant": 0.72}})
    assert not any(exceeded(slow_model(), proof, np.random.default_rng(k), 20.0) for k in range(3))


def test_no_time_between_events_is_searched_if_the_threshold_decays_and_the_drift_does_not() -> None:
    assert inter_event_s(slow_model(0.0), 0.01, (0.1, 1.0)) == 0
    assert inter_event_s(slow_model(0.0), 0.01, (0.1, 0.0)) > 0


# The time before the first input.


def test_the_sensor_error_before_the_first_input_is_bounded() -> None:
    """Without an input ‖e_s‖ = ‖∫ e^{Hs} BKx‖ is near 0.01 at 0.01 s."""
    proof = proved("early_0.005").proof
    sensor = next(bound for bound in proof.bounds if bound.output == "e_s")
    assert float(sensor.decaying.mid()) > 0.0099


def test_events_without_a_comparison_may_come_before_the_first_input() -> None:
    loop = double_integrator(SCHEDULE._replace(start=fmpq(1, 20)))
    due = with_rule(loop, always=True)
    assert is_quiet(loop)
    assert not is_quiet(due)
    assert is_quiet(changed(due, due=loop.times.start))


def test_no_time_between_events_is_longer_than_until_one_is_due() -> None:
    """The test at this time may be an event, whatever is compared and whatever a document names."""
    loop, document = until_due(), proved("until_due").document
    for named in (document["inter_event_s"], 0.09, 1e3):
        proof = prove_by_forms(loop, {**document, "inter_event_s": named})
        assert proof.inter_event is not None
        assert proof.inter_event <= loop.times.due
    rejects(changed(loop, due=loop.times.due / 2), document, "^more events than 0 may happen in '0 later'")


def test_a_start_is_quiet_only_if_the_error_is_what_is_compared() -> None:
    """‖W e_s‖ below the floor says nothing of 20 ‖W e_s‖, nor of ‖W x‖."""
    loop = double_integrator(SCHEDULE._replace(start=fmpq(3, 100)))
    loop = with_rule(loop, level=arb(0), floor=number(0.06))
    assert is_quiet(loop)
    for each in (loop.rule.positive * 20, matrix([[0, 0, 1, 0]]), matrix([[1, 0, 0, 0], [0, 1, 0, 0]])):
        assert not is_quiet(with_rule(loop, positive=each))


def test_a_start_in_which_an_event_may_come_is_rejected(witness: Proved) -> None:
    rejects(DEFAULT._replace(times=SCHEDULE._replace(start=fmpq(1, 2))), witness.document, "at motion/start,")


def test_two_units_that_do_not_decay_are_joined() -> None:
    """|Cz|² ≤ D₁² + D₂², which is less than (D₁ + D₂)²."""
    found = proved("rate_0_floor")
    numbers = entry_of(found.document, "x")["numbers"]
    bound = next(b for b in prove_by_forms(found.loop, found.document).bounds if b.output == "x")
    assert bound.decaying == 0
    levels = [numbers.get(f"level {k}", 0.0) for k in (1, 2)]
    assert float(bound.constant) == pytest.approx(math.sqrt(sum(levels)))


# Conditions without which the statements would be false.


def entry_of(document: Document, output: str) -> Document:
    return next(entry for entry in document["bounds"] if entry["output"] == output)


def copied(witness: Proved) -> Document:
    return copy.deepcopy(witness.document)


def test_later_events_are_those_that_tests_allow() -> None:
    """Within 25 ms there are two further tests, which the drift does not exclude."""
    found = proved("changed_later")
    loop, document = found.loop, found.document
    assert document["later"] == document["later_at_start"] == 2
    rejects(loop, {**document, "later": 1}, "^more events than 1 may happen in '0 later'")
    rejects(loop, {**document, "later_at_start": 1}, "^more events than 1 may happen in 'start, 0 later'")


def test_a_longer_time_between_events_than_the_drift_allows_is_not_proven() -> None:
    found = proved("ideal")
    proof = prove_by_forms(found.loop, {**found.document, "inter_event_s": 0.3})
    assert proof.inter_event is not None
    assert 0.99 < float(proof.inter_event) / found.document["inter_event_s"] < 1.01


def test_a_document_with_more_events_before_the_first_input_is_another_one(witness: Proved) -> None:
    more = completed(DEFAULT, {**witness.document, "later_at_start": 1})
    rejects(DEFAULT, more, "at edge/start, 0 later, event/")


def test_an_update_is_on_its_way_until_an_input_from_it_acts() -> None:
    """It is 10 ms in the network, and waits up to 20 ms for a tick."""
    assert fmpq(1, 100) + fmpq(1, 50) <= UNTIL_IT_ACTS
    rejects(proved("until_it_acts").loop, proved("delay_0.01").document, "at motion/0 later/")


def is_described(loop: Loop, later: int, at_start: int) -> bool:
    """Return whether a document with some events while an update is on its way has all that tests allow."""
    try:
        assumed = Assumptions(None, later, at_start)
        LoopDocument(loop, loop.rule.rate, assumed, (), Naming("a loop")).require_counted()
    except NoDocumentError:
        return False
    return True


def test_later_events_by_tests_need_no_bound_of_the_drift() -> None:
    """A test at the time at which an input begins to act comes after it: w is the same."""
    loop = relative(0.1)._replace(times=SCHEDULE._replace(delay=fmpq(3, 100)))
    assert [is_described(loop, later, 1) for later in range(3)] == [False, False, True]


def test_the_start_has_as_many_events_as_tests() -> None:
    loop = double_integrator(SCHEDULE._replace(start=fmpq(3, 100)), level=1e-6)
    assert not is_quiet(loop)
    assert not is_described(loop, 1, 1)
    assert is_described(loop, 1, 2)


@pytest.mark.parametrize("sizes", [(1.0, 1.0), (-2.0, 0.0), (0.0, -2.0)])
def test_errors_have_the_units_of_the_loop(witness: Proved, sizes: tuple[float, float]) -> None:
    errors = dict(zip(("decaying", "constant"), sizes, strict=True))
    rejects(DEFAULT, {**witness.document, "errors": errors}, "^errors: below 0, or in a unit")


@pytest.mark.parametrize("value", [-1, 9, 1.0, True, "1", None])
def test_the_number_of_later_events_is_a_small_whole_number(witness: Proved, value: object) -> None:
    rejects(DEFAULT, {**witness.document, "later": value}, "later: not a whole number")


@pytest.mark.parametrize(
    ("decay", "reason"),
    [
        *((value, "all states: not proven at motion/0 lost/") for value in (0.0, -1.0, 0.6)),
        *((value, "^decay: not finite") for value in (math.inf, math.nan)),
        *((value, "^decay: not a number") for value in (True, "1", None)),
    ],
)
def test_forms_decay_faster_than_the_threshold(witness: Proved, decay: object, reason: str) -> None:
    document = copied(witness)
    entry_of(document, "x")["decay"] = decay
    rejects(DEFAULT, document, reason)


@pytest.mark.parametrize("rate", [-0.1, 0.31, 1e300])
def test_the_rate_is_at_most_that_of_the_threshold(witness: Proved, rate: float) -> None:
    rejects(DEFAULT, {**witness.document, "rate": rate}, "^rate: not between 0 and that of the threshold")


def test_a_threshold_of_another_rate_than_the_bounds_is_no_guard(witness: Proved) -> None:
    """At an event ‖W e_s‖ is above the loop's threshold, not above the level times e^{−rt}."""
    document = completed(DEFAULT, {**witness.document, "rate": 5e-324})
    rejects(DEFAULT, document, "at edge/0 later, all lost/")


@pytest.mark.parametrize(
    ("name", "by", "fails"),
    [
        ("c1/0 later, 1", 1.0, "edge/0 later, all lost/1 0"),
        ("c1/0 later, 1", 1.0, "edge/0 later, all lost/1 1"),
        ("c1/start, 0 later, 1", 1.0, "edge/start, 0 later, all lost/1 0"),
        ("c1/start, 0 later, 0", 1.0, "edge/start, 0 later, all lost/0 0"),
        ("c1/start, 0 later, 0", -1.0, "start"),
        ("c1/0 later, 0", -1.0, "edge/0 lost, sent/1 0"),
        ("c1/0 later, 0", 1.0, "edge/0 later, all lost/0 0"),
        ("c1/1 lost", -1.0, "edge/0 lost, lost/0 0"),
        ("c1/2 lost", -1.0, "edge/1 lost, lost/1 0"),
        ("c1/2 lost", 1.0, "edge/2 lost, sent/1 0"),
        ("c1/0 lost", -1.0, "edge/0 later, all lost/1 1"),
        ("level 1", -0.1, "output/0 lost/0/0"),
    ],
)
def test_edges_hold_at_each_node(witness: Proved, name: str, by: float, fails: str) -> None:
    """V is changed at one node: the edges into it or out of it fail."""
    document = copied(witness)
    entry = entry_of(document, "x")
    assert not failing(DEFAULT, entry, 0.3)
    entry["numbers"][name] += by * abs(entry["numbers"][name])
    assert fails in failing(DEFAULT, entry, 0.3)
    rejects(DEFAULT, document, "all states: not proven at ")


def test_a_constant_disturbance_needs_constant_bounds() -> None:
    with_push = pushed(double_integrator(IDEAL), 1e-6)
    for signal in (0.0, 1e-6, 1e-3, 1.0):
        document = completed(with_push, proved("ideal").document, signal)
        assert entry_of(document, "x")["numbers"]["level 2"] == 0
        rejects(with_push, document, "at motion/0 lost/")
    document = copied(proved("ideal_pushed"))
    entry_of(document, "x")["numbers"]["level 2"] = 0.0
    rejects(with_push, document, "at output/0 lost/")


# Hostile documents.

DEEP: list[object] = []
for _ in range(500):
    DEEP = [DEEP]
HOSTILE: dict[str, tuple[object, str]] = {
    "a list": ([], "^not a table"),
    "a text": ("bounds", "^not a table"),
    "nothing": ({}, "^rate: not a number"),
    "no bounds": ({"rate": 0.3, "bounds": []}, "^bounds: not a list of tables"),
    "bounds is a table": ({"rate": 0.3, "bounds": {}}, "^bounds: not a list of tables"),
    "a bound is a text": ({"rate": 0.3, "bounds": ["x"]}, "^bounds: not a list of tables"),
    "a bound is empty": ({"rate": 0.3, "bounds": [{}]}, "^decay: not a number"),
    "a rate that is a bool": ({"rate": True, "bounds": []}, "^rate: not a number"),
    "a rate that is a text": ({"rate": "0.3", "bounds": []}, "^rate: not a number"),
    "a rate of 1000 digits": ({"rate": 10**1000, "bounds": []}, "^rate: too large"),
    "an unknown output": (
        {"rate": 0.3, "bounds": [{"output": "\n" * 10**6, "decay": 1}]}, "^output: .* is none of the loop's",
    ),
    "a deep output": (
        {"rate": 0.3, "bounds": [{"output": DEEP, "decay": 1}]}, "^output: .* is none of the loop's",
    ),
    "deep matrices": (
        {"rate": 0.3, "bounds": [{"output": "x", "decay": 1, "matrices": {"X": DEEP}, "numbers": {}}]},
        "^X: not a number",
    ),
    "a large matrix": (
        {
            "rate": 0.3,
            "bounds": [{"output": "x", "decay": 1, "matrices": {"X": [[0.0] * 300] * 300}, "numbers": {}}],
        },
        "^X: not a square matrix of the right size",
    ),
    "a long name": (
        {
            "rate": 0.3,
            "bounds": [{"output": "x", "decay": 1, "matrices": {}, "numbers": {"m/" + "\n" * 10**6: -1}}],
        },
        "unknown matrix, or not one of this size",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_documents_are_one_line(name: str) -> None:
    document, reason = HOSTILE[name]
    rejects(DEFAULT, document, reason)


def test_an_output_occurs_once(witness: Proved) -> None:
    document = copied(witness)
    document["bounds"] *= 1000
    rejects(DEFAULT, document, "occurs twice")


@pytest.mark.parametrize("value", [True, "1", None, math.nan, math.inf, [1], 2**70, -1.0])
def test_a_multiplier_is_a_number_of_at_least_0(witness: Proved, value: object) -> None:
    document = copied(witness)
    numbers = entry_of(document, "x")["numbers"]
    numbers[next(name for name in numbers if name.startswith("m/"))] = value
    rejects(DEFAULT, document, "not |too large|below 0")


@pytest.mark.parametrize(
    "value", [[], [[]], [[1]], [[1, 2]], [[1, 2], [3, 4]], [["1", 0], [0, 1]], "ab", [1, 2]]
)
def test_a_matrix_is_square_symmetric_and_of_the_right_size(witness: Proved, value: object) -> None:
    document = copied(witness)
    entry_of(document, "x")["matrices"]["X"] = value
    rejects(DEFAULT, document, "^X: not |unknown matrix, or not one of this size")


def test_a_number_of_a_scenario_may_have_any_number_of_digits() -> None:
    with pytest.raises(RefusedError, match="gain: too large"):
        _checked(10**400, "gain")
