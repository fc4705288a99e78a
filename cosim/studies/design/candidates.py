"""Measures of a candidate (transmissions, settling, certified bounds), and the result of a design.

Transmissions and settling are those of draws.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from cosim.simulation.batch import Population, run_batch, setting_of
from cosim.studies.campaign.metrics import estimate, interval_ranks, quantile_interval
from cosim.studies.design.design_space import Candidate, DesignSpace
from noack.config.resolution import loop_of, resolve
from noack.config.scenario import Scenario
from noack.core.errors import CallerError
from noack.core.number_format import plus_minus
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import ideal_conditions, nominal_conditions
from noack.theory.certificates.scenario_certificates import certify, certify_box, outside_box

Bounded = Literal["state", "error"]
Bounds = Mapping[Bounded, float]
"""Certified sup‖x‖ and sup‖e_c‖, Euclidean; infinite if there is no bound."""


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


@dataclass
class Trial:
    """A candidate with its measures and bounds."""

    candidate: Candidate
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
    setting = replace(setting_of(resolve(scenario)), settle=limits.settle)
    rows = run_batch(setting, population)
    sent = estimate(rows["transmissions"].astype(np.float64))
    settling_s = np.where(np.isnan(rows["settling_s"]), math.inf, rows["settling_s"])
    quantile_s = float(np.quantile(settling_s, limits.quantile, method="inverted_cdf"))
    low_s, high_s = quantile_interval(settling_s, limits.quantile)
    settled = float(np.mean(settling_s <= limits.settling_s))
    return CandidateMeasures(
        len(rows), sent.mean, sent.halfwidth, quantile_s, max(low_s, 0.0), high_s, settled
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
        raise CallerError(
            f"--draws: {draws} are too few for the quantile {quantile:g}; {enough} are enough"
        )


def require_certifiable(scenario: Scenario) -> None:
    """Require that a certificate covers all plants and initial states that are drawn.

    Raises:
        CallerError: it does not cover them.
    """
    if scenario.plant.initial_state_halfwidth is not None:
        raise CallerError("--bound: needs one x(0); leave out plant.initial_state_halfwidth")
    outside = outside_box(resolve(scenario))
    if outside is not None:
        raise CallerError(f"--bound: {outside}")


def certificate_of(scenario: Scenario, limits: DesignLimits) -> ScenarioCertificate:
    """Return the certificate of all plants in the box, or of the plant if there is no box."""
    resolved = resolve(scenario)
    late = resolved.certificate.late_periods
    conditions = (
        nominal_conditions(resolved, late) if limits.schedule else ideal_conditions(resolved)
    )
    return certify_box(resolved, conditions) or certify(resolved, conditions)


def bounds_of(scenario: Scenario, limits: DesignLimits) -> Bounds:
    """Return certified sup‖x‖ and sup‖e_c‖ over all times; ‖e_c‖ ≤ ‖W⁻¹‖ ‖e_c‖_W."""
    found = certificate_of(scenario, limits)
    if found.constants is None:
        return {"state": math.inf, "error": math.inf}
    t_s = np.array([0.0, found.floor_from_s if math.isfinite(found.floor_from_s) else 0.0])
    weight = loop_of(resolve(scenario)).weight
    shrinks = 1.0 if weight is None else float(np.linalg.norm(np.linalg.inv(weight), 2))
    return {
        "state": float(found.state(t_s).max()),
        "error": shrinks * float(found.controller_error(t_s).max()),
    }


_DESIGNED = "_designed"
WORDS: dict[Bounded, str] = {"state": "sup‖x‖", "error": "sup‖e_c‖"}


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
    def scenario(self) -> Scenario:
        """The scenario of the best candidate, under a new name."""
        family = self.space.families[self.best.candidate.family]
        chosen = family.with_trigger(self.best.candidate)
        limits = self.limits
        return chosen.model_copy(
            update={
                "name": f"{chosen.name.removesuffix(_DESIGNED)[: 64 - len(_DESIGNED)]}{_DESIGNED}",
                "description": f"{chosen.name} with the trigger that transmits least while "
                f"{100 * limits.quantile:g} % of draws settle within {limits.settling_s:g} s.",
            }
        )

    @property
    def conditions(self) -> str:
        """The conditions of the certified bounds."""
        kind = "the scenario's schedule" if self.limits.schedule else "the paper's conditions"
        return f"under {kind}, for the whole box"

    def verdict(self) -> str:
        """The verdict in one line."""
        if self.confirmed:
            sent = plus_minus(self.fresh.transmissions, self.fresh.halfwidth)
            return f"{sent} transmissions, settled after {self._settling(self.fresh)}: {self._at()}"
        if self.feasible:
            return (
                f"not confirmed: on fresh draws it takes {self._settling(self.fresh)}, "
                f"{self.limits.settling_s:g} s are allowed; take more --draws"
            )
        return f"no design meets the limits; the closest has {self._missed()}, at {self._at()}"

    def document(self) -> dict[str, Any]:
        """Return the result as JSON."""
        limits = asdict(self.limits)
        limits["under"] = "schedule" if limits.pop("schedule") else "paper"
        bounds = None if self.bounds is None else dict(self.bounds)
        matrices = {"W": self.scenario.decaying.weight, "K": self.scenario.model.gain}
        best = {**self._row(self.best), **matrices, "fresh": self.fresh._asdict(), "bounds": bounds}
        return {
            "scenario": self.space.families[0].scenario.name,
            "limits": limits,
            "seed": self.seed,
            "tried": len(self.trials),
            "feasible": self.feasible,
            "confirmed": self.confirmed,
            "verdict": self.verdict(),
            "best": best,
            "front": [self._row(trial) for trial in self.front],
        }

    def _row(self, trial: Trial) -> dict[str, Any]:
        number, alpha_per_s, beta = trial.candidate
        family = self.space.families[number]
        trigger = {"alpha_per_s": alpha_per_s, "beta": beta}
        names = {"gain": family.gain, "weight": family.weight}
        return {**names, **trigger, **trial.measured._asdict()}

    def _at(self) -> str:
        one = self.best.candidate
        name = self.space.families[one.family].name
        return f"α = {one.alpha_per_s:.4g} /s, β = {one.beta:.4g}, weight {name}"

    def _settling(self, measured: CandidateMeasures) -> str:
        return f"{seconds(measured)} in {100 * self.limits.quantile:g} % of draws"

    def _missed(self) -> str:
        """Return the limits that are exceeded, with the amounts."""
        measured, missed = self.best.measured, []
        if measured.settling_high_s > self.limits.settling_s:
            missed.append(
                f"a settling time of {self._settling(measured)} "
                f"({self.limits.settling_s:g} s allowed)"
            )
        for name, limit in self.limits.bounds.items():
            value = self.best.bounds[name]
            if value > limit:
                missed.append(f"{certified(name, value)} ({limit:g} allowed)")
        return " and ".join(missed)


def certified(name: Bounded, value: float) -> str:
    """Return a certified bound as text."""
    if not math.isfinite(value):
        return f"no certified bound of {WORDS[name]}"
    return f"{WORDS[name]} ≤ {value:.4g}"


def seconds(measured: CandidateMeasures) -> str:
    """Return the quantile of the settling times with its interval, as text."""
    low, at, high = (
        f"{value:.4g}" if math.isfinite(value) else "∞"
        for value in (measured.settling_low_s, measured.settling_s, measured.settling_high_s)
    )
    return f"{at} s [{low}, {high}]"
