"""A live measurement from the options of the command line."""

import re
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

from cosim.measurement.live.probe_result import ProbeResult
from cosim.measurement.live.probe_run import listen, send
from cosim.measurement.live.probe_sender import ProbePlan
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.impairments.words import OWN_TIME_S
from noack.protocol.probe_format import (
    LONGEST_PERIOD_NS,
    MAX_PROBE_BYTES,
    MAX_PROBES,
    PROBE_BYTES,
    SHORTEST_PERIOD_NS,
)
from noack.runtime.address import parse_address, parse_destination, text_of
from noack.runtime.command_line import print_to_stderr

_ADDRESS = re.compile(r".*:[0-9]{1,5}")
_RATE = re.compile(r"([0-9]+(?:\.[0-9]+)?)(k?)(?:hz)?", re.IGNORECASE)
_SHORTEST_WAIT_NS = 3 * NS_PER_S


@dataclass(frozen=True)
class LiveOptions:
    """Options of a live measurement, as written."""

    rate: str = "50hz"
    duration: str = "60s"
    size_bytes: int = 128
    round_trip: bool = False
    silence: str = "30s"
    save: Path | None = None
    deadline_s: float | None = None


LIVE_OPTIONS = {
    "rate": "--rate", "duration": "--for", "size_bytes": "--size", "round_trip": "--round-trip",
    "silence": "--silence", "save": "--save",
}  # fmt: skip
"""Options of the command line, by field of :class:`LiveOptions`."""


def is_address(source: str) -> bool:
    """Whether a source is an address to probe, not a file."""
    return _ADDRESS.fullmatch(source) is not None and not Path(source).exists()


def period_ns_of(rate: str) -> int:
    """Return the period of a rate such as ``50hz`` or ``2khz``."""
    found = _RATE.fullmatch(rate)
    per_s = Decimal(found[1]) * (1000 if found[2] else 1) if found else Decimal(0)
    period_ns = int((NS_PER_S / per_s).to_integral_value()) if per_s else 0
    if not SHORTEST_PERIOD_NS <= period_ns <= LONGEST_PERIOD_NS:
        raise CallerError(f"--rate {rate}: expected a rate from 0.001hz to 20khz, e.g. 50hz")
    return period_ns


def time_s_of(option: str, text: str) -> float:
    """Return a positive time such as ``60s``."""
    try:
        time_s = OWN_TIME_S.read(text)
        if not 0 < time_s <= 10**8:
            raise ValueError
    except ValueError:
        raise CallerError(f"{option} {text}: expected {OWN_TIME_S.expected}") from None
    return time_s


def receive_live(address: str, options: LiveOptions) -> ProbeResult:
    """Receive one probe."""
    silence_s = time_s_of("--silence", options.silence)
    return listen(parse_address(address, "--listen"), silence_s, options.save, _log)


def send_live(address: str, options: LiveOptions) -> ProbeResult:
    """Send a probe to a listener."""
    period_ns = period_ns_of(options.rate)
    planned = max(round(time_s_of("--for", options.duration) * NS_PER_S) // period_ns, 1)
    if planned > MAX_PROBES:
        raise CallerError(f"--for {options.duration}: {planned} datagrams; at most {MAX_PROBES}")
    if not PROBE_BYTES <= options.size_bytes <= MAX_PROBE_BYTES:
        raise CallerError(
            f"--size {options.size_bytes}: expected {PROBE_BYTES} to {MAX_PROBE_BYTES} bytes"
        )
    wait_ns = max(_SHORTEST_WAIT_NS, round(2 * (options.deadline_s or 0) * NS_PER_S))
    plan = ProbePlan(period_ns, planned, options.size_bytes, options.round_trip, wait_ns)
    to = parse_destination(address, "address")
    way = "round trip" if options.round_trip else "one way"
    _log(f"{planned} datagrams to {text_of(to)}, one every {period_ns / 1e6:g} ms, {way}")
    return send(to, plan, options.save, _log)


def _log(line: str) -> None:
    print_to_stderr(f"noack measure: {line}")
