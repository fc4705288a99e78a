"""The search: few draws for all candidates, more for those that may win, all on the same draws.

A candidate is screened with few draws. Whatever seems the best is measured with all draws, and
certified, before it is believed; then it may no longer be the best. So no candidate that was tried
and meets the limits has fewer transmissions than what is chosen. With few draws the quantile itself
must meet its limit, with all draws the upper end of its interval.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from cosim.simulation.batch.batch_interface import Population
from cosim.studies.campaign.campaign_figures import undominated
from cosim.studies.campaign.random_draws import Box
from cosim.studies.design.candidate_measures import (
    Bounds,
    CandidateMeasures,
    DesignLimits,
    bounds_of,
    measure,
)
from cosim.studies.design.design_space import Candidate, DesignSpace

_SMALLEST_STEP = 0.04
"""Of the grid's steps."""
_MOST_ROUNDS = 24

Progress = Callable[[float], None]
"""Told which share of the work is done, roughly."""


@dataclass
class Trial:
    """A candidate, and what is known of it so far."""

    candidate: Candidate
    measured: CandidateMeasures
    full: bool = False
    """Measured with all draws."""
    bounds: Bounds = field(default_factory=dict)
    """Certified, once it was asked for."""

    def excess(self, limits: DesignLimits) -> float:
        """How far it misses the limits, as far as is known."""
        settling_s = self.measured.settling_high_s if self.full else self.measured.settling_s
        return limits.excess(settling_s, self.bounds)


class Search:
    """All trials of a space on common draws.

    Args:
        space: what is chosen from.
        limits: what must be met.
        box: what is drawn from.
        seed: of the draws.
        screening: draws for all candidates.
        draws: for those that may win; these and the next as many.
        progress: told how far the work is.
    """

    def __init__(
        self,
        space: DesignSpace,
        limits: DesignLimits,
        box: Box,
        seed: int,
        *,
        screening: int,
        draws: int,
        progress: Progress = lambda share: None,
    ) -> None:
        self.space, self.limits = space, limits
        self._few = box.population(seed, range(screening))
        self._all = box.population(seed, range(draws))
        self._fresh = box.population(seed, range(draws, 2 * draws))
        self._trials: dict[Candidate, Trial] = {}
        self._progress = progress

    @property
    def trials(self) -> list[Trial]:
        """What was tried, in order."""
        return list(self._trials.values())

    def run(self) -> Trial:
        """Search; return the one of the fewest transmissions within the limits, or the closest."""
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
        """The trade-off: no other trial has both fewer transmissions and a shorter settling time.

        All are within the bounds and measured with all draws.
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
        """Measure a trial on draws that no choice depended on."""
        return self._measure(trial.candidate, self._fresh)

    def _refine(self, family: int) -> None:
        """Look around a family's best, ever nearer."""
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
        """Learn all there is to know of a trial; the cheaper first, lest it be enough."""
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
