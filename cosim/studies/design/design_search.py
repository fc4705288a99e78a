"""The search for a trigger: few draws for all candidates, more for the best ones; and its result.

All candidates use the same draws. A candidate is screened with few of them. If it then ranks first,
it is measured with all draws and certified; after this another candidate may rank first. So no
tried candidate that meets the limits has fewer transmissions than the chosen one. With few draws
the quantile itself must meet its limit, with all draws the upper end of its interval.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np

from cosim.analysis.scenario_certificates import quick_certificate
from cosim.analysis.witnesses import plants_of
from cosim.simulation.exact_simulation import Population, run_batch, setting_of
from cosim.studies.campaign.campaign_figures import undominated
from cosim.studies.campaign.metrics import estimate, interval_ranks, quantile_interval
from cosim.studies.campaign.random_draws import Box, box_of
from cosim.studies.design.design_space import DesignSpace, TriggerCandidate, space_of
from netem.core.errors import CallerError
from netem.core.number_format import at_most, plus_minus
from noack.core.progress import Progress, no_progress
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.theory.certificates.conditions import outside_box
from noack.theory.coverage import require_exact

BoundedQuantity = Literal["state", "error"]
Bounds = Mapping[BoundedQuantity, float]
"""Certified sup‖x‖ and sup‖e_c‖, Euclidean; infinite if there is no bound."""
WORDS: dict[BoundedQuantity, str] = {"state": "sup‖x‖", "error": "sup‖e_c‖"}
_SMALLEST_STEP = 0.04
"""Smallest step of the refinement, as a share of the grid's steps."""
_MOST_ROUNDS = 24
"""Most rounds of the refinement."""
_SCREENING_DIVISOR = 4
"""Screening uses the number of draws divided by this."""
_NAME_SUFFIX = "_designed"


@dataclass(frozen=True)
class DesignLimits:
    """The limits of a design.

    Args:
        settling_s: upper limit of the quantile of the settling times.
        quantile: the share of draws that must settle within this limit.
        settle: a run has settled when ‖x‖ stays at or below this share of ‖x(0)‖.
        bounds: upper limits of the certified bounds.
        schedule: whether bounds are certified under the scenario's schedule; else under the paper's
            conditions.
    """

    settling_s: float
    quantile: float
    settle: float
    bounds: Bounds
    schedule: bool = False

    def excess(self, settling_s: float, bounds: Bounds) -> float:
        """Return 0 if all limits are met, else the largest 1 − limit/value."""
        pairs = [(settling_s, self.settling_s)]
        pairs += [(bounds[name], limit) for name, limit in self.bounds.items() if name in bounds]
        return max(0.0, *(1.0 - limit / value if value > 0 else 0.0 for value, limit in pairs))


class CandidateMeasures(NamedTuple):
    """Measures of a candidate over k draws; intervals have 95 % confidence."""

    draws: int
    transmissions: float
    """Mean number of transmissions."""
    halfwidth: float
    """Half-width of the mean's confidence interval."""
    settling_s: float
    """Quantile of the settling times; infinite if too many runs do not settle."""
    settling_low_s: float
    settling_high_s: float
    """Upper end of the quantile's interval, by order statistics."""
    settled: float
    """The share of runs that settle within the limit."""

    @property
    def settling(self) -> str:
        """The quantile of the settling times with its interval, as text."""
        low, value_text, high = (
            f"{value:.4g}" if math.isfinite(value) else "∞"
            for value in (self.settling_low_s, self.settling_s, self.settling_high_s)
        )
        return f"{value_text} s [{low}, {high}]"


@dataclass
class Trial:
    """A candidate with its measures and bounds."""

    candidate: TriggerCandidate
    measured: CandidateMeasures
    full: bool = False
    """Whether it was measured with all draws."""
    bounds: Bounds = field(default_factory=dict)
    """Certified bounds; empty until they are computed."""

    def excess(self, limits: DesignLimits) -> float:
        """Return by how much the candidate misses the limits, from the measures so far."""
        settling_s = self.measured.settling_high_s if self.full else self.measured.settling_s
        return limits.excess(settling_s, self.bounds)


def measure(scenario: Scenario, limits: DesignLimits, population: Population) -> CandidateMeasures:
    """Run a scenario over draws; the settling time of a failed run is infinite.

    Raises:
        CallerError: the engine cannot run the scenario.
    """
    rows = run_batch(replace(setting_of(resolve(scenario)), settle=limits.settle), population)
    sends = estimate(rows["transmissions"].astype(np.float64))
    settling_s = np.where(np.isnan(rows["settling_s"]), math.inf, rows["settling_s"])
    quantile_s = float(np.quantile(settling_s, limits.quantile, method="inverted_cdf"))
    low_s, high_s = quantile_interval(settling_s, limits.quantile)
    share = float(np.mean(settling_s <= limits.settling_s))
    return CandidateMeasures(
        len(rows), sends.mean, sends.halfwidth, quantile_s, max(low_s, 0.0), high_s, share
    )


def require_draws(draws: int, quantile: float) -> None:
    """Require enough draws for an interval of the quantile.

    Raises:
        CallerError: there are too few draws.
    """
    enough = draws
    while interval_ranks(enough, quantile)[1] == enough:
        enough += max(enough // 50, 1)
    if enough > draws:
        raise CallerError(f"--draws: {draws} are too few for the quantile {quantile:g}; {enough} are enough")


def _require_certifiable(scenario: Scenario) -> None:
    """Raise CallerError if no certificate covers all plants and initial states that are drawn."""
    if scenario.plant.initial_state_halfwidth is not None:
        raise CallerError("--bound: needs one x(0); leave out plant.initial_state_halfwidth")
    if (outside := outside_box(resolve(scenario))) is not None:
        raise CallerError(f"--bound: {outside}")


def certified_bounds(scenario: Scenario, limits: DesignLimits) -> Bounds:
    """Return sup‖x‖ and sup‖e_c‖ for all plants in the box, or for the plant if there is no box.

    ‖e_c‖ ≤ ‖W⁻¹‖ ‖e_c‖_W.
    """
    resolved = resolve(scenario)
    certificate = quick_certificate(
        resolved,
        plants_of(resolved)[-1],
        ideal=not limits.schedule,
    )
    if not (certificate.has("x") and certificate.has("e_c")):
        return {"state": math.inf, "error": math.inf}
    t_s = np.zeros(1)
    weight = loop_of(resolved).weight
    shrinks = 1.0 if weight is None else float(np.linalg.norm(np.linalg.inv(weight), 2))
    return {
        "state": float(certificate.state(t_s).max()),
        "error": shrinks * float(certificate.controller_error(t_s).max()),
    }


class TriggerSearch:
    """All trials of a space on common draws; the draws after them confirm the choice."""

    def __init__(self, space: DesignSpace, limits: DesignLimits, box: Box, seed: int, draws: int) -> None:
        self.space, self.limits = space, limits
        self._screening_draws = box.population(seed, range(max(draws // _SCREENING_DIVISOR, 1)))
        self._draws = box.population(seed, range(draws))
        self._fresh_draws = box.population(seed, range(draws, 2 * draws))
        self._trials: dict[TriggerCandidate, Trial] = {}

    @property
    def trials(self) -> list[Trial]:
        """All trials, in the order in which they were made."""
        return list(self._trials.values())

    def scenario(self, trial: Trial) -> Scenario:
        """Return the scenario of a trial."""
        return self.space.families[trial.candidate.family].with_trigger(trial.candidate)

    def run(self, progress: Progress) -> Trial:
        """Return the trial with the fewest transmissions within the limits, or the closest."""
        grid, families = list(self.space.grid()), len(self.space.families)
        for i, candidate in enumerate(grid):
            self._try([candidate])
            progress(0.5 * (i + 1) / len(grid))
        for family in range(families):
            self._refine(family)
            progress(0.5 + 0.4 * (family + 1) / families)
        self.front()
        best = self._best(self.trials)
        progress(1.0)
        return best

    def front(self) -> list[Trial]:
        """Return the trade-off: no other trial has fewer transmissions and also settles earlier.

        All its trials are within the bounds and measured with all draws.
        """
        while True:
            limits = self.limits.bounds.items()
            within_bounds = [
                trial
                for trial in self.trials
                if all(trial.bounds.get(name, 0.0) <= limit for name, limit in limits)
            ]
            transmissions = np.array([t.measured.transmissions for t in within_bounds])
            settling_s = np.array([t.measured.settling_s for t in within_bounds])
            front = [within_bounds[i] for i in undominated(transmissions, settling_s)]
            front = [t for t in front if np.isfinite(t.measured.settling_s)]
            rough = [t for t in front if not self._is_exact(t)]
            if not rough:
                return front
            for trial in rough:
                self._measure_more(trial)

    def confirm(self, trial: Trial) -> CandidateMeasures:
        """Measure a trial on new draws, which the search did not use."""
        return measure(self.scenario(trial), self.limits, self._fresh_draws)

    def _refine(self, family: int) -> None:
        """Try the neighbours of a family's best trial, in steps that become smaller."""

        def best_of_family() -> Trial:
            return self._best([t for t in self.trials if t.candidate.family == family])

        share, rounds, best = 0.5, 0, best_of_family()
        while share > _SMALLEST_STEP and rounds < _MOST_ROUNDS:
            self._try(self.space.neighbours(best.candidate, share))
            previous, best = best, best_of_family()
            if best is previous:
                share /= 2
            rounds += 1

    def _try(self, candidates: Iterable[TriggerCandidate]) -> None:
        for candidate in candidates:
            if candidate not in self._trials:
                scenario = self.space.families[candidate.family].with_trigger(candidate)
                measured = measure(scenario, self.limits, self._screening_draws)
                self._trials[candidate] = Trial(candidate, measured)

    def _best(self, trials: list[Trial]) -> Trial:
        while not self._is_exact(best := min(trials, key=self._rank)):
            self._measure_more(best)
        return best

    def _rank(self, trial: Trial) -> tuple[float, float, float, float, TriggerCandidate]:
        excess, measured = trial.excess(self.limits), trial.measured
        unsettled = 1.0 - measured.settled if excess > 0 else 0.0
        return excess, unsettled, measured.transmissions, measured.settling_s, trial.candidate

    def _is_exact(self, trial: Trial) -> bool:
        return trial.full and (not self.limits.bounds or bool(trial.bounds))

    def _measure_more(self, trial: Trial) -> None:
        """Measure a trial with all draws; if this is already done, certify its bounds."""
        if not trial.full:
            trial.measured = measure(self.scenario(trial), self.limits, self._draws)
            trial.full = True
        elif not trial.bounds:
            trial.bounds = certified_bounds(self.scenario(trial), self.limits)


@dataclass(frozen=True)
class DesignResult:
    """The result of a design."""

    space: DesignSpace
    limits: DesignLimits
    trials: Sequence[Trial]
    """All candidates that were tried."""
    front: Sequence[Trial]
    """The trade-off curve, by ascending transmissions."""
    best: Trial
    """The candidate with the fewest transmissions within the limits, or the closest to them."""
    fresh: CandidateMeasures
    """Measures of the best candidate on new draws, which the search did not use."""
    bounds: Bounds | None
    """Certified bounds of the best candidate; None if there are none."""
    seed: int

    @property
    def feasible(self) -> bool:
        """Whether the best candidate meets the limits with the upper end of its interval."""
        return self.best.excess(self.limits) == 0

    @property
    def confirmed(self) -> bool:
        """Whether the quantile itself also meets the limit on the new draws."""
        return self.feasible and self.fresh.settling_s <= self.limits.settling_s

    @property
    def name(self) -> str:
        """Name of the scenario for which the trigger is chosen."""
        return self.space.families[0].scenario.name

    @property
    def scenario(self) -> Scenario:
        """The scenario of the best candidate, under a new name."""
        chosen = self.space.families[self.best.candidate.family].with_trigger(self.best.candidate)
        limits = self.limits
        wanted = f"{100 * limits.quantile:g} % of draws settle within {limits.settling_s:g} s"
        trigger = "transmits least, of those tried, while" if self.feasible else "comes closest to this:"
        description = f"{chosen.name} with the trigger that {trigger} {wanted}."
        return chosen.model_copy(update={"name": designed_name(chosen.name), "description": description})

    @property
    def conditions(self) -> str:
        """The conditions of the certified bounds."""
        kind = "the scenario's schedule" if self.limits.schedule else "the paper's conditions"
        return f"under {kind}, for every plant that is drawn"

    def verdict(self) -> str:
        """The verdict in one line."""
        limits, share = self.limits, f"in {100 * self.limits.quantile:g} % of draws"
        candidate = self.best.candidate
        weight = self.space.families[candidate.family].name
        settings_text = f"α = {candidate.alpha_per_s:.4g} /s, β = {candidate.beta:.4g}, weight {weight}"
        if self.confirmed:
            sent = plus_minus(self.fresh.transmissions, self.fresh.halfwidth)
            return f"{sent} transmissions, settled after {self.fresh.settling} {share}: {settings_text}"
        if self.feasible:
            return (
                f"not confirmed: on fresh draws it takes {self.fresh.settling} {share}, "
                f"{limits.settling_s:g} s are allowed; take more --draws"
            )
        measured, shortfalls = self.best.measured, []
        if measured.settling_high_s > limits.settling_s:
            allowed = f"({limits.settling_s:g} s allowed)"
            shortfalls.append(f"a settling time of {measured.settling} {share} {allowed}")
        for name, limit in limits.bounds.items():
            if self.best.bounds[name] > limit:
                shortfalls.append(f"{certified(name, self.best.bounds[name])} ({limit:g} allowed)")
        return f"no design meets the limits; the closest has {' and '.join(shortfalls)}, at {settings_text}"

    def to_json(self) -> dict[str, object]:
        """Return the result as JSON."""
        limits = asdict(self.limits)
        limits["under"] = "schedule" if limits.pop("schedule") else "paper"
        best = self._row(self.best) | {
            "W": self.scenario.decaying.weight,
            "K": self.scenario.model.gain,
            "fresh": self.fresh._asdict(),
            "bounds": None if self.bounds is None else dict(self.bounds),
        }
        return {
            "scenario": self.name,
            "limits": limits,
            "seed": self.seed,
            "tried": len(self.trials),
            "feasible": self.feasible,
            "confirmed": self.confirmed,
            "verdict": self.verdict(),
            "best": best,
            "front": [self._row(trial) for trial in self.front],
        }

    def _row(self, trial: Trial) -> dict[str, object]:
        number, alpha_per_s, beta = trial.candidate
        family = self.space.families[number]
        chosen: dict[str, object] = {"gain": family.gain, "weight": family.weight}
        return chosen | {"alpha_per_s": alpha_per_s, "beta": beta} | trial.measured._asdict()


def designed_name(name: str) -> str:
    """Return the name of a scenario that is designed from one of another name."""
    return f"{name.removesuffix(_NAME_SUFFIX)[: 64 - len(_NAME_SUFFIX)]}{_NAME_SUFFIX}"


def certified(name: BoundedQuantity, value: float) -> str:
    """Return a certified bound as text."""
    if not math.isfinite(value):
        return f"no certified bound of {WORDS[name]}"
    return f"{WORDS[name]} ≤ {at_most(value)}"


def design(
    families: Mapping[tuple[str, str], Scenario],
    limits: DesignLimits,
    *,
    draws: int,
    seed: int,
    progress: Progress = no_progress,
) -> DesignResult:
    """Choose among families; the result is deterministic.

    ``families`` has unresolved scenarios by the names of gain and norm. As many new draws as
    ``draws`` confirm the choice.

    Raises:
        CallerError: the limits or the scenario do not permit a design.
    """
    first = next(iter(families.values()))
    require_exact(first)
    if limits.settling_s > first.horizon_s:
        raise CallerError(f"--settling: {limits.settling_s:g} s lie beyond horizon_s = {first.horizon_s:g}")
    require_draws(draws, limits.quantile)
    if limits.bounds:
        _require_certifiable(first)
    space = space_of(families)
    search = TriggerSearch(space, limits, box_of(first), seed, draws)
    best = search.run(progress)
    scenario = search.scenario(best)
    try:
        _require_certifiable(scenario)
        bounds = best.bounds or certified_bounds(scenario, limits)
    except CallerError:  # a bound is not required here
        bounds = None
    return DesignResult(
        space, limits, search.trials, search.front(), best, search.confirm(best), bounds, seed
    )
