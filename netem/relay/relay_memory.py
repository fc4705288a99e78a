"""A relay in the core (native/relay), which owns its memory: its tables, and its directions."""

import secrets
import select
from collections.abc import Sequence

import numpy as np

from netem.core.address import NAME_BYTES, SocketName, packed_name
from netem.core.core_library import CData, StructRows, core, ffi, new_handle, pointer_to, rows_at
from netem.impairments.link_settings import LinkSettings
from netem.link_state import Integers, LinkState
from netem.relay.relay_reports import Bytes

_ROWS = 16
"""Flows of a direction for which there is room at first."""


_NO_ERRORS = bytes(ffi.sizeof("int64_t") * core.NOACK_ERRNOS)
"""The memory of a direction's ``errors``, before there are any."""


class RelayMemory:
    """A ``noack_relay`` of a number of links, with its tables.

    Args:
        links: the links; their directions are numbered 2·link forward, 2·link + 1 reverse.
        segment: send successive datagrams of equal size as one message.
        clients: clients for which there is room at first.
        row_count: number of rows of the record that are kept for each table; 0: no record.
    """

    def __init__(self, links: int, *, segment: bool = False, clients: int = 0, row_count: int = 0) -> None:
        self.first_path = 2 * links
        self._epoll = select.epoll()
        secret = [secrets.randbits(64), secrets.randbits(64)]
        self.core: CData = new_handle("relay", links, clients, row_count, self._epoll.fileno(), secret)
        """The relay, as the core's functions take it: a ``noack_relay``."""
        self.core.segment = segment

    @property
    def clients(self) -> StructRows:
        """The rows of clients, ``noack_client``; valid until there are more."""
        return rows_at(self.core.clients, self.core.client_rows)

    @property
    def sockets(self) -> StructRows:
        """The sockets of the links, then those of the clients; valid until there are more."""
        return rows_at(self.core.sockets, self.first_path + self.core.client_rows)

    def watch(self, fd: int, place: int) -> None:
        """Wait for the datagrams of a socket, too; closing it ends this.

        Args:
            fd: its descriptor.
            place: its place among the sockets.

        Raises:
            OSError: the system refuses.
        """
        self.core.sockets[place].fd = fd
        if error := core.noack_relay_watch(self.core, fd, place):
            raise OSError(error, "epoll_ctl")

    def wait_for_only(self, fd: int, place: int, wait_ns: int) -> None:
        """Wait for the datagrams of no socket but this one, by receiving from it.

        Args:
            fd: its descriptor.
            place: its place among the sockets.
            wait_ns: how long receiving from it waits.
        """
        self.core.sockets[place].fd = fd
        self.core.only_socket, self.core.receive_wait_ns = place, wait_ns

    def add_clients(self) -> None:
        """Double the maximum number of clients."""
        if not core.noack_relay_add_clients(self.core):
            raise MemoryError

    def take_rows(self) -> tuple[StructRows, StructRows]:
        """Return the collected rows of the two tables, which the next ones overwrite."""
        packets, releases = self.core.packet_rows, self.core.release_rows
        self.core.packet_rows = self.core.release_rows = 0
        return rows_at(self.core.packets, packets), rows_at(self.core.releases, releases)

    def latest_ns(self, direction: int, rows: int) -> Integers:
        """Return the last departure time (rows,) of each flow's packets in flight; −1: none."""
        latest = np.full(rows, core.NOACK_NEVER_NS, np.int64)
        core.noack_relay_latest(self.core, direction, pointer_to(latest, "int64_t *"))
        return latest

    def close(self) -> None:
        """Stop waiting for datagrams."""
        self._epoll.close()


class RelayDirection(LinkState):
    """One direction of a link in a relay's memory; see :class:`netem.link_state.LinkState`.

    Args:
        settings, seed, name: see there.
        row: its ``noack_direction``.
    """

    def __init__(
        self,
        settings: LinkSettings,
        seed: int,
        name: Sequence[str],
        row: CData,
    ) -> None:
        super().__init__(settings, seed, *name, rows=_ROWS)
        self.row = row
        self.is_timed = False
        """Whether its settings change at given times."""
        row.link = self.core
        self._set_keeps()

    def change(self, settings: LinkSettings, latest_ns: Integers) -> None:
        """Apply other settings; see :meth:`netem.link_state.LinkState.change`."""
        super().change(settings, latest_ns)
        self._set_keeps()

    def set_server(self, name: SocketName, sends: int) -> None:
        """Set where its datagrams go, and by which socket: a value of ``noack_sends``."""
        packed, self.row.name_bytes = packed_name(name)
        self.row.name, self.row.sends = packed, sends

    def counts_of(self, name: str) -> Integers:
        """Return a copy of ``delays``, ``lateness`` or ``errors`` of its ``noack_direction``."""
        return np.frombuffer(ffi.buffer(getattr(self.row, name)), np.int64).copy()

    @property
    def needs_arrivals(self) -> bool:
        """Whether it matters when exactly a datagram has arrived."""
        return self.can_reorder or self.is_timed

    @property
    def has_errors(self) -> bool:
        """Whether any datagram could not be sent or stored."""
        return bytes(ffi.buffer(self.row.errors)) != _NO_ERRORS

    def _set_keeps(self) -> None:
        flips_bits = any(impairment.flips_bits for impairment in self.settings.impairments)
        self.row.keeps = self.can_reorder or flips_bits


def name_array(packed: bytes) -> Bytes:
    """Return a packed socket address as an array, (NAME_BYTES,) of bytes."""
    return np.frombuffer(packed.ljust(NAME_BYTES, b"\0"), np.uint8)
