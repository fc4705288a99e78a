"""An emulator with limited memory (``ulimit -v``) and many delayed datagrams."""

import errno
import json
import os
import resource
from pathlib import Path

from noack.core.errors import ExitStatus
from tests.netem.control.processes import emulator, send_through, udp_socket

SIZE_BYTES, BATCH, MOST = 60_000, 100, 40_000
MORE_BYTES = 120 * 1024 * 1024
"""Memory that the emulator may use in addition at runtime; all datagrams together exceed it."""
NO_MEMORY = os.strerror(errno.ENOMEM)


def test_datagrams_beyond_the_memory_limit_are_dropped_and_counted() -> None:
    status = ExitStatus.UNINTENDED_LOSSES
    with (
        udp_socket() as server,
        emulator(server.getsockname(), "--stats", "0.05", "delay", "1000s", status=status)
        as (address, process),
    ):  # fmt: skip
        used_bytes = int(Path(f"/proc/{process.pid}/statm").read_text().split()[0]) * 4096
        limit_bytes = used_bytes + MORE_BYTES
        resource.prlimit(process.pid, resource.RLIMIT_AS, (limit_bytes, limit_bytes))
        assert process.stdout is not None
        sent, forward = 0, {}
        for line in process.stdout:
            forward = json.loads(line)["links"][0]["forward"]
            if forward["received"] + sum(forward["unintended"].values()) == sent:
                if NO_MEMORY in forward["unintended"]:
                    break
                assert sent < MOST
                send_through(address, [bytes(SIZE_BYTES)] * BATCH)
                sent += BATCH
        assert forward["in_flight"] == forward["received"] > 100
