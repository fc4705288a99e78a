"""Live probes through the emulator: `noack measure` in processes of its own."""

import json
import socket
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from noack.traces.trace_formats import read_trace
from tests.integration.conftest import Start, starting

LONG_S = 120


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Start `noack WORDS`; what still runs at the end is killed."""
    with starting() as begin:
        yield partial(begin, cwd=tmp_path)


def line_with(stream: Any, word: str) -> str:
    """Return the next line that has a word."""
    for line in stream:
        if word in line:
            return str(line)
    raise AssertionError(f"ended without {word!r}")


def listener(start: Start, host: str = "127.0.0.1", *words: object) -> tuple[Any, str]:
    process = start("measure", "--listen", f"{host}:0", "--json", *words)
    return process, line_with(process.stderr, "listening on").split()[-1]


def emulator(start: Start, to: str, *words: str) -> str:
    host = to.rpartition(":")[0]
    listen = f"{host}:{free_port(host)}"
    process = start("netem", "--listen", listen, "--to", to, *words)
    line_with(process.stdout, "ready")
    return listen


def free_port(host: str) -> int:
    family = socket.AF_INET6 if host.startswith("[") else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        probe.bind((host.strip("[]"), 0))
        return int(probe.getsockname()[1])


def document(process: Any) -> dict[str, Any]:
    out, err = process.communicate(timeout=LONG_S)
    assert process.returncode == 0, err
    return dict(json.loads(out))


def test_periodic_losses_are_measured_exactly(start: Start, tmp_path: Path) -> None:
    process, to = listener(start, "[::1]", "--save", "received.csv")
    via = emulator(start, to, "loss", "periodic", "1/5")
    sender = start("measure", via, "--rate", "500hz", "--for", "1s", "--save", "sent.csv")
    assert sender.wait(LONG_S) == 0
    found = document(process)
    trace = read_trace(tmp_path / "received.csv")
    assert len(trace) == 500
    # The emulator's first datagram of each period of five is lost, whatever the machine does.
    first = int(np.flatnonzero(trace.lost)[0])
    assert np.flatnonzero(trace.lost).tolist() == list(range(first, 500, 5))
    assert found["lost"] == 100
    sent = (tmp_path / "sent.csv").read_text().splitlines()
    assert len(sent) == 501
