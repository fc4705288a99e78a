"""Allocates the pump's memory, and enlarges it between two calls of the pump."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from netem.engine.histogram import BUCKETS
from netem.engine.pump import pump_layout
from netem.engine.pump.pump_layout import Array, Memory
from netem.engine.relay_base import has_headroom
from netem.relay_events import EVENT

_BUFFERS = 64
_READY = 64
_LEAVING = 128
_ERRORS = 16
_VECTORS = 1024
"""Maximum number of vectors in one message."""
_CLIENTS = 64
_SLOTS = 256
_EVENTS = 8192
_DATA_BYTES = 16 * 1024 * 1024
_TABLE_SHARE = 4
"""Places of the hash table per client."""


class PumpMemory:
    """The pump's memory for a number of links; ``segment`` and ``taps`` as in its layout.

    ``row_count`` is the number of rows of the record that are kept for each table; 0: no record.
    """

    def __init__(self, links: int, segment: bool, taps: int, row_count: int = 0) -> None:
        directions = 2 * links
        self.first_path = 2 * links
        self._buffers = np.empty(_BUFFERS * pump_layout.SLOT_STRIDE + 64, np.uint8)
        self._chunks: list[Array] = []
        self.memory = Memory(
            pump=np.zeros(1, pump_layout.PUMP),
            sockets=np.zeros(2 * links + _CLIENTS, pump_layout.SOCKET),
            clients=np.zeros(_CLIENTS, pump_layout.CLIENT),
            table=np.full(_TABLE_SHARE * _CLIENTS, -1, np.int32),
            directions=np.zeros(directions, pump_layout.DIRECTION),
            delays=np.zeros((directions, BUCKETS), np.int64),
            lateness=np.zeros((directions, BUCKETS), np.int64),
            errors=np.zeros((directions, 256), np.int64),
            time=np.zeros(2, np.int64),
            poll=np.zeros(2, np.int32),
            ready=np.zeros(_READY * pump_layout.READY_WORDS, np.uint32),
            in_headers=np.zeros(_BUFFERS, pump_layout.HEADER),
            in_vectors=np.zeros(_BUFFERS, pump_layout.VECTOR),
            in_names=np.zeros((_BUFFERS, pump_layout.NAME_BYTES // 8), np.int64),
            in_controls=np.zeros((_BUFFERS, pump_layout.CONTROL_BYTES // 8), np.int64),
            error_headers=np.zeros(_ERRORS, pump_layout.HEADER),
            error_controls=np.zeros((_ERRORS, pump_layout.ERROR_CONTROL_BYTES // 8), np.int64),
            out_headers=np.zeros(_LEAVING, pump_layout.HEADER),
            out_first=np.zeros(_LEAVING, np.int32),
            out_vectors=np.zeros(_VECTORS, pump_layout.VECTOR),
            out_controls=np.zeros(_LEAVING, pump_layout.CONTROL),
            leaving=np.zeros(_LEAVING, pump_layout.LEAVING),
            order=np.zeros(_LEAVING, np.int32),
            heap=np.zeros(_SLOTS, pump_layout.ENTRY),
            slots=np.zeros(_SLOTS, pump_layout.SLOT),
            chunks=np.zeros(0, np.int64),
            block_next=np.zeros(0, np.int32),
            events=np.zeros(_EVENTS if taps else 0, EVENT),
            data=np.zeros(_DATA_BYTES if taps == 2 else 0, np.uint8),
            packets=np.zeros(row_count, pump_layout.PACKET_ROW),
            releases=np.zeros(row_count, pump_layout.RELEASE_ROW),
            integers=np.zeros(1, np.int32),
        )
        self.memory.clients["number"] = -1
        self.memory.sockets["fd"] = -1
        pump = self.pump
        pump["first_path"], pump["slots_in"], pump["taps"] = 2 * links, _BUFFERS, taps
        pump["segment"], pump["segment_below"] = segment, pump_layout.MOST_BYTES
        pump["speed"], pump["records"] = 1.0, row_count > 0
        pump["change_ns"] = np.iinfo(np.int64).max
        pump["free_slot"] = pump["free_block"] = -1
        self._lay_out_buffers()
        self._free_slots(0)
        self.add_chunk()

    @property
    def pump(self) -> Any:
        """The pump's own fields, a row of :data:`netem.engine.pump.pump_layout.PUMP`."""
        return self.memory.pump[0]

    def read_controls(self) -> None:
        """Receive control messages too."""
        headers, controls = self.memory.in_headers, self.memory.in_controls
        self.pump["control_bytes"] = pump_layout.CONTROL_BYTES
        headers["control"] = (
            controls.ctypes.data + np.arange(len(headers)) * pump_layout.CONTROL_BYTES
        )
        headers["control_bytes"] = pump_layout.CONTROL_BYTES

    def add_room(self) -> bool:
        """Make room for one more delayed datagram and its copy; return whether memory sufficed."""
        old = self.memory
        if not has_headroom(2 * (old.heap.nbytes + old.slots.nbytes)):
            return False
        if self.pump["free_slots"] < 2:
            count = len(old.slots)
            self.memory = old._replace(heap=doubled(old.heap), slots=doubled(old.slots))
            self._free_slots(count)
        # Any two datagrams fit into one chunk.
        if self.pump["free_blocks"] < pump_layout.CHUNK_BLOCKS // 2:
            self.add_chunk()
        return True

    def add_chunk(self) -> None:
        """Add a chunk of blocks."""
        memory, pump = self.memory, self.pump
        chunk = np.empty(pump_layout.CHUNK_BLOCKS * pump_layout.BLOCK_BYTES, np.uint8)
        self._chunks.append(chunk)
        begin = len(memory.block_next)
        following = np.arange(begin + 1, begin + 1 + pump_layout.CHUNK_BLOCKS, dtype=np.int32)
        following[-1] = pump["free_block"]
        pump["free_block"] = begin
        pump["free_blocks"] += pump_layout.CHUNK_BLOCKS
        self.memory = memory._replace(
            chunks=np.append(memory.chunks, np.int64(chunk.ctypes.data)),
            block_next=np.concatenate((memory.block_next, following)),
        )

    def add_clients(self) -> None:
        """Double the maximum number of clients; the new hash table is empty."""
        old = self.memory
        count = len(old.clients)
        clients = doubled(old.clients)
        clients["number"][count:] = -1
        sockets = np.zeros(self.first_path + 2 * count, pump_layout.SOCKET)
        sockets["fd"] = -1
        sockets[: self.first_path + count] = old.sockets
        table = np.full(2 * _TABLE_SHARE * count, -1, np.int32)
        self.memory = old._replace(clients=clients, sockets=sockets, table=table)

    def latest_ns(self, direction: int, rows: int) -> NDArray[np.int64]:
        """Return the last departure time (rows,) of each flow's packets in flight; −1: none."""
        memory = self.memory
        heap = memory.heap[: self.pump["heap"]]
        slots = memory.slots[heap["slot"]]
        own = slots["direction"] == direction
        latest = np.full(rows, -1, np.int64)
        places = memory.clients["place"][slots["client"][own]]
        np.maximum.at(latest, places, heap["release_ns"][own])
        return latest

    def _free_slots(self, begin: int) -> None:
        slots, pump = self.memory.slots, self.pump
        slots["next"][begin:] = np.arange(begin + 1, len(slots) + 1)
        slots["next"][-1] = pump["free_slot"]
        pump["free_slot"] = begin
        pump["free_slots"] += len(slots) - begin

    def _lay_out_buffers(self) -> None:
        memory, pump = self.memory, self.pump
        first = (self._buffers.ctypes.data + 63) // 64 * 64
        numbers = np.arange(_BUFFERS)
        pump["buffers"] = first
        memory.in_vectors["base"] = first + numbers * pump_layout.SLOT_STRIDE
        memory.in_vectors["size_bytes"] = pump_layout.MOST_BYTES
        headers = memory.in_headers
        headers["name"] = memory.in_names.ctypes.data + numbers * pump_layout.NAME_BYTES
        headers["name_bytes"] = pump_layout.NAME_BYTES
        headers["vectors"] = memory.in_vectors.ctypes.data + numbers * pump_layout.VECTOR.itemsize
        headers["n_vectors"] = 1
        controls = memory.error_controls
        memory.error_headers["control"] = (
            controls.ctypes.data + np.arange(_ERRORS) * pump_layout.ERROR_CONTROL_BYTES
        )


def doubled(array: Array) -> Array:
    """Return an array of twice the length; the new elements are 0."""
    grown = np.zeros((2 * len(array), *array.shape[1:]), array.dtype)
    grown[: len(array)] = array
    return grown
