"""The time that processes get to start grows with the load."""

import pytest

from cosim.live.wait_limit import WaitLimit


def reached_after_s(limit: WaitLimit, load: float) -> float:
    while not limit.is_reached:
        limit.wait(0.125, load)
    return limit.waited_s


@pytest.mark.parametrize(
    ("load", "times", "reason"),
    [
        (0.4, 1, "waited 30 s (start_within_s); a load of 0.4 on 2 cores is not the likely cause"),
        (2.0, 1, "a load of 2.0 on 2 cores is not the likely cause"),
        (4.0, 2, "likely cause: a load of 4.0 on 2 cores; start fewer runs at once"),
        (1e6, 20, "waited 600 s; likely cause: a load of 1000000.0 on 2 cores; start fewer runs"),
    ],
)
def test_the_time_to_start_grows_with_the_load(load: float, times: int, reason: str) -> None:
    limit = WaitLimit(30.0, 2)
    assert reached_after_s(limit, load) == pytest.approx(30.0 * times, abs=0.25)
    assert reason in limit.explain_start(["plant"])
