"""The search: few draws for all candidates, more for the best ones; all use the same draws.

A candidate is screened with few draws. If it then ranks first, it is measured with all draws and
certified; after this another candidate may rank first. So no tried candidate that meets the limits
has fewer transmissions than the chosen one. With few draws the quantile itself must meet its limit,
with all draws the upper end of its interval.
"""

from collections.abc import Callable, Iterable, Mapping

import numpy as np

from cosim.simulation.batch import Population
from cosim.studies.campaign.campaign_figures import undominated
from cosim.studies.campaign.random_draws import Box, box_of
from cosim.studies.design.candidates import (
    CandidateMeasures,
    DesignLimits,
    DesignResult,
    Trial,
    bounds_of,
    measure,
    require_certifiable,
    require_draws,
)
from cosim.studies.design.design_space import Candidate, DesignSpace, space_of
from noack.config.scenario import Scenario
from noack.core.errors import CallerError

_SMALLEST_STEP = 0.04
"""Smallest step of the refinement, as a share of the grid's steps."""
_MOST_ROUNDS = 24
_SCREENING = 4
"""Screening uses the number of draws divided by this."""

Progress = Callable[[float], None]
"""Called with the approximate share of the work that is done."""


def design(
    families: Mapping[tuple[str, str], Scenario],
    limits: DesignLimits,
    *,
    draws: int,
    seed: int,
    progress: Progress = lambda share: None,
) -> DesignResult:
    """Choose among families; the result is deterministic.

    ``families`` has unresolved scenarios by the names of gain and norm. As many new draws as
    ``draws`` confirm the choice.

    Raises:
        CallerError: the limits or the scenario do not permit a design.
    """
    first = next(iter(families.values()))
    first.coverage.require_exact()
    if limits.settling_s > first.horizon_s:
        raise CallerError(
            f"--settling: {limits.settling_s:g} s lie beyond horizon_s = {first.horizon_s:g}"
        )
    require_draws(draws, limits.quantile)
    if limits.bounds:
        require_certifiable(first)
    space = space_of(families)
    search = Search(space, limits, box_of(first), seed, draws, progress)
    best = search.run()
    scenario = space.families[best.candidate.family].with_trigger(best.candidate)
    try:
        require_certifiable(scenario)
        bounds = best.bounds or bounds_of(scenario, limits)
    except CallerError:  # a bound is not required here
        bounds = None
    return DesignResult(
        space, limits, search.trials, search.front(), best, search.confirm(best), bounds, seed
    )


class Search:
    """All trials of a space on common draws; the draws after them confirm the choice."""

    def __init__(
        self,
        space: DesignSpace,
        limits: DesignLimits,
        box: Box,
        seed: int,
        draws: int,
        progress: Progress,
    ) -> None:
        self.space, self.limits = space, limits
        self._few = box.population(seed, range(max(draws // _SCREENING, 1)))
        self._all = box.population(seed, range(draws))
        self._fresh = box.population(seed, range(draws, 2 * draws))
        self._trials: dict[Candidate, Trial] = {}
        self._progress = progress

    @property
    def trials(self) -> list[Trial]:
        """All trials, in the order in which they were made."""
        return list(self._trials.values())

    def run(self) -> Trial:
        """Return the trial with the fewest transmissions within the limits, or the closest."""
        grid, families = list(self.space.grid()), len(self.space.families)
        for i, candidate in enumerate(grid):
            self._try([candidate])
            self._progress(0.5 * (i + 1) / len(grid))
        for family in range(families):
            self._refine(family)
            self._progress(0.5 + 0.4 * (family + 1) / families)
        self.front()
        best = self._best(self.trials)
        self._progress(1.0)
        return best

    def front(self) -> list[Trial]:
        """Return the trade-off: no other trial has fewer transmissions and also settles earlier.

        All its trials are within the bounds and measured with all draws.
        """
        while True:
            known = [t for t in self.trials if self._within_bounds(t)]
            sent = np.array([t.measured.transmissions for t in known])
            settling_s = np.array([t.measured.settling_s for t in known])
            front = [known[i] for i in undominated(sent, settling_s)]
            front = [t for t in front if np.isfinite(t.measured.settling_s)]
            open_ = [t for t in front if not self._settled(t)]
            if not open_:
                return front
            for trial in open_:
                self._settle(trial)

    def confirm(self, trial: Trial) -> CandidateMeasures:
        """Measure a trial on new draws, which the search did not use."""
        return self._measure(trial.candidate, self._fresh)

    def _refine(self, family: int) -> None:
        """Try the neighbours of a family's best trial, in steps that become smaller."""
        share, rounds = 0.5, 0
        best = self._best(self._of(family))
        while share > _SMALLEST_STEP and rounds < _MOST_ROUNDS:
            self._try(self.space.around(best.candidate, share))
            before, best = best, self._best(self._of(family))
            if best is before:
                share /= 2
            rounds += 1

    def _of(self, family: int) -> list[Trial]:
        return [trial for trial in self.trials if trial.candidate.family == family]

    def _try(self, candidates: Iterable[Candidate]) -> None:
        for one in candidates:
            if one not in self._trials:
                self._trials[one] = Trial(one, self._measure(one, self._few))

    def _best(self, trials: list[Trial]) -> Trial:
        while True:
            best = min(trials, key=self._rank)
            if self._settled(best):
                return best
            self._settle(best)

    def _rank(self, trial: Trial) -> tuple[float, float, float, Candidate]:
        excess, measured = trial.excess(self.limits), trial.measured
        unsettled = 1.0 - measured.settled if excess > 0 else 0.0
        return excess, unsettled, measured.transmissions, trial.candidate

    def _settled(self, trial: Trial) -> bool:
        return trial.full and (not self.limits.bounds or bool(trial.bounds))

    def _settle(self, trial: Trial) -> None:
        """Measure a trial with all draws; if this is already done, certify its bounds."""
        if not trial.full:
            trial.measured, trial.full = self._measure(trial.candidate, self._all), True
        elif not trial.bounds:
            family = self.space.families[trial.candidate.family]
            trial.bounds = bounds_of(family.with_trigger(trial.candidate), self.limits)

    def _within_bounds(self, trial: Trial) -> bool:
        return all(
            trial.bounds.get(name, 0.0) <= limit for name, limit in self.limits.bounds.items()
        )

    def _measure(self, candidate: Candidate, population: Population) -> CandidateMeasures:
        family = self.space.families[candidate.family]
        return measure(family.with_trigger(candidate), self.limits, population)
