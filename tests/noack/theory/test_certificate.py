"""Tries to break the certificates: no bound is exceeded by random loops and worst-case networks.

The same check must detect each broken copy of the certificates.
"""

import pytest
from hypothesis import find, given, settings
from hypothesis import strategies as st

from noack.theory.bounds.terms import NoCertificateError
from tests.noack.theory.broken_certificates import MUTANTS
from tests.noack.theory.loops import (
    SEARCH,
    System,
    assert_not_smaller,
    certified_or_skipped,
    networks,
    seeds,
    simulate,
    systems,
)


@settings(SEARCH, max_examples=80)
@given(systems(), seeds)
def test_no_certified_bound_is_ever_exceeded(system: System, seed: int) -> None:
    """80 loops with 128 runs each: more than 10,000 runs."""
    certified = certified_or_skipped(system)
    assert simulate(system, *networks(seed, system)).exceeded(system, certified) == []


@pytest.mark.parametrize("harder", ["dropouts", "sampling_s", "delay_s", "hold_s", "start_s"])
@settings(SEARCH, max_examples=2)
@given(systems(), st.floats(0.05, 2.0))
def test_harder_conditions_never_have_smaller_bounds(
    harder: str, system: System, share: float
) -> None:
    easy = system.conditions
    more = 1 if harder == "dropouts" else share * system.step_s
    hard = easy._replace(**{harder: getattr(easy, harder) + more})
    assert_not_smaller(certified_or_skipped(system, hard), system.certify(easy), system)


@pytest.mark.parametrize("mutant", MUTANTS)
def test_runs_exceed_a_broken_certificate_and_not_the_true_one(mutant: str) -> None:
    """In loops in which one effect dominates."""
    broken, where = MUTANTS[mutant]

    def is_caught(case: tuple[System, int]) -> bool:
        system, seed = case
        trace = simulate(system, *networks(seed, system))
        try:
            caught = trace.exceeded(system, broken(system)) != []
            assert not caught or trace.exceeded(system, system.certify()) == []
        except NoCertificateError:
            return False
        return caught

    find(
        st.tuples(systems(**where), seeds),
        is_caught,
        settings=settings(SEARCH, max_examples=100, database=None),
    )
