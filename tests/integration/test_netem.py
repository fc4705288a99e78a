"""The network emulator as a standalone program."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from noack.core.errors import ExitStatus

COMMAND = [sys.executable, "-m", "netem"]


@contextmanager
def emulator(*arguments: str, links: int = 1) -> Iterator[tuple[subprocess.Popen[str], list[int]]]:
    """Start an emulator; yield its process and its ports."""
    with subprocess.Popen(
        [*COMMAND, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        ports = []
        try:
            for line in process.stderr:
                if found := re.search(r":(\d+) → .*, Ctrl-C ends$", line):
                    ports.append(int(found[1]))
                if len(ports) == links:
                    break
                assert found or "compiling" in line, line + process.stderr.read()
            yield process, ports
        finally:
            if process.poll() is None:
                process.kill()


def ended(process: subprocess.Popen[str]) -> tuple[str, str]:
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=60)
    assert process.returncode == 0, stderr
    return stdout, stderr


@contextmanager
def server(family: int = socket.AF_INET) -> Iterator[tuple[socket.socket, str]]:
    with socket.socket(family, socket.SOCK_DGRAM) as endpoint:
        endpoint.bind(("::1" if family == socket.AF_INET6 else "127.0.0.1", 0))
        endpoint.settimeout(60)
        host, port = endpoint.getsockname()[:2]
        yield endpoint, f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


@contextmanager
def client(family: int = socket.AF_INET) -> Iterator[socket.socket]:
    with socket.socket(family, socket.SOCK_DGRAM) as endpoint:
        endpoint.settimeout(60)
        yield endpoint


def forward_of(stdout: str) -> Any:
    (link,) = totals_of(stdout)["links"]
    return link["forward"]


def totals_of(stdout: str) -> Any:
    """Return the JSON that follows the line with ``ready``."""
    ready, _, totals = stdout.partition("\n")
    assert json.loads(ready).keys() == {"ready"}
    return json.loads(totals)


@pytest.mark.parametrize("engine", ["batched", "plain"])
@pytest.mark.parametrize(("words", "run"), [("loss worst mansd 3 first", 3), ("loss none", 0)])
def test_the_emulator_relays_any_udp_program(words: str, run: int, engine: str) -> None:
    with server() as (there, to), client() as here:
        arguments = ["--listen", ":0", "--to", to, "--engine", engine, "--json", *words.split()]
        with emulator(*arguments) as (process, [port]):
            for number in range(40):
                here.sendto(b"%d" % number, ("127.0.0.1", port))
            arrived = [int(there.recv(100)) for _ in range(40 // (run + 1))]
            stdout, _ = ended(process)
    assert arrived == list(range(0, 40, run + 1))
    told = forward_of(stdout)
    assert told["received"] == 40
    assert told["fates"] == {
        "delivered": 0 if run else 40, "dropped": 30 if run else 0, "forced": 10 if run else 0,
        "corrupted": 0, "overflowed": 0, "blacked_out": 0,
    }  # fmt: skip
    assert told["longest_loss_burst"] == run
    assert set(told["unintended"].values()) == {0}


@pytest.mark.parametrize("family", [socket.AF_INET, socket.AF_INET6], ids=["IPv4", "IPv6"])
def test_the_reverse_direction_has_its_own_impairments(family: int) -> None:
    host = "[::1]" if family == socket.AF_INET6 else "127.0.0.1"
    with server(family) as (there, to), client(family) as here:
        arguments = ["--listen", f"{host}:0", "--to", to, "--reverse", "loss periodic 1/2"]
        with emulator(*arguments) as (process, [port]):
            here.sendto(b"ask", (host.strip("[]"), port))
            question, asker = there.recvfrom(100)
            for number in range(6):
                there.sendto(b"%d" % number, asker)
            answers = [here.recv(100) for _ in range(3)]
            _, stderr = ended(process)
    assert question == b"ask"
    assert answers == [b"1", b"3", b"5"]
    assert re.search(r"dropped by a loss model +0 +3 *\n", stderr)


def test_several_links_are_read_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "links.toml"
    with server() as (there, to), client() as here:
        path.write_text(
            f"""
            [[link]]
            name = "first"
            listen = ":0"
            to = "{to}"
            words = "loss script 0"
            [[link]]
            name = "second"
            listen = ":0"
            to = "{to}"
            """
        )
        with emulator("--links", str(path), "--json", links=2) as (process, ports):
            here.sendto(b"lost", ("127.0.0.1", ports[0]))
            here.sendto(b"passes", ("127.0.0.1", ports[1]))
            assert there.recv(100) == b"passes"
            here.sendto(b"second of the first", ("127.0.0.1", ports[0]))
            assert there.recv(100) == b"second of the first"
            stdout, _ = ended(process)
    assert [link["name"] for link in totals_of(stdout)["links"]] == ["first", "second"]


def test_recorded_fates_are_replayed(tmp_path: Path) -> None:
    """Another seed and other words give the recorded fates."""
    arrived = []
    record, again = tmp_path / "fates.parquet", tmp_path / "again.parquet"
    for arguments in (
        ["--record-fates", str(record), "loss", "40%", "seed", "3"],
        ["--replay-fates", str(record), "--record-fates", str(again), "seed", "4"],
    ):
        with server() as (there, to), client() as here:
            with emulator("--listen", ":0", "--to", to, *arguments) as (process, [port]):
                for number in range(50):
                    here.sendto(b"%d" % number, ("127.0.0.1", port))
                if not arrived:
                    here.sendto(b"end", ("127.0.0.1", port))
                last, numbers = b"", []
                while last != b"end" and (not arrived or numbers != arrived[0]):
                    last = there.recv(100)
                    numbers.append(last)
                ended(process)
            arrived.append([number for number in numbers if number != b"end"])
    assert arrived[0] == arrived[1]
    assert 10 < len(arrived[0]) < 45
    fates = [pq.read_table(path)["fate"].to_pylist()[:50] for path in (record, again)]
    assert fates[0] == fates[1]


def test_a_capture_and_statistics_are_written(tmp_path: Path) -> None:
    capture, lines = tmp_path / "all.pcapng", tmp_path / "lines.json"
    with server() as (there, to), client() as here:
        arguments = ["--listen", ":0", "--to", to, "loss", "script", "0", "--capture", str(capture)]
        arguments += ["--stats", "0.05", "--stats-file", str(lines), "--realtime"]
        with emulator(*arguments) as (process, [port]):
            for word in (b"lost", b"passes"):
                here.sendto(word, ("127.0.0.1", port))
            assert there.recv(100) == b"passes"
            ended(process)
    content = capture.read_bytes()
    assert content.startswith(b"\x0a\x0d\x0d\x0a")
    assert b"passes" in content
    assert b"dropped by the loss model" in content
    told = [json.loads(line) for line in lines.read_text().splitlines()]
    assert told[-1]["links"][0]["forward"]["received"] == 2


def test_a_taken_port_is_reported(tmp_path: Path) -> None:
    with server() as (_, taken):
        done = subprocess.run(
            [*COMMAND, "--listen", taken, "--to", ":9"],
            capture_output=True, text=True, timeout=60, check=False,
        )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr.startswith(f"noack netem: link relay: UDP port {taken} is already taken")
    assert done.stderr.count("\n") == 1


def waiting(*arguments: str, **more: Any) -> subprocess.Popen[str]:
    """An emulator whose standard output is a pipe."""
    command = [*COMMAND, "--listen", ":0", *arguments]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **more
    )


@pytest.mark.parametrize("engine", ["batched", "plain"])
def test_a_script_can_wait_until_the_emulator_is_ready(engine: str) -> None:
    """After the line ``ready`` on the pipe, datagrams are not lost."""
    with (
        server() as (there, to),
        client() as here,
        waiting("--to", to, "--engine", engine) as process,
    ):
        try:
            assert process.stdout is not None
            ready = process.stdout.readline()
            found = re.fullmatch(r"ready: listening on 127\.0\.0\.1:(\d+)\n", ready)
            assert found, ready
            here.sendto(b"at once", ("127.0.0.1", int(found[1])))
            assert there.recv(100) == b"at once"
            stdout, _ = ended(process)
        finally:
            process.kill()
    assert stdout == ""


def test_show_names_the_compilation_and_its_duration(tmp_path: Path) -> None:
    """With an empty cache, ``show`` names the state; the duration is stored for the next start."""
    environment = os.environ | {
        "XDG_CACHE_HOME": str(tmp_path / "cache"), "XDG_RUNTIME_DIR": str(tmp_path),
    }  # fmt: skip

    def show() -> str:
        done = subprocess.run(
            [*COMMAND, "show"], env=environment, capture_output=True, text=True, check=False
        )
        return done.stdout + done.stderr

    with waiting("--to", ":9", "--control", "lab", env=environment) as process:
        try:
            assert process.stderr is not None
            assert process.stdout is not None
            said = process.stderr.readline()
            assert said.startswith("noack netem: compiling the relay for this machine, once; ")
            assert "this takes about 15 s" in said
            os.kill(process.pid, signal.SIGSTOP)
            assert "emulator 'lab' is starting" in show()
            os.kill(process.pid, signal.SIGCONT)
            assert process.stdout.readline().startswith("ready: ")
            assert "noack netem lab" in show()
            ended(process)
        finally:
            process.kill()
    (record,) = (tmp_path / "cache" / "noack").glob("netem.seconds")
    assert float(record.read_text()) > 0


def test_unintended_losses_have_their_own_exit_status() -> None:
    """The kernel's buffer overflows while the emulator is stopped."""
    with (
        client() as here,
        emulator("--listen", ":0", "--to", ":9", "mansd", "2") as (process, [port]),
    ):
        os.kill(process.pid, signal.SIGSTOP)
        for _ in range(30_000):
            here.sendto(b"x", ("127.0.0.1", port))
        os.kill(process.pid, signal.SIGCONT)
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=60)
    assert process.returncode == ExitStatus.UNINTENDED_LOSSES == 3
    assert "the guarantee does not hold (exit status 3)" in stderr
