"""Processes that help with the end of a long run, and prepare it while the run goes on.

The certificates of the loops depend on the scenario alone. The helpers compute them at idle
priority: a process of the run that wakes up takes the core at once. What is not computed when the
run ends, or is lost with a helper, is computed then.
"""

from collections import deque
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING

from cosim.live.process_pool import at_idle_priority, process_starts, processes
from noack.core.process_limits import cores
from noack.scenario.scenario import Scenario, loop_names

if TYPE_CHECKING:
    from cosim.live.finalize import Expectations

_MANY_STEPS = 50_000
"""Loops with fewer steps of the plant, all together, are judged in less time than processes
start."""
_LOOPS_AT_ONCE = 16
"""The end of a run waits for the certificates of so many loops at most."""


class EndHelpers:
    """Processes on all cores but one; there are none if the end of the run takes no time.

    Args:
        scenario: the scenario of the run.
    """

    def __init__(self, scenario: Scenario) -> None:
        timing, self._loops = scenario.timing, len(loop_names(scenario))
        steps = self._loops * (timing.horizon_ns // timing.plant_period_ns)
        self._count = cores() - 1 if steps >= _MANY_STEPS else 0
        self._stack, self._threads = ExitStack(), list[Thread]()
        self._blocks: deque[range] = deque()
        self._pool: ProcessPoolExecutor | None = None
        self._found: dict[int, Expectations] = {}

    def prepare(self, run_dir: Path) -> None:
        """Compute the certificates of many loops from now on."""
        loops = range(self._loops)
        if len(loops) <= _LOOPS_AT_ONCE or (pool := self.start()) is None:
            return
        self._blocks.extend(loops[first:][:_LOOPS_AT_ONCE] for first in loops[::_LOOPS_AT_ONCE])
        for _ in range(self._count):
            thread = Thread(target=self._prepare, args=(pool, run_dir), daemon=True)
            thread.start()
            self._threads.append(thread)

    def _prepare(self, pool: ProcessPoolExecutor, run_dir: Path) -> None:
        try:
            while self._blocks:
                block = self._blocks.popleft()
                function = "cosim.live.finalize", "expectations_of"
                with process_starts():
                    found = pool.submit(at_idle_priority, *function, run_dir, block)
                self._found |= zip(block, found.result(), strict=True)
        except BrokenProcessPool:  # a process was killed
            self._pool = None
        except Exception:  # the end of the run reports it; or another thread took the last block
            self._blocks.clear()

    def expectations(self, loops: range) -> "Sequence[Expectations] | None":
        """Return what to expect of some loops, if it is known of all of them."""
        found = [self._found[number] for number in loops if number in self._found]
        return found if len(found) == len(loops) else None

    def start(self) -> ProcessPoolExecutor | None:
        """Return the processes, all of which are free now; None if there are none."""
        self._blocks.clear()
        for thread in self._threads:
            thread.join()
        if self._pool is None and self._count:
            self._pool = self._stack.enter_context(processes(self._count))
        return self._pool

    def close(self) -> None:
        """End the processes."""
        self._blocks.clear()
        self._stack.close()
