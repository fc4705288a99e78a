"""Measures of a candidate: transmissions and settling over draws, and certified bounds."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np

from cosim.simulation.batch import Population, run_batch, setting_of
from cosim.studies.campaign.draw_statistics import estimate, interval_ranks, quantile_interval
from cosim.studies.design.design_space import Candidate
from noack.config.resolution import loop_of, resolve
from noack.config.scenario import Scenario
from noack.core.errors import CallerError
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
