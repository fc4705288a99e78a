"""The time to start and to end grows with the load, and the message says what was measured."""

import math

import pytest

from cosim.live.launcher import WaitLimit


def reached_after_s(limit: WaitLimit, load: float, step_s: float = 0.125) -> float:
    while not limit.is_reached:
        limit.wait(step_s, load)
    return limit.waited_s


@pytest.mark.parametrize(
    ("load", "times"), [(0.0, 1), (1.9, 1), (2.0, 1), (4.0, 2), (20.0, 10), (40.0, 20), (1e6, 20)]
)
def test_a_limit_grows_with_the_load(load: float, times: int) -> None:
    assert reached_after_s(WaitLimit(30.0, 2), load) == pytest.approx(30.0 * times, abs=0.25)


def test_only_the_current_load_extends_the_limit() -> None:
    limit = WaitLimit(30.0, 2)
    limit.wait(60.0, 6.0)
    assert not limit.is_reached
    assert reached_after_s(limit, 0.0) == pytest.approx(60.0 + 10.0, abs=0.25)


def test_an_infinite_limit_is_never_reached() -> None:
    limit = WaitLimit(math.inf, 1)
    limit.wait(1e9, 0.0)
    assert not limit.is_reached


def test_a_load_is_named_as_the_likely_cause_with_the_remedies() -> None:
    limit = WaitLimit(30.0, 2)
    reached_after_s(limit, 68.3)
    assert limit.explain_start() == (
        "not ready in time: waited 600 s; likely cause: a load of 68.3 on 2 cores; "
        "start fewer runs at once, or set start_within_s above 30"
    )


@pytest.mark.parametrize("load", [0.4, 2.2])
def test_a_low_load_is_not_named_as_the_cause(load: float) -> None:
    limit = WaitLimit(30.0, 2)
    waited_s = reached_after_s(limit, load)
    assert limit.explain_start() == (
        f"not ready in time: waited {waited_s:.0f} s (start_within_s); "
        f"a load of {load} on 2 cores is not the likely cause"
    )
