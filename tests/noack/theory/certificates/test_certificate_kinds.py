"""Certificates of random loops: no bound is exceeded, and those of broken copies are."""

from functools import cache, reduce

import pytest

from tests.noack.theory.certificates.certificate_kinds import Tally
from tests.noack.theory.certificates.certificate_kinds.comparison import KINDS, examine

MOST = 60
LOOPS = dict.fromkeys(KINDS, 1) | {"decaying": 2, "continuous time": 2, "self_triggered": 2}
"""Of each kind; `python -m tests.noack.theory.certificates.certificate_kinds` tries thousands."""
BROKEN = [(name, next(iter(kind.broken))) for name, kind in KINDS.items() if kind.broken]
"""One of each kind; `python -m tests.noack.theory.certificates.certificate_kinds` tries all."""


@cache
def examined(name: str, seed: int) -> Tally:
    """The comparison of one loop with its true certificate."""
    return examine(KINDS[name], range(seed, seed + 1))


@pytest.mark.parametrize("name", KINDS)
def test_no_bound_of_a_random_loop_is_exceeded(name: str) -> None:
    tally = reduce(Tally.plus, (examined(name, seed) for seed in range(LOOPS[name])))
    assert tally.runs > 1
    assert tally.violated[""] == 0
    assert max(tally.closest.values()) > 0


@pytest.mark.parametrize(("name", "mistake"), BROKEN)
def test_a_broken_copy_of_each_kind_is_detected(name: str, mistake: str) -> None:
    """Within 60 loops in which the mistake matters; true certificates stand in the same loop."""
    kind = KINDS[name]
    broken = kind.broken[mistake]
    for seed in range(MOST):
        if examine(kind, range(seed, seed + 1), broken).violated[""]:
            true = broken._replace(certify=kind.certify)
            tally = examine(kind, range(seed, seed + 1), true) if broken.draw else examined(name, seed)
            assert tally.violated[""] == 0
            return
    pytest.fail("no run exceeds it")


@pytest.mark.parametrize("seed", [6000, 6007])
def test_the_first_event_of_an_integral_needs_no_large_error(seed: int) -> None:
    """In these loops the integral reaches δ long before e_s reaches δ divided by the sampling period.

    Certificates that took the latter for granted had events too close, and a bound of e_c too small.
    """
    assert examined("send_on_area", seed).violated[""] == 0
