"""What all visitors of the page share: a worker process, the known scenarios, the live run."""

import asyncio
import multiprocessing
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from pathlib import Path
from typing import Any, Self, TypeVar

from cosim.interactive.draft import known_scenarios
from cosim.lab.live_run import LiveRun
from cosim.record.run_directory import SUMMARY_FILE

T = TypeVar("T")

ANSWER_S = 60.0
"""So long a browser may take to answer: without a graphics card it may draw for seconds."""
_GIVE_UP_S = 3.0
"""So long the worker may go on with a call whose page does not want it any more."""
_NICE = 10
"""The worker yields to a live run and to the page."""


class LabServices:
    """The services of the page; a context, which ends the worker and a live run."""

    def __init__(self, scenario: str, folder: Path, runs: Path) -> None:
        self.scenario, self.folder, self.runs = scenario, folder, runs
        self.live: LiveRun | None = None
        self._pool = _new_pool()
        self._turn = asyncio.Lock()
        self._following: asyncio.Task[None] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        _end(self._pool)
        if self.live is not None:
            self.live.stop()

    @property
    def known(self) -> Mapping[str, str]:
        """Scenarios that the page offers, and what opens them."""
        return known_scenarios(self.folder, self.scenario)

    async def compute(self, function: Callable[..., T], *arguments: Any) -> T:
        """Call a function in the worker process, after the calls that were made before.

        A cancelled call is not begun, or given up after a moment.

        Raises: what the function raises.
        """
        try:
            return await self._call(function, *arguments)
        except BrokenProcessPool:  # killed, perhaps out of memory
            self._replace_worker()
            return await self._call(function, *arguments)

    async def _call(self, function: Callable[..., T], *arguments: Any) -> T:
        loop = asyncio.get_running_loop()
        await self._turn.acquire()
        call: asyncio.Future[T] = loop.run_in_executor(self._pool, function, *arguments)
        call.add_done_callback(self._end_turn)
        try:
            # Shielded: Python 3.11 prints a traceback when a pool ends that has cancelled calls.
            return await asyncio.shield(call)
        except asyncio.CancelledError:
            loop.call_later(_GIVE_UP_S, self._give_up, call)
            raise

    def _end_turn(self, call: asyncio.Future[Any]) -> None:
        self._turn.release()
        if not call.cancelled():
            call.exception()  # perhaps nobody waits for it any more

    def _give_up(self, call: asyncio.Future[Any]) -> None:
        if not call.done():
            self._replace_worker()

    def _replace_worker(self) -> None:
        """Begin a new worker process; a call in the old one is broken."""
        old, self._pool = self._pool, _new_pool()
        _end(old)

    async def run_live(self, text: str, horizon_s: float, folder: Path) -> LiveRun:
        """Start a live run, after the end of the one before."""
        if self.live is not None:
            await self.live.end()
        self.live = LiveRun(horizon_s)
        await self.live.start(text, folder, self.runs)
        self._following = asyncio.create_task(self.live.follow())
        return self.live

    def recorded(self) -> list[str]:
        """Return the names of the run directories, the newest first."""
        with suppress(OSError):
            found = [path for path in self.runs.iterdir() if (path / "scenario.toml").is_file()]
            return sorted((one.name for one in found if not one.is_symlink()), reverse=True)
        return []

    def has_ended(self, name: str) -> bool:
        """Whether a recorded run has a summary."""
        return (self.runs / name / SUMMARY_FILE).is_file()


class PageCalls:
    """The computations that one page waits for."""

    def __init__(self, services: LabServices) -> None:
        self._services = services
        self._calls: set[asyncio.Task[Any]] = set()

    async def compute(self, function: Callable[..., T], *arguments: Any) -> T:
        """Call a function in the worker process.

        Raises: what the function raises; CancelledError if the page is closed.
        """
        call = asyncio.create_task(self._services.compute(function, *arguments))
        self._calls.add(call)
        call.add_done_callback(self._calls.discard)
        return await call

    def give_up(self) -> None:
        """Give all of them up: the page is closed."""
        for call in self._calls:
            call.cancel()


def _end(pool: ProcessPoolExecutor) -> None:
    """End a worker at once: it may compute for seconds."""
    for worker in multiprocessing.active_children():
        worker.kill()
    pool.shutdown(wait=True)


def _new_pool() -> ProcessPoolExecutor:
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(1, mp_context=context, initializer=_prepare)


def _prepare() -> None:
    """Yield to others, and load what is needed, so that the first answer is quick."""
    os.nice(_NICE)
    from cosim.interactive import ensemble, scenario_guarantee  # noqa: F401
