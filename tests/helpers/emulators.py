"""Emulators in separate processes."""

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any


class Emulator:
    """``python -m netem`` with one link, in a separate folder.

    Args:
        folder: where it runs.
        to: the server, HOST:PORT.
        words: impairments and options.
        listen: the address to which clients send.
        inside: a command prefix, e.g. to run the emulator in a network namespace.
    """

    def __init__(self, folder: Path, to: str, *words: str, listen: str, inside: Sequence[str] = ()) -> None:
        self.process = subprocess.Popen(
            [
                *inside, sys.executable, "-m", "netem", "--listen", listen, "--to", to, "--json",
                *words,
            ],
            cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self.process.stdout is not None
        ready = self.process.stdout.readline()
        assert ready, self.process.communicate()[1]
        (link,) = json.loads(ready)["ready"]
        self.host, _, port = link["listen"].rpartition(":")
        self.port = int(port)

    def finish(self) -> dict[str, Any]:
        """End the emulator and check for unintended losses; return its link's statistics."""
        link, status, stderr = self.end()
        assert status == 0, stderr
        for line in stderr.splitlines():
            # A program may end with datagrams to it in flight.
            usual = ("Ctrl-C ends", "ICMP port unreachable", "netem: control: ", "of settings, ")
            assert any(words in line for words in usual), stderr
        return link

    def end(self) -> tuple[dict[str, Any], int, str]:
        """End the emulator; return its link's statistics, exit status and standard error."""
        self.process.send_signal(signal.SIGINT)
        stdout, stderr = self.process.communicate(timeout=60)
        (link,) = json.loads(stdout)["links"]
        return dict(link), self.process.returncode, stderr


Emulate = Callable[..., Emulator]


@contextmanager
def start_emulators(folder: Path) -> Iterator[Emulate]:
    """Start emulators; kill the remaining ones at the end."""
    started: list[Emulator] = []

    def start(to: str, *words: str, listen: str = "127.0.0.1:0", inside: Sequence[str] = ()) -> Emulator:
        own = folder / f"emulator {len(started)}"
        own.mkdir()
        started.append(Emulator(own, to, *words, listen=listen, inside=inside))
        return started[-1]

    try:
        yield start
    finally:
        for emulator in started:
            emulator.process.kill()
            emulator.process.communicate()
