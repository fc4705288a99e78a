"""UDP sockets: bound to loopback, with large kernel buffers, never blocking."""

import errno
import os
import socket
from collections import Counter
from contextlib import suppress
from pathlib import Path

from noack.errors import CallerError
from noack.io.address import Address, text_of
from noack.wire import MAX_DATAGRAM_BYTES, Decoder, Encoder, Flow, Message, flow_of

LOOPBACK = "127.0.0.1"

# The default receive buffer holds 256 small datagrams; 4 MiB holds some 10,000. What overflows is
# lost without a trace, and an unintended loss breaks the MANSD guarantee.
_BUFFER_BYTES = 4 * 1024 * 1024
_SO_RCVBUFFORCE = 33
_REPORTED_SOURCES = 16
_READ_BYTES = MAX_DATAGRAM_BYTES + 1
"""What is longer than any datagram of the loop is cut, and rejected by its length."""
MAX_UDP_BYTES = 65_535


def bind(port: int, who: str, key: str, host: str = LOOPBACK) -> socket.socket:
    """Return a non-blocking UDP socket bound to ``host:port`` (port 0: any free one).

    Args:
        port: the port.
        who: the process, for the error message.
        key: the scenario key or option that set the port, for the error message.
        host: the local address.

    Raises:
        CallerError: the port is taken or not permitted.
    """
    endpoint = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        endpoint.bind((host, port))
    except OSError as error:
        endpoint.close()
        reason = {
            errno.EADDRINUSE: "is already taken by another program",
            errno.EACCES: "needs privileges that this user does not have",
        }.get(error.errno or 0, f"cannot be bound ({error.strerror})")
        raise CallerError(
            f"{who}: UDP port {host}:{port} {reason}; set {key} to another port, or to 0 for any"
        ) from None
    endpoint.setblocking(False)
    enlarge_buffer(endpoint)
    return endpoint


def enlarge_buffer(endpoint: socket.socket) -> int:
    """Ask for a 4 MiB receive buffer; return what the kernel granted, in bytes."""
    try:
        endpoint.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _BUFFER_BYTES)
    except OSError:
        with suppress(OSError):
            endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
    return endpoint.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)


def free_tcp_port(host: str = LOOPBACK) -> int:
    """Return a TCP port that is free now."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.bind((host, 0))
        return int(probe.getsockname()[1])


def require_free_tcp_port(port: int, key: str, host: str = LOOPBACK) -> None:
    """Raise CallerError if a TCP port cannot be listened on."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise CallerError(
                f"control plane: TCP port {host}:{port} cannot be bound ({error.strerror}); "
                f"set {key} to another port, or to 0 for any"
            ) from None


def kernel_drops(endpoint: socket.socket) -> int | None:
    """Datagrams that the kernel dropped as nobody took them in time; None if it does not say."""
    inode = str(os.fstat(endpoint.fileno()).st_ino)
    try:
        lines = Path("/proc/net/udp").read_text().splitlines()
    except OSError:
        return None
    return next((int(f[-1]) for line in lines if (f := line.split())[9] == inode), None)


class SourceCount:
    """Counts datagrams by source address, cheaply while the source stays the same."""

    def __init__(self) -> None:
        self._counts: Counter[Address] = Counter()
        self._last: Address | None = None
        self._run = 0

    def add(self, source: Address) -> None:
        """Count one datagram."""
        if source == self._last:
            self._run += 1
            return
        self._fold()
        self._last, self._run = source, 1

    def busiest(self) -> dict[str, int]:
        """The sources that sent most; a flood from many ports must not flood the report."""
        self._fold()
        return {text_of(source): n for source, n in self._counts.most_common(_REPORTED_SOURCES)}

    def _fold(self) -> None:
        if self._last is not None and self._run:
            self._counts[self._last] += self._run
            self._run = 0


class CountingSocket:
    """A bound socket with one destination that accounts for what passes through it.

    It stays unconnected: a connected one would fail a send for an earlier one's ICMP error, which
    in the network emulator is a loss beyond the cap.

    Args:
        endpoint: from :func:`bind`.
        destination: where it sends.
    """

    def __init__(self, endpoint: socket.socket, destination: Address) -> None:
        self._endpoint = endpoint
        self._destination = destination
        self._sources = SourceCount()
        self._sent = 0
        self.send_errors: Counter[str] = Counter()

    def fileno(self) -> int:
        """File descriptor to wait on."""
        return self._endpoint.fileno()

    def take(self, most_bytes: int) -> tuple[bytes, Address] | None:
        """Take one datagram, cut at ``most_bytes``, with its source; None if there was none."""
        try:
            data, source = self._endpoint.recvfrom(most_bytes)
        except OSError:
            return None
        self._sources.add(source)
        return data, source

    def put(self, data: bytes, destination: Address | None = None) -> None:
        """Send a datagram; a failure is counted, as nobody would learn of it anyway."""
        try:
            self._endpoint.sendto(data, destination or self._destination)
            self._sent += 1
        except OSError as error:
            self.send_errors[str(error)] += 1

    def report(self) -> dict[str, object]:
        """Counters, for the run's summary."""
        return {
            "local": text_of(self._endpoint.getsockname()),
            "destination": text_of(self._destination),
            "sent": self._sent,
            "send_errors": dict(self.send_errors),
            "received_from": self._sources.busiest(),
            "lost_in_kernel": kernel_drops(self._endpoint),
        }


class MessageSocket(CountingSocket):
    """A process's one socket in the loop: receives one flow, sends another.

    Where updates are acknowledged, acknowledgements come or go beside them.

    Args:
        endpoint: a bound socket, from :func:`bind`.
        decoder: takes the flow that the process receives.
        encoder: makes the datagrams that it sends.
        sends: the flow that it sends.
        source: who sends to it; what comes from elsewhere is never acted on.
        destination: where it sends.
        acknowledgements: takes acknowledgements, and who sends them.
        acknowledges_to: where it sends them.
    """

    def __init__(
        self,
        endpoint: socket.socket,
        decoder: Decoder,
        encoder: Encoder,
        sends: Flow,
        *,
        source: Address,
        destination: Address,
        acknowledgements: tuple[Decoder, Address] | None = None,
        acknowledges_to: Address | None = None,
    ) -> None:
        super().__init__(endpoint, destination)
        self._decoder = decoder
        self._encoder = encoder
        self._sends = sends
        self._source = source
        self._acknowledgements = acknowledgements
        self._acknowledges_to = acknowledges_to

    def receive(self) -> Message | None:
        """Take one datagram; None if there was none or it was rejected."""
        taken = self.take(_READ_BYTES)
        if taken is None:
            return None
        data, source = taken
        if self._acknowledgements is not None and flow_of(data) == Flow.ACKNOWLEDGEMENT:
            decoder, peer = self._acknowledgements
            return decoder.decode(data, from_peer=source == peer)
        return self._decoder.decode(data, from_peer=source == self._source)

    def send(self, message: Message) -> None:
        """Send a message."""
        if message.flow is Flow.ACKNOWLEDGEMENT and self._acknowledges_to is not None:
            self.put(self._encoder.encode(message), self._acknowledges_to)
            return
        if message.flow is not self._sends:
            raise ValueError(f"this process sends {self._sends.name}, not {message.flow.name}")
        self.put(self._encoder.encode(message))

    def report(self) -> dict[str, object]:
        """Counters, for the run's summary."""
        report = super().report() | {"sends": self._sends.name.lower(), **self._decoder.report()}
        if self._acknowledgements is not None:
            report["acknowledgements"] = self._acknowledgements[0].report()
        return report
