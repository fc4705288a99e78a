"""The clocks of several hosts: chrony's bound, the mapping of the epoch, what cannot have arrived yet."""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from netem.core.errors import MachineError
from noack.protocol.record_tables import CONTROLLER_DELIVERY, tables
from noack.runtime import host_clocks
from noack.runtime.control_messages import ClockError
from noack.runtime.host_clocks import CHRONY, STATED, CausalityCheck, chrony_error_ns, clock_error

TRACKING = (
    "50484330,PHC0,1,1709727533.139866748,-0.000004315,-0.000003372,0.000002759,1.274,-0.005,"
    "0.161,0.000000200,0.000029493,8.0,Normal"
)


@pytest.fixture
def chronyc(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The only program on the path, which may be missing."""
    monkeypatch.setenv("PATH", str(tmp_path))
    return tmp_path / "chronyc"


def answers(chronyc: Path, line: str, status: int = 0) -> None:
    chronyc.write_text(f"#!/bin/sh\n[ \"$*\" = '-c tracking' ] && echo '{line}'\nexit {status}\n")
    chronyc.chmod(0o755)


def test_the_bound_is_offset_plus_dispersion_plus_half_the_delay(chronyc: Path) -> None:
    """The formula of chronyc(1): 4.315 + 29.493 + 0.2 / 2 µs."""
    answers(chronyc, TRACKING)
    assert chrony_error_ns() == 33_908
    assert clock_error("here", 1000.0) == ClockError(clock="here", error_ns=33_908, source=CHRONY)


def test_without_chrony_the_bound_is_what_the_scenario_states(chronyc: Path) -> None:
    stated = ClockError(clock="here", error_ns=250_000, source=STATED)
    assert clock_error("here", 250.0) == stated
    answers(chronyc, "506 Cannot talk to daemon", 1)
    assert clock_error("here", 250.0) == stated


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (TRACKING.replace("Normal", "Not synchronised"), "chrony has not synchronised this host's clock"),
        ("506,Cannot", "not understood: '506,Cannot'"),
        (TRACKING.replace("0.000029493", "nan"), "not understood"),
    ],
)
def test_a_clock_without_a_bound_is_refused_in_one_line(chronyc: Path, line: str, reason: str) -> None:
    answers(chronyc, line)
    with pytest.raises(MachineError, match=reason):
        chrony_error_ns()


def test_a_step_of_the_wall_clock_changes_the_mapping_by_its_size(monkeypatch: pytest.MonkeyPatch) -> None:
    before_ns = host_clocks.realtime_offset_ns()
    own = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: own() + 10**12)
    assert abs(host_clocks.realtime_offset_ns() - before_ns - 10**12) < 10**11  # stalls, and adjustments


def test_processes_of_one_host_have_the_same_mapping() -> None:
    program = "from noack.runtime.host_clocks import realtime_offset_ns; print(realtime_offset_ns())"
    other = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert abs(int(other.stdout) - host_clocks.realtime_offset_ns()) < 10**11


def test_a_message_may_come_early_by_the_errors_of_both_clocks_only() -> None:
    clocks = {
        role: ClockError(clock=role, error_ns=error_ns, source=CHRONY)
        for role, error_ns in (("plant", 300), ("sensor", 0), ("netem", 0), ("controller", 700))
    }
    rows = np.zeros(3, tables(1, 1)[CONTROLLER_DELIVERY])
    rows["t_ns"], rows["now_ns"] = 10_000, (10_500, 9_000, 8_999)
    assert CausalityCheck("controller", clocks, 1.0).check(CONTROLLER_DELIVERY, rows[:2]) is None
    notice = CausalityCheck("controller", clocks, 1.0).check(CONTROLLER_DELIVERY, rows)
    assert notice is not None
    assert notice.t_ns == 8_999
    assert CausalityCheck("controller", clocks, 2.0).check(CONTROLLER_DELIVERY, rows) is None
    one_clock = {role: clock.model_copy(update={"clock": "one"}) for role, clock in clocks.items()}
    assert CausalityCheck("controller", one_clock, 1.0).check(CONTROLLER_DELIVERY, rows) is not None
