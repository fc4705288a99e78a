"""The paper's assumptions, checked for one scenario before it runs.

A claim is worth its assumptions. Each gets a verdict with its reason; what only the run can show
(delays, the longest drop run) is checked against the run's record.
"""

import math
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from noack.clock import NS_PER_S
from noack.linear import Matrix, spectral_abscissa
from noack.resolve import Loop, loop_of
from noack.scenario import Scenario


class Verdict(StrEnum):
    """What is known of an assumption."""

    HOLDS = "holds"
    VIOLATED = "violated"
    NOT_NEEDED = "not needed"
    PRESUPPOSED = "presupposed"
    """Only a run can show it; every run is checked for it."""


class Assumption(NamedTuple):
    """One assumption and its verdict."""

    what: str
    source: str
    """Where the paper makes it."""
    verdict: Verdict
    why: str


def assumptions(resolved: Scenario) -> list[Assumption]:
    """Return the paper's assumptions for a resolved scenario, with verdicts."""
    loop = loop_of(resolved)
    return [
        _closed_loop(loop),
        _decay_rate(loop, resolved.trigger.alpha_per_s),
        _unstable_and_distinct(loop.A),
        _mansd(resolved),
        _continuous_time(resolved),
    ]


def _verdict(holds: bool) -> Verdict:
    return Verdict.HOLDS if holds else Verdict.VIOLATED


def _closed_loop(loop: Loop) -> Assumption:
    true = spectral_abscissa(loop.A + loop.B @ loop.K)
    nominal = spectral_abscissa(loop.A_model + loop.B_model @ loop.K)
    return Assumption(
        "the gain stabilises the plant and the model",
        "Theorem 2",
        _verdict(true < 0 and nominal < 0),
        f"largest real part {true:.3g} /s with A + BK, {nominal:.3g} /s with Â + B̂K",
    )


def _decay_rate(loop: Loop, alpha_per_s: float) -> Assumption:
    rate = -spectral_abscissa(loop.A + loop.B @ loop.K)
    how = f"decays at any rate below {rate:.3g} /s" if rate > 0 else "does not decay"
    return Assumption(
        "0 < α < ᾱ: the threshold decays more slowly than the closed loop",
        "Theorem 2",
        _verdict(alpha_per_s < rate),
        f"α = {alpha_per_s:g} /s; ‖e^((A+BK)t)‖ {how}",
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
    return Assumption(
        "A is unstable with distinct eigenvalues",
        "Proposition 1, used by Theorem 1",
        _verdict(unstable > 0 and distinct),
        f"{count} in the open right half plane; "
        + ("all distinct" if distinct else "some coincide"),
    )


def _mansd(resolved: Scenario) -> Assumption:
    network = resolved.network
    start = {
        "first_packet": "the first packet is delivered",
        "known_state": "sensor and controller know x(0)",
    }[network.initial_sync]
    return Assumption(
        f"at most M − 1 = {network.mansd} successive dropouts after a delivered t_0",
        "Section III",
        _verdict(network.enforce_mansd),
        ("enforced by the network" if network.enforce_mansd else "enforcement is switched off")
        + f"; {start}",
    )


def _continuous_time(resolved: Scenario) -> Assumption:
    period_ms = 1e3 * resolved.plant_period_ns * resolved.plant.measure_every / NS_PER_S
    control_ms = 1e3 * resolved.controller_period_ns / NS_PER_S
    return Assumption(
        "the trigger watches continuously; network and input act at once",
        "Section II",
        Verdict.VIOLATED,
        f"sampled every {period_ms:g} ms, input held for {control_ms:g} ms: "
        "‖e_s‖ may pass the threshold by what it grows in between",
    )
