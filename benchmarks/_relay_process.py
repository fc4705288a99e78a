"""The relays of the benchmarks, ours and the peers, as processes under load."""

import re
import shutil
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Literal

import numpy as np
import numpy.typing as npt

from benchmarks._relay_cores import RELAY_CORE, on_core
from benchmarks._relay_load import LOOPBACK, Built, Burst, Ends
from benchmarks._relay_ours import READY, Ours, Totals, command_of, totals_of
from benchmarks._report import Figures, MeasurementError, Rounds

BURST = 8000
"""Datagrams in a burst, if the relay's receive buffer holds that many."""
_PROBE = 20_000
_LOSSY_SLACK = 16
"""With 5 % loss, this number of consecutive losses does not occur within a benchmark."""
_READY_S = 120.0
"""Maximum wait for a relay to listen; a busy machine starts it late."""
_END_S = 30.0
_PORT = re.compile(r"^(\d+)$")


@dataclass(frozen=True)
class Kind:
    """A kind of relay.

    Args:
        name: its name in the tables.
        command: returns its command line for the sink's port and a free port to listen on.
        says: where and how it reports its listening port; None if it is the given free port.
        lossy: whether it may lose datagrams.
    """

    name: str
    command: Callable[[int, int], list[str]]
    says: tuple[str, re.Pattern[str]] | None = ("stdout", _PORT)
    lossy: bool = False


def c_relay(built: Built, *words: Literal["segment", "names", "paths"]) -> Kind:
    """Return ``relay.c`` in one of its modes."""
    text = {"segment": "segments", "names": "senders' addresses", "paths": "a socket per client"}
    name = ", ".join(["C relay", *(text[word] for word in words)])
    return Kind(name, lambda to, _: [str(built.relay), str(to), *words])


def socat() -> Kind | str:
    """Return socat, forward only; or why it is missing."""
    program = shutil.which("socat")
    if program is None:
        return "socat is not installed (Debian: apt-get install socat)"
    return Kind(
        "socat",
        lambda to, port: [
            program, "-u", "-b", "2048", f"UDP4-RECV:{port},rcvbuf=4194304",
            f"UDP4-SENDTO:{LOOPBACK}:{to}",
        ],
        says=None,
    )  # fmt: skip


def our_relay(name: str, ours: Ours, *, lossy: bool = True) -> Kind:
    """Return ``python -m netem``."""
    return Kind(name, lambda to, _: command_of(ours, to), ("stderr", READY), lossy)


def figures_of(name: str, burst: Burst, sent: int, slack: int, cpu_s: float) -> Figures:
    """Return ``per_s``, datagrams received and decided per second, and ``cpu_us`` per datagram.

    Raises:
        MeasurementError: more datagrams are missing than the relay can have dropped.
    """
    if burst.decided < sent - slack or (slack == 0 and burst.received != sent):
        raise MeasurementError(f"{name}: of a burst of {sent} only {burst.received} arrived")
    return {"per_s": burst.decided / burst.wall_s, "cpu_us": cpu_s / sent * 1e6}


class Relay:
    """A running relay with its sender and sink."""

    def __init__(self, kind: Kind, process: subprocess.Popen[str], ends: Ends) -> None:
        self.name = kind.name
        self.ends = ends
        self.pid = process.pid
        self._process = process
        self._slack = _LOSSY_SLACK if kind.lossy else 0
        self._burst = 0

    def cpu_s(self) -> float:
        """CPU time of all its threads so far, including system time."""
        return self._scheduled_s(0)

    def waited_s(self) -> float:
        """Time so far in which its threads were ready to run, but other threads had their core."""
        return self._scheduled_s(1)

    def _scheduled_s(self, field: int) -> float:
        tasks = Path(f"/proc/{self.pid}/task").glob("*/schedstat")
        return sum(int(task.read_text().split()[field]) for task in tasks) * 1e-9

    def burst(self, addresses: npt.NDArray[np.uint32] | None = None) -> Figures:
        """Send it one burst; the first time, also determine the capacity of its buffer.

        Args:
            addresses: send from these in turn; None for one sender.
        """
        if not self._burst:
            held = self.ends.burst(self.pid, _PROBE, addresses=addresses).decided
            self._burst = min(BURST, held * 9 // 10)
            if not self._burst:
                raise MeasurementError(f"{self.name} forwards nothing")
        before_s = self.cpu_s()
        found = self.ends.burst(self.pid, self._burst, self._slack, addresses)
        return figures_of(self.name, found, self._burst, self._slack, self.cpu_s() - before_s)

    def totals(self) -> Totals:
        """End our relay as Ctrl-C does; return its totals."""
        self._process.send_signal(signal.SIGINT)
        try:
            stdout, _ = self._process.communicate(timeout=_END_S)
        except subprocess.TimeoutExpired:
            raise MeasurementError(f"{self.name} does not end") from None
        return totals_of(stdout)


@contextmanager
def running(kind: Kind, built: Built) -> Iterator[Relay]:
    """Run a relay on its core, between sender and sink.

    Raises:
        MeasurementError: it does not start to listen.
    """
    ends = Ends(built.load)
    chosen = _free_port()
    with on_core(RELAY_CORE):
        process = subprocess.Popen(
            kind.command(ends.sink_port, chosen),
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
    try:
        ends.connect(_listening_on(kind, process, chosen))
        yield Relay(kind, process, ends)
    finally:
        process.kill()
        process.communicate()
        ends.close()


def start_all(
    kinds: Mapping[str, Kind | str], built: Built, stack: ExitStack, rounds: Rounds
) -> list[Relay]:
    """Start relays that run until the stack ends, and return them.

    A relay that does not start is missing in the rounds.

    Args:
        kinds: kinds of relays by name, or the reason why there is none.
        built: the compiled load.
        stack: ends the relays.
        rounds: receives the reasons for missing relays.
    """
    relays: list[Relay] = []
    for name, kind in kinds.items():
        if isinstance(kind, str):
            rounds.add(name, kind)
            continue
        try:
            relays.append(stack.enter_context(running(kind, built)))
        except MeasurementError as error:
            rounds.add(name, str(error))
    return relays


def in_turn(
    relays: list[Relay], rounds: Rounds, measure: Callable[[Relay], Figures | None]
) -> None:
    """Measure one round of each relay; a relay that fails is missing from then on."""
    for relay in list(relays):
        try:
            figures = measure(relay)
            if figures is not None:
                rounds.add(relay.name, figures)
        except MeasurementError as error:
            rounds.add(relay.name, str(error))
            relays.remove(relay)


def _listening_on(kind: Kind, process: subprocess.Popen[str], chosen: int) -> int:
    deadline = threading.Timer(_READY_S, process.kill)
    deadline.start()
    try:
        if kind.says is None:
            while process.poll() is None:
                if _is_bound(chosen):
                    return chosen
                time.sleep(0.01)
        else:
            stream, port = kind.says
            said: IO[str] = getattr(process, stream)
            for line in said:
                if (found := port.search(line)) is not None:
                    return int(found[1])
    finally:
        deadline.cancel()
    _, stderr = process.communicate()
    why = (stderr.strip() or "nothing").splitlines()[-1]
    raise MeasurementError(f"{kind.name} does not begin to listen, said {why!r}")


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def _is_bound(port: int) -> bool:
    lines = Path("/proc/net/udp").read_text().splitlines()[1:]
    return any(int(line.split()[1].rpartition(":")[2], 16) == port for line in lines)
