"""The events that the pump reports to taps."""

from typing import Any

from netem.engine.pump.payload_store import copy_payload
from netem.engine.pump.pump_layout import CLIENT, DIRECTION, Memory
from netem.relay_events import EVENT
from noack.impairments.link_records import NEVER_NS
from noack.runtime.native.libc_calls import address_of, array_at, memcpy

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
    """Whether three events fit: arrival of a datagram, its departure, its copy's departure.

    If there is a record: also whether a row of each table fits.
    """
    pump = memory.pump[0]
    if pump.records != 0 and (
        pump.packet_rows == len(memory.packets) or pump.release_rows == len(memory.releases)
    ):
        return False
    if pump.taps == 0:
        return True
    if pump.events + pump.leaving + 3 > len(memory.events):
        return False
    return pump.taps == 1 or pump.data + pump.leaving_bytes + 3 * size_bytes <= len(memory.data)


def report_arrival(
    memory: Memory, direction: int, client: int, payload: int, decision: Any
) -> None:
    """Report the arrival of a datagram, with the address of its payload, and the decision."""
    pump, size_bytes = memory.pump[0], decision.size_bytes
    event = memory.events[pump.events]
    _fill(memory, event, direction, client, pump.now_ns, decision.packet, decision.fate, size_bytes)
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
    _put_addresses(memory, event, direction, client, direction & 1)
    if pump.taps == 2:
        memcpy(address_of(memory.data) + pump.data, payload, size_bytes)
        pump.data += size_bytes
    pump.events += 1


def report_departure(memory: Memory, number: int, now_ns: int) -> None:
    """Report the departure of the datagram in a row of ``leaving``."""
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
    _put_addresses(memory, event, leaving.direction, leaving.client, 1 - (leaving.direction & 1))
    if pump.taps == 2:
        place = address_of(memory.data) + pump.data
        if leaving.slot < 0:
            memcpy(place, leaving.address, leaving.size_bytes)
        else:
            copy_payload(memory, leaving.slot, place)
        pump.data += leaving.size_bytes
    pump.events += 1


def _fill(
    memory: Memory,
    event: Any,
    direction: int,
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
    event.mansd = memory.directions[direction].mansd
    event.offset = pump.data
    event.size_bytes = size_bytes
    event.link = direction >> 1
    event.direction = direction & 1
    event.fate = fate


def _put_addresses(
    memory: Memory, event: Any, direction: int, client: int, server_side: int
) -> None:
    """Write source and destination address of a datagram on one side of a link."""
    pump = memory.pump[0]
    here = address_of(memory.clients) + client * _CLIENT_BYTES
    link = address_of(memory.directions) + (direction & ~1) * _DIRECTION_BYTES
    near, far = here + _CLIENT_NAME, link + _LISTEN
    if server_side:
        near, far = here + _CLIENT_LOCAL, link + _SERVER
    if direction & 1:
        near, far = far, near
    place = address_of(memory.events) + pump.events * _EVENT_BYTES
    event.interface = (direction & ~1) + server_side
    event.family, event.source_port = _put_host(memory, near, place + _SOURCE)
    _, event.destination_port = _put_host(memory, far, place + _DESTINATION)


def _put_host(memory: Memory, name: int, place: int) -> tuple[int, int]:
    """Copy a socket address's host to ``place``; return the IP version and the port."""
    head = array_at(memory.data, name, 4, 1)
    port = (int(head[2]) << 8) | int(head[3])
    if head[0] == _AF_INET:
        memcpy(place, name + 4, 4)
        return 4, port
    memcpy(place, name + 8, 16)
    return 6, port
