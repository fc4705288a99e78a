"""What the page computes: the services that all visitors share, and the session of each.

:class:`LabServices` has a worker process, the known scenarios and the live run; :class:`Session`
has what one visitor explores, the edited scenario and what was computed of it.
"""

import asyncio
import multiprocessing
import os
import time
from collections.abc import Awaitable, Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self, TypeVar, TypeVarTuple

from cosim.interactive.draft_results import CERTIFICATE, ENSEMBLE, MARGIN, RUN, DraftResults
from cosim.interactive.exploration import Exploration, explore_ensemble, explore_or_simulate, why_not_exact
from cosim.interactive.scenario_draft import Draft, DraftError, Mistake, known_scenarios
from cosim.interactive.scenario_guarantee import certify, margin_of
from cosim.lab.live_run import LiveRun
from cosim.lab.recorded_views import live_view, recorded_view
from cosim.record.run_directory import SUMMARY_FILE
from noack.core.errors import NoackError
from noack.scenario.scenario import Scenario

T = TypeVar("T")
Ts = TypeVarTuple("Ts")

ANSWER_S = 60.0
"""Time limit for a browser's answer: without a graphics card it may draw for seconds."""
_GIVE_UP_S = 3.0
"""Time limit for a call whose page no longer needs it; then the worker is replaced."""
_MANAGER_ENDS_S = 5.0
"""Time limit at the end for the thread of the pool, whose worker is killed."""
_POLL_S = 0.4
"""Least time between two readings of what a live run has recorded."""
_QUIET_S = 0.15
"""Time after the last change until what takes longer than a redraw is computed."""
_MARGIN_S = 0.6
"""Further time until the margin is computed, which takes longest."""
_SLOW_S = 1.0
"""Time without a result after which the page shows that it waits."""
_NICE = 10
"""The worker yields to a live run and to the page."""


class LabServices:
    """The services of the page; a context, which ends the worker and a live run."""

    def __init__(self, scenario: str, folder: Path, runs: Path) -> None:
        self.scenario, self.folder, self.runs = scenario, folder, runs
        self.live: LiveRun | None = None
        self._pool = _start_worker()
        self._turn = asyncio.Lock()
        self._following: asyncio.Task[None] | None = None
        self._watching: asyncio.Task[None] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        manager = self._pool._executor_manager_thread  # None: nothing was computed
        _end_worker(self._pool)
        if manager is not None:
            # The interpreter would wake it up at its exit, perhaps while it closes its pipe.
            manager.join(_MANAGER_ENDS_S)  # type: ignore[attr-defined] # it is a thread
        if self.live is not None:
            self.live.stop()

    @property
    def known(self) -> Mapping[str, str]:
        """Scenarios that the page offers, and what opens them."""
        return known_scenarios(self.folder, self.scenario)

    async def compute(self, function: Callable[[*Ts], T], *arguments: *Ts) -> T:
        """Call a function in the worker process, after the calls that were made before.

        A cancelled call does not start, or is given up after a moment.

        Raises: what the function raises.
        """
        try:
            return await self._call(function, *arguments)
        except BrokenProcessPool:  # killed, perhaps out of memory
            self._replace_worker()
            return await self._call(function, *arguments)

    async def _call(self, function: Callable[[*Ts], T], *arguments: *Ts) -> T:
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

    def _end_turn(self, call: asyncio.Future[T]) -> None:
        self._turn.release()
        if not call.cancelled():
            call.exception()  # perhaps nobody waits for it any more

    def _give_up(self, call: asyncio.Future[T]) -> None:
        if not call.done():
            self._replace_worker()

    def _replace_worker(self) -> None:
        """Begin a new worker process; a call in the old one is broken."""
        old, self._pool = self._pool, _start_worker()
        _end_worker(old)

    async def run_live(self, text: str, horizon_s: float, folder: Path) -> LiveRun:
        """Start a live run, after the end of the one before."""
        if self.live is not None:
            await self.live.end()
        self.live = LiveRun(horizon_s)
        await self.live.start(text, folder, self.runs)
        self._following = asyncio.create_task(self.live.follow())
        self._watching = asyncio.create_task(self._watch(self.live))
        return self.live

    async def _watch(self, live: LiveRun) -> None:
        """Read what a live run has recorded, again and again, for a quarter of the time at most."""
        took_s = 0.0
        while not live.is_over:
            await asyncio.sleep(max(_POLL_S, 3 * took_s))
            if live.state != "running" or live.run_dir is None or not live.watched:
                continue
            live.watched, began_s = False, time.perf_counter()
            with suppress(NoackError, OSError, ValueError):  # the run ends, and its spool goes
                live.exploration = await self.compute(live_view, live.run_dir) or live.exploration
                live.version += 1
            took_s = time.perf_counter() - began_s
        if live.verdict and live.run_dir is not None:
            live.exploration = (await self.compute(recorded_view, live.run_dir, None)).run
            live.version += 1

    def recorded(self) -> list[str]:
        """Return the names of the run directories, the newest first."""
        with suppress(OSError):
            folders = [path for path in self.runs.iterdir() if (path / "scenario.toml").is_file()]
            return sorted((folder.name for folder in folders if not folder.is_symlink()), reverse=True)
        return []

    def has_ended(self, name: str) -> bool:
        """Whether a recorded run has a summary."""
        return (self.runs / name / SUMMARY_FILE).is_file()


class PageCalls:
    """The computations that one page waits for."""

    def __init__(self, services: LabServices) -> None:
        self._services = services
        self._calls: set[asyncio.Task[object]] = set()

    async def compute(self, function: Callable[[*Ts], T], *arguments: *Ts) -> T:
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


def _end_worker(pool: ProcessPoolExecutor) -> None:
    """End a worker at once, whatever it does: it may compute for seconds.

    If it dies in the middle of an answer, a thread of the pool waits for the rest. The pool itself
    keeps the answers' pipe open for writing, so the thread would never see its end, and the pool,
    the event loop that waits for it, and the interpreter at its exit would wait for ever.
    """
    answers = pool._result_queue
    for worker in multiprocessing.active_children():
        worker.kill()
    pool.shutdown(wait=False)
    answers._writer.close()  # type: ignore[attr-defined] # its other end then reads that it ended


def _start_worker() -> ProcessPoolExecutor:
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(1, mp_context=context, initializer=_prepare_worker)


def _prepare_worker() -> None:
    """Yield to others. To find this function the worker has loaded what the first answer needs."""
    os.nice(_NICE)


@dataclass
class Session:
    """The state of one page; :meth:`change` is called with each new draft."""

    calls: PageCalls
    draft: Draft
    on_drawn: Callable[[], Awaitable[None]]
    """Called when there is a new run."""
    on_rest: Callable[[], Awaitable[None]]
    """Called once the settings have rested for a moment, and with each further result."""
    results: DraftResults | None = None
    """Of the draft; None without a run."""
    before: Exploration | None = None
    """The run before the last change, for comparison."""
    mistakes: list[Mistake] = field(default_factory=list)
    note: str = ""
    """Why there is no run, or what its drawing leaves out."""
    pending: str = ""
    """In words: what is computed, or waits for the processor."""
    _wanted: int = 0
    _drawn: int = 0
    _busy: bool = False
    _rest_task: asyncio.Task[None] | None = None

    def end(self) -> None:
        """Compute nothing more: the page was closed."""
        if self._rest_task is not None:
            self._rest_task.cancel()
        self.calls.give_up()

    @property
    def is_behind(self) -> bool:
        """Whether a newer draft than the drawn one waits."""
        return self._drawn < self._wanted

    async def change(self, draft: Draft, *, gesture: bool = True) -> None:
        """Take another draft; of several changes during a redraw only the newest is drawn.

        Args:
            draft: the new one.
            gesture: whether a new change begins: the run before it is kept for comparison.
        """
        if gesture and self.results is not None:
            self.before = self.results.run
        self.draft = draft
        self._wanted += 1
        if self._rest_task is not None:
            self._rest_task.cancel()
        if self._busy:
            return
        self._busy = True
        try:
            while self.is_behind:
                self._drawn = self._wanted
                await self._explore()
                await self.on_drawn()
        finally:
            self._busy = False
        self._rest_task = asyncio.create_task(self._compute_rest())

    async def _explore(self) -> None:
        self.results, self.mistakes, self.note = None, [], ""
        try:
            scenario = self.draft.scenario
            if scenario.loops:
                self.note = "a scenario of several loops: run it live"
                return
            results = DraftResults(self.draft)
            if (why := why_not_exact(scenario)) is not None:
                self.note = f"in virtual time, which takes longer: {why}"
                results.put(RUN, await self._compute("run", explore_or_simulate, scenario))
            results.compute_run()  # an exact one takes some milliseconds
            self.results, self.pending = results, "computing: certificate"
        except DraftError as error:
            self.mistakes = error.mistakes
        except NoackError as error:
            self.note = str(error)

    async def _compute_rest(self) -> None:
        """Compute what takes longer, once the settings have rested for a moment."""
        await asyncio.sleep(_QUIET_S)
        await self.on_rest()
        if (results := self.results) is None:
            return
        scenario = self.draft.scenario
        try:
            results.put(CERTIFICATE, await self._compute("certificate", certify, scenario))
            await self.on_rest()
            if why_not_exact(scenario) is None:
                results.put(ENSEMBLE, await self._compute("bands", explore_ensemble, scenario))
                await self.on_rest()
            await asyncio.sleep(_MARGIN_S)
            margin = await self._compute("margin", margin_of, scenario)
            if margin.defined:
                results.put(MARGIN, margin)
        except NoackError as error:
            self.note, self.pending = str(error), ""
        await self.on_rest()

    async def _compute(self, quantity: str, function: Callable[[Scenario], T], scenario: Scenario) -> T:
        """Compute a result; show what is computed, and after a while that it waits."""

        async def show_waiting() -> None:
            await asyncio.sleep(_SLOW_S)
            self.pending = f"{quantity}: waiting for the processor"
            await self.on_rest()

        self.pending = f"computing: {quantity}"
        waiting = asyncio.create_task(show_waiting())
        try:
            result = await self.calls.compute(function, scenario)
        finally:
            waiting.cancel()
        self.pending = ""
        return result
