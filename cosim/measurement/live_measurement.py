"""A live measurement, from the options of the command line to the result.

It drives a sender or a receiver (``probe_ends.py``) from a socket and the monotonic clock. The raw
trace is written meanwhile, so that a killed process loses nothing.
"""

import errno
import hashlib
import os
import re
import secrets
import select
import socket as sockets
import time
from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Self

from cosim.measurement.probe_ends import ProbePlan, ProbeReceiver, ProbeResult, ProbeSender
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError, MachineError, NeverStartedError, PeerError, why
from noack.core.file_access import open_growing
from noack.impairments.words import OWN_TIME_S
from noack.protocol.probe_format import (
    LONGEST_PERIOD_NS,
    MAX_PROBE_BYTES,
    MAX_PROBES,
    PROBE_BYTES,
    SHORTEST_PERIOD_NS,
)
from noack.runtime.address import Address, address_text, family_of, parse_address, parse_destination
from noack.runtime.command_line import Signals, print_to_stderr
from noack.runtime.host_clocks.time_exchange import Arrival, ArrivalSocket, HostClocks
from noack.runtime.udp_sockets import drops_of, enlarge_buffer

_ADDRESS = re.compile(r".*:[0-9]{1,5}")
_RATE = re.compile(r"([0-9]+(?:\.[0-9]+)?)(k?)(?:hz)?", re.IGNORECASE)
_SHORTEST_WAIT_NS = 3 * NS_PER_S


@dataclass(frozen=True)
class LiveProbeOptions:
    """Options of a live measurement, as written."""

    rate: str = "50hz"
    duration: str = "60s"
    size_bytes: int = 128
    round_trip: bool = False
    silence: str = "30s"
    save: Path | None = None
    deadline_s: float | None = None


LIVE_OPTIONS = {
    "rate": "--rate",
    "duration": "--for",
    "size_bytes": "--size",
    "round_trip": "--round-trip",
    "silence": "--silence",
    "save": "--save",
}
"""Options of the command line, by field of :class:`LiveProbeOptions`."""


def is_address(source: str) -> bool:
    """Whether a source is an address to probe, not a file."""
    return _ADDRESS.fullmatch(source) is not None and not Path(source).exists()


def period_ns_of(rate: str) -> int:
    """Return the period of a rate such as ``50hz`` or ``2khz``."""
    match = _RATE.fullmatch(rate)
    per_s = Decimal(match[1]) * (1000 if match[2] else 1) if match else Decimal(0)
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


def receive_live(address: str, options: LiveProbeOptions) -> ProbeResult:
    """Receive one probe."""
    silence_s = time_s_of("--silence", options.silence)
    return listen(parse_address(address, "--listen"), silence_s, options.save, _log)


def send_live(address: str, options: LiveProbeOptions) -> ProbeResult:
    """Send a probe to a listener."""
    period_ns = period_ns_of(options.rate)
    planned = max(round(time_s_of("--for", options.duration) * NS_PER_S) // period_ns, 1)
    if planned > MAX_PROBES:
        raise CallerError(f"--for {options.duration}: {planned} datagrams; at most {MAX_PROBES}")
    if not PROBE_BYTES <= options.size_bytes <= MAX_PROBE_BYTES:
        raise CallerError(f"--size {options.size_bytes}: expected {PROBE_BYTES} to {MAX_PROBE_BYTES} bytes")
    wait_ns = max(_SHORTEST_WAIT_NS, round(2 * (options.deadline_s or 0) * NS_PER_S))
    plan = ProbePlan(period_ns, planned, options.size_bytes, options.round_trip, wait_ns)
    destination = parse_destination(address, "address")
    direction = "round trip" if options.round_trip else "one way"
    _log(f"{planned} datagrams to {address_text(destination)}, one every {period_ns / 1e6:g} ms, {direction}")
    return send(destination, plan, options.save, _log)


def _log(line: str) -> None:
    print_to_stderr(f"noack measure: {line}")


_LONGEST_WAIT_S = 0.1
_MOST_AT_ONCE = 256
"""Largest number of datagrams that are read at once."""
_BOOT = Path("/proc/sys/kernel/random/boot_id")


def host_number() -> int:
    """Return a number of this machine since its last boot: equal numbers mean the same clock.

    0 if the system has none.
    """
    try:
        return int.from_bytes(hashlib.sha256(_BOOT.read_bytes()).digest()[:8], "little")
    except OSError:
        return 0


class ProbeSocket:
    """A socket that listens on ``listen``, or is connected to ``peer``.

    Raises:
        CallerError: the address cannot be used.
    """

    def __init__(self, *, listen: Address | None = None, peer: Address | None = None) -> None:
        address = listen or peer
        assert address is not None
        self.endpoint = sockets.socket(family_of(address), sockets.SOCK_DGRAM)
        try:
            (self.endpoint.connect if listen is None else self.endpoint.bind)(address)
        except OSError as error:
            self.endpoint.close()
            verb = "send to" if listen is None else "listen on"
            raise CallerError(f"cannot {verb} {address_text(address)}: {why(error)}") from None
        enlarge_buffer(self.endpoint)
        self.arrivals = ArrivalSocket(self.endpoint, MAX_PROBE_BYTES, HostClocks())
        self.receive(1)  # compares the clocks before the first arrival
        self._send_errors = 0
        self.last_send_error = os.strerror(errno.ECONNREFUSED)
        """The system's text; that of an error that only the next read reports is this one."""

    @property
    def send_errors(self) -> int:
        """Number of sends that failed, as the sends or later reads reported."""
        return self._send_errors + self.arrivals.errors

    def receive(self, limit: int = _MOST_AT_ONCE) -> list[Arrival]:
        """Return the datagrams that wait, with the kernel's times of arrival."""
        return self.arrivals.receive(limit)

    def send(self, data: bytes, destination: Address | None = None) -> None:
        """Send a datagram; a failure is counted.

        Raises:
            CallerError: the datagram is too large for the path.
            MachineError: the system does not permit it.
        """
        for _ in range(2):  # the first error may belong to the datagram before
            try:
                if destination is None:
                    self.endpoint.send(data)
                else:
                    self.endpoint.sendto(data, destination)
                return
            except OSError as error:
                if isinstance(error, PermissionError):
                    raise MachineError(f"cannot send: {why(error)}") from None
                if len(data) > MAX_PROBE_BYTES or error.errno == errno.EMSGSIZE:
                    raise CallerError(f"--size {len(data)}: {why(error)}") from None
                self._send_errors += 1
                self.last_send_error = why(error)
                if not isinstance(error, ConnectionRefusedError):
                    return

    @property
    def kernel_drops(self) -> int | None:
        """Datagrams dropped by the kernel because the receive buffer was full."""
        return drops_of(self.endpoint)


def listen(address: Address, silence_s: float, save: Path | None, log: Callable[[str], None]) -> ProbeResult:
    """Receive one probe, until its sender has ended it, a long silence, or a signal.

    Args:
        address: where to listen.
        silence_s: the probe is over after this time without a datagram.
        save: file for the raw trace; None: no file.
        log: takes a line for the user.

    Raises:
        NoackError: the address or the file cannot be used, or nothing was received.
    """
    socket = ProbeSocket(listen=address)
    with socket.endpoint, ProbeRows(save, log) as rows, Signals().handled() as signals:
        log(f"listening on {address_text(socket.endpoint.getsockname())}")
        receiver = ProbeReceiver(host_number(), time.monotonic_ns(), int(silence_s * 1e9), log, rows.add)
        while signals.received is None:
            select.select([socket.endpoint], (), (), _LONGEST_WAIT_S)
            arrivals = socket.receive()
            for data, source, received_ns in arrivals:
                answer = receiver.handle(data, address_text(source), received_ns)
                if answer is not None:
                    socket.send(answer, source)
            rows.flush()
            if not arrivals and receiver.is_over(time.monotonic_ns()):
                break
        result = _finish_probe(receiver.finish, socket)
        if result is None:
            raise NeverStartedError("stopped before a datagram of a probe arrived", signals.status)
    return result


def send(address: Address, plan: ProbePlan, save: Path | None, log: Callable[[str], None]) -> ProbeResult:
    """Send a probe; a signal ends it early.

    Args:
        address: where a listener receives it.
        plan: what to send.
        save: file for the raw trace; None: no file.
        log: takes a line for the user.

    Raises:
        NoackError: the address or the file cannot be used, or no process listens there.
    """
    socket = ProbeSocket(peer=address)
    with socket.endpoint, ProbeRows(save, log) as rows, Signals().handled() as signals:
        sender = ProbeSender(plan, secrets.randbits(64), host_number(), time.monotonic_ns(), rows.add)
        failed_sends = 0
        while not sender.is_over(now_ns := time.monotonic_ns()):
            wait_ns = sender.next_deadline_ns() - now_ns
            if wait_ns <= 0:
                socket.send(sender.on_timer(time.monotonic_ns()))
                wait_ns = 0
                if sender.ends <= 1:  # a send reports the failure of the one before
                    if socket.send_errors and not failed_sends:
                        log(f"{socket.last_send_error}: is a listener running there?")
                    failed_sends = min(socket.send_errors, sender.sent)
            select.select([socket.endpoint], (), (), min(wait_ns * 1e-9, _LONGEST_WAIT_S))
            for arrival in socket.receive():
                sender.handle(arrival.data, arrival.latest_ns)
            rows.flush()
            if signals.received is not None:
                sender.stop(time.monotonic_ns())
        if failed_sends:
            reason = f"{failed_sends} of {sender.sent} sends failed: {socket.last_send_error}"
            if failed_sends == sender.sent:
                raise PeerError(f"{address_text(address)}: {reason}; is a listener running there?")
            log(reason)
        result = _finish_probe(sender.finish, socket)
        assert result is not None
    return result


def _finish_probe(
    finish: Callable[[int | None], ProbeResult | None], socket: ProbeSocket
) -> ProbeResult | None:
    """Return the result of one end, with notes about the socket; None if nothing was received."""
    try:
        result = finish(socket.kernel_drops)
    except ValueError as error:
        raise PeerError(f"the datagrams of the other end contradict each other: {error}") from None
    if result is None:
        return None
    notes = list(result.notes)
    if clock_sets := socket.arrivals.clock_sets:
        notes.append(
            f"this host's real-time clock was set {clock_sets} times; the probe uses the monotonic clock"
        )
    if result.kernel_drops:
        notes.append(
            f"unintended losses: the kernel of this host dropped {result.kernel_drops} datagrams "
            "because this process did not read them in time; the network delivered them, "
            "but they are counted as lost"
        )
    return result._replace(notes=tuple(notes))


class ProbeRows:
    """A CSV file that grows row by row; an error while writing is logged, and ends the file.

    Args:
        path: the file, which is replaced; None: no file.
        log: takes a line for the user.

    Raises:
        CallerError: the file cannot be written.
    """

    def __init__(self, path: Path | None, log: Callable[[str], None]) -> None:
        self._path, self._log = path, log
        self._waiting: list[str] = []
        self._file: int | None = None
        if path is not None:
            try:
                self._file = open_growing(path, follow=True)
            except (OSError, ValueError) as error:
                raise CallerError(f"--save {path}: cannot be written: {why(error)}") from None

    def add(self, *values: object) -> None:
        """Add a row."""
        if self._file is not None:
            self._waiting.append(",".join(map(str, values)) + "\n")

    def flush(self) -> None:
        """Pass the added rows to the system."""
        if self._file is None or not self._waiting:
            return
        data = "".join(self._waiting).encode()
        self._waiting.clear()
        try:
            while data:
                data = data[os.write(self._file, data) :]
        except OSError as error:
            self._log(f"--save {self._path}: ends here: {why(error)}; the probe continues")
            self.close()

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.flush()
        self.close()
