"""The pump's loop: wait, receive, decide, send, and release delayed datagrams."""

from netem.engine.pump import pump_layout as layout
from netem.engine.pump.cache_warming import warm_clients
from netem.engine.pump.error_queue import take_errors
from netem.engine.pump.pump_clock import relay_time_ns, wall_ns_of
from netem.engine.pump.pump_decisions import decide, release_due
from netem.engine.pump.pump_layout import READY_WORDS, SYS_EPOLL_PWAIT2, Array, Memory
from netem.engine.pump.pump_send import send
from noack.runtime.native import libc_calls as libc

_HEADER_BYTES = layout.HEADER.itemsize
_EPOLLERR = 8
_NS = 1_000_000_000
_FEW_BUFFERS = 16
_HOUSEKEEPING_NS = 500_000
"""Housekeeping in Python nearly always takes less time."""
_MOST_PUT_OFF_NS = 10_000_000


def run_pump(
    memory: Memory,
    decisions: Array,
    until_ns: int,
) -> int:
    """Relay until Python is needed, or until a time since the relay's start; return the reason.

    Args:
        memory: the pump's memory.
        decisions: (1,) of ``noack_decision``, a buffer.
        until_ns: latest time to return.
    """
    pump = memory.pump[0]
    while True:
        reason = layout.CARRY_ON
        if pump.batch_next < pump.batch_end:
            reason = decide(memory, decisions)
        if reason == layout.CARRY_ON:
            reason = release_due(memory, pump.read_ns)
        all_taken = pump.ready_next >= pump.ready
        if reason != layout.CARRY_ON or all_taken or pump.slots_in - pump.batch_end < _FEW_BUFFERS:
            if pump.leaving > 0:
                send(memory)
            if reason == layout.LEAVING_FULL:
                continue
            if reason != layout.CARRY_ON:
                return reason
            pump.batch_next = 0
            pump.batch_end = 0
        if all_taken:
            pump.read_ns = relay_time_ns(memory)
            wait_until_ns = until_ns
            if pump.read_ns >= until_ns:
                if not _is_soon_due(memory, until_ns):
                    pump.ready = 0
                    pump.ready_next = 0
                    return layout.HOUSEKEEPING
                wait_until_ns = pump.read_ns + int(_HOUSEKEEPING_NS * pump.speed)
            if not _wait(memory, wait_until_ns):
                return layout.HOUSEKEEPING
        if pump.ready_next < pump.ready:
            _receive(memory)
            warm_clients(memory)


def _is_soon_due(memory: Memory, until_ns: int) -> bool:
    """Whether to postpone housekeeping because it would make the next delayed datagram late."""
    pump = memory.pump[0]
    return (
        pump.heap > 0
        and memory.heap[0].release_ns - pump.read_ns < _HOUSEKEEPING_NS * pump.speed
        and pump.read_ns - until_ns < _MOST_PUT_OFF_NS * pump.speed
    )


def _wait(memory: Memory, until_ns: int) -> bool:
    """Wait for a datagram or the next release time; return False if a signal interrupted it."""
    pump = memory.pump[0]
    wait_ns = wall_ns_of(memory, until_ns - pump.read_ns)
    if pump.heap > 0:
        due_ns = wall_ns_of(memory, memory.heap[0].release_ns - pump.read_ns)
        wait_ns = max(min(wait_ns, due_ns - pump.spin_ns), 0)
    events = len(memory.ready) // READY_WORDS
    address = libc.address_of(memory.ready)
    memory.time[0] = wait_ns // _NS
    memory.time[1] = wait_ns % _NS
    if pump.sleeps == 0:
        found = libc.syscall(
            SYS_EPOLL_PWAIT2, pump.epoll, address, events, libc.address_of(memory.time), 0, 0
        )
    else:
        memory.poll[0] = pump.epoll
        memory.poll[1] = libc.POLLIN
        found = libc.ppoll(libc.address_of(memory.poll), 1, libc.address_of(memory.time), 0)
        if found > 0:
            found = libc.epoll_wait(pump.epoll, address, events, 0)
    pump.ready = max(found, 0)
    pump.ready_next = 0
    if pump.ready == 0:
        pump.read_ns = relay_time_ns(memory)
    return found >= 0


def _receive(memory: Memory) -> None:
    """Receive datagrams from the next socket that is ready, as far as there are buffers."""
    pump = memory.pump[0]
    event = pump.ready_next * READY_WORDS
    socket = memory.ready[event + READY_WORDS - 2]
    pump.ready_next += 1
    if memory.ready[event] & _EPOLLERR:
        take_errors(memory, socket)
    begin = pump.batch_end
    headers = libc.address_of(memory.in_headers) + begin * _HEADER_BYTES
    fd = memory.sockets[socket].fd
    taken = libc.recvmmsg(fd, headers, pump.slots_in - begin, libc.MSG_DONTWAIT, 0)
    pump.read_ns = relay_time_ns(memory)
    if pump.stamps != 0:
        pump.real_ns = libc.clock_ns(libc.CLOCK_REALTIME, memory.time)
    if taken > 0:
        pump.batch_socket = socket
        pump.batch_next = begin
        pump.batch_end = begin + taken
