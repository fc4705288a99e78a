"""What witnesses prove of some loops, and that they prove nothing about others."""

import contextlib
import copy
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
from flint import arb, fmpq

from noack.core.balls import is_zero, matrix
from noack.proof.elaborate.errors import RejectedError
from noack.proof.elaborate.loop import Loop
from noack.proof.statement_proof import prove_by_forms, prove_statement
from tests.checker.completed import completed
from tests.checker.loops import bounds_of, changed, double_integrator, holding, relative, with_rule
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
    "one loss more": (lambda loop: loop._replace(losses=loop.losses + 1), "at edge/2 lost, lost/"),
    "another plant": (lambda loop: loop._replace(B=loop.B * 1.02), "at motion/1 lost/"),
    "a plant that may be another": (
        lambda loop: loop._replace(half_B=matrix([[0.0], [0.02]])), "at motion/0 lost/",
    ),
    "another gain": (lambda loop: loop._replace(gain=loop.gain * 1.05), "at motion/1 lost/"),
    "another model": (lambda loop: loop._replace(model_B=loop.model_B * 1.05), "at motion/0 lost/"),
    "larger start": (lambda loop: loop._replace(start=loop.start * 1.01), "at start$"),
    "rarer tests": (
        lambda loop: loop._replace(times=loop.times._replace(sampling=fmpq(1, 50))), "at motion/0 lost/1$",
    ),
    "longer delays": (
        lambda loop: loop._replace(times=loop.times._replace(delay=fmpq(1, 10))), "at motion/0 later/",
    ),
    "older inputs": (
        lambda loop: loop._replace(times=loop.times._replace(age=fmpq(1, 20))), "at motion/1 lost/",
    ),
    "later start": (
        lambda loop: loop._replace(times=loop.times._replace(start=fmpq(1, 10))), "at motion/start, ",
    ),
    "larger threshold": (
        lambda loop: with_rule(loop, level=loop.rule.level * 1.05), "at motion/0 lost/",
    ),
    "slower threshold": (
        lambda loop: loop._replace(rule=loop.rule._replace(rate=arb(0.2))),
        "^rate: not between 0 and that of the threshold",
    ),
    "a floor": (
        lambda loop: loop._replace(rule=loop.rule._replace(floor=arb(0.001))), "at motion/0 lost/",
    ),
    "a disturbance": (
        lambda loop: loop._replace(pushes=matrix([[0.0], [1.0]]), sizes=(arb(0.01),)), "at motion/0 lost/",
    ),
    "events at any time": (
        lambda loop: loop._replace(rule=loop.rule._replace(always=True)),
        "^more events than 0 may happen in '0 later'",
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


def test_without_a_matrix_or_a_number_no_more_is_proven(witness: Proved) -> None:
    """A number that is missing is 0, and a few multipliers may be 0."""
    proof = prove_by_forms(double_integrator(), witness.document)
    for index, entry in enumerate(witness.document["bounds"]):
        for table in ("numbers", "matrices"):
            for name in list(entry[table])[::6]:
                document = copy.deepcopy(witness.document)
                del document["bounds"][index][table][name]
                if name.startswith("m/") and is_proven(document):
                    assert bounds_of(prove_by_forms(double_integrator(), document)) == bounds_of(proof)
                else:
                    with pytest.raises(RejectedError, match=r"not proven at|unknown matrix"):
                        prove_by_forms(double_integrator(), document)


def is_proven(document: Mapping[str, Any]) -> bool:
    """Return whether a document is a proof about the double integrator."""
    with contextlib.suppress(RejectedError):
        prove_by_forms(double_integrator(), document)
        return True
    return False


def test_all_events_that_need_no_comparison_are_in_the_document(witness: Proved) -> None:
    """There may be one at the test after 10 ms: while an update is on its way, and before the first input."""
    loop = with_rule(double_integrator(), always=True)
    for counts, reason in {
        (0, 1): "^more events than 0 may happen in '0 later'",
        (1, 0): "^more events than 0 may happen in 'start, 0 later'",
        (1, 1): "at ",
    }.items():
        document = {**witness.document, **dict(zip(("later", "later_at_start"), counts, strict=True))}
        with pytest.raises(RejectedError, match=reason):
            prove_by_forms(loop, completed(loop, document))


def test_a_held_input_lacks_as_many_errors_as_updates_are_missing() -> None:
    """With two losses up to three updates are missing; each of them changed x_s by at most the threshold."""
    sizes = bounds_of(prove_by_forms(holding(level=0.05), proved("holding_decaying").document))
    assert 1.0 <= sizes["x"] < 1.2
    assert 3 * 0.05 <= sizes["e_c"] < 1.01 * 3 * 0.05


def test_at_rate_0_the_bounds_are_those_of_the_largest_threshold() -> None:
    witness = proved("holding")
    assert not witness.proof.rate > 0
    with pytest.raises(RejectedError, match=r"at motion/0 lost/"):
        prove_statement(holding(level=0.05), completed(holding(level=0.05), witness.document))


@pytest.mark.parametrize("sigma", [0.02, 0.2])
def test_a_relative_rule_has_decaying_bounds(sigma: float) -> None:
    witness = proved(f"relative_{sigma}")
    sizes = bounds_of(witness.proof)
    assert witness.proof.rate > 0
    assert 1.0 <= sizes["x"] < 1.25
    assert sizes["e_s"] < 1.25 * sigma
    assert sizes["e_c"] < 6 * sigma
    with pytest.raises(RejectedError, match=r"at motion/0 lost/"):
        prove_statement(relative(1.05 * sigma), witness.document)


def test_without_a_bound_of_the_drift_tests_say_how_many_events_come_while_an_update_is_on_its_way() -> None:
    witness = proved("relative_tested")
    later = changed(witness.loop, least_sampling=fmpq(1, 200))
    with pytest.raises(RejectedError, match=r"^more events than 0 may happen in '0 later'"):
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
    with pytest.raises(RejectedError, match="output 1: not proven at output/"):
        prove_statement(larger, witness.document)
