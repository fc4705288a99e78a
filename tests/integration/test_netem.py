"""The network emulator as a standalone program."""

import json
import os
import re
import resource
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
from tests.attacks.attacked import unread_bytes
from tests.integration.conftest import wait_for

COMMAND = [sys.executable, "-m", "netem"]
MIB = 2**20


def size_of(pid: int) -> int:
    """Size of a process's address space, in bytes."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[0]) * resource.getpagesize()


@contextmanager
def emulator(
    *arguments: str, links: int = 1, **more: Any
) -> Iterator[tuple[subprocess.Popen[str], list[int]]]:
    """Start an emulator; yield its process and ports when it reports that it is ready."""
    with subprocess.Popen(
        [*COMMAND, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **more
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        try:
            ready = process.stdout.readline()
            assert "ready" in ready, ready + process.stderr.read()
            addresses = re.findall(r'[^:]:(\d+)(?=[,\n]|", "to")', ready)
            ports = [int(port) for port in addresses]
            assert len(ports) == links, ready
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


def forward_of(totals: str) -> Any:
    (link,) = json.loads(totals)["links"]
    return link["forward"]


@pytest.mark.parametrize("words", ["loss worst mansd 3 first", "loss none"])
def test_the_emulator_relays_any_udp_program(words: str) -> None:
    burst = 3 if "worst" in words else 0
    with server() as (there, to), client() as here:
        arguments = ["--listen", ":0", "--to", to, "--json", *words.split()]
        with emulator(*arguments) as (process, [port]):
            for number in range(40):
                here.sendto(b"%d" % number, ("127.0.0.1", port))
            arrived = [int(there.recv(100)) for _ in range(40 // (burst + 1))]
            totals, _ = ended(process)
    assert arrived == list(range(0, 40, burst + 1))
    forward = forward_of(totals)
    assert forward["received"] == 40
    assert forward["fates"] == {
        "delivered": 0 if burst else 40, "dropped": 30 if burst else 0,
        "forced": 10 if burst else 0, "corrupted": 0, "overflowed": 0, "blacked_out": 0,
    }  # fmt: skip
    assert forward["longest_loss_burst"] == burst
    assert set(forward["unintended"].values()) == {0}


def test_the_relay_impairs_each_direction_of_ipv6_by_its_own_words() -> None:
    with server(socket.AF_INET6) as (there, to), client(socket.AF_INET6) as here:
        arguments = ["--listen", "[::1]:0", "--to", to, "--reverse", "loss periodic 1/2"]
        with emulator(*arguments) as (process, [port]):
            here.sendto(b"ask", ("::1", port))
            question, asker = there.recvfrom(100)
            for number in range(6):
                there.sendto(b"%d" % number, asker)
            answers = [here.recv(100) for _ in range(3)]
            stdout, stderr = ended(process)
    assert question == b"ask"
    assert answers == [b"1", b"3", b"5"]
    assert stdout == ""
    assert re.search(r"lost +0 +3 dropped", stderr)


def test_several_links_a_capture_and_statistics(tmp_path: Path) -> None:
    links, capture = tmp_path / "links.toml", tmp_path / "all.pcapng"
    lines = tmp_path / "lines.json"
    with server() as (there, to), client() as here:
        links.write_text(
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
        arguments = ["--links", str(links), "--capture", str(capture), "--realtime"]
        arguments += ["--stats", "0.05", "--stats-file", str(lines)]
        with emulator(*arguments, links=2) as (process, ports):
            here.sendto(b"lost", ("127.0.0.1", ports[0]))
            here.sendto(b"passes", ("127.0.0.1", ports[1]))
            assert there.recv(100) == b"passes"
            here.sendto(b"second of the first", ("127.0.0.1", ports[0]))
            assert there.recv(100) == b"second of the first"
            ended(process)
    content = capture.read_bytes()
    assert content.startswith(b"\x0a\x0d\x0d\x0a")
    assert b"passes" in content
    assert b"dropped by the loss model" in content
    newest = json.loads(lines.read_text().splitlines()[-1])["links"]
    assert [link["name"] for link in newest] == ["first", "second"]
    assert [link["forward"]["received"] for link in newest] == [2, 1]


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


def test_a_taken_port_is_reported(tmp_path: Path) -> None:
    with server() as (_, taken):
        done = subprocess.run(
            [*COMMAND, "--listen", taken, "--to", ":9"],
            capture_output=True, text=True, timeout=60, check=False,
        )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr.startswith(f"noack netem: link relay: UDP port {taken} is already taken")
    assert done.stderr.count("\n") == 1


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


@pytest.mark.skipif(sys.platform != "linux", reason="limits of another process are for Linux")
def test_the_emulator_keeps_48_mib_of_the_allowed_memory() -> None:
    """Delayed datagrams take the rest; the emulator goes on, and counts those without room."""
    words = ("--listen", "127.0.0.1:0", "--to", "127.0.0.1:9", "--json", "delay", "1000s")
    with emulator(*words) as (process, (port,)), socket.socket(type=socket.SOCK_DGRAM) as sender:
        allowed = size_of(process.pid) + 160 * MIB
        resource.prlimit(process.pid, resource.RLIMIT_AS, (allowed, allowed))
        for number in range(5000):  # 300 MB
            sender.sendto(bytes(60_000), ("127.0.0.1", port))
            if number % 50 == 49:
                wait_for(lambda: not unread_bytes(process.pid)[port])
        wait_for(lambda: allowed - size_of(process.pid) <= 112 * MIB)
        assert 40 * MIB < allowed - size_of(process.pid) <= 112 * MIB
        process.send_signal(signal.SIGINT)
        stdout, stderr = process.communicate(timeout=60)
    assert process.returncode == ExitStatus.UNINTENDED_LOSSES, stderr
    assert "Cannot allocate memory" in stdout + stderr
