"""Start an emulator by its command line and read its results."""

import json
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow.parquet as pq

from noack.protocol.record_tables import Fate

LET_OUT = (Fate.DELIVERED, Fate.FORCED, Fate.CORRUPTED)


class Departure(NamedTuple):
    """A departed datagram or copy."""

    due_ns: int
    packet: int
    """Number of the datagram in its flow."""
    delay_ns: int


class Emulator:
    """``python -m netem`` with one link, in a separate folder.

    Args:
        folder: the folder for its fate trace.
        to: the server, HOST:PORT.
        words: impairments and options.
        listen: the address to which clients send.
        inside: a command prefix, e.g. to run the emulator in a network namespace.
    """

    def __init__(
        self, folder: Path, to: str, *words: str, listen: str, inside: Sequence[str] = ()
    ) -> None:
        self._trace = folder / "fates.parquet"
        self._process = subprocess.Popen(
            [
                *inside, sys.executable, "-m", "netem", "--listen", listen, "--to", to, "--json",
                "--record-fates", str(self._trace), *words,
            ],
            cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self._process.stdout is not None
        ready = self._process.stdout.readline()
        assert ready, self._process.communicate()[1]
        (link,) = json.loads(ready)["ready"]
        self.host, _, port = link["listen"].rpartition(":")
        self.port = int(port)

    def finish(self) -> dict[str, Any]:
        """End the emulator and check for unintended losses; return its link's statistics."""
        link, status, stderr = self.end()
        assert status == 0, stderr
        for line in stderr.splitlines():
            # A program may end with datagrams to it in flight.
            usual = ("compiling", "Ctrl-C ends", "ICMP port unreachable")
            assert any(words in line for words in usual), stderr
        for direction in ("forward", "reverse"):
            assert not any(link[direction]["unintended"].values()), link[direction]["unintended"]
        return link

    def end(self) -> tuple[dict[str, Any], int, str]:
        """End the emulator; return its link's statistics, exit status and standard error."""
        self._process.send_signal(signal.SIGINT)
        stdout, stderr = self._process.communicate(timeout=60)
        (link,) = json.loads(stdout)["links"]
        return dict(link), self._process.returncode, stderr

    def kill(self) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.communicate()

    def fates(self, direction: str, flow: int = 0) -> list[dict[str, Any]]:
        """Return the fate of each datagram of a flow, in the order of arrival."""
        rows: list[dict[str, Any]] = pq.read_table(self._trace).to_pylist()
        return [row for row in rows if row["direction"] == direction and row["flow"] == flow]

    def departures(self, direction: str, flow: int = 0) -> list[Departure]:
        """Return the departures of a flow in the order of their due times."""
        leaving = []
        for row in self.fates(direction, flow):
            if row["fate"] in LET_OUT:
                for delay_ns in (row["delay_ns"], row["copy_delay_ns"]):
                    if delay_ns >= 0:
                        due_ns = row["arrival_ns"] + delay_ns
                        leaving.append(Departure(due_ns, row["packet"], delay_ns))
        return sorted(leaving, key=lambda departure: departure.due_ns)  # a stable order
