"""What one visitor of the page explores: the edited scenario and what was computed of it."""

import asyncio
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import TypeVar

from cosim.interactive.draft import Draft, DraftError, Mistake
from cosim.interactive.ensemble import Ensemble, explore_ensemble
from cosim.interactive.exploration import Exploration, explore, why_not_exact
from cosim.interactive.figure_curves import Shown
from cosim.interactive.run_exploration import simulate_sampled
from cosim.interactive.scenario_guarantee import (
    Guarantee,
    Margin,
    certify,
    margin_of,
    warning,
)
from cosim.lab.page.lab_services import PageCalls
from noack.config.scenario import Scenario
from noack.core.errors import NoackError

_QUIET_S = 0.15
"""So long after the last change, what takes longer than a redraw is computed."""
_MARGIN_S = 0.6
_SLOW_S = 1.0
"""Without a result for so long, the page says that it waits."""
T = TypeVar("T")


@dataclass
class Session:
    """The state of one page; :meth:`change` is called with each new draft."""

    calls: PageCalls
    draft: Draft
    on_drawn: Callable[[], Awaitable[None]]
    """Called when there is something new to draw."""
    run: Exploration | None = None
    ensemble: Ensemble | None = None
    guarantee: Guarantee | None = None
    margin: Margin | None = None
    reference: Exploration | None = None
    state: int = 0
    mistakes: list[Mistake] = field(default_factory=list)
    note: str = ""
    """Why there is no run, or what its drawing leaves out."""
    pending: str = ""
    """In words: what is computed, or waits for the processor."""
    redraw_ms: float = 0.0
    _wanted: int = 0
    _drawn: int = 0
    _busy: bool = False
    _later: asyncio.Task[None] | None = None

    def end(self) -> None:
        """Compute nothing more: the page was closed."""
        if self._later is not None:
            self._later.cancel()
        self.calls.give_up()

    async def change(self, draft: Draft) -> None:
        """Take another draft; of several changes during a redraw only the newest is drawn."""
        self.draft = draft
        self._wanted += 1
        if self._later is not None:
            self._later.cancel()
        if self._busy:
            return
        self._busy = True
        try:
            while self._drawn < self._wanted:
                self._drawn = self._wanted
                began_s = time.perf_counter()
                await self._explore()
                await self.on_drawn()
                self.redraw_ms = 1e3 * (time.perf_counter() - began_s)
        finally:
            self._busy = False
        self._later = asyncio.create_task(self._compute_rest())

    @property
    def warning(self) -> str:
        """In words: whether the loop is unstable, and why nothing is guaranteed."""
        return "" if self.run is None else warning(self.run, self.guarantee, self.margin)

    def keep(self) -> None:
        """Keep the run for comparison, or forget the one that was kept."""
        self.reference = self.run if self.reference is None else None

    def shown(self, *, dark: bool) -> Shown | None:
        """Return what the figure shows; None without a run."""
        if self.run is None:
            return None
        self.state = min(self.state, self.run.x.shape[1] - 1)
        return Shown(self.run, self.state, self.ensemble, self.guarantee, self.reference, dark=dark)

    async def _explore(self) -> None:
        self.ensemble = self.guarantee = self.margin = None
        self.mistakes, self.note = [], ""
        try:
            scenario = self.draft.scenario
            if scenario.loops:
                self.run, self.note = None, "a scenario of several loops: run it live"
                return
            if (why := why_not_exact(scenario)) is None:
                self.run = explore(scenario)
            else:
                self.note = f"in virtual time, which takes about a second: {why}"
                self.run = await self._compute("run", simulate_sampled, scenario)
        except DraftError as error:
            self.run, self.mistakes = None, error.mistakes
        except NoackError as error:
            self.run, self.note = None, str(error)
        self.pending = "" if self.run is None else "computing: certificate"

    async def _compute_rest(self) -> None:
        """Compute what takes longer, once the settings have rested for a moment."""
        if self.run is None:
            return
        await asyncio.sleep(_QUIET_S)
        scenario = self.draft.scenario
        try:
            self.guarantee = await self._compute("certificate", certify, scenario)
            await self.on_drawn()
            if why_not_exact(scenario) is None:
                self.ensemble = await self._compute("bands", explore_ensemble, scenario)
                await self.on_drawn()
            await asyncio.sleep(_MARGIN_S)
            self.margin = await self._compute("margin", margin_of, scenario)
        except NoackError as error:
            self.note, self.pending = str(error), ""
        await self.on_drawn()

    async def _compute(self, what: str, function: Callable[[Scenario], T], scenario: Scenario) -> T:
        """Compute a result, and say so; if it does not come soon, that it waits."""

        async def say_waiting() -> None:
            await asyncio.sleep(_SLOW_S)
            self.pending = f"{what}: waiting for the processor"
            await self.on_drawn()

        self.pending = f"computing: {what}"
        waiting = asyncio.create_task(say_waiting())
        try:
            found = await self.calls.compute(function, scenario)
        finally:
            waiting.cancel()
        self.pending = ""
        return found
