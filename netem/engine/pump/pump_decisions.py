"""What becomes of the datagrams at hand, and what was delayed and is due."""

from netem.engine.pump.client_table import find, key_of
from netem.engine.pump.libc_calls import ENOMEM, array_at
from netem.engine.pump.payload_store import blocks_for, keep, pop, push
from netem.engine.pump.pump_events import has_room, tell_arrival
from netem.engine.pump.pump_layout import (
    CARRY_ON,
    EVENTS_FULL,
    LEAVING_FULL,
    NAME_BYTES,
    NEW_CLIENT,
    NO_NAME,
    SERVER_NAME,
    STORE_FULL,
    Memory,
)
from netem.rule_records import PacketDecision
from netem.rules.link_rules import LinkMemory, LinkProgram, admit, leave
from netem.rules.mansd import NEVER_NS

_HEAD_BYTES = 16
"""Of a control message: its length, its level and its kind."""
_STAMP = 1 | 35 << 32
"""Level and kind: SOL_SOCKET, SCM_TIMESTAMPNS."""
_NS = 1_000_000_000


def let_out_due(memory: Memory, state_like: LinkMemory, until_ns: int) -> int:
    """Line up what is due; return why this ends: CARRY_ON, or what there is no room for.

    Args:
        memory: the pump's.
        state_like: a state; only its types count.
        until_ns: what is due by then is.
    """
    pump = memory.pump[0]
    while pump.heap > 0 and memory.heap[0].release_ns <= until_ns:
        entry = memory.heap[0]
        slot = memory.slots[entry.slot]
        if pump.leaving == len(memory.leaving):
            return LEAVING_FULL
        if not has_room(memory, slot.size_bytes):
            return EVENTS_FULL
        release_ns, number = entry.release_ns, entry.slot
        pop(memory)
        pump.now_ns = max(pump.now_ns, release_ns)
        memory.clients[slot.client].in_flight -= 1
        _line_up(
            memory, state_like, slot.direction, slot.client, slot.packet, slot.arrival_ns,
            release_ns, slot.size_bytes, 0, number, slot.bit, slot.copy, slot.fate, 1, slot.counts,
        )  # fmt: skip
    return CARRY_ON


def decide(
    memory: Memory, program_like: LinkProgram, state_like: LinkMemory, verdict: PacketDecision
) -> int:
    """Decide on the datagrams at hand, all from one socket; return why this ends.

    Args:
        memory: the pump's.
        program_like: a program; only its types count.
        state_like: a state; likewise.
        verdict: room for one.
    """
    pump = memory.pump[0]
    back = pump.batch_socket >= pump.first_path
    client_row = pump.batch_socket - pump.first_path
    link = memory.clients[client_row].link if back else pump.batch_socket
    way = 2 * link + back
    direction = memory.directions[way]
    program = LinkProgram(
        array_at(program_like.stages, direction.stages, direction.stages_rows, 0),
        array_at(program_like.chances, direction.chances, direction.chances_rows, 0),
        array_at(program_like.chains, direction.chains, direction.chains_rows, 0),
        array_at(program_like.four_states, direction.four_states, direction.four_states_rows, 0),
        array_at(program_like.scripts, direction.scripts, direction.scripts_rows, 0),
        array_at(program_like.waits, direction.waits, direction.waits_rows, 0),
        array_at(program_like.bottlenecks, direction.bottlenecks, direction.bottlenecks_rows, 0),
        array_at(program_like.darknesses, direction.darknesses, direction.darknesses_rows, 0),
        array_at(program_like.integers, direction.integers, direction.integers_rows, 0),
        array_at(program_like.reals, direction.reals, direction.reals_rows, 0),
        array_at(program_like.decisions, direction.decisions, direction.decisions_rows, 0),
        array_at(
            program_like.decisions_begin, direction.decisions_begin,
            direction.decisions_begin_rows, 0,
        ),
        direction.mansd,
        direction.limit,
        direction.scored != 0,
        direction.tracks != 0,
    )  # fmt: skip
    state = LinkMemory(
        array_at(state_like.flows, direction.flows, direction.rows, 0),
        array_at(state_like.memory, direction.memory, direction.rows, direction.stages_rows),
        array_at(state_like.recent_ns, direction.recent_ns, direction.rows, direction.width),
        array_at(state_like.queues, direction.queues, direction.queue_rows, 0),
        array_at(state_like.departures_ns, direction.departures_ns, direction.departure_rows, 0),
        memory.link_states[way],
        memory.counters[way],
    )
    while pump.batch_next < pump.batch_end:
        header = memory.in_headers[pump.batch_next]
        _read_arrival(memory)
        # Never before what was decided already; so what is due between two datagrams leaves there.
        now_ns = max(pump.now_ns, min(pump.arrival_ns, pump.read_ns))
        reason = let_out_due(memory, state_like, now_ns)
        if reason != CARRY_ON:
            return reason
        pump.now_ns = now_ns
        size_bytes = header.size_bytes
        address = memory.in_vectors[pump.batch_next].base
        if pump.leaving + 2 > len(memory.leaving):
            return LEAVING_FULL
        if not has_room(memory, size_bytes):
            return EVENTS_FULL
        taken = True
        if direction.keeps != 0 and (
            pump.free_slots < 2 or pump.free_blocks < 2 * blocks_for(size_bytes)
        ):
            if pump.no_memory == 0:
                return STORE_FULL
            memory.errors[way, ENOMEM] += 1
            taken = False
        elif not back:
            name = memory.in_names[pump.batch_next]
            key0, key1, key2, key3 = key_of(name, link)
            client_row = find(memory.table, memory.clients, key0, key1, key2, key3)
            if client_row < 0:
                if direction.full == 0:
                    return NEW_CLIENT
                direction.refused += 1
                taken = False
        if taken:
            client = memory.clients[client_row]
            client.last_ns = now_ns
            admit(program, state, client.place, size_bytes, now_ns, verdict)
            if pump.taps != 0:
                tell_arrival(memory, way, client_row, size_bytes, address, verdict)
            if verdict.release_ns != NEVER_NS:
                intact = verdict.bit < 0
                _release(
                    memory, state_like, way, client_row, address, size_bytes, verdict.packet,
                    verdict.fate, verdict.release_ns, verdict.bit, False, intact,
                )  # fmt: skip
                if verdict.copy_ns != NEVER_NS:
                    _release(
                        memory, state_like, way, client_row, address, size_bytes, verdict.packet,
                        verdict.fate, verdict.copy_ns, verdict.copy_bit, True,
                        not intact and verdict.copy_bit < 0,
                    )  # fmt: skip
        header.name_bytes = NAME_BYTES
        header.control_bytes = pump.control_bytes
        pump.batch_next += 1
    return CARRY_ON


def _read_arrival(memory: Memory) -> None:
    """Read when the datagram at hand came."""
    pump = memory.pump[0]
    header, words = memory.in_headers[pump.batch_next], memory.in_controls[pump.batch_next]
    pump.arrival_ns = pump.read_ns
    place, left_bytes = 0, header.control_bytes
    while left_bytes >= _HEAD_BYTES and place + 3 < len(words):
        used_bytes = (words[place] + 7) & ~7
        if words[place + 1] == _STAMP:
            pump.arrival_ns = words[place + 2] * _NS + words[place + 3] - pump.real_ns
        left_bytes -= used_bytes
        place += used_bytes >> 3


def _release(
    memory: Memory,
    state_like: LinkMemory,
    way: int,
    client: int,
    address: int,
    size_bytes: int,
    packet: int,
    fate: int,
    release_ns: int,
    bit: int,
    copy: bool,
    counts: bool,
) -> None:
    """Line up a datagram that leaves now, or keep it until it is due."""
    pump = memory.pump[0]
    number = -1
    delayed = release_ns > pump.now_ns
    if delayed or bit >= 0:
        number = keep(memory, address, size_bytes, bit)
    if delayed:
        slot = memory.slots[number]
        slot.packet = packet
        slot.arrival_ns = pump.now_ns
        slot.direction = way
        slot.client = client
        slot.copy = copy
        slot.counts = counts
        slot.fate = fate
        pump.put += 1
        push(memory, release_ns, pump.put, number)
        memory.clients[client].in_flight += 1
    else:
        _line_up(
            memory, state_like, way, client, packet, pump.now_ns, release_ns, size_bytes, address,
            number, bit, copy, fate, 0, counts,
        )  # fmt: skip


def _line_up(
    memory: Memory,
    state_like: LinkMemory,
    way: int,
    client: int,
    packet: int,
    arrival_ns: int,
    release_ns: int,
    size_bytes: int,
    address: int,
    slot: int,
    bit: int,
    copy: int,
    fate: int,
    delayed: int,
    counts: int,
) -> None:
    """Line up a datagram to be sent, and take note that it leaves."""
    pump, direction = memory.pump[0], memory.directions[way]
    place = memory.clients[client].place
    state = LinkMemory(
        array_at(state_like.flows, direction.flows, direction.rows, 0),
        state_like.memory,
        state_like.recent_ns,
        state_like.queues,
        state_like.departures_ns,
        memory.link_states[way],
        memory.counters[way],
    )
    stale = leave(state, place, packet, size_bytes, delayed != 0, counts != 0)
    leaving = memory.leaving[pump.leaving]
    pump.leaving += 1
    pump.leaving_bytes += size_bytes
    leaving.address = address
    leaving.packet = packet
    leaving.arrival_ns = arrival_ns
    leaving.release_ns = release_ns
    leaving.bit = bit
    leaving.size_bytes = size_bytes
    leaving.slot = slot
    link = way >> 1
    if direction.sends == NO_NAME:
        leaving.socket = pump.first_path + client
    elif direction.sends == SERVER_NAME:
        leaving.socket = len(memory.directions) // 2 + link
    else:
        leaving.socket = link
    leaving.direction = way
    leaving.client = client
    leaving.error = 0
    leaving.delayed = delayed
    leaving.copy = copy
    leaving.fate = fate
    leaving.stale = stale
