"""The rows of a run's record, written where the core decides (native/link.c).

They are numbered in the order of these calls: a replay calls the rules in the same order.
"""

from typing import Any

from netem.engine.pump.pump_layout import PACKET_ROW, Memory
from noack.protocol.record_tables import PACKET_HEAD_BYTES
from noack.runtime.native.libc_calls import address_of, array_at, memcpy

_ROW_BYTES = PACKET_ROW.itemsize
_HEAD = PACKET_ROW.fields["head"][1]  # type: ignore[index]
_HEAD_WORDS = PACKET_HEAD_BYTES // 8


def record_packet(memory: Memory, direction: int, client: int, payload: int, decision: Any) -> None:
    """Write the row of a datagram with its payload's address and the decision."""
    pump = memory.pump[0]
    row = memory.packets[pump.packet_rows]
    row.input = pump.inputs
    row.sequence = pump.first_number + decision.packet
    row.t_ns = min(pump.arrival_ns, decision.arrival_ns)
    row.now_ns = decision.arrival_ns
    row.flow = pump.loops * direction + client
    row.fate = decision.fate
    row.consecutive_losses = decision.consecutive_losses
    row.release_ns = decision.release_ns
    row.copy_ns = decision.copy_ns
    row.bit = decision.bit
    row.size_bytes = decision.size_bytes
    place = address_of(memory.packets) + pump.packet_rows * _ROW_BYTES + _HEAD
    words = array_at(memory.time, place, _HEAD_WORDS, 1)
    for k in range(_HEAD_WORDS):
        words[k] = 0
    memcpy(place, payload, min(decision.size_bytes, PACKET_HEAD_BYTES))
    pump.packet_rows += 1
    pump.inputs += 1


def record_release(memory: Memory, number: int, now_ns: int) -> None:
    """Write the row of the delayed datagram in a row of ``leaving``; it leaves at ``now_ns``."""
    pump, leaving = memory.pump[0], memory.leaving[number]
    row = memory.releases[pump.release_rows]
    row.input = pump.inputs
    row.sequence = pump.first_number + leaving.packet
    row.t_ns = leaving.release_ns
    row.now_ns = now_ns
    row.flow = pump.loops * leaving.direction + leaving.client
    row.copy = leaving.copy
    row.stale = leaving.stale
    pump.release_rows += 1
    pump.inputs += 1
