"""Reads the errors of earlier datagrams from a socket's error queue (IP_RECVERR).

With IP_RECVERR, a send to a full device queue fails (ENOBUFS). However, each ICMP error also makes
the socket's next call fail once. Therefore the error queue is emptied after a failed call, to find
out whether an ICMP error caused the failure.
"""

from netem.engine.pump.pump_layout import HEADER, Memory
from noack.runtime.native.libc_calls import ECONNREFUSED, MSG_DONTWAIT, address_of, recvmmsg

_MSG_ERRQUEUE = 0x2000
_RECVERR = 0 | 11 << 32
_RECVERR_6 = 41 | 25 << 32
"""Level and kind: SOL_IP, IP_RECVERR; SOL_IPV6, IPV6_RECVERR."""
_LOW_WORD = 0xFFFFFFFF
_ICMP = 2
_ICMP_6 = 3
"""Origins of an error. Errors of other origins are local; they make the call itself fail."""
_HEADER_BYTES = HEADER.itemsize


def take_errors(memory: Memory, socket: int) -> int:
    """Empty a socket's error queue; return the number of ICMP errors.

    Port-unreachable errors of the destination are counted.
    """
    pump, headers = memory.pump[0], memory.error_headers
    found, taken = 0, len(headers)
    while taken == len(headers):
        for k in range(len(headers)):
            headers[k].control_bytes = memory.error_controls.shape[1] * 8
        fd = memory.sockets[socket].fd
        taken = recvmmsg(fd, address_of(headers), len(headers), MSG_DONTWAIT | _MSG_ERRQUEUE, 0)
        for k in range(taken):
            error = _icmp_error(memory, k)
            found += error != 0
            if error == ECONNREFUSED and socket >= pump.first_path:
                link = memory.clients[socket - pump.first_path].link
                memory.directions[2 * link].port_unreachable += 1
            elif error == ECONNREFUSED and socket >= len(memory.directions) // 2:
                link = socket - len(memory.directions) // 2
                memory.directions[2 * link].port_unreachable += 1
    return found


def _icmp_error(memory: Memory, k: int) -> int:
    """Return the errno of entry k if it comes from ICMP, else 0."""
    words, left_bytes, place = memory.error_controls[k], memory.error_headers[k].control_bytes, 0
    while left_bytes >= 32 and place + 3 < len(words):
        used_bytes = (words[place] + 7) & ~7
        kind, error = words[place + 1], words[place + 2]
        if kind in (_RECVERR, _RECVERR_6) and (error >> 32) & 255 in (_ICMP, _ICMP_6):
            return error & _LOW_WORD
        left_bytes -= used_bytes
        place += used_bytes >> 3
    return 0
