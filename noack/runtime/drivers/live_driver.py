"""The live driver: the core drives the machines of a process; Python does what is rare.

``native/driver/driver.c`` waits for ticks and datagrams, passes them to the machines, sends their
messages, and collects the rows of the record. It returns to Python at housekeeping, if a table of
rows is full, and for each datagram that is encrypted.
"""

import os
import socket
import weakref
from collections.abc import Mapping, Sequence
from contextlib import suppress

from netem.core.address import Address, SocketName, packed_name
from netem.core.clock import RunClock
from netem.core.core_library import CData
from noack.core.core_library import core, ffi, new_handle
from noack.machines.loop_machines import LoopMachines
from noack.protocol.wire_format import (
    HEADER_BYTES,
    TAG_BYTES,
    Flow,
    Rejection,
    Wire,
    reception_report,
    rejected_of,
)
from noack.runtime.counting_sockets import CountingSockets, errors_by_text
from noack.runtime.drivers.real_time_loop import RecordSink

_UDP_GRO = 104
_AT_ONCE_NS = -(2**63)
"""Do what is due, and do not wait."""


def _raise_error(number: int) -> None:
    if number:
        raise OSError(number, os.strerror(number))


class LiveDriver:
    """Drives the machines of all loops of a process.

    Args:
        machines: the machines.
        wire: what their datagrams have in common.
        spin_ns: busy-wait for this time before a tick.
        coalescing_ns: sleep for this time if the next tick is nearer, to do several at once.
    """

    def __init__(
        self,
        machines: LoopMachines,
        wire: Wire,
        *,
        spin_ns: int = 0,
        coalescing_ns: int = 0,
    ) -> None:
        self.machines, self._wire = machines, wire
        self.core: CData = new_handle("driver", machines.core, wire.core, spin_ns, coalescing_ns)
        _raise_error(core.noack_driver_open(self.core))
        self.close = weakref.finalize(self, core.noack_driver_close, self.core)
        """Close its timer and its epoll."""

    def open(
        self,
        senders: Sequence[socket.socket],
        receivers: Sequence[socket.socket],
        sources: Sequence[Address],
    ) -> None:
        """Use these sockets from now on.

        Args:
            senders: connected to where the messages of every run go; also to where
                acknowledgements do.
            receivers: the sockets of the peers.
            sources: where the messages of every run come from; also where acknowledgements do.
        """
        for index, sender in enumerate(senders):
            self.core.senders[index] = sender.fileno()
        self.core.receiver_count = len(receivers)
        for index, receiver in enumerate(receivers):
            self.core.receivers[index] = receiver.fileno()
            if self.core.process.loops > 1:  # several datagrams then come as one message
                with suppress(OSError):
                    receiver.setsockopt(socket.IPPROTO_UDP, _UDP_GRO, 1)
        for peer, address in zip(self.core.sources, sources, strict=False):
            peer.name, peer.name_bytes = packed_name(address)
        _raise_error(core.noack_driver_watch(self.core))

    def set_clock(self, clock: RunClock) -> None:
        """Read the time as this clock does."""
        clock.set_core(self.core.clock)

    def next_deadline_ns(self) -> int | None:
        """The next tick of all machines, in the time of the run."""
        return self.machines.next_deadline_ns()

    def drive(self, until_ns: int, sink: RecordSink) -> None:
        """Work until about a time of the run; pass on the rows of the record."""
        driver, machines = self.core, self.machines
        while (reason := core.noack_drive(driver, until_ns)) != core.NOACK_DRIVEN:
            if reason == core.NOACK_DRIVER_ROWS:
                self._pass_rows(sink)
            elif reason == core.NOACK_DRIVER_FAILED:
                machines.raise_failure()
            elif reason == core.NOACK_DRIVER_OPEN:
                self._open_datagram()
            else:
                self._seal_datagram()
        self._pass_rows(sink)

    def take(self, data: bytes, source: SocketName, sink: RecordSink) -> None:
        """Process a datagram that Python has received."""
        name, _ = packed_name(source)
        core.noack_driver_add_datagram(self.core, name, data, len(data))
        self.drive(_AT_ONCE_NS, sink)

    @property
    def accepted(self) -> int:
        """Number of accepted datagrams."""
        return sum(machine.received.accepted for machine in self._each_machine())

    @property
    def rejected(self) -> Mapping[Rejection, int]:
        """Number of rejected datagrams by reason."""
        counts = dict.fromkeys(Rejection, 0)
        for machine in self._each_machine():
            for reason, number in rejected_of(machine.received).items():
                counts[reason] += number
        return counts

    def reports(self) -> list[dict[str, object]]:
        """Counters of each loop, for the run's summary."""
        return [reception_report(machine.received) for machine in self._each_machine()]

    def acknowledgements(self) -> dict[str, object]:
        """Counters of the acknowledgements of all loops."""
        reports = [machine.acknowledgements for machine in self._each_machine()]
        rejected = [rejected_of(report) for report in reports]
        by_reason = {reason.value: sum(report[reason] for report in rejected) for reason in Rejection}
        return {
            "accepted": sum(report.accepted for report in reports),
            "rejected": {reason: n for reason, n in by_reason.items() if n},
            "loops": [reception_report(report) for report in reports],
        }

    def _each_machine(self) -> list[CData]:
        process = self.machines.core
        return [core.noack_process_machine(process, loop) for loop in range(process.loops)]

    def _pass_rows(self, sink: RecordSink) -> None:
        for table, rows in self.machines.take_rows(last=True):
            sink.extend_table(table, rows)
        for notice in self.machines.take_notices():
            sink.notice(notice)

    def _open_datagram(self) -> None:
        """Decrypt the vector of the datagram in place."""
        driver, seal = self.core, self._wire.seal
        assert seal is not None
        memory = ffi.buffer(driver.datagram, driver.datagram_bytes)
        vector = seal.decrypt(bytes(memory), HEADER_BYTES)
        if vector is not None:
            memory[HEADER_BYTES : HEADER_BYTES + len(vector)] = vector
        driver.opened = core.NOACK_NOT_AUTHENTIC if vector is None else core.NOACK_OPENED

    def _seal_datagram(self) -> None:
        """Encrypt the vector of the datagram in place, and write its tag."""
        driver, seal = self.core, self._wire.seal
        assert seal is not None
        memory = ffi.buffer(driver.datagram, driver.datagram_bytes)
        memory[:] = seal.encrypt(bytes(memory[:HEADER_BYTES]), bytes(memory[HEADER_BYTES:-TAG_BYTES]))


class LoopSockets(CountingSockets):
    """The sockets of a process in the loop.

    Args:
        endpoint: its socket.
        driver: drives its machines.
        sends: the flow that it sends in every run.
        source: where the flow that it receives in every run comes from.
        destination: where the flow that it sends goes to.
        acknowledged_by: where acknowledgements come from; None: it receives none.
        acknowledges_to: where they go to; None: it sends none.

    Raises:
        PeerError: the system refused a socket for a peer.
    """

    def __init__(
        self,
        endpoint: socket.socket,
        driver: LiveDriver,
        sends: Flow,
        *,
        source: Address,
        destination: Address,
        acknowledged_by: Address | None = None,
        acknowledges_to: Address | None = None,
    ) -> None:
        sources = [source] if acknowledged_by is None else [source, acknowledged_by]
        destinations = [destination, *([] if acknowledges_to is None else [acknowledges_to])]
        super().__init__(endpoint, destinations, sources)
        self._driver, self._sends = driver, sends
        self._expected = sources
        self._is_acknowledged = acknowledged_by is not None
        driver.open(self.senders, self.peer_sockets, sources)

    def take(self, data: bytes, source: SocketName, now_ns: int, sink: RecordSink) -> None:
        """Pass a datagram to the driver, which rejects all but those of the peers."""
        self._driver.take(data, source, sink)

    def report(self) -> dict[str, object]:
        """Counters, for the run's summary."""
        driver, driver_core = self._driver, self._driver.core
        for peer, address in zip(driver_core.sources, self._expected, strict=False):
            self.count_received(address, peer.received)
        self._sources.add_others(driver_core.unknown_source)
        driver_core.unknown_source = 0
        rejected = {reason.value: n for reason, n in driver.rejected.items()}
        return super().report() | {
            "sent": driver_core.sent,
            "send_errors": errors_by_text(driver_core.errors),
            "sends": self._sends.name.lower(),
            "accepted": driver.accepted,
            "rejected": self.rejected(rejected),
            "loops": driver.reports(),
            **({"acknowledgements": driver.acknowledgements()} if self._is_acknowledged else {}),
        }

    def close(self) -> None:
        """Close the sockets that it opened itself, and the driver's timer."""
        super().close()
        self._driver.close()
