"""The certificates of a run's loops, computed by one process while the run goes on.

It runs at idle priority: a process of the run that wakes up takes the core at once. What it has not
computed when the run ends, or what is lost with it, is computed then.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Self, cast

from cosim.live.processes.process_pool import at_idle_priority, process_starts, processes
from cosim.record.run_directory import RunEnding

if TYPE_CHECKING:
    from cosim.analysis.claims.run_certificates import Expectations

_POLL_S = 0.05


class _RunEndedError(Exception):
    """The run has ended: the process is no longer waited for."""


class EarlyCertificates:
    """Computes the expectations of a run's loops; a context manager, at whose end the process ends."""

    def __init__(self) -> None:
        self.known: dict[int, Expectations] = {}
        """What is computed, by the number of the loop; complete when the context has ended."""
        self._ended = Event()
        self._thread: Thread | None = None

    def start(self, run_dir: Path) -> None:
        """Begin to compute them, in the order of the loops."""
        self._thread = Thread(target=self._compute, args=(run_dir,), daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        if self._thread is not None:
            self._thread.join()

    def _compute(self, run_dir: Path) -> None:
        module = "cosim.analysis.claims.run_certificates"
        by_key: dict[str, Expectations] = {}
        with suppress(Exception), processes(1) as pool:  # the end of the run reports an error
            while True:
                number = len(self.known)
                with process_starts():
                    future = pool.submit(at_idle_priority, module, "expectations_of_loop", run_dir, number)
                while not future.done():
                    if self._ended.wait(_POLL_S):
                        raise _RunEndedError
                if (found := cast("tuple[str, Expectations | None] | None", future.result())) is None:
                    return
                key, expectations = found
                if expectations is not None:
                    by_key[key] = expectations
                self.known[number] = by_key[key]


@dataclass(frozen=True)
class LaunchedEnding(RunEnding):
    """How a launched run ended."""

    expectations: Mapping[int, "Expectations"] = field(default_factory=dict)
    """What is known already of its loops, by their numbers."""
