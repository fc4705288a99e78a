"""A design, from the scenario to the result."""

from collections.abc import Callable, Mapping

from cosim.studies.campaign.random_draws import box_of
from cosim.studies.design.candidate_measures import (
    DesignLimits,
    bounds_of,
    require_certifiable,
    require_draws,
)
from cosim.studies.design.design_result import DesignResult
from cosim.studies.design.design_search import Search
from cosim.studies.design.design_space import space_of
from noack.config.scenario import Scenario
from noack.core.errors import CallerError

_SCREENING = 4
"""Screening uses the number of draws divided by this."""


def design(
    families: Mapping[tuple[str, str], Scenario],
    limits: DesignLimits,
    *,
    draws: int,
    seed: int,
    progress: Callable[[float], None] = lambda share: None,
) -> DesignResult:
    """Choose among families; the result is deterministic.

    Args:
        families: scenarios, not resolved, by the names of gain and norm.
        limits: the limits that the design must meet.
        draws: number of draws for the choice; the same number of new draws confirms it.
        seed: of all draws.
        progress: called with the approximate share of the work that is done.

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
    search = Search(
        space, limits, box_of(first), seed,
        screening=max(draws // _SCREENING, 1), draws=draws, progress=progress,
    )  # fmt: skip
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
