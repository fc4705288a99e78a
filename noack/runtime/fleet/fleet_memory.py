"""Allocates the memory of a fleet's driver."""

from collections.abc import Sequence

import numpy as np

from noack.config.fleet_layout import (
    FLEET,
    NEVER_NS,
    NOTE,
    SCRATCH,
    STRIDE,
    FleetMemory,
    FleetParts,
)
from noack.config.message_sizes import MessageSizes
from noack.protocol.record_tables import LOOP as LOOP_COLUMN
from noack.protocol.wire_format import MAGIC, VERSION, Flow, datagram_bytes
from noack.runtime.fleet.driver_layout import BUFFERS, DRIVER, WIRE, Array, DriverMemory, WireMemory
from noack.runtime.fleet.wire_words import REASONS, keyed_state
from noack.runtime.native.socket_structs import HEADER, VECTOR

_ROWS = 8192
"""Rows of each table that are collected before Python takes them."""
_NOTES = 1024
"""Notes that are collected likewise."""


def driver_memory(
    parts: FleetParts,
    phases_ns: Sequence[int],
    dimensions: tuple[int, int],
    row_types: tuple[np.dtype[np.void], np.dtype[np.void]],
    wire: WireMemory,
) -> DriverMemory:
    """Return the memory; ``row_types`` are those of timers and of messages."""
    count, (timer_row, message_row) = len(phases_ns), row_types
    fleet, driver = np.zeros(1, FLEET), np.zeros(1, DRIVER)
    fleet["n"], fleet["m"] = dimensions
    fleet["loops"] = count
    loops = parts.loops
    loops["phase_ns"] = phases_ns
    due = sorted(
        (int(one["due_ns"] + one["phase_ns"]), number)
        for number, one in enumerate(loops)
        if one["due_ns"] != NEVER_NS
    )
    heap = np.zeros(2 * count, np.int64)
    heap[: 2 * len(due)] = np.array(due, np.int64).ravel()
    driver["due"], driver["speed"], driver["fd_in"], driver["fd_out"] = len(due), 1.0, -1, -1
    driver["prefix_bytes"] = 2 * (LOOP_COLUMN in (message_row.names or ()))
    driver["timer_row_bytes"], driver["message_row_bytes"] = (
        timer_row.itemsize,
        message_row.itemsize,
    )
    arrived, out = np.zeros(BUFFERS * STRIDE, np.int64), np.zeros(BUFFERS * STRIDE, np.int64)
    row = np.zeros(max(timer_row.itemsize, message_row.itemsize) // 8 + 1, np.int64)
    vectors_in, headers_in = _headers(arrived, 8 * STRIDE)
    vectors_out, headers_out = _headers(out, datagram_bytes(int(wire.settings[0]["entries_sent"])))
    machines = FleetMemory(
        fleet, loops, out, out.view(np.float64), arrived, arrived.view(np.float64),
        np.zeros(_NOTES, NOTE), row, row.view(np.float64), np.zeros(SCRATCH),
    )  # fmt: skip
    return DriverMemory(
        fleet=machines,
        wire=wire,
        driver=driver,
        heap=heap,
        timer_rows=np.zeros(_ROWS * timer_row.itemsize, np.uint8),
        message_rows=np.zeros(_ROWS * message_row.itemsize, np.uint8),
        rejected=np.zeros((count, len(REASONS)), np.int64),
        errors=np.zeros(256, np.int64),
        headers_in=headers_in,
        vectors_in=vectors_in,
        headers_out=headers_out,
        vectors_out=vectors_out,
        time=np.zeros(2, np.int64),
        poll=np.zeros(2, np.int32),
        integers=np.zeros(1, np.int32),
        data=np.zeros(2, np.uint16),
    )


def wire_memory(
    sends: Flow, receives: Flow, sizes: MessageSizes, run_id: int, key: bytes
) -> WireMemory:
    """Return what is needed to read and write the datagrams of a process."""
    settings = np.zeros(1, WIRE)
    sent, received = sizes.entries(sends), sizes.entries(receives)
    settings["sends"] = int.from_bytes(MAGIC, "little") | VERSION << 16 | sends << 24 | sent << 32
    settings["run_id"] = np.uint64(run_id).view(np.int64)
    settings["entries_sent"], settings["entries_received"] = sent, received
    settings["flow_received"] = receives
    return WireMemory(settings, keyed_state(key), np.zeros(8, np.uint64), np.zeros(16, np.uint64))


def _headers(words: Array, size_bytes: int) -> tuple[Array, Array]:
    """Return vectors and headers of the datagrams whose words these are."""
    vectors, headers = np.zeros(BUFFERS, VECTOR), np.zeros(BUFFERS, HEADER)
    numbers = np.arange(BUFFERS)
    vectors["base"] = words.ctypes.data + numbers * STRIDE * 8
    vectors["size_bytes"] = size_bytes
    headers["vectors"] = vectors.ctypes.data + numbers * VECTOR.itemsize
    headers["n_vectors"] = 1
    return vectors, headers
