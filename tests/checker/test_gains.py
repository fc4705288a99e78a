"""Bounds by gains: they are true in runs, near closed forms, and each condition of the argument counts."""

import copy
import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from flint import arb, fmpq
from scipy.linalg import expm

from netem.core.periods import period_of
from noack.core.balls import beside, identity, matrix, number, zeros
from noack.core.schedule import LoopSchedule
from noack.proof.elaborate.errors import RejectedError
from noack.proof.elaborate.loop import Loop, Memory
from noack.proof.search.results import Proof, smallest_bounds
from noack.proof.statement_proof import prove_statement
from noack.theory.witnesses.documents import witness_by_gains
from noack.theory.witnesses.effort import NoWitnessError
from noack.theory.witnesses.gains import _lyapunov
from noack_gains.reading import RejectedError as RejectedGainsError
from noack_gains.responses import Decay, responses, responses_until
from tests.checker.loops import AREA, DUE, IDEAL, SCHEDULE, changed, double_integrator, scalar, with_form
from tests.checker.proofs import OUTPUTS, by_gains, proved
from tests.checker.random_loops import KINDS, random_loop
from tests.checker.runs import exceeded

_ACCURACY, _OF_A_STIFF_ONE, _OF_QUADRATURE = 0.03, 0.5, 1e-4
"""Of enclosed responses, of a fast state beside a slow one, and of a sum over a fine grid, relatively."""


def sizes(proof: Proof, *, from_start: bool = True) -> dict[str, float]:
    """Return the bounds at t = 0, or those in the limit."""
    chosen = [bound for bound in proof.bounds if bound.from_start == from_start]
    return {bound.output: float(bound.decaying) + float(bound.constant) for bound in chosen}


# Responses.


@pytest.mark.parametrize(
    "M",
    [
        [[-1.0, 2.0], [-2.0, -1.0]],
        [[-0.2, 10.0], [0.0, -0.2]],
        [[-1e3, 300.0], [0.0, -0.5]],
        [[0.0, 1.0, 0.0], [-4.0, -0.3, 1.0], [0.0, 0.0, -5.0]],
    ],
    ids=["a spiral", "a defective one", "a stiff one", "a slow one"],
)
def test_responses_are_those_of_quadrature(M: list[list[float]]) -> None:
    n, floating = len(M), np.array(M)
    table: Any = _lyapunov(floating, 0.0, "M")
    decay = Decay(matrix(table["form"]), number(table["decay"]))
    outputs, inputs = np.eye(n)[:1], np.ones((n, 1))
    decay.require(matrix(M), "M")
    found = responses(matrix(M), decay, [matrix(outputs.tolist()), identity(n)], [matrix(inputs.tolist())])
    slowest = -np.linalg.eigvals(floating).real.max()
    accuracy = _ACCURACY if np.linalg.norm(floating) < 1000 * slowest else _OF_A_STIFF_ONE
    times = np.concatenate([[0.0], np.geomspace(1e-6, 30 / slowest, 3000)])
    states = expm(floating * times[:, None, None]) @ inputs
    for (response,), C in zip(found, (outputs, np.eye(n)), strict=True):
        norms = np.linalg.norm(C @ states, axis=(1, 2))
        assert norms.max() <= float(response.most) <= norms.max() * (1 + accuracy)
        total = np.trapezoid(norms, times)
        assert total * (1 - _OF_QUADRATURE) <= float(response.total) <= total * (1 + accuracy)


def test_a_form_with_no_inverse_within_balls_is_rejected() -> None:
    with pytest.raises(RejectedGainsError, match="inverse"):
        _ = Decay(matrix([[1.0, 1.0], [1.0, 1.0]]), number(1.0)).inverse


def test_responses_up_to_a_time_may_grow() -> None:
    [[found]] = responses_until(matrix([[1.0]]), number(2.0), [identity(1)], [identity(1)])
    assert math.exp(2) <= float(found.most) <= math.exp(2) * 1.05
    assert math.exp(2) - 1 <= float(found.total) <= (math.exp(2) - 1) * 1.05


def test_a_scalar_loop_has_the_bounds_of_the_closed_form() -> None:
    """With G = −1 + r all suprema are at once: ‖e_c‖ ≤ Mθ, and ∫2e^{−(1−r)s} ds = 2/(1 − r)."""
    document, proof = by_gains(scalar())
    assert document["rate"] == 0.25
    found = sizes(proof)
    assert found["e_s"] == pytest.approx(0.1, rel=1e-6)
    assert found["e_c"] == pytest.approx(0.3, rel=_ACCURACY)
    assert found["x"] == pytest.approx(1 + 0.3 * 2 / 0.75, rel=_ACCURACY)
    assert found["u[0]"] == pytest.approx(found["x"] + found["e_c"], rel=1e-6)


def test_a_constant_disturbance_has_the_limit_of_the_closed_form() -> None:
    """In the limit e_c is at most M times the floor, and |x| at most the integrals of both."""
    loop = scalar(floor=0.01)._replace(pushes=identity(1), sizes=(number(0.05),))
    limits = sizes(by_gains(loop)[1], from_start=False)
    assert limits["x"] == pytest.approx(0.05 + 2 * 0.03, rel=_ACCURACY)


def test_a_limit_that_the_bound_from_the_start_on_implies_is_not_stated() -> None:
    proof = by_gains(scalar(floor=0.01))[1]
    assert {bound.output for bound in proof.bounds if not bound.from_start} == {"x", "x[0]", "y[0]"}
    assert all(bound.from_start for bound in smallest_bounds(proof))
    assert len(smallest_bounds(proof)) == len(OUTPUTS)


def test_any_number_of_later_events_is_covered() -> None:
    """A delay of 40 tests: the quadratic forms would need as many vectors."""
    loop = scalar(
        0, SCHEDULE._replace(sampling=fmpq(1, 1000), least_sampling=fmpq(1, 1000), delay=fmpq(1, 25))
    )
    assert sizes(by_gains(loop)[1])["e_c"] < 0.2


# What is proven is true, and what is not is rejected.


REJECTED: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "a rate that is too large": (lambda document: document.update(rate=0.24999), "inter_event_s"),
    "a rate above that of the threshold": (lambda document: document.update(rate=0.26), "rate: it is larger"),
    "a time between events that is too long": (
        lambda document: document["gains"].update(inter_event_s=1.05 * document["gains"]["inter_event_s"]),
        "inter_event_s",
    ),
    "a negative time between events": (
        lambda document: document["gains"].update(inter_event_s=-1.0), "inter_event_s",
    ),
    "no tail of the model": (lambda document: document["gains"].pop("model"), "model: missing"),
    "no tail of the plant": (lambda document: document["gains"].pop("plant"), "plant"),
    "a tail that falls too fast": (
        lambda document: document["gains"]["plant"].update(decay=2.0), "plant: not proven to decay",
    ),
    "a tail that grows": (
        lambda document: document["gains"]["model"].update(decay=-1.0),
        "model: its rate of decay is not above 0",
    ),
    "a form that is not positive": (
        lambda document: document["gains"]["plant"].update(form=[[-1.0]]), "plant: not proven to decay",
    ),
    "a form without rank": (
        lambda document: document["gains"]["plant"].update(form=[[0.0]]), "plant: not proven to decay",
    ),
    "inputs without coordinates": (lambda document: document["gains"].update(inputs=[[0.0]]), "inverse"),
    "inputs of another size": (lambda document: document["gains"].update(inputs=[[1.0, 0.0]]), "inputs"),
    "an unknown output": (
        lambda document: document["gains"].update(outputs=["x[7]"]), r"outputs: 'x\[7\]' is none",
    ),
    "no table": (lambda document: document.update(gains=3), "gains"),
}  # fmt: skip


@pytest.mark.parametrize("change", REJECTED)
def test_changed_documents_are_rejected(change: str) -> None:
    loop = scalar(times=SCHEDULE)
    document = copy.deepcopy(by_gains(loop)[0])
    apply, reason = REJECTED[change]
    apply(document)
    with pytest.raises(RejectedError, match=reason) as caught:
        prove_statement(loop, document)
    assert "\n" not in str(caught.value)


def test_another_gain_is_rejected() -> None:
    loop = scalar(times=SCHEDULE)
    with pytest.raises(RejectedError, match=r"^gains: plant: not proven to decay so fast"):
        prove_statement(loop._replace(gain=number(-0.6) * identity(1)), by_gains(loop)[0])


def test_a_loop_gain_above_1_is_rejected() -> None:
    """Inputs that are 1 s old, with a plant that grows by e in this time."""
    loop = scalar(times=SCHEDULE)
    with pytest.raises(RejectedError, match="times as large; a proof needs less than 1"):
        prove_statement(changed(loop, age=fmpq(1)), by_gains(loop)[0])


def test_more_losses_than_a_loop_may_have_are_refused_at_once() -> None:
    with pytest.raises(NoWitnessError, match="0 to 1000 losses"):
        witness_by_gains(double_integrator()._replace(losses=10**6), ["x"])


def test_what_is_not_covered_is_rejected() -> None:
    loop = double_integrator()
    document = by_gains(loop)[0]
    with pytest.raises(RejectedError, match=r"^gains: "):
        prove_statement(
            loop._replace(rule=loop.rule._replace(memory=Memory(arb(1), identity(4), arb(0)))), document
        )


# Rules with terms of x and e_s.


FORM = [[-1e-4, 0.0, 0.006, 0.0], [0.0, -2e-4, 0.0, 0.005], [0.006, 0.0, 2.0, 0.4], [0.0, 0.005, 0.4, 1.5]]


@pytest.mark.parametrize(
    ("name", "factor"), [("errors", 1.001), ("share", 0.999), ("shift", 0.98), ("shift", 1.02)]
)
def test_a_silent_test_that_says_less_is_rejected(name: str, factor: float) -> None:
    loop = with_form(double_integrator(SCHEDULE), FORM)
    document = copy.deepcopy(by_gains(loop)[0])
    prove_statement(loop, document)
    rows = document["gains"]["comparison"][name]
    document["gains"]["comparison"][name] = [[factor * entry for entry in row] for row in rows]
    with pytest.raises(RejectedError, match="a silent test does not say as much"):
        prove_statement(loop, document)


def test_a_comparison_is_needed_of_the_right_size() -> None:
    loop = with_form(double_integrator(SCHEDULE), FORM)
    document = by_gains(loop)[0]
    for change in ({"shift": [[0.0]]}, {"share": [[0.1]]}, {"errors": [[1.0, 0.0]]}):
        other = copy.deepcopy(document)
        other["gains"]["comparison"] |= change
        with pytest.raises(RejectedError, match=r"not 2 rows|a row has not 2 entries"):
            prove_statement(loop, other)
    del document["gains"]["comparison"]
    with pytest.raises(RejectedError, match="so one is needed"):
        prove_statement(loop, document)


@pytest.mark.parametrize("factor", [1.3, 3.0])
def test_a_witness_of_a_rule_does_not_prove_bounds_of_a_laxer_one(factor: float) -> None:
    loop = with_form(double_integrator(SCHEDULE), FORM)
    laxer = [
        [entry * (factor if (i < 2) != (j < 2) else 1.0) for j, entry in enumerate(row)]
        for i, row in enumerate(FORM)
    ]
    with pytest.raises(RejectedError, match="a silent test does not say as much"):
        prove_statement(with_form(loop, laxer), by_gains(loop)[0])


def test_a_rule_that_says_nothing_of_an_error_has_no_bounds_by_gains() -> None:
    loop = with_form(double_integrator(SCHEDULE), [[*row[:3], 0.0] for row in FORM[:3]] + [[0.0] * 4])
    with pytest.raises(NoWitnessError, match="may still have any size"):
        by_gains(loop)


def test_a_completed_square_is_as_good_as_the_rule_that_it_is() -> None:
    """‖2e_s‖² > θ² + ‖0.1x‖² as a form has the bounds of ‖e_s‖ > θ/2, with 0.05x."""
    loop = double_integrator(SCHEDULE)
    rule = loop.rule._replace(
        level=arb(0), floor=number(0.02), negative=number(0.05) * beside(identity(2), zeros(2, 2))
    )
    form = [[-0.01 * (i == j) if i < 2 else 4.0 * (i == j) for j in range(4)] for i in range(4)]
    own, other = (
        sizes(by_gains(each)[1]) for each in (loop._replace(rule=rule), with_form(loop, form, 0.0016))
    )
    assert other == pytest.approx(own, rel=1e-4)


def test_a_threshold_and_a_share_of_x_do_not_add_up() -> None:
    """Without losses and delays ‖e_s‖ ≤ √(θ² + s²) with s = σ sup |x|."""
    loop = scalar(0)._replace(start=number(0.2) * identity(1))
    loop = loop._replace(rule=loop.rule._replace(negative=number(0.1) * matrix([[1, 0]])))
    found = sizes(by_gains(loop)[1])
    assert found["e_s"] == pytest.approx(math.hypot(0.1, 0.1 * found["x"]), rel=1e-3)


def test_a_bound_of_the_input_error_that_holds_at_all_times_counts_alone() -> None:
    """If p = −Kx before the first input is below what p is at most later, this time changes nothing of x."""
    loop = scalar(2, SCHEDULE, level=0.0, floor=1.0)._replace(start=number(0.01) * identity(1))
    later, at_once = (sizes(by_gains(each)[1])["x"] for each in (changed(loop, start=fmpq(1, 5)), loop))
    assert later == pytest.approx(at_once, rel=1e-2)


# Rules that are taken for others.


def test_a_deadline_bounds_what_a_threshold_does_not() -> None:
    loose = by_gains(DUE._replace(rule=DUE.rule._replace(always=False), times=SCHEDULE))[1]
    document, proof = by_gains(DUE)
    assert document["gains"]["by_time"]
    assert sizes(proof)["e_c"] < 0.05 * sizes(loose)["e_c"]
    small = DUE._replace(rule=DUE.rule._replace(floor=number(1e-3)))
    assert "by_time" not in by_gains(small)[0]["gains"]


def test_a_rule_without_a_deadline_is_not_taken_for_a_periodic_one() -> None:
    document = by_gains(DUE)[0]
    loop = DUE._replace(rule=DUE.rule._replace(always=False), times=SCHEDULE)
    with pytest.raises(RejectedError, match="by_time: the rule has no largest time"):
        prove_statement(loop, document)
    with pytest.raises(RejectedError, match="events are due, and the rule needs its comparison"):
        prove_statement(DUE._replace(rule=loop.rule), document)


@pytest.mark.parametrize("tests", [0, -1, 2.5, 10**9])
def test_an_integral_is_averaged_over_some_tests(tests: float) -> None:
    document = copy.deepcopy(by_gains(AREA)[0])
    document["gains"]["tests"] = tests
    with pytest.raises(RejectedError, match="tests"):
        prove_statement(AREA, document)


@pytest.mark.parametrize("window_s", [0.0, -0.1])
def test_an_integral_is_averaged_over_some_time(window_s: float) -> None:
    loop = AREA._replace(times=IDEAL)
    document = copy.deepcopy(by_gains(loop)[0])
    document["gains"]["window_s"] = window_s
    with pytest.raises(RejectedError, match="window_s"):
        prove_statement(loop, document)


def test_a_rule_that_integrates_has_nothing_but_a_floor() -> None:
    document = by_gains(AREA)[0]
    share = AREA.rule._replace(negative=matrix([[1, 0]]))
    for loop in (AREA._replace(rule=share), changed(AREA, dwell=fmpq(1, 10))):
        with pytest.raises(RejectedError, match="integrates"):
            prove_statement(loop, document)


def test_an_error_below_the_mean_threshold_may_still_fill_the_area() -> None:
    """|e_s| grows by 30/s and is below a/T = 1 for 20 ms, but its integral is above a = 0.001 after 9 ms."""
    loop = changed(AREA, sampling=fmpq(1, 1000), least_sampling=fmpq(1, 1000), start=fmpq(0))
    loop = loop._replace(
        start=zeros(1, 1), sizes=(number(30.0),), rule=AREA.rule._replace(floor=number(0.001))
    )
    document = copy.deepcopy(by_gains(loop)[0])
    document["gains"] |= {"tests": 1}
    prove_statement(loop, document)
    document["gains"] |= {"inter_event_s": 0.02}
    with pytest.raises(RejectedError, match="not proven for this rule"):
        prove_statement(loop, document)


def test_no_forms_are_those_of_a_rule_that_integrates() -> None:
    loop, document = double_integrator(), proved("double_integrator").document
    with pytest.raises(RejectedError, match="integrates"):
        prove_statement(loop._replace(rule=loop.rule._replace(integrates=True, level=arb(0))), document)


def test_a_dwell_time_has_bounds_with_tests_at_all_times() -> None:
    loop = changed(scalar(0, floor=0.02), dwell=fmpq(1, 20))
    assert sizes(by_gains(scalar(0, floor=0.02))[1])["e_s"] < sizes(by_gains(loop)[1])["e_s"] < 0.3


STEADY = scalar(0, SCHEDULE, floor=0.02)._replace(pushes=identity(1), sizes=(number(3.0),))
"""All that it is pushed by is in e_c, as long as an update is on its way."""
QUIET = scalar(0, SCHEDULE._replace(start=fmpq(0)), level=1e-3)
"""What moves e_s beside the errors themselves shows at once."""
NETWORK_S = fmpq(1, 50)
_OF_INPUTS = LoopSchedule(period_of(100.0), 1, period_of(10.0), 0.0, network_delay_s=0.02, input_gap_ns=10**7)
UNTIL_IT_ACTS = fmpq(_OF_INPUTS.bounds.delay_ns, 10**9)
"""20 ms in the network, up to 100 ms until a tick, 10 ms on the way of its input: 130 ms."""
LIES: dict[str, tuple[Loop, Callable[[Loop], Loop]]] = {
    "a loss": (scalar(times=SCHEDULE, floor=0.02), lambda loop: loop._replace(losses=0)),
    "noise": (
        scalar(times=SCHEDULE, floor=0.02)._replace(noise=number(0.015) * identity(1)),
        lambda loop: loop._replace(noise=zeros(1, 0)),
    ),
    "a disturbance": (
        scalar(0, SCHEDULE, floor=0.02)._replace(pushes=identity(1), sizes=(number(3.0),)),
        lambda loop: loop._replace(pushes=zeros(1, 0), sizes=()),
    ),
    "the start": (
        scalar(times=SCHEDULE)._replace(start=10 * identity(1)),
        lambda loop: loop._replace(start=identity(1)),
    ),
    "the time without an input": (
        changed(scalar(times=SCHEDULE), start=fmpq(2)), lambda loop: changed(loop, start=fmpq(0)),
    ),
    "a push before the first input": (
        changed(scalar(times=SCHEDULE), start=fmpq(1))._replace(push_before_input=5 * identity(1)),
        lambda loop: loop._replace(push_before_input=None),
    ),
    "the threshold": (
        scalar(times=SCHEDULE), lambda loop: loop._replace(rule=loop.rule._replace(level=number(0.05))),
    ),
    "a share of x": (
        scalar(0, SCHEDULE)._replace(
            rule=scalar().rule._replace(negative=number(0.2) * matrix([[1, 0]]))
        ),
        lambda loop: loop._replace(rule=loop.rule._replace(negative=zeros(0, 2))),
    ),
    "a term of x and e_s": (
        scalar(0, SCHEDULE)._replace(
            rule=scalar().rule._replace(positive=matrix([[0.3, 1.0]]), level=arb(0), floor=number(0.02)),
            pushes=identity(1), sizes=(number(0.1),),
        ),
        lambda loop: loop._replace(rule=loop.rule._replace(positive=matrix([[0, 1]]))),
    ),
    "a late deadline": (
        changed(DUE, longest=fmpq(1, 4)), lambda loop: changed(loop, longest=fmpq(1, 50)),
    ),
    "a delay": (
        changed(STEADY, delay=fmpq(1, 5)), lambda loop: changed(loop, delay=fmpq(0)),
    ),
    "a delay but that of the network": (
        changed(STEADY, delay=UNTIL_IT_ACTS), lambda loop: changed(loop, delay=NETWORK_S),
    ),
    "an age": (changed(QUIET, age=fmpq(1, 5)), lambda loop: changed(loop, age=fmpq(0))),
    "a box of A": (
        QUIET._replace(half_A=number(0.2) * identity(1)), lambda loop: loop._replace(half_A=zeros(1, 1)),
    ),
    "a box of B": (
        QUIET._replace(half_B=number(0.4) * identity(1)), lambda loop: loop._replace(half_B=zeros(1, 1)),
    ),
    "a mismatch of the model": (
        QUIET._replace(model_A=number(0.8) * identity(1)), lambda loop: loop._replace(model_A=loop.A),
    ),
    "a large area": (AREA, lambda loop: loop._replace(rule=loop.rule._replace(floor=number(1e-4)))),
    "slow tests": (
        changed(scalar(0, SCHEDULE), sampling=fmpq(1, 5), least_sampling=fmpq(1, 5)),
        lambda loop: changed(loop, sampling=fmpq(1, 100), least_sampling=fmpq(1, 100)),
    ),
}  # fmt: skip


@pytest.mark.parametrize("left_out", LIES)
def test_a_proof_that_leaves_out_a_condition_is_exceeded_by_runs(left_out: str) -> None:
    loop, lie = LIES[left_out]
    true, false = by_gains(loop)[1], by_gains(lie(loop))[1]

    def is_exceeded(proof: Proof, seed: int) -> bool:
        return bool(exceeded(loop, proof, np.random.default_rng(seed), 6.0, by_forms=False))

    assert any(is_exceeded(false, seed) for seed in range(8))
    assert not is_exceeded(true, 0)


@pytest.mark.parametrize("count", [1, pytest.param(8, marks=pytest.mark.deep)])
@pytest.mark.parametrize("kind", KINDS)
def test_bounds_of_random_loops_are_not_exceeded(kind: str, count: int) -> None:
    found = seed = 0
    while found < count:
        seed, rng = seed + 1, np.random.default_rng(seed)
        loop = random_loop(rng, kind)
        try:
            proof = by_gains(loop)[1]
        except NoWitnessError:
            continue
        found += 1
        step = loop.times.sampling if loop.times.sampling > 0 else loop.times.period / 5
        assert exceeded(loop, proof, rng, 100 * float(arb(step)), by_forms=False) == []


def least_sizes(loop: Loop) -> dict[str, float]:
    return sizes(by_gains(loop)[1])


BEFORE = scalar(times=SCHEDULE, floor=0.02)


@functools.cache
def sizes_before() -> dict[str, float]:
    return least_sizes(BEFORE)


@pytest.mark.parametrize(
    "change",
    [
        lambda loop: loop._replace(losses=3),
        lambda loop: changed(loop, delay=fmpq(1, 10)),
        lambda loop: changed(loop, age=fmpq(1, 10)),
        lambda loop: changed(loop, start=fmpq(1, 10)),
        lambda loop: changed(loop, sampling=fmpq(1, 10), least_sampling=fmpq(1, 10)),
        lambda loop: loop._replace(start=2 * loop.start),
        lambda loop: loop._replace(noise=number(0.005) * identity(1)),
        lambda loop: loop._replace(pushes=identity(1), sizes=(number(0.1),)),
        lambda loop: loop._replace(half_A=number(0.05) * identity(1)),
        lambda loop: loop._replace(half_B=number(0.05) * identity(1)),
        lambda loop: loop._replace(model_A=number(0.9) * identity(1)),
        lambda loop: loop._replace(rule=loop.rule._replace(level=number(0.12))),
        lambda loop: loop._replace(rule=loop.rule._replace(negative=number(0.01) * matrix([[1, 0]]))),
        lambda loop: loop._replace(rule=loop.rule._replace(positive=matrix([[0.01, 1]]))),
    ],
    ids=[
        "losses", "delay", "age", "start-time", "sampling", "start", "noise", "disturbance", "A", "B",
        "model", "level", "share", "mixed",
    ],
)  # fmt: skip
def test_each_condition_counts(change: Callable[[Loop], Loop]) -> None:
    before, after = sizes_before(), least_sizes(change(BEFORE))
    assert after["x"] > before["x"] * 1.001
    assert min(after[name] / before[name] for name in before) > 1 - 1e-6


def test_a_floor_counts_in_the_limit() -> None:
    """Near the start a larger one costs nothing: the threshold is the larger one of both parts."""
    loop = scalar(times=SCHEDULE, floor=0.02)
    higher = loop._replace(rule=loop.rule._replace(floor=number(0.03)))
    before, after = (sizes(by_gains(each)[1], from_start=False) for each in (loop, higher))
    assert after["x"] == pytest.approx(1.5 * before["x"], rel=1e-3)


def test_two_parts_of_a_threshold_do_not_add_up() -> None:
    """Without losses and delays ‖e_s‖ ≤ max(0.1 e^{−rt}, 0.04)."""
    found = {bound.output: bound for bound in by_gains(scalar(0, floor=0.04))[1].bounds if bound.from_start}
    assert float(found["e_s"].decaying) == pytest.approx(0.06, rel=1e-3)
    assert float(found["e_s"].constant) == pytest.approx(0.04, rel=1e-3)


def test_no_input_at_first_counts_once() -> None:
    """What acts before the first input, p = −Kx, drives an error for as long, however long a period is."""
    loop = scalar(2, SCHEDULE)._replace(start=100 * identity(1))
    loop = changed(loop, period=fmpq(1, 10), least_period=fmpq(1, 10))._replace(
        rule=loop.rule._replace(positive=zeros(0, 2), level=arb(0))
    )
    assert sizes(by_gains(loop)[1])["e_c"] < 25  # it would drive errors to 2 · 100 · 0.32 s within Mh + d
