"""The network emulator as a standalone program."""

import json
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

COMMAND = [sys.executable, "-m", "netem"]


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
def server() -> Iterator[tuple[socket.socket, str]]:
    with client() as endpoint:
        endpoint.bind(("127.0.0.1", 0))
        yield endpoint, f"127.0.0.1:{endpoint.getsockname()[1]}"


@contextmanager
def client() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as endpoint:
        endpoint.settimeout(60)
        yield endpoint


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
