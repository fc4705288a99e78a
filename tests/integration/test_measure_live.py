"""Live probes through the emulator: `noack measure` in processes of its own."""

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from noack.traces.packet_trace import read_trace
from tests.helpers.live_runs import Start, start_commands

LONG_S = 120


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Start `noack WORDS`; what still runs at the end is killed."""
    with start_commands() as begin:
        yield partial(begin, cwd=tmp_path)


def line_with(stream: Any, word: str) -> str:
    """Return the next line that has a word."""
    for line in stream:
        if word in line:
            return str(line)
    raise AssertionError(f"ended without {word!r}")


def test_periodic_losses_are_measured_exactly(start: Start, tmp_path: Path) -> None:
    process = start("measure", "--listen", "[::1]:0", "--json", "--save", "received.csv")
    address = line_with(process.stderr, "listening on").split()[-1]
    relay = start("netem", "--listen", "[::1]:0", "--to", address, "--json", "loss", "periodic", "1/5")
    (link,) = json.loads(line_with(relay.stdout, "ready"))["ready"]
    sender = start("measure", link["listen"], "--rate", "500hz", "--for", "1s", "--save", "sent.csv")
    assert sender.wait(LONG_S) == 0
    out, err = process.communicate(timeout=LONG_S)
    assert process.returncode == 0, err
    report = json.loads(out)
    trace = read_trace(tmp_path / "received.csv")
    assert len(trace) == 500
    # The emulator's first datagram of each period of five is lost, whatever the machine does.
    first = int(np.flatnonzero(trace.lost)[0])
    assert np.flatnonzero(trace.lost).tolist() == list(range(first, 500, 5))
    assert report["lost"] == 100
    sent = (tmp_path / "sent.csv").read_text().splitlines()
    assert len(sent) == 501
