"""Live probes through the emulator: `noack measure` in processes of its own."""

import json
import os
import re
import signal
import socket
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from noack.protocol.probe_format import ProbeDatagram, ProbeKind, encode_probe
from noack.traces.trace_formats import read_trace
from tests.integration.conftest import Start, starting, wait_for

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


def test_a_round_trip_tells_the_two_ways_apart(start: Start, tmp_path: Path) -> None:
    process, to = listener(start)
    words = ["loss", "periodic", "1/5", "--reverse", "loss", "periodic", "1/10"]
    via = emulator(start, to, *words)
    options = ("--rate", "200hz", "--for", "1s", "--round-trip", "--save", "s.csv", "--json")
    document(start("measure", via, *options))
    lost = [line.rpartition(",")[2] for line in (tmp_path / "s.csv").read_text().splitlines()[1:]]
    assert lost.count("forward") == 40
    assert lost.count("reverse") == 16  # every tenth of 160 answers
    assert document(process)["lost"] == 40


def test_a_killed_sender_leaves_a_report_and_a_raw_trace(start: Start, tmp_path: Path) -> None:
    process, to = listener(start, "127.0.0.1", "--silence", "3s")
    sender = start("measure", to, "--rate", "100hz", "--for", "600s", "--save", "sent.csv")
    wait_for_rows(tmp_path / "sent.csv", 50)
    sender.kill()
    assert document(process)["packets"] >= 50


def test_a_killed_listener_leaves_its_raw_trace(start: Start, tmp_path: Path) -> None:
    process, to = listener(start, "127.0.0.1", "--save", "received.csv")
    sender = start("measure", to, "--rate", "100hz", "--for", "600s")
    wait_for_rows(tmp_path / "received.csv", 50)
    process.kill()
    process.wait()
    assert len(read_trace(tmp_path / "received.csv")) >= 49
    line_with(sender.stderr, "Connection refused: is a listener running there?")
    sender.send_signal(signal.SIGINT)
    _, err = sender.communicate(timeout=LONG_S)
    assert sender.returncode == 0
    failed, of = re.search(r"(\d+) of (\d+) sends failed: Connection refused", err).groups()  # type: ignore[union-attr]
    assert 0 < int(failed) < int(of)


def test_other_datagrams_are_ignored_and_counted(start: Start) -> None:
    process, to = listener(start)
    host, _, port = to.rpartition(":")
    stranger = encode_probe(ProbeDatagram(ProbeKind.PROBE, 1, 2, 0, 0, 0, 10**7, 10))
    sender = start("measure", to, "--rate", "100hz", "--for", "2s")
    line_with(process.stderr, "receiving from")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as endpoint:
        for data in (b"", b"foreign", os.urandom(200), stranger, stranger):
            endpoint.sendto(data, (host, int(port)))
    assert sender.wait(LONG_S) == 0
    found = document(process)
    assert found["packets"] == 200
    notes = " ".join(found["remarks"])
    assert "3 not of this program" in notes
    assert "2 of another probe" in notes


def test_ctrl_c_ends_a_listener(start: Start) -> None:
    process, to = listener(start)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=LONG_S)
    assert process.returncode == 130
    assert "stopped before a datagram of a probe arrived" in err
    process, to = listener(start)
    sender = start("measure", to, "--rate", "100hz", "--for", "600s")
    line_with(process.stderr, "receiving from")
    process.send_signal(signal.SIGINT)
    document(process)
    sender.kill()


def wait_for_rows(path: Path, rows: int) -> None:
    wait_for(lambda: path.exists() and path.read_text().count("\n") > rows)
