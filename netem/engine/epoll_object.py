"""The pump's epoll object."""

import ctypes
import os
import select
import struct

from netem.engine.pump.pump_layout import READY_WORDS, SYS_EPOLL_PWAIT2

_EPOLL_CTL_ADD = 1
_FORMAT = "=IQ" if READY_WORDS == 3 else "=IIQ"


class Epoll:
    """The pump's epoll object, which returns the numbers of the sockets that are ready."""

    def __init__(self) -> None:
        self._epoll = select.epoll()
        self._libc = ctypes.CDLL(None, use_errno=True)

    def fileno(self) -> int:
        """Return the file descriptor."""
        return self._epoll.fileno()

    def add(self, fd: int, number: int) -> None:
        """Wait for a socket too; ``number`` is returned when it is ready. Closing removes it."""
        pad = [0] * (READY_WORDS - 3)
        event = struct.pack(_FORMAT, select.EPOLLIN, *pad, number)
        if self._libc.epoll_ctl(self.fileno(), _EPOLL_CTL_ADD, fd, event) != 0:
            code = ctypes.get_errno()
            raise OSError(code, os.strerror(code))

    def waits_by_ns(self) -> bool:
        """Whether the kernel has epoll_pwait2."""
        event = ctypes.create_string_buffer(4 * READY_WORDS)
        limit = struct.pack("=qq", 0, 0)
        status = self._libc.syscall(
            *map(ctypes.c_long, (SYS_EPOLL_PWAIT2, self.fileno())),
            event, ctypes.c_long(1), limit, None, ctypes.c_long(0),
        )  # fmt: skip
        return bool(status >= 0)

    def close(self) -> None:
        """Close the epoll object."""
        self._epoll.close()
