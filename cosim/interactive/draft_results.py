"""What follows from an edited scenario, computed when it is first asked for."""

from collections.abc import Callable
from typing import TypeVar

from cosim.interactive.draft import Draft
from cosim.interactive.ensemble import Ensemble, explore_ensemble
from cosim.interactive.exploration import Exploration, run_of, why_not_exact
from cosim.interactive.exploration_figure import Shown
from cosim.interactive.scenario_guarantee import Guarantee, Margin, certify, margin_of, warning
from noack.config.scenario import Scenario
from noack.core.errors import CallerError

T = TypeVar("T")

RUN, CERTIFICATE, ENSEMBLE, MARGIN = "run", "certificate", "ensemble", "margin"


class DraftResults:
    """The draft and its results; each change of the draft begins anew.

    Raises:
        NoackError: the scenario is wrong, or has several loops.
    """

    def __init__(self, draft: Draft) -> None:
        self.listeners: list[Callable[[], None]] = []
        """Called after each change of the draft."""
        self.take(draft)

    def take(self, draft: Draft) -> None:
        """Take another draft; if it is wrong, the old one stays.

        Raises:
            NoackError: the scenario is wrong, or has several loops.
        """
        if draft.scenario.loops:
            raise CallerError("loops: only one loop can be explored; noack.simulate takes several")
        self.draft = draft
        self._found: dict[str, object] = {}
        for listener in self.listeners:
            listener()

    @property
    def known(self) -> frozenset[str]:
        """Which results are computed: RUN, CERTIFICATE, ENSEMBLE, MARGIN."""
        return frozenset(self._found)

    @property
    def run(self) -> Exploration:
        """The run."""
        return self._once(RUN, run_of, Exploration)

    @property
    def certificate(self) -> Guarantee:
        """What is guaranteed."""
        return self._once(CERTIFICATE, certify, Guarantee)

    @property
    def ensemble(self) -> Ensemble | None:
        """Bands over many draws; None without exact simulation."""
        if why_not_exact(self.draft.scenario) is not None:
            return None
        return self._once(ENSEMBLE, explore_ensemble, Ensemble)

    @property
    def margin(self) -> Margin:
        """For which M the loop is stable; this may take seconds."""
        return self._once(MARGIN, margin_of, Margin)

    @property
    def warning(self) -> str:
        """In words, by what is computed: whether the loop is unstable, and why."""
        certificate = self.certificate if CERTIFICATE in self.known else None
        return warning(self.run, certificate, self.margin if MARGIN in self.known else None)

    def shown(self, state: int) -> Shown:
        """Return what a figure shows of the results that are computed."""
        return Shown(
            self.run, state, self.ensemble if ENSEMBLE in self.known else None,
            self.certificate if CERTIFICATE in self.known else None,
        )  # fmt: skip

    def _once(self, name: str, compute: Callable[[Scenario], T], kind: type[T]) -> T:
        if name not in self._found:
            self._found[name] = compute(self.draft.scenario)
        found = self._found[name]
        assert isinstance(found, kind)
        return found
