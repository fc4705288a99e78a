"""The loop that drives a fleet: serve timers and messages, write rows, send, receive, wait."""

from collections.abc import Callable
from typing import Any

from noack.config.fleet_layout import NEEDS_MATRIX, NEVER_NS, SENDS, STRIDE
from noack.protocol.wire_format import HEADER_BYTES
from noack.runtime.fleet.deadline_heap import lower_first
from noack.runtime.fleet.driver_layout import (
    AT_ONCE,
    BUFFERS,
    HOUSEKEEPING,
    MATRIX_MISSING,
    ROWS_FULL,
    DriverMemory,
)
from noack.runtime.fleet.wire_words import complete_datagram, loop_of_datagram
from noack.runtime.native import libc_calls as libc
from noack.runtime.native.socket_structs import HEADER

_NS = 1_000_000_000
_HEADER_BYTES = HEADER.itemsize
_NONE = -1

Handle = Callable[..., Any]


def driver_of(
    handle: Handle, on_timer: Handle, inline: Callable[[Handle], Any] = lambda function: function
) -> Callable[..., int]:
    """Return the driver of a role with these two functions.

    ``inline`` makes a function known to the compiler.
    """

    @inline
    def serve_message(memory: DriverMemory, own: Any) -> Any:
        """Process the current datagram; return a reason to return to Python, or _NONE."""
        driver, fleet = memory.driver[0], memory.fleet
        place = driver.arrived_next
        begin = place * STRIDE
        size_bytes = memory.headers_in[place].size_bytes
        loop = loop_of_datagram(
            memory.wire, fleet.loops, fleet.arrived, fleet.arrived_reals, begin, size_bytes,
            driver.from_peer != 0,
        )  # fmt: skip
        if loop < 0:
            memory.rejected[claimed_loop(fleet, begin, size_bytes), -1 - loop] += 1
            driver.arrived_next += 1
            return _NONE
        one = fleet.loops[loop]
        outputs = handle(memory.fleet, own, loop, begin, time_ns(memory) - one.phase_ns)
        if outputs == NEEDS_MATRIX:
            return MATRIX_MISSING
        one.newest = fleet.arrived[begin + 2]
        one.accepted += 1
        driver.arrived_next += 1
        put_row(memory, loop, memory.message_rows, driver.message_rows, driver.message_row_bytes)
        driver.message_rows += 1
        if outputs == SENDS:
            put_message(memory, loop)
        return _NONE

    @inline
    def serve_timer(memory: DriverMemory, own: Any, now_ns: int) -> Any:
        """Do the work of the first deadline; return a reason to return to Python, or _NONE."""
        driver, heap = memory.driver[0], memory.heap
        loop = heap[1]
        one = memory.fleet.loops[loop]
        outputs = on_timer(memory.fleet, own, loop, now_ns - one.phase_ns)
        if outputs == NEEDS_MATRIX:
            return MATRIX_MISSING
        if one.due_ns == NEVER_NS:
            driver.due -= 1
            heap[0], heap[1] = heap[2 * driver.due], heap[2 * driver.due + 1]
        else:
            heap[0] = one.due_ns + one.phase_ns
        lower_first(heap, driver.due)
        put_row(memory, loop, memory.timer_rows, driver.timer_rows, driver.timer_row_bytes)
        driver.timer_rows += 1
        if outputs == SENDS:
            put_message(memory, loop)
        return _NONE

    def drive(memory: DriverMemory, own: Any, until_ns: int) -> Any:
        """Drive the fleet until Python is needed, or until a time; return the reason."""
        driver, fleet = memory.driver[0], memory.fleet.fleet[0]
        most_messages = len(memory.message_rows) // driver.message_row_bytes
        most_timers = len(memory.timer_rows) // driver.timer_row_bytes
        most_notes = len(memory.fleet.notes)
        while True:
            works = False
            while driver.arrived_next < driver.arrived_end:
                if driver.message_rows == most_messages or fleet.notes == most_notes:
                    return ROWS_FULL
                if fleet.out == BUFFERS:
                    send(memory)
                reason = serve_message(memory, own)
                if reason != _NONE:
                    return reason
                works = True
            for _ in range(AT_ONCE):
                now_ns = time_ns(memory)
                if driver.due == 0 or memory.heap[0] > now_ns:
                    break
                if driver.timer_rows == most_timers or fleet.notes == most_notes:
                    return ROWS_FULL
                if fleet.out == BUFFERS:
                    send(memory)
                reason = serve_timer(memory, own, now_ns)
                if reason != _NONE:
                    return reason
                works = True
            if driver.fd_in < 0:
                return HOUSEKEEPING
            if fleet.out > 0:
                send(memory)
            if time_ns(memory) >= until_ns:
                return HOUSEKEEPING
            receive(memory)
            if driver.arrived_end == 0 and not wait(memory, until_ns, works):
                return HOUSEKEEPING

    return drive


def claimed_loop(fleet: Any, begin: int, size_bytes: int) -> int:
    """Return the loop that a rejected datagram names; 0 if there is no such loop."""
    loop = (fleet.arrived[begin] >> 48) & 0xFFFF
    return int(loop) if size_bytes >= HEADER_BYTES and loop < len(fleet.loops) else 0


def put_row(memory: DriverMemory, loop: int, rows: Any, number: int, row_bytes: int) -> None:
    """Append the row that a machine has written to a table."""
    prefix_bytes = memory.driver[0].prefix_bytes
    place = libc.address_of(rows) + number * row_bytes
    if prefix_bytes != 0:
        memory.data[0] = loop
        libc.memcpy(place, libc.address_of(memory.data), prefix_bytes)
    libc.memcpy(place + prefix_bytes, libc.address_of(memory.fleet.row), row_bytes - prefix_bytes)


def put_message(memory: DriverMemory, loop: int) -> None:
    """Complete the datagram of the message that a machine has written."""
    fleet = memory.fleet.fleet[0]
    complete_datagram(memory.wire, memory.fleet.out, fleet.out * STRIDE, loop)
    fleet.out += 1


def send(memory: DriverMemory) -> None:
    """Send all datagrams that wait; a failure is counted."""
    driver, fleet = memory.driver[0], memory.fleet.fleet[0]
    place = 0
    while place < fleet.out:
        headers = libc.address_of(memory.headers_out) + place * _HEADER_BYTES
        sent = libc.sendmmsg(driver.fd_out, headers, fleet.out - place, libc.MSG_DONTWAIT)
        if sent > 0:
            driver.sent += sent
            place += sent
        else:
            memory.errors[libc.errno(memory.integers) & 255] += 1
            place += 1
    fleet.out = 0


def receive(memory: DriverMemory) -> None:
    """Receive as many datagrams as there are buffers, without waiting."""
    driver = memory.driver[0]
    headers = libc.address_of(memory.headers_in)
    taken = libc.recvmmsg(driver.fd_in, headers, BUFFERS, libc.MSG_DONTWAIT, 0)
    driver.arrived_next = 0
    driver.arrived_end = max(taken, 0)


def wait(memory: DriverMemory, until_ns: int, rests: bool) -> bool:
    """Wait for a datagram or a deadline, or rest; return False if a signal interrupted it."""
    driver = memory.driver[0]
    now_ns = time_ns(memory)
    wait_ns = until_ns - now_ns
    if driver.due > 0:
        wait_ns = min(wait_ns, memory.heap[0] - now_ns)
    if driver.speed != 1.0:
        wait_ns = int(wait_ns / driver.speed)
    watched = 1
    if rests and 0 < wait_ns < driver.rest_ns:
        wait_ns = driver.rest_ns
        watched = 0
    wait_ns = max(wait_ns, 0)
    memory.time[0] = wait_ns // _NS
    memory.time[1] = wait_ns % _NS
    memory.poll[0] = driver.fd_in
    memory.poll[1] = libc.POLLIN
    address = libc.address_of(memory.time)
    return bool(libc.ppoll(libc.address_of(memory.poll), watched, address, 0) >= 0)


def time_ns(memory: DriverMemory) -> int:
    """Return the simulated time; the same as :meth:`noack.core.clock.RunClock.now_ns`."""
    driver = memory.driver[0]
    if driver.fd_in < 0:
        return int(driver.epoch_ns)  # without sockets, Python sets the time
    wall_ns = libc.clock_ns(libc.CLOCK_MONOTONIC, memory.time) - driver.epoch_ns
    return int(wall_ns) if driver.speed == 1.0 else int(wall_ns * driver.speed)
