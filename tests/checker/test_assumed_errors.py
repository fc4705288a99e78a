"""Witnesses with an assumed size of the sensor's error, between tests and while updates are on their way."""

import numpy as np
import pytest
from flint import arb, fmpq

from noack.core.balls import identity, number
from noack.proof.elaborate.errors import RejectedError
from noack.proof.elaborate.hybrid_system import Errors, Model
from noack.proof.statement_proof import prove_statement
from tests.checker.completed import completed
from tests.checker.loops import bounds_of, changed, double_integrator
from tests.checker.proofs import Proved, proved
from tests.checker.runs import exceeded, floats

HELD = ("holds", "holding", "holding_decaying")
"""Loops that hold their input; the first one under a schedule."""


@pytest.fixture(scope="module", params=["holds", "until_due"])
def found(request: pytest.FixtureRequest) -> Proved:
    return proved(request.param)


def test_runs_under_the_schedule_stay_below_the_bounds(found: Proved) -> None:
    assert 1.0 <= bounds_of(found.proof)["x"] < 1.8
    for seed in range(6):
        assert not exceeded(found.loop, found.proof, np.random.default_rng(seed), 4.0)


@pytest.mark.parametrize("share", [0.5, 0.97])
def test_errors_below_those_that_are_proven_are_rejected(found: Proved, share: float) -> None:
    """Between two tests We may grow beyond them, so that they are no fact."""
    errors = {name: share * size for name, size in found.document["errors"].items()}
    with pytest.raises(RejectedError, match="the fact 'bound of e' does not hold here"):
        prove_statement(found.loop, {**found.document, "errors": errors})


@pytest.mark.parametrize("share", [0.5, 0.99])
@pytest.mark.parametrize("name", ["holding", "holding_decaying"])
def test_errors_below_the_threshold_are_rejected(name: str, share: float) -> None:
    """With tests at all times We is up to the threshold, and w changes by it at an event."""
    held = proved(name)
    errors = {name: share * size for name, size in held.document["errors"].items()}
    with pytest.raises(RejectedError, match="bound of w: not proven at edge/0 lost, lost"):
        prove_statement(held.loop, {**held.document, "errors": errors})


@pytest.mark.parametrize("name", HELD)
def test_larger_errors_are_not_covered_by_the_same_forms(name: str) -> None:
    held = proved(name)
    larger = {name: 1.5 * size for name, size in held.document["errors"].items()}
    with pytest.raises(RejectedError, match="all states: not proven at motion/1 lost/"):
        prove_statement(held.loop, {**held.document, "errors": larger})


@pytest.mark.parametrize("change", ["slower tests", "later updates", "more losses", "another plant"])
def test_a_witness_proves_nothing_about_another_loop(found: Proved, change: str) -> None:
    loop, times = found.loop, found.loop.times
    other = {
        "slower tests": changed(loop, sampling=3 * times.sampling, least_sampling=3 * times.sampling),
        "later updates": changed(loop, delay=times.delay + fmpq(1, 50)),
        "more losses": loop._replace(losses=loop.losses + 2),
        "another plant": loop._replace(B=2 * loop.B),
    }[change]
    reason = {
        "slower tests": "the fact 'bound of e' does not hold here",
        "later updates": "the fact 'bound of e' does not hold here|^more events than 0 may happen",
        "more losses": "not proven at (motion/3 lost/|edge/2 lost, lost/)",
        "another plant": "all states: not proven at motion/0 lost/",
    }[change]
    with pytest.raises(RejectedError, match=reason):
        prove_statement(other, completed(other, found.document, whole=True))


def test_facts_about_errors_bound_those_of_each_location() -> None:
    """With a held input w is the sum of as many errors as updates are missing."""
    loop = double_integrator()._replace(holds=True)
    model = Model(loop, arb(0), number(1.0), Errors(arb(0), number(0.5)), later=1)
    sizes = {}
    for place in model.locations:
        E = floats(identity(model.size))
        size = {"e": [], "w": []}  # type: dict[str, list[float]]
        for fact in map(floats, place.facts):
            name = "e" if fact[2, 2] else "w"
            assert np.allclose(fact, fact.T)
            assert np.allclose(np.diag(fact)[: len(E) - 2].sum(), loop.n)
            size[name].append(np.sqrt(-fact[-1, -1]) / 0.5)
        sizes[place.name] = size
    assert sizes == {
        "0 lost": {"e": [1.0], "w": []},
        "1 lost": {"e": [1.0], "w": [1.0]},
        "2 lost": {"e": [1.0], "w": [2.0]},
        "0 later": {"e": [1.0], "w": [3.0]},
        "1 later": {"e": [1.0], "w": [4.0]},
        "start, 0 later": {"e": [], "w": []},
    }


def test_a_loop_that_does_not_hold_its_input_has_no_fact_about_what_the_input_lacks() -> None:
    """There w moves, and no rule bounds it."""
    model = Model(double_integrator(), number(0.3), number(1.0), Errors(number(0.5), arb(0)), later=1)
    facts = [floats(fact) for place in model.locations for fact in place.facts]
    assert facts
    assert all(fact[2, 2] for fact in facts)
