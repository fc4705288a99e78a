"""The certificates of a run's loops, computed by one process while the run goes on.

It runs at idle priority: a process of the run that wakes up takes the core at once. What it has not
computed when the run ends, or what is lost with it, is computed then.
"""

import multiprocessing
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Self

from cosim.live.processes.process_pool import start_alone
from cosim.record.run_directory import RunEnding
from netem.core.system_processes import be_idle

if TYPE_CHECKING:
    from cosim.analysis.claims.run_certificates import RunCertificate

_POLL_S = 0.05


class EarlyCertificates:
    """Computes the certificates of a run's loops; a context manager, at whose end the process ends."""

    def __init__(self) -> None:
        self.known: dict[int, list[RunCertificate] | None] = {}
        """What is computed, by the number of the loop; complete when the context has ended."""
        self._ended = Event()
        self._process: BaseProcess | None = None
        self._thread: Thread | None = None

    def start(self, run_dir: Path) -> None:
        """Begin to compute them, in the order of the loops."""
        receiver, sender = multiprocessing.Pipe(duplex=False)
        with suppress(OSError):  # there is no memory for a process, and the end of the run computes them
            self._process = start_alone(_compute, run_dir, sender)
            sender.close()
            self._thread = Thread(target=self._receive, args=(receiver,), daemon=True)
            self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        if self._process is not None:
            self._process.kill()  # at idle priority it may not even get the time to end by itself
        if self._thread is not None:
            self._thread.join()

    def _receive(self, receiver: Connection) -> None:
        by_key: dict[str, list[RunCertificate]] = {}
        with suppress(EOFError, OSError), receiver:  # the process has ended
            while not self._ended.is_set():
                if receiver.poll(_POLL_S):
                    key, found = receiver.recv()
                    if found is not None:
                        by_key[key] = found
                    self.known[len(self.known)] = by_key.get(key)


def _compute(run_dir: Path, sender: Connection) -> None:
    """Send the certificates of each loop in turn: its key, and the certificates at their first time."""
    be_idle()
    from cosim.analysis.claims.run_certificates import certificates_key, expected_certificates
    from cosim.record.run_record import resolved_run

    loops = resolved_run(run_dir).loops
    sent = set[str]()
    for loop in loops:
        key = certificates_key(loop)
        sender.send((key, None if key in sent else expected_certificates(loop, len(loops))))
        sent.add(key)


@dataclass(frozen=True)
class LaunchedEnding(RunEnding):
    """How a launched run ended."""

    certificates: Mapping[int, "list[RunCertificate] | None"] = field(default_factory=dict)
    """What is known already of its loops, by their numbers."""
