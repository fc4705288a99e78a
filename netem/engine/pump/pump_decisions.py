"""Decides for received packets, and releases delayed packets that are due."""

from typing import Any

from netem.engine.pump import pump_layout as layout
from netem.engine.pump.client_table import find, key_of
from netem.engine.pump.payload_store import blocks_for, keep, pop, push
from netem.engine.pump.pump_clock import simulated_ns_of
from netem.engine.pump.pump_events import has_room, report_arrival
from netem.engine.pump.pump_layout import Array, Memory
from netem.engine.pump.pump_records import record_packet, record_release
from noack.impairments.link_records import NEVER_NS
from noack.protocol.wire_format import HEADER_BYTES
from noack.runtime.native.libc_calls import ENOMEM, address_of, array_at, link_decide, link_leave

_HEAD_BYTES = 16
"""Header of a control message: length, level and kind."""
_STAMP = 1 | 35 << 32
"""Level and kind: SOL_SOCKET, SCM_TIMESTAMPNS."""
_NS = 1_000_000_000
_NO_CLIENT = -1
_REFUSED = -2
_NO_ROOM = -3


def release_due(memory: Memory, until_ns: int) -> int:
    """Queue the packets that are due for sending; return CARRY_ON, or which buffer is full."""
    pump = memory.pump[0]
    while pump.heap > 0 and memory.heap[0].release_ns <= until_ns:
        entry = memory.heap[0]
        slot = memory.slots[entry.slot]
        if pump.leaving == len(memory.leaving):
            return layout.LEAVING_FULL
        if not has_room(memory, slot.size_bytes):
            return layout.EVENTS_FULL
        leaving = memory.leaving[pump.leaving]
        leaving.slot = entry.slot
        leaving.release_ns = entry.release_ns
        pop(memory)
        pump.now_ns = max(pump.now_ns, leaving.release_ns)
        memory.clients[slot.client].in_flight -= 1
        leaving.address = 0
        leaving.packet = slot.packet
        leaving.arrival_ns = slot.arrival_ns
        leaving.bit = slot.bit
        leaving.size_bytes = slot.size_bytes
        leaving.direction = slot.direction
        leaving.client = slot.client
        leaving.delayed = 1
        leaving.copy = slot.copy
        leaving.fate = slot.fate
        leaving.counts = slot.counts
        _line_up(memory)
        if pump.records != 0:
            record_release(memory, pump.leaving - 1, until_ns)
    return layout.CARRY_ON


def decide(memory: Memory, decisions: Array) -> int:
    """Decide for the packets received from one socket; return CARRY_ON, or why this ended."""
    pump, decision = memory.pump[0], decisions[0]
    reverse = pump.batch_socket >= pump.first_path
    link = pump.batch_socket
    if reverse:
        link = memory.clients[pump.batch_socket - pump.first_path].link
    number = 2 * link + reverse
    direction = memory.directions[number]
    while pump.batch_next < pump.batch_end:
        header = memory.in_headers[pump.batch_next]
        _read_arrival(memory)
        # Decision times ascend, so that a packet that is due between two arrivals leaves
        # between them. In a record, the time of the decision is the machine's input.
        now_ns = max(pump.now_ns, pump.read_ns)
        if pump.records == 0:
            now_ns = max(pump.now_ns, min(pump.arrival_ns, pump.read_ns))
        reason = release_due(memory, now_ns)
        if reason != layout.CARRY_ON:
            return reason
        pump.now_ns = now_ns
        if now_ns >= pump.change_ns:
            return layout.CHANGE_DUE
        size_bytes = header.size_bytes
        if pump.leaving + 2 > len(memory.leaving):
            return layout.LEAVING_FULL
        if not has_room(memory, size_bytes):
            return layout.EVENTS_FULL
        client_row = _client_of(memory, number, size_bytes)
        if client_row == _NO_CLIENT:
            return layout.NEW_CLIENT
        if client_row == _NO_ROOM:
            return layout.STORE_FULL
        if client_row >= 0:
            client = memory.clients[client_row]
            client.last_ns = now_ns
            link_decide(direction.link, client.place, size_bytes, now_ns, address_of(decisions))
            address = memory.in_vectors[pump.batch_next].base
            if pump.taps != 0:
                report_arrival(memory, number, client_row, address, decision)
            if pump.records != 0:
                record_packet(memory, number, client_row, address, decision)
            if decision.release_ns != NEVER_NS:
                _release(memory, number, client_row, address, decision, 0)
            if decision.copy_ns != NEVER_NS:
                _release(memory, number, client_row, address, decision, 1)
        header.name_bytes = layout.NAME_BYTES
        header.control_bytes = pump.control_bytes
        pump.batch_next += 1
    return layout.CARRY_ON


def _client_of(memory: Memory, number: int, size_bytes: int) -> int:
    """Return the row of the current packet's client, or why there is none; count a refused packet.

    A packet is refused if it and its copy might not fit into the store, if it comes from a client
    beyond the maximum number, or if it is of no loop of the run.
    """
    pump, direction = memory.pump[0], memory.directions[number]
    if direction.keeps != 0 and (
        pump.free_slots < 2 or pump.free_blocks < 2 * blocks_for(size_bytes)
    ):
        if pump.no_memory == 0:
            return _NO_ROOM
        memory.errors[number, ENOMEM] += 1
        return _REFUSED
    if number & 1:
        row = pump.batch_socket - pump.first_path
        return row if pump.by_loop == 0 else _row_of_loop(memory, size_bytes)
    key0, key1, key2, key3 = key_of(memory.in_names[pump.batch_next], number >> 1)
    row = find(memory.table, memory.clients, key0, key1, key2, key3)
    if row < 0:
        if direction.full == 0:
            return _NO_CLIENT
        direction.refused += 1
        return _REFUSED
    return row if pump.by_loop == 0 else _row_of_loop(memory, size_bytes)


def _row_of_loop(memory: Memory, size_bytes: int) -> int:
    """Return the row of the current packet's loop; count a packet of no loop as refused."""
    pump = memory.pump[0]
    if size_bytes >= HEADER_BYTES:
        words = array_at(memory.time, memory.in_vectors[pump.batch_next].base, 1, 1)
        loop = (words[0] >> 48) & 0xFFFF
        if loop < pump.loops:
            return loop
    pump.no_loop += 1
    return _REFUSED


def _read_arrival(memory: Memory) -> None:
    """Read the arrival time of the current packet.

    The kernel's timestamps are of the wall clock. One from before the relay's start is ignored: the
    wall clock was set since.
    """
    pump = memory.pump[0]
    header, words = memory.in_headers[pump.batch_next], memory.in_controls[pump.batch_next]
    pump.arrival_ns = pump.read_ns
    place, left_bytes = 0, header.control_bytes
    while left_bytes >= _HEAD_BYTES and place + 3 < len(words):
        used_bytes = (words[place] + 7) & ~7
        if words[place + 1] == _STAMP:
            waited_ns = pump.real_ns - (words[place + 2] * _NS + words[place + 3])
            waited_ns = simulated_ns_of(memory, waited_ns)
            if waited_ns <= pump.read_ns:
                pump.arrival_ns = pump.read_ns - waited_ns
        left_bytes -= used_bytes
        place += used_bytes >> 3


def _release(
    memory: Memory,
    direction: int,
    client: int,
    address: int,
    decision: Any,
    copy: int,
) -> None:
    """Queue a packet or its copy for sending if it leaves now, else store it until it is due."""
    pump = memory.pump[0]
    release_ns, bit, counts = decision.release_ns, decision.bit, decision.bit < 0
    if copy != 0:
        release_ns, bit = decision.copy_ns, decision.copy_bit
        counts = not counts and bit < 0
    number = -1
    delayed = release_ns > pump.now_ns
    if delayed or bit >= 0:
        number = keep(memory, address, decision.size_bytes, bit)
    if delayed:
        slot = memory.slots[number]
        slot.packet = decision.packet
        slot.arrival_ns = pump.now_ns
        slot.direction = direction
        slot.client = client
        slot.copy = copy
        slot.counts = counts
        slot.fate = decision.fate
        pump.put += 1
        # At equal times, datagrams leave in order of direction, then of arrival.
        push(memory, release_ns, ((direction & 1) << 62) + pump.put, number)
        memory.clients[client].in_flight += 1
        return
    leaving = memory.leaving[pump.leaving]
    leaving.address = address
    leaving.packet = decision.packet
    leaving.arrival_ns = pump.now_ns
    leaving.release_ns = release_ns
    leaving.bit = bit
    leaving.size_bytes = decision.size_bytes
    leaving.slot = number
    leaving.direction = direction
    leaving.client = client
    leaving.delayed = 0
    leaving.copy = copy
    leaving.fate = decision.fate
    leaving.counts = counts
    _line_up(memory)


def _line_up(memory: Memory) -> None:
    """Queue the packet in the first free row of ``leaving`` for sending; record its departure."""
    pump = memory.pump[0]
    leaving = memory.leaving[pump.leaving]
    number = leaving.direction
    direction, link = memory.directions[number], number >> 1
    leaving.stale = link_leave(
        direction.link, memory.clients[leaving.client].place, leaving.packet, leaving.size_bytes,
        leaving.delayed, leaving.counts,
    )  # fmt: skip
    leaving.error = 0
    pump.leaving += 1
    pump.leaving_bytes += leaving.size_bytes
    if direction.sends == layout.OWN_SOCKET:
        leaving.socket = pump.first_path + leaving.client
    elif direction.sends == layout.CLIENT_NAME:
        leaving.socket = link
    else:
        leaving.socket = len(memory.directions) // 2 + link
