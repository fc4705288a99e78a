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

T = TypeVar("T")

_NICE = 10
"""The worker yields to a live run and to the page."""


class LabServices:
    """The services of the page; a context, which ends the worker and a live run."""

    def __init__(self, scenario: str, folder: Path, runs: Path) -> None:
        self.scenario, self.folder, self.runs = scenario, folder, runs
        self.live: LiveRun | None = None
        self._pool = _new_pool()
        self._following: asyncio.Task[None] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in multiprocessing.active_children():  # it may compute for seconds
            worker.kill()
        self._pool.shutdown(wait=True)
        if self.live is not None:
            self.live.stop()

    @property
    def known(self) -> Mapping[str, str]:
        """Scenarios that the page offers, and what opens them."""
        return known_scenarios(self.folder, self.scenario)

    async def compute(self, function: Callable[..., T], *arguments: Any) -> T:
        """Call a function in the worker process.

        Raises: what the function raises.
        """
        try:
            return await self._submit(function, *arguments)
        except BrokenProcessPool:  # killed, perhaps out of memory
            self._pool = _new_pool()
            return await self._submit(function, *arguments)

    def _submit(self, function: Callable[..., T], *arguments: Any) -> asyncio.Future[T]:
        # Shielded: Python 3.11 prints a traceback when a pool ends that has cancelled calls.
        loop = asyncio.get_running_loop()
        return asyncio.shield(loop.run_in_executor(self._pool, function, *arguments))

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


def _new_pool() -> ProcessPoolExecutor:
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(1, mp_context=context, initializer=_prepare)


def _prepare() -> None:
    """Yield to others, and load what is needed, so that the first answer is quick."""
    os.nice(_NICE)
    from cosim.interactive import ensemble, scenario_guarantee  # noqa: F401
