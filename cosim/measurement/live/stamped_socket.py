"""A UDP socket whose datagrams have the kernel's time of arrival, on the monotonic clock.

The kernel stamps a datagram with the real-time clock (SO_TIMESTAMPNS). The difference between the
two clocks, read with each datagram, converts the stamp. If the real-time clock was set meanwhile,
the time of reading is used instead.
"""

import errno
import hashlib
import socket
import struct
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from noack.core.errors import CallerError, MachineError, why
from noack.protocol.probe_format import MAX_PROBE_BYTES
from noack.runtime.address import Address, family_of, text_of
from noack.runtime.udp_sockets import drops_of, enlarge_buffer

_SO_TIMESTAMPNS = 35
_TIMESPEC = struct.Struct("@ll")
_SET_NS = 1_000_000
_PREEMPTED_NS = 20_000
_LONGEST_WAIT_NS = 60 * 10**9
_BOOT = Path("/proc/sys/kernel/random/boot_id")


class Arrival(NamedTuple):
    """A datagram, its source, and its time of arrival."""

    data: bytes
    source: Address
    received_ns: int


def host_number() -> int:
    """Return a number of this machine since its last boot: equal numbers mean the same clock.

    0 if the system has none.
    """
    try:
        return int.from_bytes(hashlib.sha256(_BOOT.read_bytes()).digest()[:8], "little")
    except OSError:
        return 0


class StampedSocket:
    """A socket that listens on ``listen``, or is connected to ``to``.

    Raises:
        CallerError: the address cannot be used.
    """

    def __init__(self, *, listen: Address | None = None, to: Address | None = None) -> None:
        address = listen or to
        assert address is not None
        self.endpoint = socket.socket(family_of(address), socket.SOCK_DGRAM)
        try:
            if listen is not None:
                self.endpoint.bind(listen)
            else:
                self.endpoint.connect(address)
        except OSError as error:
            self.endpoint.close()
            verb = "listen on" if listen is not None else "send to"
            raise CallerError(f"cannot {verb} {text_of(address)}: {why(error)}") from None
        enlarge_buffer(self.endpoint)
        if sys.platform == "linux":
            with suppress(OSError):
                self.endpoint.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        self.clock_sets = 0
        """How often the real-time clock was set."""
        self._offset_ns = time.time_ns() - time.monotonic_ns()
        self.send_errors = 0
        self.last_send_error = ""

    def receive(self) -> Arrival | None:
        """Return the next datagram; None if none is waiting."""
        try:
            data, ancillary, _, source = self.endpoint.recvmsg(
                MAX_PROBE_BYTES + 1, 64, socket.MSG_DONTWAIT
            )
        except BlockingIOError:
            return None
        except OSError as error:  # an ICMP error of an earlier send
            self._count(error)
            return None
        now_ns, was_set = time.monotonic_ns(), self._compare_clocks()
        for level, kind, stamp in ancillary:
            if (level, kind) == (socket.SOL_SOCKET, _SO_TIMESTAMPNS) and not was_set:
                seconds, ns = _TIMESPEC.unpack_from(stamp)
                stamp_ns = seconds * 10**9 + ns - self._offset_ns
                if now_ns - _LONGEST_WAIT_NS < stamp_ns < now_ns:
                    now_ns = stamp_ns
        return Arrival(data, source[:2], now_ns)

    def _compare_clocks(self) -> bool:
        """Update the difference of the two clocks; return whether the real-time clock was set."""
        before_ns, real_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        if after_ns - before_ns > _PREEMPTED_NS:
            return False
        change_ns = real_ns - before_ns - self._offset_ns
        self._offset_ns += change_ns
        was_set = abs(change_ns) > _SET_NS
        self.clock_sets += was_set
        return was_set

    def send(self, data: bytes, to: Address | None = None) -> None:
        """Send a datagram; a failure is counted.

        Raises:
            CallerError: the datagram is too large for the path.
            MachineError: the system does not permit it.
        """
        for _ in range(2):  # the first error may belong to the datagram before
            try:
                if to is None:
                    self.endpoint.send(data)
                else:
                    self.endpoint.sendto(data, to)
                return
            except PermissionError as error:
                raise MachineError(f"cannot send: {why(error)}") from None
            except ConnectionRefusedError as error:
                self._count(error)
            except OSError as error:
                if len(data) > MAX_PROBE_BYTES or error.errno == errno.EMSGSIZE:
                    raise CallerError(f"--size {len(data)}: {why(error)}") from None
                self._count(error)
                return

    def _count(self, error: OSError) -> None:
        self.send_errors += 1
        self.last_send_error = why(error)

    @property
    def kernel_drops(self) -> int | None:
        """Datagrams dropped by the kernel because the receive buffer was full."""
        return drops_of(self.endpoint)
