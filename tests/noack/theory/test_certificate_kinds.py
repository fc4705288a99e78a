"""Certificates of random loops: no bound is exceeded, and those of each broken copy are."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.noack.theory.certificate_kinds.comparison import KINDS, examine
from tests.oracles.lossy_loops import (
    SEARCH,
    System,
    assert_not_smaller,
    certified_or_skipped,
    systems,
)

FEW, MOST = 6, 60
LOOPS = dict.fromkeys(KINDS, FEW) | {"decaying": 40, "continuous time": 20}
BROKEN = [(name, mistake) for name, kind in KINDS.items() for mistake in kind.broken]


@pytest.mark.parametrize("name", KINDS)
def test_no_bound_of_a_random_loop_is_exceeded(name: str) -> None:
    tally = examine(KINDS[name], range(LOOPS[name]))
    assert tally.runs >= FEW
    assert tally.violated[""] == 0
    assert max(tally.closest.values()) > 0


@pytest.mark.parametrize(("name", "mistake"), BROKEN)
def test_each_broken_copy_is_detected(name: str, mistake: str) -> None:
    """Within 60 loops in which the mistake matters; true certificates stand in the same loop."""
    kind = KINDS[name]
    broken = kind.broken[mistake]
    for seed in range(MOST):
        if examine(kind, range(seed, seed + 1), broken).violated[""]:
            true = broken._replace(certify=kind.certify)
            assert examine(kind, range(seed, seed + 1), true).violated[""] == 0
            return
    pytest.fail("no run exceeds it")


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
