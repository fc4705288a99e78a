"""An emulator whose memory is limited (``ulimit -v``), and much that is delayed."""

import errno
import json
import os
import resource
from pathlib import Path

import pytest

from netem.engine.engine_choice import Engine
from noack.core.errors import ExitStatus
from tests.netem.control.processes import emulator, send_through, udp_socket

SIZE_BYTES, BATCH, MOST = 60_000, 100, 40_000
MORE_BYTES = 120 * 1024 * 1024
"""What the emulator may take when it runs; all datagrams have much more."""
NO_MEMORY = os.strerror(errno.ENOMEM)


@pytest.mark.parametrize("engine", ["batched", "plain"])
def test_what_there_is_no_memory_for_is_dropped_and_counted(engine: Engine) -> None:
    options = ("--engine", engine, "--stats", "0.05", "delay", "1000s")
    status = ExitStatus.UNINTENDED_LOSSES
    with udp_socket() as server, emulator(server.getsockname(), *options, status=status) as running:
        address, process = running
        used_bytes = int(Path(f"/proc/{process.pid}/statm").read_text().split()[0]) * 4096
        limit_bytes = used_bytes + MORE_BYTES
        resource.prlimit(process.pid, resource.RLIMIT_AS, (limit_bytes, limit_bytes))
        assert process.stdout is not None
        sent, forward = 0, {}
        for line in process.stdout:
            forward = json.loads(line)["links"][0]["forward"]
            if forward["arrived"] + sum(forward["unintended"].values()) == sent:
                if NO_MEMORY in forward["unintended"]:
                    break
                assert sent < MOST
                send_through(address, [bytes(SIZE_BYTES)] * BATCH)
                sent += BATCH
        assert forward["in_flight"] == forward["arrived"] > 100
