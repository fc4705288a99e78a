"""The memory of a relay, which the core uses (native/relay): allocates it, and enlarges it."""

import secrets
import select
from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from netem.link_state import Integers, LinkState
from netem.relay.relay_reports import Bytes
from noack.core.clock import NEVER_NS
from noack.core.core_library import CData, StructRows, core, dtype_of, ffi, pointer_to
from noack.impairments.link_settings import LinkSettings
from noack.runtime.address import NAME_BYTES, SocketName, packed_name

CLIENT, SOCKET, SLOT = map(dtype_of, ("noack_client", "noack_socket", "noack_slot"))
ENTRY = dtype_of("noack_heap_entry")
_CLIENTS, _SLOTS, _ROWS = 64, 256, 16
"""Clients, delayed datagrams, and flows of a direction for which there is room at first."""
_TABLE_SHARE = 4
"""Places of the hash table per client."""
_HEADROOM_BYTES = 48 * 1024 * 1024
"""Reserve for everything but delayed datagrams. malloc serves blocks of this size from the system,
not from its heap, and returns them to the system when they are freed."""


class RelayMemory:
    """The memory of a relay for a number of links.

    Args:
        links: the links; their directions are numbered 2·link forward, 2·link + 1 reverse.
        segment: send successive datagrams of equal size as one message.
        row_count: number of rows of the record that are kept for each table; 0: no record.
    """

    def __init__(
        self,
        links: int,
        *,
        segment: bool = False,
        row_count: int = 0,
    ) -> None:
        self.first_path = 2 * links
        self._chunks: list[Bytes] = []
        self._epoll = select.epoll()
        self.directions: CData = ffi.new("noack_direction[]", 2 * links)
        self.packets: StructRows = np.zeros(row_count, dtype_of("noack_packet_row"))
        self.releases: StructRows = np.zeros(row_count, dtype_of("noack_release_row"))
        self._scratch = zeros_in_lines(core.noack_relay_scratch_bytes(), np.dtype(np.uint8))
        self.core: CData = ffi.new("noack_relay *", {
            "links": links, "epoll": self._epoll.fileno(), "only_socket": -1,
            "clock": {"speed": 1.0}, "change_ns": NEVER_NS, "segment": segment,
            "segment_below": 2**16, "records": row_count > 0,
            "directions": self.directions,
            "row_count": row_count, "free_slot": -1, "free_block": -1,
            "secret": [secrets.randbits(64), secrets.randbits(64)],
        })  # fmt: skip
        """The relay, as the core's functions take it: a ``noack_relay``."""
        self.core.scratch = pointer_to(self._scratch, "void *")
        self._set_clients(zeros_in_lines(_CLIENTS, CLIENT), np.zeros(2 * links + _CLIENTS, SOCKET))
        self.clients["number"] = self.sockets["fd"] = -1
        self._waiting: StructRows = np.zeros(0, dtype_of("noack_waiting"))
        self._set_slots(np.zeros(_SLOTS, ENTRY), np.zeros(_SLOTS, SLOT), 0)
        self._block_next = np.zeros(0, np.int32)
        self._add_chunk()
        for name, kind in (
            ("packets", "noack_packet_row *"),
            ("releases", "noack_release_row *"),
        ):
            setattr(self.core, name, pointer_to(getattr(self, name), kind))
        core.noack_relay_open(self.core)

    def watch(self, fd: int, place: int) -> None:
        """Wait for the datagrams of a socket, too; closing it ends this.

        Args:
            fd: its descriptor.
            place: its place among the sockets.

        Raises:
            OSError: the system refuses.
        """
        self.sockets["fd"][place] = fd
        if error := core.noack_relay_watch(self.core, fd, place):
            raise OSError(error, "epoll_ctl")

    def wait_for_only(self, fd: int, place: int, wait_ns: int) -> None:
        """Wait for the datagrams of no socket but this one, by receiving from it.

        Args:
            fd: its descriptor.
            place: its place among the sockets.
            wait_ns: how long receiving from it waits.
        """
        self.sockets["fd"][place] = fd
        self.core.only_socket, self.core.receive_wait_ns = place, wait_ns

    def add_room(self) -> None:
        """Make room for one more delayed datagram and its copy, if there is memory."""
        relay = self.core
        relay.no_memory = not has_headroom(
            2 * (self._heap.nbytes + self._slots.nbytes + self._waiting.nbytes)
        )
        if relay.no_memory:
            return
        if relay.free_slots < 2:
            self._set_slots(double_length(self._heap), double_length(self._slots), len(self._slots))
        # Any two datagrams fit into one chunk.
        if relay.free_blocks < core.NOACK_CHUNK_BLOCKS // 2:
            self._add_chunk()

    def add_clients(self) -> None:
        """Double the maximum number of clients."""
        count = len(self.clients)
        clients = zeros_in_lines(2 * count, CLIENT)
        clients[:count] = self.clients
        sockets = np.zeros(self.first_path + 2 * count, SOCKET)
        clients["number"][count:] = sockets["fd"] = -1
        sockets[: self.first_path + count] = self.sockets
        self._set_clients(clients, sockets)
        for row in np.flatnonzero(clients["number"] >= 0).tolist():
            core.noack_client_insert(self.core, row)

    def take_rows(self) -> tuple[StructRows, StructRows]:
        """Return the collected rows of the two tables, which the next ones overwrite."""
        packets, releases = self.core.packet_rows, self.core.release_rows
        self.core.packet_rows = self.core.release_rows = 0
        return self.packets[:packets], self.releases[:releases]

    def latest_ns(self, direction: int, rows: int) -> Integers:
        """Return the last departure time (rows,) of each flow's packets in flight; −1: none."""
        latest = np.full(rows, core.NOACK_NEVER_NS, np.int64)
        core.noack_relay_latest(self.core, direction, pointer_to(latest, "int64_t *"))
        return latest

    def close(self) -> None:
        """Stop waiting for datagrams."""
        self._epoll.close()

    def _set_clients(self, clients: StructRows, sockets: StructRows) -> None:
        self.clients, self.sockets = clients, sockets
        self._table = np.full(_TABLE_SHARE * len(clients), -1, np.int32)
        self.core.client_rows, self.core.table_places = len(clients), len(self._table)
        self.core.clients = pointer_to(clients, "noack_client *")
        self.core.sockets = pointer_to(sockets, "noack_socket *")
        self.core.table = pointer_to(self._table, "int32_t *")

    def _set_slots(self, heap: StructRows, slots: StructRows, begin: int) -> None:
        """Use these arrays; the slots from ``begin`` on are free."""
        relay, count = self.core, len(slots)
        slots["next"][begin:] = np.arange(begin + 1, count + 1)
        slots["next"][-1] = relay.free_slot
        relay.free_slot, relay.slot_count = begin, count
        relay.free_slots += count - begin
        self._heap, self._slots = heap, slots
        relay.heap = pointer_to(heap, "noack_heap_entry *")
        relay.slots = pointer_to(slots, "noack_slot *")
        waiting: StructRows = np.zeros(count, dtype_of("noack_waiting"))
        waiting[:begin] = self._waiting[:begin]
        self._waiting = waiting
        relay.waiting = pointer_to(waiting, "noack_waiting *")

    def _add_chunk(self) -> None:
        relay, blocks = self.core, core.NOACK_CHUNK_BLOCKS
        self._chunks.append(np.empty(blocks * core.NOACK_BLOCK_BYTES, np.uint8))
        begin = len(self._block_next)
        following = np.arange(begin + 1, begin + 1 + blocks, dtype=np.int32)
        following[-1] = relay.free_block
        relay.free_block = begin
        relay.free_blocks += blocks
        self._block_next = np.concatenate((self._block_next, following))
        self._chunk_addresses = np.array([chunk.ctypes.data for chunk in self._chunks], np.intp)
        relay.block_count = len(self._block_next)
        relay.block_next = pointer_to(self._block_next, "int32_t *")
        relay.chunks = pointer_to(self._chunk_addresses, "uint8_t * *")


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

    def _set_keeps(self) -> None:
        flips_bits = any(impairment.flips_bits for impairment in self.settings.impairments)
        self.row.keeps = self.tracks or flips_bits


def has_headroom(wanted_bytes: int = 0) -> bool:
    """Whether ``wanted_bytes`` and the headroom can be allocated; the check takes microseconds."""
    try:
        np.empty(_HEADROOM_BYTES + wanted_bytes, np.uint8)
    except MemoryError:
        return False
    return True


_Element = TypeVar("_Element", bound=np.generic)


def zeros_in_lines(count: int, dtype: np.dtype[_Element]) -> NDArray[_Element]:
    """Return an array of zeros, (count,), that begins at a cache line: a multiple of 64 bytes."""
    size_bytes = count * dtype.itemsize
    room = np.zeros(size_bytes + 64, np.uint8)
    begin = -room.ctypes.data % 64
    return room[begin : begin + size_bytes].view(dtype)


def double_length(array: StructRows) -> StructRows:
    """Return an array of twice the length; the new elements are 0."""
    return np.concatenate((array, np.zeros_like(array)))


def name_array(packed: bytes) -> Bytes:
    """Return a packed socket address as an array, (NAME_BYTES,) of bytes."""
    return np.frombuffer(packed.ljust(NAME_BYTES, b"\0"), np.uint8)
