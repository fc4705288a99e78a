"""Sends the queued datagrams: one call per socket, each flow in its order."""

from netem.engine.histogram import bucket_of
from netem.engine.pump import pump_layout as layout
from netem.engine.pump.error_queue import take_errors
from netem.engine.pump.payload_store import block_address, blocks_for, drop
from netem.engine.pump.pump_clock import relay_time_ns
from netem.engine.pump.pump_events import report_departure
from netem.engine.pump.pump_layout import Memory
from noack.runtime.native import libc_calls as libc

_NO_WAIT = libc.MSG_DONTWAIT
_EINTR = 4
_EAGAIN = 11
_ENOBUFS = 105
_HEADER_BYTES = layout.HEADER.itemsize
_VECTOR_BYTES = layout.VECTOR.itemsize
_CONTROL_BYTES = layout.CONTROL.itemsize
_CLIENT_BYTES = layout.CLIENT.itemsize
_CLIENT_NAME = layout.CLIENT.fields["name"][1]  # type: ignore[index]
_DIRECTION_BYTES = layout.DIRECTION.itemsize
_DIRECTION_NAME = layout.DIRECTION.fields["name"][1]  # type: ignore[index]
_UDP = 17
_UDP_SEGMENT = 103
_SEGMENT_CONTROL_BYTES = 18
_MOST_SEGMENTS = 64
_MOST_SEGMENTED_BYTES = 65_507
_TRIES = 3
_MOST_TRIES = 64
"""Maximum number of tries. An ICMP error of an earlier datagram makes one send fail. A send that
fails without an ICMP error in the error queue, or this often, is expected to fail again."""
_PATIENCE_NS = 50_000_000
"""Maximum time to wait for a full socket. There is no wait for a full queue of the device
(ENOBUFS), since it would delay other links."""


def send(memory: Memory) -> None:
    """Send all queued datagrams."""
    pump = memory.pump[0]
    pump.stamp += 1
    sockets = 0
    for number in range(pump.leaving):
        leaving = memory.leaving[number]
        socket = memory.sockets[leaving.socket]
        if socket.stamp != pump.stamp:
            socket.stamp = pump.stamp
            socket.head = number
            memory.order[sockets] = leaving.socket
            sockets += 1
        else:
            memory.leaving[socket.tail].next = number
        socket.tail = number
        leaving.next = -1
    for place in range(sockets):
        socket = memory.sockets[memory.order[place]]
        number = socket.head
        while number >= 0:
            headers, following = _fill(memory, number)
            done = headers
            if socket.fd >= 0:
                done = _transmit(memory, memory.order[place], headers, following)
            else:
                for k in range(headers):
                    memory.leaving[memory.out_first[k]].error = socket.error
            if done < headers:
                following = memory.out_first[done]
            now_ns = relay_time_ns(memory)
            while number != following:
                _account(memory, number, now_ns)
                number = memory.leaving[number].next
    pump.leaving = 0
    pump.leaving_bytes = 0


def _fill(memory: Memory, number: int) -> tuple[int, int]:
    """Fill headers from datagram ``number`` on; return their number and the next datagram."""
    pump = memory.pump[0]
    headers, vectors = 0, 0
    base = libc.address_of(memory.out_vectors)
    while number >= 0 and headers < len(memory.out_headers):
        leaving = memory.leaving[number]
        size_bytes = leaving.size_bytes
        needed = 1 if leaving.slot < 0 else blocks_for(size_bytes)
        if vectors + needed > len(memory.out_vectors):
            break
        header = memory.out_headers[headers]
        memory.out_first[headers] = number
        header.vectors = base + vectors * _VECTOR_BYTES
        first_vector = vectors
        vectors = _add_vectors(memory, vectors, number)
        number = leaving.next
        header.control = 0
        header.control_bytes = 0
        if pump.segment != 0 and 0 < size_bytes < pump.segment_below:
            segments, all_bytes, last_bytes = 1, size_bytes, size_bytes
            to_client = memory.directions[leaving.direction].sends == layout.CLIENT_NAME
            while number >= 0 and segments < _MOST_SEGMENTS and last_bytes == size_bytes:
                other = memory.leaving[number]
                last_bytes = other.size_bytes
                needed = 1 if other.slot < 0 else blocks_for(last_bytes)
                if (
                    not 0 < last_bytes <= size_bytes
                    or all_bytes + last_bytes > _MOST_SEGMENTED_BYTES
                    or vectors + needed > len(memory.out_vectors)
                    or other.direction != leaving.direction
                    or (other.client != leaving.client and to_client)
                ):
                    break
                vectors = _add_vectors(memory, vectors, number)
                all_bytes += last_bytes
                segments += 1
                number = other.next
            if segments > 1:
                control = memory.out_controls[headers]
                control.bytes = _SEGMENT_CONTROL_BYTES
                control.level = _UDP
                control.kind = _UDP_SEGMENT
                control.size_bytes = size_bytes
                header.control = libc.address_of(memory.out_controls) + headers * _CONTROL_BYTES
                header.control_bytes = _CONTROL_BYTES
        header.n_vectors = vectors - first_vector
        _address(memory, headers, leaving.direction, leaving.client)
        headers += 1
    return headers, number


def _address(memory: Memory, header: int, number: int, client: int) -> None:
    """Write the destination of a message."""
    direction = memory.directions[number]
    name, name_bytes = 0, 0
    if direction.sends == layout.CLIENT_NAME:
        name = libc.address_of(memory.clients) + client * _CLIENT_BYTES + _CLIENT_NAME
        name_bytes = memory.clients[client].name_bytes
    elif direction.sends == layout.DESTINATION_NAME:
        name = libc.address_of(memory.directions) + number * _DIRECTION_BYTES + _DIRECTION_NAME
        name_bytes = direction.name_bytes
    memory.out_headers[header].name = name
    memory.out_headers[header].name_bytes = name_bytes


def _add_vectors(memory: Memory, vectors: int, number: int) -> int:
    """Write the vectors of a datagram's payload; return the next free vector."""
    leaving = memory.leaving[number]
    if leaving.slot < 0:
        vector = memory.out_vectors[vectors]
        vector.base = leaving.address
        vector.size_bytes = leaving.size_bytes
        return vectors + 1
    block, left_bytes = memory.slots[leaving.slot].block, leaving.size_bytes
    for k in range(blocks_for(left_bytes)):
        vector = memory.out_vectors[vectors + k]
        vector.base = block_address(memory.chunks, block)
        vector.size_bytes = min(left_bytes, layout.BLOCK_BYTES)
        left_bytes -= layout.BLOCK_BYTES
        block = memory.block_next[block]
    return vectors + blocks_for(leaving.size_bytes)


def _transmit(memory: Memory, socket: int, headers: int, following: int) -> int:
    """Send a number of messages; return the number of messages that were sent or failed.

    If it is smaller than ``headers``, the kernel does not segment the next message: the headers of
    the remaining datagrams must be filled again. ``following`` is the datagram after the last
    message; −1 none.
    """
    pump, fd = memory.pump[0], memory.sockets[socket].fd
    done, tries, waited_ns = 0, 0, 0
    base, vectors = libc.address_of(memory.out_headers), libc.address_of(memory.out_vectors)
    while done < headers:
        header = memory.out_headers[done]
        if headers - done == 1 and header.n_vectors == 1 and header.control_bytes == 0:
            # For a single datagram, sendto is cheaper; libc's own also handles thread cancellation.
            vector = memory.out_vectors[(header.vectors - vectors) // _VECTOR_BYTES]
            sent = libc.syscall(
                layout.SYS_SENDTO, fd, vector.base, vector.size_bytes, _NO_WAIT, header.name,
                header.name_bytes,
            )  # fmt: skip
            sent = min(sent + 1, 1)
        else:
            sent = libc.sendmmsg(fd, base + done * _HEADER_BYTES, headers - done, _NO_WAIT)
        if sent > 0:
            done += sent
            tries = 0
            continue
        error = libc.errno(memory.integers)
        if error == _EINTR:
            continue
        if error == _EAGAIN and waited_ns < _PATIENCE_NS:
            waited_ns += _wait_for_room(memory, fd)
            continue
        number = memory.out_first[done]
        if error not in (_EAGAIN, _ENOBUFS):
            tries += 1
            if tries < (_MOST_TRIES if take_errors(memory, socket) > 0 else _TRIES):
                continue
            if header.control_bytes > 0:
                size_bytes = memory.leaving[number].size_bytes
                pump.segment_below = min(pump.segment_below, size_bytes)
                return done
        done += 1
        tries = 0
        end = memory.out_first[done] if done < headers else following
        while number != end:
            memory.leaving[number].error = error
            number = memory.leaving[number].next
    return done


def _wait_for_room(memory: Memory, fd: int) -> int:
    """Wait at most 1 ms until a socket is writable; return the waiting time in ns."""
    begun_ns = libc.clock_ns(libc.CLOCK_MONOTONIC, memory.time)
    memory.poll[0] = fd
    memory.poll[1] = libc.POLLOUT
    libc.poll(libc.address_of(memory.poll), 1, 1)
    return max(libc.clock_ns(libc.CLOCK_MONOTONIC, memory.time) - begun_ns, 1000)


def _account(memory: Memory, number: int, now_ns: int) -> None:
    """Count a datagram as sent or failed, and free its payload."""
    pump, leaving = memory.pump[0], memory.leaving[number]
    if leaving.error == 0:
        memory.delays[leaving.direction, bucket_of(now_ns - leaving.arrival_ns)] += 1
        if leaving.delayed != 0:
            memory.lateness[leaving.direction, bucket_of(now_ns - leaving.release_ns)] += 1
        if pump.taps != 0:
            report_departure(memory, number, now_ns)
    else:
        memory.errors[leaving.direction, leaving.error & 255] += 1
    if leaving.slot >= 0:
        drop(memory, leaving.slot)
