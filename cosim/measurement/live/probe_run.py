"""Runs a live probe: drives its sender or its receiver from a socket and the monotonic clock."""

import secrets
import select
import time
from collections.abc import Callable
from pathlib import Path

from cosim.measurement.live.probe_receiver import ProbeReceiver
from cosim.measurement.live.probe_result import ProbeResult
from cosim.measurement.live.probe_rows import ProbeRows
from cosim.measurement.live.probe_sender import ProbePlan, ProbeSender
from cosim.measurement.live.stamped_socket import StampedSocket, host_number
from noack.core.errors import NeverStartedError, PeerError
from noack.runtime.address import Address, text_of
from noack.runtime.command_line import Signals

_LONGEST_WAIT_S = 0.1
_BATCH = 256


def listen(
    address: Address, silence_s: float, save: Path | None, log: Callable[[str], None]
) -> ProbeResult:
    """Receive one probe, until its sender has ended it, a long silence, or a signal.

    Args:
        address: where to listen.
        silence_s: the probe is over after so long without a datagram.
        save: file for the raw trace; None: no file.
        log: takes a line for the user.

    Raises:
        NoackError: the address or the file cannot be used, or nothing was received.
    """
    socket = StampedSocket(listen=address)
    with socket.endpoint, ProbeRows(save, log) as rows, Signals().handled() as signals:
        log(f"listening on {text_of(socket.endpoint.getsockname())}")
        receiver = ProbeReceiver(
            host_number(), time.monotonic_ns(), int(silence_s * 1e9), log, rows.add
        )
        while signals.received is None:
            select.select([socket.endpoint], (), (), _LONGEST_WAIT_S)
            read = 0
            while read < _BATCH and (arrival := socket.receive()) is not None:
                read += 1
                source = arrival.source
                answer = receiver.handle(arrival.data, text_of(source), arrival.received_ns)
                if answer is not None:
                    socket.send(answer, source)
            rows.flush()
            if not read and receiver.is_over(time.monotonic_ns()):
                break
        result = _consistent(receiver.finish, socket)
        if result is None:
            raise NeverStartedError("stopped before a datagram of a probe arrived", signals.status)
    return result


def send(
    address: Address, plan: ProbePlan, save: Path | None, log: Callable[[str], None]
) -> ProbeResult:
    """Send a probe; a signal ends it early.

    Args:
        address: where a listener receives it.
        plan: what to send.
        save: file for the raw trace; None: no file.
        log: takes a line for the user.

    Raises:
        NoackError: the address or the file cannot be used, or no process listens there.
    """
    socket = StampedSocket(to=address)
    with socket.endpoint, ProbeRows(save, log) as rows, Signals().handled() as signals:
        sender = ProbeSender(
            plan, secrets.randbits(64), host_number(), time.monotonic_ns(), rows.add
        )
        refused = 0
        while not sender.is_over(now_ns := time.monotonic_ns()):
            wait_ns = sender.next_deadline_ns() - now_ns
            if wait_ns <= 0:
                socket.send(sender.on_timer(time.monotonic_ns()))
                wait_ns = 0
                if sender.ends <= 1:  # a send reports the failure of the one before
                    if socket.send_errors and not refused:
                        log(f"{socket.last_send_error}: is a listener running there?")
                    refused = min(socket.send_errors, sender.sent)
            select.select([socket.endpoint], (), (), min(wait_ns * 1e-9, _LONGEST_WAIT_S))
            for _ in range(_BATCH):
                if (arrival := socket.receive()) is None:
                    break
                sender.handle(arrival.data, arrival.received_ns)
            rows.flush()
            if signals.received is not None:
                sender.stop(time.monotonic_ns())
        if refused:
            reason = f"{refused} of {sender.sent} sends failed: {socket.last_send_error}"
            if refused == sender.sent:
                raise PeerError(f"{text_of(address)}: {reason}; is a listener running there?")
            log(reason)
        result = _consistent(sender.finish, socket)
        assert result is not None
    return result


def _consistent(
    finish: Callable[[int | None], ProbeResult | None], socket: StampedSocket
) -> ProbeResult | None:
    """Return the result, with what the socket found."""
    try:
        result = finish(socket.kernel_drops)
    except ValueError as error:
        raise PeerError(f"the datagrams of the other end contradict each other: {error}") from None
    if result is None:
        return None
    notes = list(result.notes)
    if socket.clock_sets:
        notes.append(
            f"this host's real-time clock was set {socket.clock_sets} times; "
            "the probe uses the monotonic clock"
        )
    if result.kernel_drops:
        notes.append(
            f"unintended losses: the kernel of this host dropped {result.kernel_drops} datagrams "
            "because this process did not read them in time; the network delivered them, "
            "but they are counted as lost"
        )
    return result._replace(notes=tuple(notes))
