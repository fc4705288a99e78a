"""Assumptions of the paper and of a certificate, checked for one scenario before it runs.

A claim holds only under its assumptions. Each assumption gets a verdict with its reason.
Assumptions about the run itself (delays, the longest loss burst) are checked against its record.
"""

import math
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from noack.config.resolution import LoopMatrices, loop_of
from noack.config.scenario import Scenario
from noack.config.state_estimation import SteadyState, steady_state
from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix, spectral_abscissa
from noack.theory.certificate import Constants, NetworkConditions


class AssumptionStatus(StrEnum):
    """The status of an assumption."""

    HOLDS = "holds"
    VIOLATED = "violated"
    IDEALISED = "idealised"
    """No sampled loop meets it; certificates allow for the difference."""
    NOT_NEEDED = "not needed"
    """It does not hold, or is not checked; no computed bound depends on it."""
    ASSUMED = "assumed"
    """It depends on the run and is checked in each run."""


class Assumption(NamedTuple):
    """One assumption and its verdict."""

    what: str
    source: str
    """The place in the paper."""
    verdict: AssumptionStatus
    why: str


def assumptions(resolved: Scenario) -> list[Assumption]:
    """Return the paper's assumptions for a resolved scenario, with verdicts."""
    loop = loop_of(resolved)
    return [
        *([_closed_loop(loop)] if resolved.coverage.is_linear else _not_linear(loop, resolved)),
        *_trigger(loop, resolved),
        *_control_law(resolved),
        *_protocol(resolved),
        *([_unstable_and_distinct(loop.A)] if resolved.coverage.is_linear else []),
        _mansd(resolved),
        _continuous_time(resolved),
        *_disturbed(resolved),
        *_estimated(loop, resolved),
    ]


def _not_linear(loop: LoopMatrices, resolved: Scenario) -> list[Assumption]:
    nominal = spectral_abscissa(loop.A_model + loop.B_model @ loop.K)
    return [
        Assumption(
            "the plant is ẋ = Ax + Bu", "eq:plant", AssumptionStatus.VIOLATED,
            f'it is of kind "{resolved.plant.system.kind}": the theorems and the certificates say '
            "nothing of it",
        ),
        Assumption(
            "the gain stabilises the model", "Theorem 2", _verdict(nominal < 0),
            f"largest real part {nominal:.3g} /s with Â + B̂K{_other_sign(loop)}",
        ),
    ]  # fmt: skip


def _disturbed(resolved: Scenario) -> list[Assumption]:
    if not resolved.plant.disturbances:
        return []
    what = ", ".join(f"{one.kind} at the {one.at}" for one in resolved.plant.disturbances)
    return [
        Assumption(
            "nothing disturbs the plant", "eq:plant", AssumptionStatus.VIOLATED,
            f"{what}: not covered by the theorems and the certificates",
        )
    ]  # fmt: skip


def _estimated(loop: LoopMatrices, resolved: Scenario) -> list[Assumption]:
    """Return the assumptions that replace "the sensor measures x" with an observer or noise."""
    if resolved.coverage.knows_state:
        return []
    found = steady_state(resolved)
    rms, p = float(np.sqrt(np.trace(found.covariance))), resolved.message_sizes.outputs
    how = (
        "with noise"
        if resolved.observer is None
        else f"by an observer ({resolved.observer.kind}), from y of {p} "
        + ("entry" if p == 1 else "entries")
    )
    measured = Assumption(
        "the sensor measures x", "Section II", AssumptionStatus.VIOLATED,
        f"x is known {how}: not covered by the theorems and the certificates",
    )  # fmt: skip
    if resolved.observer is None:
        return [measured, *_above_noise(loop, resolved, found)]
    if not np.isfinite(found.radius):
        why = "no steady state found: model and covariances differ by too many magnitudes"
        decays = Assumption("the observer's error decays", "(I − LC)e^(ÂT)", _verdict(False), why)
        return [measured, decays]
    comes_to = (
        f"noise and random disturbances alone give ‖x̂ − x‖ = {rms:.3g} (RMS)"
        if found.radius < 1
        else "‖x̂ − x‖ grows"
    )
    decays = Assumption(
        "the observer's error decays", "(I − LC)e^(ÂT)", _verdict(found.radius < 1),
        f"steady-state spectral radius {found.radius:.4g} per measurement; {comes_to}",
    )  # fmt: skip
    above = _above_noise(loop, resolved, found) if found.radius < 1 else []
    return [measured, decays, *above]


def _above_noise(loop: LoopMatrices, resolved: Scenario, found: SteadyState) -> list[Assumption]:
    """Return whether the trigger's smallest threshold is above the e_s from estimation errors.

    This e_s is the difference between the estimation error now and at the last event. Its RMS is
    √2 times that of the error if the two are uncorrelated; three times this value is rarely
    exceeded. For an unstable plant the error from the last event grows until every threshold is
    reached.
    """
    least = resolved.trigger.least_threshold
    if least is None:
        return []
    weight = np.eye(loop.n) if loop.weight is None else loop.weight
    size = float(np.sqrt(2 * np.trace(weight @ found.covariance @ weight.T)))
    return [
        Assumption(
            "the threshold stays above the noise", "trigger", _verdict(least >= 3 * size),
            f"it falls to {least:.3g}; noise alone gives ‖e_s‖ = {size:.3g} (RMS): set "
            f"trigger.floor ≥ {3 * size:.2g}; below that, noise alone triggers",
        )
    ]  # fmt: skip


def _trigger(loop: LoopMatrices, resolved: Scenario) -> list[Assumption]:
    if resolved.coverage.is_decaying:
        rate = _decay_rate(loop, resolved.decaying.alpha_per_s)
        return [rate] if resolved.coverage.is_linear else []
    policy = resolved.trigger.policy
    return [
        Assumption(
            "the trigger is ‖e_s‖ > βe^(−αt)", "eq:thre", AssumptionStatus.VIOLATED,
            f'the policy is "{policy}": not covered by the theorems and the certificates',
        )
    ]  # fmt: skip


def _control_law(resolved: Scenario) -> list[Assumption]:
    if resolved.controller.is_linear:
        return []
    return [
        Assumption(
            "the input is u = K x_c", "eq:ModCont", AssumptionStatus.VIOLATED,
            f'controller.kind = "{resolved.controller.kind}": the theorems and the certificates '
            "do not cover it",
        )
    ]  # fmt: skip


def _protocol(resolved: Scenario) -> list[Assumption]:
    if not resolved.protocol.acknowledges:
        return []
    return [
        Assumption(
            "the sensor resets x_s at every event; nothing is acknowledged", "Section II",
            AssumptionStatus.VIOLATED,
            'protocol = "ack": not covered by the theorems and the certificates',
        )
    ]  # fmt: skip


def _verdict(holds: bool) -> AssumptionStatus:
    return AssumptionStatus.HOLDS if holds else AssumptionStatus.VIOLATED


def _closed_loop(loop: LoopMatrices) -> Assumption:
    true = spectral_abscissa(loop.A + loop.B @ loop.K)
    nominal = spectral_abscissa(loop.A_model + loop.B_model @ loop.K)
    return Assumption(
        "the gain stabilises the plant and the model",
        "Theorem 2",
        _verdict(true < 0 and nominal < 0),
        f"largest real part {true:.3g} /s with A + BK, {nominal:.3g} /s with Â + B̂K"
        f"{_other_sign(loop)}",
    )


def _other_sign(loop: LoopMatrices) -> str:
    """Return a hint if K seems to be the gain of u = −Kx, the convention of most programs."""
    given, other = (
        spectral_abscissa(loop.A_model + sign * loop.B_model @ loop.K) for sign in (1.0, -1.0)
    )
    return "; the loop's u is +Kx, and −K would stabilise it" if other < 0 <= given else ""


def _decay_rate(loop: LoopMatrices, alpha_per_s: float) -> Assumption:
    rate = -spectral_abscissa(loop.A + loop.B @ loop.K)
    how = f"decay rate {rate:.3g} /s" if rate > 0 else f"grows at {0.0 - rate:.3g} /s"
    return Assumption(
        "0 < α < ᾱ: the threshold decays more slowly than the closed loop",
        "Theorem 2",
        _verdict(alpha_per_s < rate),
        f"α = {alpha_per_s:g} /s; A + BK: {how}",
    )


def _unstable_and_distinct(A: Matrix) -> Assumption:
    eigenvalues = np.linalg.eigvals(A)
    # A defective pair splits by about the square root of the rounding error.
    tolerance = math.sqrt(np.finfo(float).eps) * max(float(np.linalg.norm(A, 2)), 1.0)
    unstable = int((eigenvalues.real > tolerance).sum())
    n = len(eigenvalues)
    gaps = [abs(eigenvalues[i] - eigenvalues[j]) for i in range(n) for j in range(i)]
    distinct = min(gaps, default=math.inf) > tolerance
    count = "no eigenvalue" if unstable == 0 else f"{unstable} of {n} eigenvalues"
    why = f"{count} in the open right half plane; "
    why += "all distinct" if distinct else "repeated eigenvalues"
    holds = unstable > 0 and distinct
    return Assumption(
        "A is unstable with distinct eigenvalues",
        "Proposition 1, used by Theorem 1",
        AssumptionStatus.HOLDS if holds else AssumptionStatus.NOT_NEEDED,
        why if holds else f"{why}; used by the paper's proof, but by no bound computed here",
    )


def _mansd(resolved: Scenario) -> Assumption:
    network = resolved.network
    start = {
        "first_packet": "the first packet is delivered",
        "known_state": "sensor and controller know x(0)",
    }[network.initial_sync]
    return Assumption(
        f"at most M − 1 = {network.mansd} consecutive losses after a delivered t_0",
        "Section III",
        _verdict(network.enforce_mansd),
        ("enforced by the network" if network.enforce_mansd else "not enforced (enforce_mansd)")
        + f"; {start}",
    )


def _continuous_time(resolved: Scenario) -> Assumption:
    period_ms = 1e3 * resolved.timing.measurement_period_ns / NS_PER_S
    control_ms = 1e3 * resolved.timing.controller_period_ns / NS_PER_S
    return Assumption(
        "continuous trigger; network and input without delay",
        "Section II",
        AssumptionStatus.IDEALISED,
        "never true of a sampled loop; the certificates allow for the difference. Here: sampled "
        f"every {period_ms:g} ms, input held for {control_ms:g} ms" + _network_delay(resolved),
    )


def _network_delay(resolved: Scenario) -> str:
    link = resolved.network.link
    if not link.longest_delay_s:
        return ""
    longest_ms = 1e3 * link.longest_delay_s
    if link.delay_is_bounded:
        return f"; the network delays updates by up to {longest_ms:g} ms"
    return f"; the network's delay has no bound; the certificates allow for {longest_ms:g} ms"


def certificate_assumptions(
    resolved: Scenario,
    conditions: NetworkConditions,
    decay: dict[str, float],
    held: bool,
    constants: Constants | None,
    void: str | None,
) -> list[Assumption]:
    """Return the assumptions of a certificate, with verdicts.

    Args:
        resolved: the scenario.
        conditions: the assumptions about network and schedule.
        decay: decay rates per second, of "the models" and of "A + BK".
        held: whether the models hold instead of decaying.
        constants: constants of the certificate; None if there is no certificate.
        void: reason for having no certificate.
    """
    alpha, network = resolved.decaying.alpha_per_s, resolved.network
    rate = 0.0 if constants is None else constants.rate_per_s
    if held:
        why = "a hold does not decay: the certified bounds are constant"
        models = Assumption(
            "α is below the decay rate of the models", "(I1)", AssumptionStatus.VIOLATED, why
        )
    else:
        models = _rate("the models", "(I1)", alpha, decay["the models"], rate)
    assumed = [
        f"at most {conditions.dropouts} consecutive losses after a delivered t_0",
        f"the trigger is tested every {1e3 * conditions.sampling_s:g} ms"
        if conditions.sampling_s
        else "the trigger is tested continuously",
        f"an update reaches the plant within {1e3 * conditions.delay_s:g} ms of its event",
        f"the applied input is at most {1e3 * conditions.hold_s:g} ms old",
        f"the first input arrives within {1e3 * conditions.start_s:g} ms",
    ]
    enforced = "enforced by the network" if network.enforce_mansd else "not enforced"
    checks = [enforced, *["checked in each run"] * 4]
    verdicts = [AssumptionStatus.HOLDS if network.enforce_mansd else AssumptionStatus.ASSUMED]
    verdicts += [AssumptionStatus.ASSUMED] * 4
    gain = (
        Assumption(
            "small-gain condition",
            "certificate",
            AssumptionStatus.HOLDS,
            f"met: the loop gain of the errors is {constants.loop_gain:.3g}, below 1",
        )
        if constants is not None
        else Assumption(
            "there is a certificate", "certificate", AssumptionStatus.VIOLATED, void or ""
        )
    )
    return [
        models,
        _rate("A + BK", "Theorem 2", alpha, decay["A + BK"], rate),
        *(
            Assumption(what, "conditions", verdict, why)
            for what, verdict, why in zip(assumed, verdicts, checks, strict=True)
        ),
        gain,
        Assumption(
            "A is unstable with distinct eigenvalues",
            "Proposition 1",
            AssumptionStatus.NOT_NEEDED,
            "the bounds rest on (I1), which holds for every plant",
        ),
    ]


def _rate(of: str, source: str, alpha: float, decay: float, rate: float) -> Assumption:
    holds = below(alpha, decay)
    why = f"α = {alpha:g} /s, " + (
        f"decay rate {decay:.3g} /s" if decay >= 0 else f"grows at {-decay:.3g} /s"
    )
    if not holds:
        why += f"; certified instead: bounds with decay rate {rate:.3g} /s" if rate else ""
    verdict = AssumptionStatus.HOLDS if holds else AssumptionStatus.VIOLATED
    return Assumption(f"α is below the decay rate of {of}", source, verdict, why)


def below(alpha_per_s: float, decay_per_s: float) -> bool:
    """Return whether α is below the decay rate by more than rounding."""
    return alpha_per_s < (1 - 1e-9) * decay_per_s
