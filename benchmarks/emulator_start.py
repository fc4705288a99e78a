"""The emulator alone, from an empty environment to its first packet: size of wheel and packages, time."""

import json
import re
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.report import Goal, MeasurementError, Row, announce

_ROOT = Path(__file__).parents[1]
_MEBI = 1024**2
_WORDS = ("--listen", "127.0.0.1:0", "--json", "loss", "30%", "mansd", "4", "first", "--to")


def emulator_rows() -> Iterator[Row]:
    """Build the wheel of noack-netem, install it into a new environment, and relay a packet.

    The time is of `python -m venv`, `pip install WHEEL` with what it needs from the package index, and the
    start of `noack-netem` up to the arrival of a packet; so it depends on the network, too.
    """
    announce("noack-netem in an empty environment")
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        wheel = _built(folder)
        yield Row("noack-netem: its wheel", wheel.stat().st_size / _MEBI, "MiB", goal=Goal("<=", 3))
        began_s = time.monotonic()
        _execute(sys.executable, "-m", "venv", folder / "env")
        _execute(folder / "env" / "bin" / "pip", "install", "--quiet", "--no-compile", wheel)
        installed_s = time.monotonic() - began_s
        relayed_s = _first_packet_s(folder / "env" / "bin" / "noack-netem")
        (packages,) = (folder / "env").glob("lib/python*/site-packages")
        sizes = {path.name: _size(path) for path in packages.iterdir() if not _is_of_pip(path)}
    yield Row("an empty environment, and `pip install` of the wheel", installed_s, "s")
    yield Row("from its command to the first packet that is relayed", relayed_s, "s")
    yield Row("together", installed_s + relayed_s, "s", goal=Goal("<=", 15))
    largest = sorted(sizes.items(), key=lambda item: -item[1])[:6]
    note = ", ".join(f"{name} {size / _MEBI:.0f}" for name, size in largest)
    yield Row("installed, without pip", sum(sizes.values()) / _MEBI, "MiB", goal=Goal("<=", 120), note=note)


def _built(folder: Path) -> Path:
    _execute(
        Path(sys.executable).with_name("uv"), "build", "--quiet", "--wheel", "--no-build-isolation",
        "--python", sys.executable, "--out-dir", folder, _ROOT / "netem",
    )  # fmt: skip
    (wheel,) = folder.glob("*.whl")
    return wheel


def _execute(*command: str | Path) -> None:
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise MeasurementError(f"{Path(command[0]).name} failed: {done.stderr.strip()[-200:]}")


def _first_packet_s(program: Path) -> float:
    """Return the time from the command to the arrival of a packet that it relays."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))
        server.settimeout(60)
        began_s = time.monotonic()
        address = f"127.0.0.1:{server.getsockname()[1]}"
        with subprocess.Popen([program, *_WORDS, address], stdout=subprocess.PIPE, text=True) as relay:
            assert relay.stdout is not None
            host, port = json.loads(relay.stdout.readline())["ready"][0]["listen"].split(":")
            server.sendto(b"first", (host, int(port)))  # `first` delivers the first packet of a flow
            server.recv(100)
            relayed_s = time.monotonic() - began_s
            relay.terminate()
    return relayed_s


def _size(path: Path) -> int:
    return sum(file.stat().st_size for file in (path, *path.rglob("*")) if file.is_file())


def _is_of_pip(path: Path) -> bool:
    return (
        re.match(r"pip\b|setuptools\b|_distutils_hack|distutils-precedence|pkg_resources", path.name)
        is not None
    )
