"""What all visitors of the page share: processes that compute, recorded runs, the live run."""

import asyncio
from collections.abc import Callable
from multiprocessing.pool import Pool
from pathlib import Path
from typing import Any, TypeVar, TypeVarTuple

import noack
from noack_lab.live_run import LiveRun
from noack_lab.scenario_draft import Draft

T = TypeVar("T")
Ts = TypeVarTuple("Ts")


class LabServices:
    """The services of the page."""

    def __init__(self, draft: Draft, runs: Path, pool: Pool) -> None:
        self.draft, self.runs, self._pool = draft, runs, pool
        self.live: LiveRun | None = None
        self._running: asyncio.Task[None] | None = None

    async def compute(self, function: Callable[[*Ts], T], *arguments: *Ts) -> T:
        """Call a function in another process.

        Raises: what the function raises.
        """
        loop = asyncio.get_running_loop()
        future: asyncio.Future[T] = loop.create_future()

        def settle(value: Any, error: BaseException | None) -> None:
            if future.done():  # it was cancelled
                return
            if error is None:
                future.set_result(value)
            else:
                future.set_exception(error)

        self._pool.apply_async(
            function,
            arguments,
            callback=lambda value: loop.call_soon_threadsafe(settle, value, None),
            error_callback=lambda error: loop.call_soon_threadsafe(settle, None, error),
        )
        return await future

    def recorded(self) -> list[str]:
        """Return the names of the runs that have ended, the newest first."""
        summaries = self.runs.glob("*/summary.json")
        return sorted((path.parent.name for path in summaries if path.parent.name != "latest"), reverse=True)

    def run_live(self, scenario: noack.Scenario) -> None:
        """Start a live run, unless one is active."""
        if self.live is None or self.live.is_over:
            self.live = LiveRun(scenario.horizon_s)
            self._running = asyncio.create_task(self.live.run(scenario, self.runs))

    async def end(self) -> None:
        """End a live run."""
        if self.live is not None:
            await self.live.end()
