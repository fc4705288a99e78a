"""What is guaranteed for a scenario: certificate, margin, the verdict, and a warning in words."""

from dataclasses import dataclass

import numpy as np

from cosim.analysis.certificates import constant_rows
from cosim.analysis.margin_search import find_margin
from cosim.analysis.summary_model import ExitPart
from cosim.interactive.exploration import Exploration
from cosim.output.run_verdict import (
    BAD,
    DOUBTFUL,
    GOOD,
    NEUTRAL,
    VerdictLine,
    ending_line,
    state_text,
    transmission_line,
)
from noack.core.errors import CallerError, ExitStatus
from noack.core.linear_systems import Vector
from noack.core.number_format import number, percent
from noack.runtime.life_cycle import HORIZON
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.theory.certificates.assumptions import AssumptionStatus
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import (
    OWN_PLANT,
    about_setpoint,
    nominal_conditions,
    void_at_setpoint,
)
from noack.theory.certificates.scenario_certificates import own_plant

CERTIFIED, VOID, NOT_COVERED = "certified", "no certificate", "not covered"
_POINTS = 121


@dataclass(frozen=True)
class Guarantee:
    """The certificate of a scenario's plant under its own schedule, at N times."""

    verdict: str
    """CERTIFIED, VOID or NOT_COVERED."""
    reason: str
    """One sentence: what is guaranteed, or why nothing is."""
    rows: tuple[tuple[str, str], ...]
    """Constants: label and value."""
    assumptions: tuple[tuple[str, str, str], ...]
    """Verdict, what is assumed, and why."""
    t_s: Vector
    e_s: Vector
    """Bound of ‖e_s‖; NaN without a certificate."""
    e_c: Vector
    x: Vector


@dataclass(frozen=True)
class Margin:
    """For which M the loop is stable under every loss pattern."""

    verdict: str
    """In words."""
    rows: tuple[tuple[str, str, str], ...]
    """M, growth of the worst pattern, verdict."""
    defined: bool
    """Whether the loop has a margin: its trigger has a longest time between events."""


def certify(scenario: Scenario) -> Guarantee:
    """Certify a scenario's own plant; a scenario that is not covered is no error.

    Raises:
        NoackError: the scenario is wrong.
    """
    resolved = resolve(scenario)
    t_s = np.linspace(0.0, resolved.horizon_s, _POINTS)
    nothing = np.full(_POINTS, np.nan)
    try:
        certificate = _certificate(resolved)
    except CallerError as error:
        return Guarantee(NOT_COVERED, str(error), (), (), t_s, nothing, nothing, nothing)
    reason = _reason(certificate)
    assumptions = tuple(
        (str(one.verdict), one.what, one.why)
        for one in certificate.assumptions
        if one.verdict != AssumptionStatus.HOLDS and one.why != reason
    )
    rows = () if certificate.constants is None else constant_rows([certificate], None, 0)
    with np.errstate(all="ignore"):
        return Guarantee(
            VOID if certificate.constants is None else CERTIFIED,
            reason,
            tuple((label, values[0]) for label, values, _ in rows),
            assumptions,
            t_s,
            certificate.sensor_error(t_s),
            certificate.controller_error(t_s),
            certificate.state(t_s),
        )


def _certificate(resolved: Scenario) -> ScenarioCertificate:
    resolved.coverage.require_constant()
    resolved.coverage.require_certifiable()
    if (void := void_at_setpoint(resolved).get(OWN_PLANT)) is not None:
        raise CallerError(f"controller.setpoint: {void}")
    shifted = about_setpoint(resolved)
    late = resolved.certificate.late_periods
    return own_plant(shifted).certificate(nominal_conditions(shifted, late))


def _reason(certificate: ScenarioCertificate) -> str:
    found = certificate.constants
    if found is None:
        return certificate.void or "no bounds were found"
    patterns = "every loss pattern allowed by M"
    if found.rate_per_s == 0:
        return f"{patterns}: all errors stay bounded"
    rate = f"decay at the rate {number(found.rate_per_s)} /s"
    if certificate.persistent_constants is not None:
        return f"{patterns}: all errors stay bounded; what the start causes {rate}"
    return f"{patterns}: all errors {rate}"


def margin_of(scenario: Scenario) -> Margin:
    """Find the largest M for which the loop is stable; this may take seconds.

    Raises:
        NoackError: the scenario is wrong.
    """
    resolved = resolve(scenario)
    try:
        found = find_margin(resolved, accuracy=1e-3, with_period=False)
    except CallerError as error:
        return Margin(str(error), (), defined=False)
    rows = tuple(
        (str(cap.m), f"{number(cap.found.lower, 5)} – {number(cap.found.upper, 5)}",
         cap.found.verdict)
        for cap in found.caps
    )  # fmt: skip
    return Margin(found.verdict, rows, defined=True)


def verdict_of(run: Exploration, guarantee: Guarantee | None) -> tuple[VerdictLine, ...]:
    """Return the verdict of an explored run, in the three lines that a live run ends with.

    Without ``guarantee`` the certificate is still being computed.
    """
    horizon_s, reached_s = run.scenario.horizon_s, float(run.t_s[-1])
    status, reason = ExitStatus.OK, HORIZON
    if run.diverged_at_s is not None:
        status, reason = ExitStatus.FAILED, f"diverged at {number(run.diverged_at_s, 4)} s"
    elif run.cut:
        status, reason = ExitStatus.INTERRUPTED, run.cut
    largest, last = float(np.nanmax(run.x_norm)), float(run.x_norm[-1])
    state = state_text(largest, last, None) if run.diverged_at_s is None else ""
    events = len(run.event_s)
    return (
        ending_line(ExitPart(status=status, reason=reason), reached_s, horizon_s, state),
        _guarantee_line(run, guarantee),
        transmission_line(events, events - run.lost),
    )


def _guarantee_line(run: Exploration, guarantee: Guarantee | None) -> VerdictLine:
    if guarantee is None:
        return VerdictLine("guarantee: being computed", NEUTRAL)
    if guarantee.verdict != CERTIFIED:
        why = (
            guarantee.reason if guarantee.verdict == NOT_COVERED else f"{VOID}: {guarantee.reason}"
        )
        return VerdictLine(f"guarantee not checkable: {why}", DOUBTFUL)
    with np.errstate(all="ignore"):
        used = [
            values / np.exp(np.interp(run.t_s, guarantee.t_s, np.log(bound)))
            for values, bound in (
                (np.where(run.controller_knows, run.e_c_norm, 0.0), guarantee.e_c),
                (run.x_norm, guarantee.x),
            )
        ]
    above = np.nanmax(np.stack([*used, np.zeros_like(run.t_s)]), axis=0) > 1
    if above.any():
        return VerdictLine(f"guarantee broken since {run.t_s[above][0]:.3f} s", BAD)
    share = percent(float(np.nanmax(np.append(used[0], 0.0))))
    return VerdictLine(f"guarantee kept: ‖e_c‖ was at most {share} of its bound", GOOD)


def warning(run: Exploration, guarantee: Guarantee | None, margin: Margin | None) -> str:
    """Return in words whether a run is unstable, and what is guaranteed; empty if stable."""
    if run.diverged_at_s is None and not run.cut and run.x_norm[-1] <= run.x_norm[0]:
        return ""
    ending, kept, _ = verdict_of(run, guarantee)
    parts = [ending.text, *([kept.text] if guarantee is not None else [])]
    if margin is not None and margin.defined:
        parts.append(f"margin: {margin.verdict}")
    return "; ".join(parts)
