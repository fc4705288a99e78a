"""Decode the request that ``tc`` would send to the kernel for given words."""

import shutil
import struct
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

_SHIM = """
#include <sys/socket.h>
#include <unistd.h>
ssize_t sendmsg(int fd, const struct msghdr *message, int flags) {
    for (size_t i = 0; i < message->msg_iovlen; i++)
        if (write(1, message->msg_iov[i].iov_base, message->msg_iov[i].iov_len) < 0) _exit(3);
    _exit(0);
}
"""
_OPTIONS = 2
_KINDS = {1: "correlation", 3: "reorder", 4: "corrupt", 5: "loss", 6: "rate"}
_LOSSES = {1: "state", 2: "gemodel"}
_LATENCY64, _JITTER64 = 10, 11
_UNIT = 2**32 - 1


class Request(NamedTuple):
    """A netem request; probabilities and correlations are in [0, 1], times in seconds."""

    limit: int
    delay_s: float
    jitter_s: float
    delay_correlation: float
    loss: float
    loss_correlation: float
    duplicate: float
    corrupt: tuple[float, float]
    reorder: tuple[float, float]
    gap: int
    state: tuple[float, ...] | None
    """p13, p31, p32, p14, p23."""
    gemodel: tuple[float, ...] | None
    """p, r, h, 1 − k."""
    rate: tuple[int, int, int, int] | None
    """Bytes per second, overhead, cell size, cell overhead."""


class Tc:
    """The program ``tc``; its request to the kernel is intercepted."""

    def __init__(self, folder: Path) -> None:
        source = folder / "shim.c"
        self._shim = folder / "shim.so"
        source.write_text(_SHIM)
        command = ["gcc", "-shared", "-fPIC", "-o", self._shim, source]
        subprocess.run(command, check=True, capture_output=True, timeout=60)
        self._ticks_per_s = 1.0
        (self._ticks_per_s,) = (self._read(["delay", "1s"]).delay_s,)

    @staticmethod
    def available() -> bool:
        """Whether ``tc`` and a compiler are installed."""
        return shutil.which("tc") is not None and shutil.which("gcc") is not None

    def request(self, words: str) -> Request | None:
        """Return the request for these words; None if tc refuses them."""
        return self._read(words.split())

    def _read(self, words: Sequence[str]) -> Request | None:
        done = subprocess.run(
            ["tc", "qdisc", "add", "dev", "lo", "root", "netem", *words],
            env={"LD_PRELOAD": str(self._shim), "PATH": "/usr/sbin:/sbin:/usr/bin:/bin"},
            capture_output=True, check=False, timeout=20,
        )  # fmt: skip
        if done.returncode != 0:
            return None
        # A netlink header of 16 bytes, a tc header of 20, then attributes.
        return self._decoded(_attributes(done.stdout[36:])[_OPTIONS])

    def _decoded(self, options: bytes) -> Request:
        latency, limit, loss, gap, duplicate, jitter = struct.unpack("=6I", options[:24])
        found = _attributes(options[24:])
        own = {name: found[kind] for kind, name in _KINDS.items() if kind in found}
        delay_correlation, loss_correlation, _ = _shares(own.get("correlation", bytes(12)))
        chains = {_LOSSES[kind]: _shares(data) for kind, data in _attributes(
            own.get("loss", b"")).items()}  # fmt: skip
        wide = [found.get(kind) for kind in (_LATENCY64, _JITTER64)]
        delay_s, jitter_s = (
            ticks / self._ticks_per_s if exact is None else struct.unpack("=q", exact)[0] * 1e-9
            for ticks, exact in zip((latency, jitter), wide, strict=True)
        )
        return Request(
            limit, delay_s, jitter_s, delay_correlation, loss / _UNIT, loss_correlation,
            duplicate / _UNIT,
            _pair(own.get("corrupt", bytes(8))), _pair(own.get("reorder", bytes(8))), gap,
            chains.get("state"), chains.get("gemodel"),
            struct.unpack("=IiIi", own["rate"]) if "rate" in own else None,
        )  # fmt: skip


def _attributes(data: bytes) -> dict[int, bytes]:
    found = {}
    while len(data) >= 4:
        length, kind = struct.unpack("=HH", data[:4])
        found[kind & 0x3FFF] = data[4:length]
        data = data[(length + 3) // 4 * 4 :]
    return found


def _shares(data: bytes) -> tuple[float, ...]:
    return tuple(number / _UNIT for (number,) in struct.iter_unpack("=I", data))


def _pair(data: bytes) -> tuple[float, float]:
    probability, correlation = _shares(data)
    return probability, correlation
