"""The request that ``tc`` would send to the kernel for given words."""

import shutil
import subprocess
from pathlib import Path

_SHIM = """
#include <sys/socket.h>
#include <unistd.h>
ssize_t sendmsg(int fd, const struct msghdr *message, int flags) {
    for (size_t i = 0; i < message->msg_iovlen; i++)
        if (write(1, message->msg_iov[i].iov_base, message->msg_iov[i].iov_len) < 0) _exit(3);
    _exit(0);
}
"""
_HEADERS_BYTES = 36
"""A netlink header of 16 bytes and one of tc; the first has a time stamp."""


class Tc:
    """The program ``tc``; its request to the kernel is intercepted."""

    def __init__(self, folder: Path) -> None:
        source = folder / "shim.c"
        self._shim = folder / "shim.so"
        source.write_text(_SHIM)
        command = ["gcc", "-shared", "-fPIC", "-o", self._shim, source]
        subprocess.run(command, check=True, capture_output=True, timeout=60)

    @staticmethod
    def available() -> bool:
        """Whether ``tc`` and a compiler are installed."""
        return shutil.which("tc") is not None and shutil.which("gcc") is not None

    def request(self, words: str) -> bytes | None:
        """Return the request's attributes for these words; None if tc refuses them."""
        done = subprocess.run(
            ["tc", "qdisc", "add", "dev", "lo", "root", "netem", *words.split()],
            env={"LD_PRELOAD": str(self._shim), "PATH": "/usr/sbin:/sbin:/usr/bin:/bin"},
            capture_output=True, check=False, timeout=20,
        )  # fmt: skip
        return done.stdout[_HEADERS_BYTES:] if done.returncode == 0 else None
