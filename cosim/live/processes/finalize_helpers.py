"""Processes that help to finalise a long run, and prepare this while the run goes on.

They import libraries and write tables at idle priority: a process of the run that wakes up takes the
core at once. What is not done when the run ends, or is lost with a helper, is done then.
"""

import os
import time
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Thread, current_thread
from typing import TypeVar, cast

from cosim.live.processes.process_pool import at_idle_priority, call_by_name, process_starts, processes
from cosim.record.run_directory import RunEnding
from noack.core.file_access import open_append
from noack.core.system_processes import cores
from noack.runtime.spool import EARLY, EARLY_ENDED, SPOOL
from noack.scenario.scenario import Scenario, loop_names

Result = TypeVar("Result")
Item = TypeVar("Item", bound=Hashable)
_MANY_STEPS = 50_000
"""Loops with fewer steps of the plant, all together, are evaluated in less time than processes
start."""
_GRACE_S = 2.0
"""Wall time for what is being prepared when the run ends."""
_FEW_LOOPS = 16
"""The end of a run of at most this number of loops is not prepared."""
_POLL_S = 0.005


class FinalizeHelpers:
    """Processes on all cores but one; none if the end of the run takes no time.

    Args:
        scenario: the scenario of the run.
    """

    def __init__(self, scenario: Scenario) -> None:
        timing, self._loops = scenario.timing, len(loop_names(scenario))
        steps = self._loops * (timing.horizon_ns // timing.plant_period_ns)
        self.count = cores() - 1 if steps >= _MANY_STEPS else 0
        self._stack, self._threads = ExitStack(), list[Thread]()
        self._pool: ProcessPoolExecutor | None = None
        self._due: deque[Callable[[], object]] = deque()
        """What is still to be prepared."""
        self._end_file: Path | None = None
        """Its existence is the sign for the process that writes tables that the run has ended; see
        ``cosim.record.spool_conversion``."""
        self._writer: Thread | None = None
        """The thread that waits for this process."""
        self.early: Mapping[str, int] = {}
        """The tables that are written, with the bytes of their spool."""

    def prepare(self, run_dir: Path) -> None:
        """Prepare the end of a run of many loops from now on."""
        if self._loops <= _FEW_LOOPS:
            return
        self.end_preparation()
        # This process keeps them, too.
        self._due.append(partial(call_by_name, "cosim.record.run_record", "scenarios_of", run_dir))
        self._due.append(lambda: self._call_at_idle_priority("import_libraries"))
        self._due.append(partial(self._write_early, run_dir))
        for _ in range(self.count):
            self._threads.append(Thread(target=self._prepare_all, daemon=True))
            self._threads[-1].start()

    def _prepare_all(self) -> None:
        try:
            while True:
                self._due.popleft()()
        except BrokenProcessPool:  # a process was killed
            self._pool = None
        except Exception:  # the end of the run reports an error; IndexError: all is prepared
            pass

    def _write_early(self, run_dir: Path) -> None:
        self._end_file, self._writer = run_dir / SPOOL / EARLY / EARLY_ENDED, current_thread()
        written = self.submit(call_by_name, "cosim.record.spool_conversion", "write_early", run_dir).result()
        self.early = cast("Mapping[str, int]", written)

    def _make_end_file(self) -> bool:
        """Make the sign that the run has ended; return whether it exists."""
        if self._end_file is None:  # no process writes tables, or not yet
            return False
        with suppress(OSError):  # its folder does not exist yet
            os.close(open_append(self._end_file))
            return True
        return False

    @property
    def _is_writing(self) -> bool:
        """Whether a process has seen the sign and writes the rest, no longer at idle priority."""
        if self._end_file is None or self._writer is None:
            return False
        return self._writer.is_alive() and not self._end_file.exists()

    def _call_at_idle_priority(self, function: str, *arguments: object) -> object:
        """Return the result of a function of :mod:`cosim.live.finalize`, which a process calls."""
        return self.submit(at_idle_priority, "cosim.live.finalize", function, *arguments).result()

    def end_preparation(self) -> None:
        """End the preparation; afterwards there are free processes.

        On a busy machine idle priority gets almost no time: what is not prepared soon is given up.
        """
        self._due.clear()
        until_s = time.monotonic() + _GRACE_S
        notified = False
        while any(thread.is_alive() for thread in self._threads):
            notified = notified or self._make_end_file()
            if time.monotonic() > until_s and not (notified and self._is_writing):
                break
            time.sleep(_POLL_S)
        if any(thread.is_alive() for thread in self._threads):
            self._abort()
            for thread in self._threads:
                thread.join()
            self._pool = None
        if self._pool is None and self.count:
            self._pool = self._stack.enter_context(processes(self.count))

    def submit(self, function: Callable[..., Result], *arguments: object) -> Future[Result]:
        """Let a process call a function."""
        assert self._pool is not None
        with process_starts():
            return self._pool.submit(function, *arguments)

    def call(self, function: Callable[..., Result], *arguments: object) -> Result:
        """Return the result of a function in a process; call it here if the process is killed."""
        try:
            return self.submit(function, *arguments).result()
        except BrokenProcessPool:
            return function(*arguments)

    def each(
        self,
        function: Callable[[Item], Result],
        work: Iterable[Item],
        show: Callable[[float], None],
    ) -> Iterable[Result]:
        """Call a function for each item, here and in the processes; return its results."""
        with self.share(work, partial(self.call, function), show) as take:
            results = take(function)
        return results.values()

    @contextmanager
    def share(
        self, work: Iterable[Item], elsewhere: Callable[[Item], Result], show: Callable[[float], None]
    ) -> Iterator[Callable[[Callable[[Item], Result]], Mapping[Item, Result]]]:
        """Let threads do work ``elsewhere``, item by item; this one does it with what is yielded.

        This returns the results, all of which are there at the end of the context. ``show`` is
        called with the completed share.
        """
        waiting, results = deque(work), dict[Item, Result]()
        count = len(waiting)

        def left() -> Iterator[Item]:
            with suppress(IndexError):
                while True:
                    yield waiting.popleft()

        def work_on(function: Callable[[Item], Result]) -> Mapping[Item, Result]:
            for item in left():
                results[item] = function(item)
                show(len(results) / count)
            return results

        with ThreadPoolExecutor(max(self.count, 1)) as threads:
            futures = [threads.submit(work_on, elsewhere) for _ in range(min(self.count, count - 1))]
            try:
                yield work_on
            finally:
                waiting.clear()  # an interrupted run waits for one item at most
        for future in futures:
            future.result()

    def close(self) -> None:
        """End the processes."""
        self._due.clear()
        self._abort()

    def _abort(self) -> None:
        """End the processes, also those that still compute."""
        # After an exception `processes` does not wait for them.
        self._stack.__exit__(TimeoutError, TimeoutError(), None)


@contextmanager
def lasting_helpers(scenario: Scenario) -> Iterator[FinalizeHelpers]:
    """Have helpers during a run and, unless an error ends it, for its end."""
    helpers = FinalizeHelpers(scenario)
    try:
        yield helpers
    except BaseException:
        helpers.close()
        raise


@dataclass(frozen=True)
class RunEndingWithHelpers(RunEnding):
    """How a run ended whose end was prepared."""

    helpers: FinalizeHelpers | None = None
