"""What is computed of the edited scenario, when it is first asked for."""

from collections.abc import Callable
from typing import TypeVar, cast

from cosim.interactive.exploration import (
    Ensemble,
    Exploration,
    Fact,
    explore_ensemble,
    explore_or_simulate,
    why_not_exact,
)
from cosim.interactive.exploration_figure import ExploredRun
from cosim.interactive.scenario_draft import Draft
from cosim.interactive.scenario_guarantee import Guarantee, Margin, certify, margin_of, warning
from noack.core.errors import CallerError
from noack.scenario.scenario import Scenario

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
        self._results: dict[str, object] = {}
        for listener in self.listeners:
            listener()

    @property
    def known(self) -> frozenset[str]:
        """Which results are computed: RUN, CERTIFICATE, ENSEMBLE, MARGIN."""
        return frozenset(self._results)

    @property
    def run(self) -> Exploration:
        """The run."""
        return self._once(RUN, explore_or_simulate)

    def compute_run(self) -> None:
        """Compute the run, unless it is known.

        Raises:
            NoackError: the scenario is wrong.
        """
        self._once(RUN, explore_or_simulate)

    def compute_certificate(self) -> None:
        """Compute the certificate, unless it is known; a figure then shows it.

        Raises:
            NoackError: the scenario is wrong.
        """
        self._once(CERTIFICATE, certify)

    @property
    def certificate(self) -> Guarantee:
        """What is guaranteed."""
        return self._once(CERTIFICATE, certify)

    @property
    def ensemble(self) -> Ensemble | None:
        """Bands over many draws; None without exact simulation."""
        if why_not_exact(self.draft.scenario) is not None:
            return None
        return self._once(ENSEMBLE, explore_ensemble)

    @property
    def margin(self) -> Margin:
        """For which M the loop is stable; this may take seconds."""
        return self._once(MARGIN, margin_of)

    @property
    def warning(self) -> str:
        """In words, by what is computed: whether the loop is unstable, and why."""
        certificate = self.certificate if CERTIFICATE in self.known else None
        return warning(self.run, certificate, self.margin if MARGIN in self.known else None)

    @property
    def facts(self) -> dict[str, list[Fact]]:
        """What is computed, in groups."""
        bands = self.ensemble if ENSEMBLE in self.known else None
        run = [*self.run.numbers, *(() if bands is None else bands.numbers)]
        groups = {f"this run ({self.run.kind})": run}
        if CERTIFICATE in self.known:
            certificate = self.certificate
            groups["certificate"] = [
                Fact("certificate", f"{certificate.verdict}: {certificate.reason}"),
                *certificate.rows,
                *(
                    Fact(assumption.what, f"{assumption.verdict} ({assumption.why})")
                    for assumption in certificate.assumptions
                ),
            ]
        if MARGIN in self.known:
            groups["margin"] = [
                Fact("margin", self.margin.verdict),
                *(
                    Fact(
                        f"M = {row.m}: growth of the worst pattern (D delivered, L lost) per event",
                        f"{row.growth}, {row.verdict}",
                    )
                    for row in self.margin.rows
                ),
            ]
        return groups

    def explored_run(self, state: int) -> ExploredRun:
        """Return what a figure shows of the results that are computed."""
        return ExploredRun(
            self.run,
            state,
            self.ensemble if ENSEMBLE in self.known else None,
            self.certificate if CERTIFICATE in self.known else None,
        )

    def put(self, name: str, result: object) -> None:
        """Take a result that was computed elsewhere: RUN, CERTIFICATE, ENSEMBLE or MARGIN."""
        self._results[name] = result

    def _once(self, name: str, compute: Callable[[Scenario], T]) -> T:
        if name not in self._results:
            self._results[name] = compute(self.draft.scenario)
        return cast(T, self._results[name])
