"""Clocks of a run, and the name of a host's monotonic clock."""

import os
import subprocess
import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from noack.core import clock as host_clock
from noack.core.clock import (
    ClockOffset,
    Exchange,
    RunClock,
    SlewedClock,
    SlewedRunClock,
    clock_identity,
)
from noack.core.core_library import core, ffi

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


def in_core(clock: RunClock) -> Any:
    """Return the clock in the core."""
    made = ffi.new("noack_clock *")
    clock.set_core(made)
    return made


@given(speeds, st.integers(0, 10**12), st.integers(0, 10**13))
def test_the_computed_wait_ends_at_the_deadline(speed: float, wall_ns: int, t_ns: int) -> None:
    now_ns = clock_at(speed, wall_ns).now_ns()
    wait_ns = core.noack_clock_wait_ns(in_core(clock_at(speed, wall_ns)), t_ns - now_ns)
    assert (wait_ns > 0) == (t_ns > now_ns) or 0 <= t_ns - now_ns <= speed
    if wait_ns > 0:
        # Within a nanosecond of wall time plus the rounding of times of up to 10¹⁵ ns.
        assert abs(clock_at(speed, wall_ns + wait_ns).now_ns() - t_ns) <= 2 + 2 * speed


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan")])
def test_a_speed_that_is_not_positive_is_refused(speed: float) -> None:
    with pytest.raises(ValueError, match="speed must be positive"):
        RunClock(EPOCH_NS, speed)


slews = st.integers(1_300_000, 10**9 - 1)


def slewed_clock(begin_ns: int, offset_ns: int, target_ns: int, slew_ppb: int) -> SlewedClock:
    """A clock that has one offset and moves to another one."""
    offset = ClockOffset()
    offset.add(Exchange(begin_ns, begin_ns + offset_ns, begin_ns + offset_ns, begin_ns))
    clock = SlewedClock(offset, begin_ns, slew_ppb)
    sent_ns = begin_ns + 10**9
    offset.add(Exchange(sent_ns, sent_ns + target_ns, sent_ns + target_ns, sent_ns))
    clock.follow(sent_ns)
    return clock


@given(speeds, st.integers(0, 10**12), st.integers(0, 10**13), slews, st.booleans())
def test_a_wait_on_a_slewed_clock_is_never_too_long(
    speed: float, wall_ns: int, wanted_ns: int, slew_ppb: int, ahead: bool
) -> None:
    slewed = slewed_clock(wall_ns, 0, 10**13 if ahead else -(10**13), slew_ppb)
    readings = [wall_ns + 10**9]
    clock = SlewedRunClock(slewed.now_ns(readings[0]), speed, slewed, lambda: readings[-1])
    wait_ns = core.noack_clock_wait_ns(in_core(clock), wanted_ns)
    assert wait_ns <= wanted_ns / speed
    readings.append(readings[0] + wait_ns)
    # The rounding of times of up to 10¹⁵ ns, as above.
    assert clock.now_ns() <= wanted_ns + 2 + 2 * speed


@given(
    speeds, st.integers(0, 10**12), st.integers(-(10**14), 10**14), st.integers(-(10**9), 10**9),
    slews, st.lists(st.integers(0, 10**15), min_size=1, max_size=9),
)  # fmt: skip
def test_the_core_reads_the_same_clocks(
    speed: float, begin_ns: int, offset_ns: int, jump_ns: int, slew_ppb: int, waits: list[int]
) -> None:
    slewed = slewed_clock(begin_ns, offset_ns, offset_ns + jump_ns, slew_ppb)
    readings = [begin_ns + 10**9]
    own: RunClock = RunClock(begin_ns, speed, lambda: readings[-1])
    other: RunClock = SlewedRunClock(begin_ns + offset_ns, speed, slewed, lambda: readings[-1])
    for clock in (own, other):
        other_clock, found = in_core(clock), []
        for wait_ns in sorted(waits):
            readings.append(readings[0] + wait_ns)
            found.append(core.noack_clock_at_ns(other_clock, readings[-1]))
            assert found[-1] == clock.now_ns()
        assert found == sorted(found)


_PRINT = "from noack.core.clock import clock_identity; print(clock_identity())"


def _elsewhere(*before: str) -> str:
    command = [*before, sys.executable, "-c", _PRINT]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def test_processes_of_a_machine_share_a_clock() -> None:
    assert clock_identity() == _elsewhere()


@pytest.mark.skipif(sys.platform != "linux" or os.geteuid() != 0, reason="needs root")
def test_another_time_namespace_is_another_clock() -> None:
    try:
        other = _elsewhere("unshare", "--time", "--monotonic=1", "--fork")
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no time namespaces here")
    assert other != clock_identity()


def test_another_boot_is_another_clock(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = clock_identity()
    (tmp_path / "boot_id").write_text("another\n")
    monkeypatch.setattr(host_clock, "_BOOT", tmp_path / "boot_id")
    assert clock_identity() != found


def test_a_system_without_boot_id_has_a_number(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(host_clock, "_BOOT", tmp_path / "absent")
    assert clock_identity() == clock_identity()
    assert clock_identity().startswith("machine ")
