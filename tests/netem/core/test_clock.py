"""The clock of a run, and a host's clock by name."""

import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem.core import clock as host_clock
from netem.core.clock import RunClock, clock_identity

EPOCH_NS = 123_456_789_012_345
speeds = st.sampled_from([0.01, 0.5, 1.0, 2.0, 3.0, 10.0, 1000.0])


def clock_at(speed: float, wall_ns: int) -> RunClock:
    """A clock with this reading of the wall clock since the epoch."""
    return RunClock(EPOCH_NS, speed, lambda: EPOCH_NS + wall_ns)


@given(speeds, st.integers(-(10**12), 10**15))
def test_simulated_time_is_wall_time_times_speed(speed: float, wall_ns: int) -> None:
    exact = Fraction(speed) * wall_ns
    # Rounded down to a nanosecond, after one product with a relative error of 2⁻⁵³.
    error_ns = abs(clock_at(speed, wall_ns).now_ns() - exact)
    assert error_ns <= 1 + abs(exact) / 2**53
    assert error_ns == 0 or speed != 1.0


_PRINT = "from netem.core.clock import clock_identity; print(clock_identity())"


def _elsewhere(*before: str) -> str:
    command = [*before, sys.executable, "-c", _PRINT]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def test_processes_of_a_machine_share_a_clock_also_without_a_boot_id(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert clock_identity() == _elsewhere()
    monkeypatch.setattr(host_clock, "_BOOT", tmp_path / "absent")
    assert clock_identity().startswith("machine ")
