"""One process each, started by hand; and the network emulator on its own."""

import json
import os
import re
import signal
import socket
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cosim.record import load_record
from tests.integration.conftest import Running, noack_command, settings, wait_for

ROLES = ("plant", "sensor", "controller", "netem")


@pytest.fixture
def by_hand(tmp_path: Path) -> Iterator[Callable[[str], subprocess.Popen[str]]]:
    """Start one process as a person would; whatever is left is killed at the end."""
    started: list[subprocess.Popen[str]] = []

    def begin(role: str) -> subprocess.Popen[str]:
        started.append(_start_by_hand(role, tmp_path))
        return started[-1]

    yield begin
    for process in started:
        if process.poll() is None:
            process.kill()
            process.communicate()


def _start_by_hand(role: str, tmp_path: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        noack_command(role, "--json"),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"XDG_RUNTIME_DIR": str(tmp_path)},
    )


def test_five_terminals_in_any_order(
    start: Callable[..., Running],
    by_hand: Callable[[str], subprocess.Popen[str]],
    tmp_path: Path,
) -> None:
    early = [by_hand(role) for role in ROLES[:2]]
    recording = start(*settings(speed=5.0, horizon_s=10.0), command=("record", "lane_following"))
    (folder,) = [tmp_path / f"noack-{os.getuid()}"]
    ticket = folder / "default.json"
    wait_for(ticket.exists)
    assert stat.S_IMODE(ticket.stat().st_mode) == 0o600
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    key = json.loads(ticket.read_text())["key"].encode()
    late = [by_hand(role) for role in ROLES[2:]]
    finished = recording.finish()
    assert finished.status == 0, finished.stderr
    assert finished.summary["missing_samples"] == 0
    assert finished.summary["lost_outside_netem"] == 0
    for process in early + late:
        stdout, stderr = process.communicate(timeout=30)
        assert process.returncode == 0, stderr
        assert json.loads(stdout)["ended"] == "horizon"
    assert not ticket.exists()
    for path in finished.run_dir.rglob("*"):
        assert not path.is_file() or key not in path.read_bytes()
    assert len(load_record(finished.run_dir)["plant_step"]) == 5001


def test_a_process_that_a_person_ends_is_named(
    start: Callable[..., Running], by_hand: Callable[[str], subprocess.Popen[str]]
) -> None:
    recording = start(*settings(speed=5.0, horizon_s=500.0), command=("record", "lane_following"))
    processes = {role: by_hand(role) for role in ROLES}
    recording.wait_started()
    processes["sensor"].send_signal(signal.SIGINT)
    finished = recording.finish()
    assert finished.status == 1
    assert finished.summary["exit"]["reason"] == "sensor ended early: SIGINT"
    for process in processes.values():
        process.communicate(timeout=30)
    assert processes["sensor"].returncode == 130


@pytest.mark.parametrize(("loss", "expected_run"), [("worst_case", 3), ("lossless", 0)])
def test_netem_serves_any_udp_program(loss: str, expected_run: int) -> None:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client,
    ):
        server.bind(("127.0.0.1", 0))
        server.settimeout(20)
        destination = f"127.0.0.1:{server.getsockname()[1]}"
        command = [sys.executable, "-m", "netem", "--listen", "127.0.0.1:0", "--to", destination]
        command += ["--loss", loss, "--mansd", "3", "--json"]
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as relay:
            assert relay.stderr is not None
            found = re.search(r"127\.0\.0\.1:(\d+) → ", relay.stderr.readline())
            assert found
            for number in range(40):
                client.sendto(b"%d" % number, ("127.0.0.1", int(found[1])))
            stride = expected_run + 1
            arrived = [int(server.recv(100)) for _ in range(40 // stride)]
            relay.send_signal(signal.SIGINT)
            stdout, _ = relay.communicate(timeout=20)
    assert relay.returncode == 0
    assert arrived == list(range(0, 40, stride))
    assert json.loads(stdout) == {
        "delivered": 0 if expected_run else 40,
        "dropped": 30 if expected_run else 0,
        "forced": 10 if expected_run else 0,
        "longest_drop_run": expected_run,
        "send_errors": 0,
        "lost_in_kernel": 0,
    }


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--listen", "127.0.0.1:0"], "--listen and --to go together"),
        (["--listen", "x", "--to", "127.0.0.1:9"], "expected HOST:PORT"),
        (["--listen", ":0", "--to", ":9", "--loss", "bernoulli:1.5"], "less than or equal to 1"),
        (["--listen", ":0", "--to", ":9", "--loss", "sometimes"], "expected one of lossless"),
        (["--listen", ":0", "--to", ":9", "--mansd", "-1"], "must be 0 or more"),
        (["--listen", ":0", "--to", ":9", "--seed", "-1"], "must be 0 or more"),
        (["--listen", ":0", "--to", "[::1]:9"], "no such IPv4 host"),
        (["--loss", "worst_case"], "is for an emulator on its own"),
    ],
)
def test_netem_says_what_is_wrong(arguments: list[str], words: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "netem", *arguments],
        capture_output=True, text=True, timeout=30, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert words in done.stderr
    assert "Traceback" not in done.stderr
