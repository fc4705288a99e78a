"""What witnesses prove of some loops, and that they prove nothing about others."""

import copy
import math
from collections.abc import Callable

import numpy as np
import pytest
from flint import arb, fmpq

from noack.proof.statement_proof import prove_statement
from noack_check.balls import is_zero, matrix, number
from noack_check.check import RejectedError
from noack_check.loop import Loop, Times
from noack_check.sentences import assumptions
from tests.checker.completed import completed
from tests.checker.loops import IDEAL, SCHEDULE, bounds_of, changed, double_integrator, holding, relative
from tests.checker.proofs import Proved, proved
from tests.checker.runs import exceeded


@pytest.fixture(scope="module")
def witness() -> Proved:
    return proved("double_integrator")


def test_bounds_are_near_what_is_simulated(witness: Proved) -> None:
    sizes = bounds_of(witness.proof)
    assert 1.0 <= sizes["x"] < 1.5  # it begins at 1
    assert 0.05 <= sizes["e_s"] < 0.06  # the threshold is 0.05
    assert sizes["e_s"] < sizes["e_c"] < 0.4
    assert witness.proof.inter_event is not None
    assert 0.02 <= float(witness.proof.inter_event) < 0.2


@pytest.mark.parametrize(("name", "floor"), [("ideal", 0.0), ("ideal_floor", 0.01)])
def test_ideal_conditions_give_smaller_bounds(witness: Proved, name: str, floor: float) -> None:
    ideal = bounds_of(proved(name).proof)
    assert ideal["e_s"] <= math.hypot(0.05, floor) * (1 + 1e-6)
    assert ideal["x"] < bounds_of(witness.proof)["x"] + floor


CHANGES: dict[str, tuple[Callable[[Loop], Loop], str]] = {
    "one loss more": (lambda loop: loop._replace(losses=loop.losses + 1), "^x: edge/2 lost, lost/"),
    "another plant": (lambda loop: loop._replace(B=loop.B * 1.02), "^x: flow/1 lost/"),
    "a plant that may be another": (
        lambda loop: loop._replace(half_B=matrix([[0.0], [0.02]])), "^x: flow/0 lost/",
    ),
    "another gain": (lambda loop: loop._replace(gain=loop.gain * 1.05), "^x: flow/1 lost/"),
    "another model": (lambda loop: loop._replace(model_B=loop.model_B * 1.05), "^x: flow/0 lost/"),
    "larger start": (lambda loop: loop._replace(start=loop.start * 1.01), "^x: start$"),
    "rarer tests": (
        lambda loop: loop._replace(times=loop.times._replace(sampling=fmpq(1, 50))), "^x: flow/0 lost/1/",
    ),
    "longer delays": (
        lambda loop: loop._replace(times=loop.times._replace(delay=fmpq(1, 10))), "^x: flow/0 later/",
    ),
    "older inputs": (
        lambda loop: loop._replace(times=loop.times._replace(age=fmpq(1, 20))), "^x: flow/1 lost/",
    ),
    "later start": (
        lambda loop: loop._replace(times=loop.times._replace(start=fmpq(1, 10))), "^x: flow/start, ",
    ),
    "larger threshold": (
        lambda loop: loop._replace(rule=loop.rule._replace(level=loop.rule.level * 1.05)), "^x: flow/0 lost/",
    ),
    "slower threshold": (
        lambda loop: loop._replace(rule=loop.rule._replace(rate=arb(0.2))),
        "^rate: not between 0 and that of the threshold",
    ),
    "a floor": (
        lambda loop: loop._replace(rule=loop.rule._replace(floor=arb(0.001))), "^x: flow/0 lost/",
    ),
    "a disturbance": (
        lambda loop: loop._replace(pushes=matrix([[0.0], [1.0]]), sizes=(arb(0.01),)), "^x: flow/0 lost/",
    ),
    "events at any time": (
        lambda loop: loop._replace(rule=loop.rule._replace(always=True)), "^x: edge/0 later, all lost/",
    ),
}  # fmt: skip
"""Other loops, and the reason for which a witness is rejected, all entries of which are there."""


@pytest.mark.parametrize("change", CHANGES)
def test_a_witness_proves_nothing_about_another_loop(witness: Proved, change: str) -> None:
    apply, reason = CHANGES[change]
    loop = apply(double_integrator())
    has_signals = loop.sizes or not is_zero(loop.half_B)
    for signal in (0.0, 1e-6, 1e-3, 1.0) if has_signals else (0.0,):
        document = (
            witness.document if reason.startswith("^rate") else completed(loop, witness.document, signal)
        )
        with pytest.raises(RejectedError, match=reason):
            prove_statement(loop, document)


def test_no_number_of_a_witness_may_be_missing_or_negative(witness: Proved) -> None:
    for index, entry in enumerate(witness.document["bounds"]):
        for table in ("numbers", "matrices"):
            for name in list(entry[table])[::6]:
                document = copy.deepcopy(witness.document)
                del document["bounds"][index][table][name]
                with pytest.raises(RejectedError, match="missing"):
                    prove_statement(double_integrator(), document)


def test_a_loop_that_holds_updates_has_bounds_by_the_chain() -> None:
    sizes = bounds_of(proved("holding_decaying").proof)
    assert 1.0 <= sizes["x"] < 1.2
    assert sizes["e_c"] == pytest.approx(3 * 0.05)


def test_at_rate_0_the_bounds_are_those_of_the_largest_threshold() -> None:
    witness = proved("holding")
    assert not witness.proof.rate > 0
    with pytest.raises(RejectedError, match=r"^x: flow/0 lost/"):
        prove_statement(holding(level=0.05), completed(holding(level=0.05), witness.document))


@pytest.mark.parametrize("sigma", [0.02, 0.2])
def test_a_relative_rule_has_decaying_bounds(sigma: float) -> None:
    witness = proved(f"relative_{sigma}")
    sizes = bounds_of(witness.proof)
    assert witness.proof.rate > 0
    assert 1.0 <= sizes["x"] < 1.25
    assert sizes["e_s"] < 1.25 * sigma
    assert sizes["e_c"] < 6 * sigma
    with pytest.raises(RejectedError, match=r"^x: flow/0 lost/"):
        prove_statement(relative(1.05 * sigma), witness.document)


def test_without_a_bound_of_the_drift_tests_say_how_many_events_come_while_an_update_is_on_its_way() -> None:
    witness = proved("relative_tested")
    later = changed(witness.loop, least_sampling=fmpq(1, 200))
    with pytest.raises(RejectedError, match="later: more events"):
        prove_statement(later, witness.document)


def test_in_the_limit_bounds_are_those_of_disturbances_and_the_floor() -> None:
    whole, ultimate, rate, *_ = proved("in_the_limit").proof.bounds
    assert (whole.from_start, ultimate.from_start, rate.from_start) == (True, False, False)
    assert 0.1 < float(ultimate.constant.mid()) < 0.7
    assert ultimate.constant <= whole.constant
    assert rate.constant < ultimate.constant


def test_an_output_is_bounded_more_tightly_than_by_the_norm_of_the_state() -> None:
    """The state turns: where both entries have opposite signs their sum is small."""
    witness = proved("outputs")
    loop = witness.loop
    sizes = bounds_of(witness.proof)
    assert sizes["y[0]"] < 0.9 * math.sqrt(2) * sizes["x"]
    assert sizes["y[1]"] < 0.9 * 3 * sizes["x"]
    rng = np.random.default_rng(5)
    assert not [miss for _ in range(3) for miss in exceeded(loop, witness.proof, rng, 8.0)]
    entry = next(e for e in witness.document["bounds"] if e["output"] == "y[1]")
    with pytest.raises(RejectedError, match=r"y\[2\]"):
        prove_statement(loop, {**witness.document, "bounds": [{**entry, "output": "y[2]"}]})
    larger = loop._replace(outputs=matrix([[1.0, 1.0], [0.0, 3.1]]))
    with pytest.raises(RejectedError, match=r"y\[1\]"):
        prove_statement(larger, witness.document)


def test_what_is_assumed_of_events_without_a_least_time_is_said() -> None:
    """A relative rule that is tested at all times has no threshold that keeps two events apart."""
    assert assumptions({}, relative(0.1)).endswith(", as long as events do not accumulate")
    tested = relative(0.1)._replace(times=SCHEDULE)
    held = relative(0.1)._replace(times=IDEAL._replace(dwell=fmpq(1, 10)))
    for loop in (tested, held, double_integrator(IDEAL), double_integrator(IDEAL, level=0.0, floor=0.1)):
        assert "accumulate" not in assumptions({}, loop)


@pytest.mark.parametrize(
    ("level", "floor", "rate", "times", "is_said"),
    [
        (0.05, 0.0, 0.3, IDEAL, True),  # the threshold falls below what two noises add up to
        (0.05, 0.019, 0.3, IDEAL, True),
        (0.05, 0.021, 0.3, IDEAL, False),
        (0.05, 0.0, 0.0, IDEAL, False),
        (0.05, 0.0, 0.3, SCHEDULE, False),
    ],
)
def test_noise_alone_may_make_events_accumulate(
    level: float, floor: float, rate: float, times: Times, is_said: bool
) -> None:
    """Of noises of 0.01 two differ by 0.02: at all times the second one may be an event."""
    loop = double_integrator(times, level=level, floor=floor)
    loop = loop._replace(noise=matrix([[0.01], [0.0]]), rule=loop.rule._replace(rate=number(rate)))
    assert ("accumulate" in assumptions({}, loop)) == is_said
