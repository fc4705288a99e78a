"""What is guaranteed for a scenario: certificate, margin, and a warning in words."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cosim.analysis.certificates import constant_rows
from cosim.analysis.margin_search import find_margin
from cosim.interactive.exploration import Exploration, Fact
from noack.core.errors import CallerError
from noack.core.linear_systems import Vector
from noack.core.number_format import at_least, at_most, number
from noack.scenario.resolution import resolve, setpoint_of
from noack.scenario.scenario import Scenario
from noack.theory.certificates.assumptions import AssumptionStatus
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import (
    OWN_PLANT,
    about_setpoint,
    nominal_conditions,
    void_at_setpoint,
)
from noack.theory.certificates.scenario_certificates import own_plant_scope

CERTIFIED, VOID, NOT_COVERED = "certified", "no certificate", "not covered"
_POINTS = 121
"""Times at which the bounds are drawn."""


class OpenAssumption(NamedTuple):
    """An assumption that does not hold for certain."""

    verdict: str
    what: str
    why: str


@dataclass(frozen=True)
class Guarantee:
    """The certificate of a scenario's plant under its own schedule, at N times."""

    verdict: str
    """CERTIFIED, VOID or NOT_COVERED."""
    reason: str
    """One sentence: what is guaranteed, or why nothing is."""
    t_s: Vector
    e_s: Vector
    """Bound of ‖e_s‖; NaN without a certificate."""
    e_c: Vector
    x: Vector
    """Bound of ‖x‖; at a set-point that of ‖x − x_r‖ plus ‖x_r‖."""
    rows: tuple[Fact, ...] = ()
    """The constants."""
    assumptions: tuple[OpenAssumption, ...] = ()


class MarginRow(NamedTuple):
    """The stability of a loop for an M."""

    m: str
    growth: str
    """Of the worst pattern per event."""
    verdict: str


@dataclass(frozen=True)
class Margin:
    """For which M the loop is stable under every loss pattern."""

    verdict: str
    """In words."""
    rows: tuple[MarginRow, ...]
    defined: bool
    """Whether the loop has a margin: its trigger has a longest time between events."""


def certify(scenario: Scenario) -> Guarantee:
    """Certify a scenario's own plant; a scenario that is not covered is no error.

    Raises:
        NoackError: the scenario is wrong.
    """
    resolved = resolve(scenario)
    t_s = np.linspace(0.0, resolved.horizon_s, _POINTS)
    no_bound = np.full(_POINTS, np.nan)
    try:
        certificate = _certificate(resolved)
    except CallerError as error:
        return Guarantee(NOT_COVERED, str(error), t_s=t_s, e_s=no_bound, e_c=no_bound, x=no_bound)
    reason = _reason(certificate)
    assumptions = tuple(
        OpenAssumption(str(assumption.verdict), assumption.what, assumption.why)
        for assumption in certificate.assumptions
        if assumption.verdict != AssumptionStatus.HOLDS and assumption.why != reason
    )
    rows = () if certificate.constants is None else constant_rows([certificate], None, 0)
    setpoint = setpoint_of(resolved)
    distance = 0.0 if setpoint is None else float(np.linalg.norm(setpoint[0]))
    with np.errstate(all="ignore"):
        return Guarantee(
            VOID if certificate.constants is None else CERTIFIED,
            reason,
            t_s=t_s,
            e_s=certificate.sensor_error(t_s),
            e_c=certificate.controller_error(t_s),
            x=certificate.state(t_s) + distance,
            rows=tuple(Fact(label, values[0]) for label, values, _ in rows),
            assumptions=assumptions,
        )


def _certificate(resolved: Scenario) -> ScenarioCertificate:
    resolved.coverage.require_constant()
    resolved.coverage.require_certifiable()
    if (void := void_at_setpoint(resolved).get(OWN_PLANT)) is not None:
        raise CallerError(f"controller.setpoint: {void}")
    shifted = about_setpoint(resolved)
    late_periods = resolved.certificate.late_periods
    return own_plant_scope(shifted).certificate(nominal_conditions(shifted, late_periods))


def _reason(certificate: ScenarioCertificate) -> str:
    constants = certificate.constants
    if constants is None:
        return certificate.void or "no bounds were found"
    patterns = "every loss pattern that the guarantee allows"
    if constants.rate_per_s == 0:
        return f"{patterns}: all errors stay bounded"
    rate = f"decay at the rate {at_least(constants.rate_per_s, 3)} /s"
    if certificate.persistent_constants is not None:
        return f"{patterns}: all errors stay bounded; what the start causes {rate}"
    if certificate.floor_constants is not None:
        return f"{patterns}: all errors {rate} down to what the threshold's floor leaves"
    return f"{patterns}: all errors {rate}"


def margin_of(scenario: Scenario) -> Margin:
    """Find the largest M for which the loop is stable; this may take seconds.

    Raises:
        NoackError: the scenario is wrong.
    """
    resolved = resolve(scenario)
    try:
        margin = find_margin(resolved, accuracy=1e-3, with_period=False)
    except CallerError as error:
        return Margin(str(error), (), defined=False)
    rows = tuple(
        MarginRow(
            str(m), f"{at_least(stability.lower, 5)} – {at_most(stability.upper, 5)}", stability.verdict
        )
        for m, stability in margin.caps
    )
    return Margin(margin.verdict, rows, defined=True)


def warning(run: Exploration, guarantee: Guarantee | None, margin: Margin | None) -> str:
    """Return in words whether a run is unstable, and why nothing is guaranteed; empty if stable."""
    parts = []
    name, norm = run.labelled_norm
    if run.diverged_at_s is not None:
        parts.append(f"The loop is unstable under these losses: it diverged at {run.diverged_at_s:.3g} s.")
    elif norm[-1] > norm[0]:
        first, last = (number(float(norm[i]), 3) for i in (0, -1))
        parts.append(f"{name} grows from {first} to {last}.")
    if run.cut_reason:
        parts.append(f"{run.cut_reason[0].upper()}{run.cut_reason[1:]}.")
    if parts and guarantee is not None and guarantee.verdict != CERTIFIED:
        parts.append(f"It has no certificate: {guarantee.reason}.")
        if margin is not None and margin.defined:
            parts.append(f"Margin: {margin.verdict}.")
    elif parts and guarantee is not None:
        parts.append("It is certified all the same: the bound allows this.")
    return " ".join(parts)
