"""Two network namespaces, whose monotonic clocks differ, bound their offset over a veth link."""

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest

from benchmarks.hosts import MAIN, measured
from benchmarks.programs import TwoHosts, two_hosts
from benchmarks.report import MeasurementError

DELAY_US = 5000


@pytest.fixture(scope="module")
def hosts() -> Iterator[TwoHosts]:
    if sys.platform != "linux" or os.geteuid() != 0:
        pytest.skip("only root can make namespaces")
    try:
        with two_hosts() as made:
            yield made
    except MeasurementError as error:
        pytest.skip(f"no namespaces here: {error}")


@pytest.fixture
def delayed(hosts: TwoHosts) -> Iterator[TwoHosts]:
    """Delay what the client sends."""
    command = ["tc", "qdisc", "{}", "dev", "line", "root", "netem", "delay", f"{DELAY_US}us"]
    add, remove = (
        hosts.inside(1, *(part.format(verb) for part in command)) for verb in ("add", "del")
    )
    try:
        subprocess.run(add, capture_output=True, text=True, check=True, timeout=60)
    except subprocess.CalledProcessError as error:
        pytest.skip(f"no delay by tc netem here: {error.stderr.strip()}")
    yield hosts
    subprocess.run(remove, check=True, timeout=60)


@pytest.mark.parametrize("ip", [4, 6])
@pytest.mark.parametrize(("ahead_s", "drift_ppb"), [(1, 100_000), (-1, -100_000), (7200, 0)])
def test_the_true_offset_is_in_the_bound(
    hosts: TwoHosts, ip: int, ahead_s: int, drift_ppb: int
) -> None:
    found = measured(hosts, ahead_s, drift_ppb, MAIN, seconds=1.0, realtime=False, ip=ip)
    assert found["checks"] > 0
    assert found["outside"] == found["restarts"] == 0


def test_a_wrong_offset_is_not_in_the_bound(hosts: TwoHosts) -> None:
    """The check can fail: a drift beyond the assumed rate, of which the checks know nothing."""
    wrong = MAIN._replace(settings={"rate_ppb": 0})
    found = measured(hosts, 1, 10**8, wrong, seconds=1.0, realtime=False)
    assert found["restarts"] > 0
    assert found["outside"] > 0


def test_a_delay_in_one_direction_widens_the_bound(delayed: TwoHosts) -> None:
    found = measured(delayed, 1, 100_000, MAIN, seconds=1.0, realtime=False)
    assert found["outside"] == found["restarts"] == 0
    assert found["error_p50_us"] >= DELAY_US / 2
