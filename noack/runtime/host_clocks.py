"""The clocks of the hosts of a run: which one a process reads, and how far it may be off.

Processes of one host read the same CLOCK_MONOTONIC. Hosts have no clock in common, but chrony or PTP
disciplines the CLOCK_REALTIME of each. So the coordinator announces the run's epoch as a reading of
both of its clocks. A process with another monotonic clock maps the epoch once, at the start barrier,
to its own CLOCK_MONOTONIC, which it reads from then on: a step of the wall clock during the run does
not matter. What chrony corrects by slewing, it corrects in both clocks.

How far a host's clock may be off is what ``chronyc tracking`` says when the process is admitted.
Without chrony it is what the scenario states (``clocks.largest_error_us``). No datagram can arrive
before it was sent: each process checks this, up to the errors of both clocks.
"""

import subprocess
import time
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from netem.core.clock import NS_PER_S
from netem.core.errors import MachineError, PeerError
from noack.protocol.record_tables import CONTROLLER_DELIVERY, PLANT_ACTUATION, SENSOR_MEASUREMENT
from noack.protocol.roles import Notice
from noack.runtime.control_messages import ClockError
from noack.scenario.run_sections import ClocksSection

CLOCK_NOTICE = "clock"
"""Level of the notice about a message that was not sent yet."""
CHRONY, STATED = "chronyc tracking", "clocks.largest_error_us"
"""Where a bound is from."""
RECEIVED: Mapping[str, tuple[str, str]] = {
    "sensor": (SENSOR_MEASUREMENT, "plant"),
    "controller": (CONTROLLER_DELIVERY, "plant"),
    "plant": (PLANT_ACTUATION, "controller"),
}
"""Of each process that receives messages: the table in which they are, and the process by whose clock
``t_ns`` had come when the message was sent. The time of an update is that of its measurement."""
_CHRONYC_S = 5.0
_OFFSET, _ROOT_DELAY, _ROOT_DISPERSION, _LEAP_STATUS, _FIELDS = 4, 10, 11, 13, 14
"""Places in the line of ``chronyc -c tracking``, and their number."""
_READINGS = 5


def chrony_error_ns() -> int | None:
    """Return how far this host's CLOCK_REALTIME may be off by chrony's measurements, in ns.

    This is the bound of chronyc(1), section "tracking", for a source whose own time is correct:
    error <= |system time offset| + root dispersion + root delay / 2. None without chrony. Raise
    MachineError if chrony has not synchronised the clock.
    """
    try:
        result = subprocess.run(
            ["chronyc", "-c", "tracking"], capture_output=True, text=True, check=True, timeout=_CHRONYC_S
        )
    except (OSError, subprocess.SubprocessError):  # not installed, or chronyd does not run
        return None
    fields = result.stdout.strip().split(",")
    try:
        offset_s, delay_s, dispersion_s = (
            float(fields[place]) for place in (_OFFSET, _ROOT_DELAY, _ROOT_DISPERSION)
        )
        error_ns = round((abs(offset_s) + dispersion_s + delay_s / 2) * NS_PER_S)
    except (IndexError, ValueError, OverflowError):
        raise MachineError(f"chronyc -c tracking: not understood: {result.stdout.strip()[:200]!r}") from None
    if len(fields) < _FIELDS or fields[_LEAP_STATUS] == "Not synchronised":
        raise MachineError("chrony has not synchronised this host's clock yet; see `chronyc sources`")
    return error_ns


def realtime_offset_ns() -> int:
    """Return CLOCK_REALTIME minus CLOCK_MONOTONIC, from the reading that took least time."""
    readings = []
    for _ in range(_READINGS):
        before_ns, realtime_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        readings.append((after_ns - before_ns, realtime_ns - (before_ns + after_ns) // 2))
    return min(readings)[1]


def clock_error(clock: str, largest_error_us: float) -> ClockError:
    """Return how far the clock of this host may be off; raise MachineError as :func:`chrony_error_ns`.

    Args:
        clock: the name of the clock.
        largest_error_us: taken as the bound without chrony.
    """
    error_ns = chrony_error_ns()
    if error_ns is None:
        return ClockError(clock=clock, error_ns=round(largest_error_us * 1000), source=STATED)
    return ClockError(clock=clock, error_ns=error_ns, source=CHRONY)


def require_small_error(which: str, clock: ClockError, settings: ClocksSection) -> None:
    """Raise PeerError if a clock may be off by more than the scenario allows."""
    if clock.error_ns > settings.largest_error_us * 1000:
        raise PeerError(
            f"{which} may be off by {clock.error_ns / 1000:g} µs, as `{clock.source}` says; "
            f"clocks.largest_error_us = {settings.largest_error_us:g} allows less"
        )


def allowed_lead_ns(role: str, clocks: Mapping[str, ClockError]) -> int:
    """Return by how much a process may receive what another has yet to send, by both clocks."""
    _, sender = RECEIVED[role]
    if clocks[sender].clock == clocks[role].clock:
        return 0
    return clocks[sender].error_ns + clocks[role].error_ns


class CausalityCheck:
    """Reports the first received message that was not sent yet, by the clocks of both hosts.

    Args:
        role: the process that receives, one of :data:`RECEIVED`.
        clocks: the clocks of all processes.
        speed: of the run.
    """

    def __init__(self, role: str, clocks: Mapping[str, ClockError], speed: float) -> None:
        self._role, self._table = role, RECEIVED[role][0]
        self._allowed_ns = round(allowed_lead_ns(role, clocks) * speed)
        self._reported = False

    def check(self, table: str, rows: NDArray[np.void]) -> Notice | None:
        """Return the notice about the first such message of the run, in rows of a table."""
        if table != self._table or self._reported or not len(rows):
            return None
        lead_ns = rows["t_ns"] - rows["now_ns"]
        early = np.flatnonzero(lead_ns > self._allowed_ns)
        if not len(early):
            return None
        self._reported = True
        first = early[0]
        text = causality_text(self._role).format(lead_ns[first] / NS_PER_S, self._allowed_ns / NS_PER_S)
        return Notice(max(int(rows["now_ns"][first]), 0), CLOCK_NOTICE, text)


def causality_text(role: str) -> str:
    """Return the message of a violation: by how much a message came too early, and what is allowed."""
    return f"{role} received a message {{:.4g}} s before it was sent; the clocks allow {{:.4g}} s"
