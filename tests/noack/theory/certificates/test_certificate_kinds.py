"""Certificates of random loops: no bound is exceeded, and those of broken copies are."""

from dataclasses import replace
from functools import cache, reduce

import numpy as np
import pytest

from noack.theory.bounds.certificate_terms import NetworkConditions
from tests.noack.theory.certificates.certificate_kinds import Tally
from tests.noack.theory.certificates.certificate_kinds.comparison import KINDS, examine
from tests.noack.theory.certificates.certificate_kinds.continuous import CONTINUOUS, constants_of
from tests.noack.theory.certificates.certificate_kinds.decaying import dominated_by_errors
from tests.noack.theory.certificates.certified_loops import certify_loop

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


def test_the_flow_makes_the_bounds_much_smaller_and_runs_come_close_to_them() -> None:
    system, conditions = dominated_by_errors(None, far=True), NetworkConditions(3)
    sharp = certify_loop(system, conditions)
    plain = certify_loop(system, conditions, structured=False)
    assert sharp.state < 0.6 * plain.state
    assert sharp.mismatch < 0.6 * plain.mismatch
    assert (sharp.inter_event_s or 0.0) > 1.3 * (plain.inter_event_s or 0.0)
    worst = CONTINUOUS.simulate(system, np.random.default_rng(1)).worst
    bounds = constants_of(sharp, system.beta)
    assert {name for name, bound in bounds.items() if worst[name] < 0.6 * bound} == set()


def test_the_flow_between_updates_makes_the_bounds_of_a_schedule_smaller() -> None:
    system = dominated_by_errors(None, far=True)
    system = replace(system, step_s=0.004, delay_steps=1, hold_steps=1)
    sharp, plain = certify_loop(system), certify_loop(system, structured=False)
    assert sharp.state < 0.6 * plain.state
    assert sharp.delta < plain.delta
    assert (sharp.inter_event_s or 0.0) >= (plain.inter_event_s or 1.0)
