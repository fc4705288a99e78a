"""The events that the pump reports to taps."""

from typing import Any

from netem.engine.pump.libc_calls import address_of, array_at, memcpy
from netem.engine.pump.payload_store import block_address
from netem.engine.pump.pump_layout import BLOCK_BYTES, CLIENT, DIRECTION, Memory
from netem.relay_events import EVENT
from noack.impairments.link_records import NEVER_NS, PacketDecision

_EVENT_BYTES = EVENT.itemsize
_SOURCE = EVENT.fields["source"][1]  # type: ignore[index]
_DESTINATION = EVENT.fields["destination"][1]  # type: ignore[index]
_CLIENT_BYTES = CLIENT.itemsize
_CLIENT_NAME = CLIENT.fields["name"][1]  # type: ignore[index]
_CLIENT_LOCAL = CLIENT.fields["local"][1]  # type: ignore[index]
_DIRECTION_BYTES = DIRECTION.itemsize
_SERVER = DIRECTION.fields["name"][1]  # type: ignore[index]
_LISTEN = DIRECTION.fields["listen"][1]  # type: ignore[index]
_AF_INET = 2


def has_room(memory: Memory, size_bytes: int) -> bool:
    """Whether three events fit: arrival of a datagram, its departure, its copy's departure."""
    pump = memory.pump[0]
    if pump.taps == 0:
        return True
    if pump.events + pump.leaving + 3 > len(memory.events):
        return False
    return pump.taps == 1 or pump.data + pump.leaving_bytes + 3 * size_bytes <= len(memory.data)


def tell_arrival(
    memory: Memory, way: int, client: int, address: int, decision: PacketDecision
) -> None:
    """Report the arrival of a datagram and the decision.

    Args:
        memory: the pump's memory.
        way: number of the direction.
        client: row of the client.
        address: address of the payload.
        decision: the decision.
    """
    pump, size_bytes = memory.pump[0], decision.size_bytes
    event = memory.events[pump.events]
    _fill(memory, event, way, client, pump.now_ns, decision.packet, decision.fate, size_bytes)
    event.consecutive_losses = decision.consecutive_losses
    event.delay_ns = -1
    event.copy_delay_ns = -1
    if decision.release_ns != NEVER_NS:
        event.delay_ns = decision.release_ns - pump.now_ns
    if decision.copy_ns != NEVER_NS:
        event.copy_delay_ns = decision.copy_ns - pump.now_ns
    event.hold_back_ns = decision.hold_back_ns
    event.bit = decision.bit
    event.copy_bit = decision.copy_bit
    event.departure = 0
    event.copy = 0
    event.stale = 0
    _tell_addresses(memory, event, way, client, way & 1)
    if pump.taps == 2:
        memcpy(address_of(memory.data) + pump.data, address, size_bytes)
        pump.data += size_bytes
    pump.events += 1


def tell_departure(memory: Memory, number: int, now_ns: int) -> None:
    """Report the departure of a datagram.

    Args:
        memory: the pump's memory.
        number: its row in ``leaving``.
        now_ns: time of departure.
    """
    pump, leaving = memory.pump[0], memory.leaving[number]
    event = memory.events[pump.events]
    _fill(
        memory, event, leaving.direction, leaving.client, now_ns, leaving.packet, leaving.fate,
        leaving.size_bytes,
    )  # fmt: skip
    event.consecutive_losses = 0
    event.delay_ns = now_ns - leaving.arrival_ns
    event.copy_delay_ns = -1
    event.hold_back_ns = 0
    event.bit = leaving.bit
    event.copy_bit = -1
    event.departure = 1
    event.copy = leaving.copy
    event.stale = leaving.stale
    _tell_addresses(memory, event, leaving.direction, leaving.client, 1 - (leaving.direction & 1))
    if pump.taps == 2:
        place = address_of(memory.data) + pump.data
        if leaving.slot < 0:
            memcpy(place, leaving.address, leaving.size_bytes)
        else:
            block, left_bytes = memory.slots[leaving.slot].block, leaving.size_bytes
            while left_bytes > 0:
                length = min(left_bytes, BLOCK_BYTES)
                memcpy(place, block_address(memory.chunks, block), length)
                place += length
                left_bytes -= length
                block = memory.block_next[block]
        pump.data += leaving.size_bytes
    pump.events += 1


def _fill(
    memory: Memory,
    event: Any,
    way: int,
    client: int,
    now_ns: int,
    packet: int,
    fate: int,
    size_bytes: int,
) -> None:
    pump = memory.pump[0]
    event.t_ns = pump.unix_ns + now_ns
    event.flow = memory.clients[client].number
    event.packet = packet
    event.mansd = memory.directions[way].mansd
    event.offset = pump.data
    event.size_bytes = size_bytes
    event.link = way >> 1
    event.direction = way & 1
    event.fate = fate


def _tell_addresses(memory: Memory, event: Any, way: int, client: int, server_side: int) -> None:
    """Write source and destination address of a datagram on one side of a link."""
    pump = memory.pump[0]
    here = address_of(memory.clients) + client * _CLIENT_BYTES
    link = address_of(memory.directions) + (way - (way & 1)) * _DIRECTION_BYTES
    near, far = here + _CLIENT_NAME, link + _LISTEN
    if server_side:
        near, far = here + _CLIENT_LOCAL, link + _SERVER
    if way & 1:
        near, far = far, near
    place = address_of(memory.events) + pump.events * _EVENT_BYTES
    event.interface = way - (way & 1) + server_side
    event.family, event.source_port = _tell_host(memory, near, place + _SOURCE)
    _, event.destination_port = _tell_host(memory, far, place + _DESTINATION)


def _tell_host(memory: Memory, name: int, place: int) -> tuple[int, int]:
    """Copy a socket address's host to ``place``; return the IP version and the port."""
    head = array_at(memory.data, name, 4, 1)
    port = (int(head[2]) << 8) | int(head[3])
    if head[0] == _AF_INET:
        memcpy(place, name + 4, 4)
        return 4, port
    memcpy(place, name + 8, 16)
    return 6, port
