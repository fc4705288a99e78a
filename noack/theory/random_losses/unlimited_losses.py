"""Bounds of a loop without a limit on consecutive losses: bursts, and moments.

Mean squares at every fixed time: :mod:`~noack.theory.random_losses.mean_square_bounds`.

At an event of the continuous trigger, where ‖e_s‖_W = β, the distribution of the number of missing
events is known exactly, and (I1) gives a bound by itself: :func:`moment_at_events`.

A run ends. Up to its horizon the certificates for at most m consecutive losses bound each run by its
own longest burst: :func:`moments_of_runs` bounds the mean of the largest ‖e_c‖ and ‖x‖ of a run.

Almost surely, x decays at every rate below that of the root mean squares. Under the paper's
conditions it does so for every loss probability below 1. :func:`unlimited_losses` says all of this
of a scenario.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from noack.core.clock import NS_PER_S
from noack.core.linear_systems import spectral_abscissa
from noack.guarantee.loss_guarantee import LongestBurst, LossGuarantee
from noack.impairments.loss_prediction import LossProcess
from noack.impairments.target_loss import loss_process
from noack.scenario.resolution import LoopMatrices, loop_of
from noack.scenario.scenario import Scenario
from noack.theory.bounds.certificate_terms import NetworkConditions, NoCertificateError
from noack.theory.bounds.disturbances import excluded_probability
from noack.theory.bounds.enclosure import NotDecayingError
from noack.theory.bounds.gains import ErrorGains, Output, PlantGains, error_gains
from noack.theory.certificates.assumptions import is_below_decay_rate
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import kept_probability, most_events, void_by_safe_input
from noack.theory.certificates.scenario_certificates import CertificateScope
from noack.theory.random_losses.mean_square_bounds import RootMeanSquares, root_mean_squares

ORDERS = (1, 2)
"""r of the moments at events, and of a run's largest values."""
_TERMS = 1024
"""Lost updates whose probability is computed; a geometric sum bounds the rest."""
_MOST_BURST, _CERTAIN = 64, 1 - 1e-9
"""Longest burst for which a certificate is sought; a probability after which longer ones do not matter."""
_ROUNDING = 1e-9
"""Above the relative error of a probability, which is a sum of products of numbers that are not negative."""
_SLOWER = 0.9
"""α that is used if the trigger's is too large, as a share of the decay rate of the loop."""
_RATES = (1.0, 0.5, 0.25, 1e-3)
"""Shares of the trigger's rate at which root mean squares are tried, until one of the smaller ones has a
loop gain that is clearly below 1: near 1 the bounds are large."""
_CLEARLY_BELOW_1 = 0.9
"""A loop gain that is clearly below 1."""


def moment_at_events(error: ErrorGains, losses: LossProcess, inter_event_s: float, order: int) -> float:
    """Bound (E(‖e_c‖_W e^{αt}/β)ʳ)^{1/r} just before an event of the continuous trigger.

    If exactly the last J updates are lost, ‖e_c‖_W e^{αt}/β ≤ S_J = 1 + g_1 + … + g_J with g_j =
    sup_{τ≥jδ}‖e^{(H+αI)τ}‖_W. So the bound is (Σ_j P(J ≥ j) (S_jʳ − S_{j−1}ʳ))^{1/r}, S_{−1} = 0. In
    a norm in which the models contract, and for independent losses, it is at most 1/(1 − p) for
    r = 1 and √(1 + p)/(1 − p) for r = 2.

    Args:
        error: the gains of the models.
        losses: the losses.
        inter_event_s: δ, a lower bound of the inter-event time; 0 is always valid.
        order: r.

    Raises:
        NoCertificateError: the probability of long bursts does not fall.
        NotDecayingError: α is not below the decay rate of e^{Hτ}.
    """
    tails, longest = losses.tails(_TERMS)
    if not longest < 1:
        raise NoCertificateError("bursts of losses may be arbitrarily long")
    gains = error.kernels[Output.WEIGHTED].sups(inter_event_s * np.arange(1.0, _TERMS + 1))
    sums = 1.0 + np.cumsum(np.append(0.0, gains))
    # Number kN + j, j ≤ N, adds at most r g_N ((k + 1) S_N)^{r−1}; P(J ≥ kN + j) ≤ longestᵏ P(J ≥ j).
    later = (1 - longest) ** -order - 1  # Σ_{k≥1} (k + 1)^{r−1} longestᵏ
    beyond = order * gains[-1] * sums[-1] ** (order - 1) * tails.sum() * later
    return float((1.0 + tails @ np.diff(sums**order) + beyond) ** (1 / order)) * (1 + _ROUNDING)


class BurstCertificate(NamedTuple):
    """The certificate for at most m consecutive losses, and the probability of a run with it."""

    most: int
    """m."""
    probability: float
    """Lower bound of the probability that no run's burst is longer."""
    events: int
    """Upper bound of the number of events in a run."""
    delta: float
    """Δ; of several bounds, or of a sum, that of ‖e_c‖_W at 0 in units of the threshold."""
    rate_per_s: float
    """ρ; 0 if one of the bounds does not decay."""
    controller_error: float
    """Bound of ‖e_c‖_W e^{ρt} at all times."""
    state: float
    """Bound of ‖x‖ e^{ρt} at all times."""


class RunMoments(NamedTuple):
    """Bounds of the mean over runs of the r-th power of a run's largest value, to the power 1/r.

    A run with a longer burst than ``most`` counts as 0.
    """

    order: int
    """r."""
    most: int
    probability: float
    """Lower bound of the probability of a run without a longer burst."""
    rate_per_s: float
    """ρ"""
    controller_error: float
    """Of sup ‖e_c‖_W e^{ρt} over a run."""
    state: float
    """Of sup ‖x‖ e^{ρt} over a run."""


def moments_of_runs(bursts: Sequence[BurstCertificate]) -> list[RunMoments]:
    """Bound the moments of the largest values of a run, for r = 1 and 2.

    Up to its end, a run whose longest burst is m keeps the bound b_m. So the mean of the r-th power
    is at most b_0ʳ + Σ_m (b_mʳ − b_{m−1}ʳ) P(longest ≥ m); b_m is increased to b_{m−1} if it is
    smaller.
    """
    if not bursts:
        return []
    last, rate_per_s = bursts[-1], min(burst.rate_per_s for burst in bursts)
    reached = [1.0, *(1 - burst.probability * (1 - _ROUNDING) for burst in bursts[:-1])]
    sizes = np.array([(0.0, 0.0), *((burst.controller_error, burst.state) for burst in bursts)])
    return [
        RunMoments(order, last.most, last.probability, rate_per_s, *map(float, means ** (1 / order)))
        for order in ORDERS
        for means in [reached @ np.diff(np.maximum.accumulate(sizes) ** order, axis=0)]
    ]


@dataclass(frozen=True)
class UnlimitedLosses:
    """Statements about a loop whose losses are random and not limited."""

    largest_probability: float
    """The largest probability that an update is lost, given any outcomes before it."""
    is_independent: bool
    horizon_s: float
    bursts: tuple[BurstCertificate, ...]
    """For increasing m, as long as there are certificates."""
    runs: tuple[RunMoments, ...]
    """For r = 1 and 2; none if there is no certificate, or if something is normally distributed."""
    root_mean_squares: RootMeanSquares | None
    """At every fixed time, under the schedule's conditions."""
    at_events: tuple[float, ...]
    """Bounds of (E(‖e_c‖_W e^{αt}/β)ʳ)^{1/r} at events, r = 1 and 2, the paper's conditions."""
    sure_rate_per_s: float | None
    """Under the schedule, x almost surely decays at every rate below it; None: not certified."""
    paper_rate_per_s: float | None
    """The same under the paper's conditions."""
    void: str | None
    """Why there are no root mean squares; None if there are."""

    def to_json(self) -> dict[str, object]:
        """Return all fields for JSON."""
        values = {name: getattr(self, name) for name in self.__dataclass_fields__}
        moments: RootMeanSquares | None = values.pop("root_mean_squares")
        return {
            **values,
            "bursts": [burst._asdict() for burst in self.bursts],
            "runs": [moment._asdict() for moment in self.runs],
            "mean_squares": moments and moments._asdict(),
        }


def unlimited_losses(
    resolved: Scenario, scope: CertificateScope, conditions: NetworkConditions
) -> UnlimitedLosses:
    """Return what is certified for a scenario's own plant without any limit on the losses.

    Raises:
        NotPredictableError: the losses are no Markov chain over the packets.
    """
    losses = loss_process(resolved.network.link)
    moments, void = _at_fixed_times(resolved, losses, conditions)
    bursts = _bursts(resolved, scope, losses, conditions)
    paper_rate, at_events = _paper(resolved, losses)
    return UnlimitedLosses(
        losses.largest_probability,
        losses.is_independent,
        resolved.timing.horizon_ns / NS_PER_S,
        tuple(bursts),
        # Normal values exceed the assumed bounds in some runs, and then by any amount.
        tuple(moments_of_runs(bursts)) if excluded_probability(resolved) == 0.0 else (),
        moments,
        at_events,
        moments.rate_per_s if moments and moments.rate_per_s > 0 else None,
        paper_rate,
        void,
    )


def _bursts(
    resolved: Scenario, scope: CertificateScope, losses: LossProcess, conditions: NetworkConditions
) -> list[BurstCertificate]:
    certificates: list[BurstCertificate] = []
    for longest in range(_MOST_BURST + 1):
        # The certificate for at most ``longest`` consecutive losses, and how likely a run keeps to that.
        certificate = scope.certificate(conditions._replace(dropouts=longest, constraints=()))
        constants, inter_event_s = certificate.constants, certificate.inter_event_s
        if constants is None or not inter_event_s:
            break
        probability = kept_probability(resolved, LossGuarantee((LongestBurst(longest),)), inter_event_s)
        if probability is None:
            break
        controller_error, state = (
            float(bound(np.zeros(1))[0]) for bound in (certificate.controller_error, certificate.state)
        )
        # With persistent terms, or a sharper bound, Δ is taken from the whole bound.
        delta = constants.delta
        if certificate.persistent_constants is not None or certificate.other is not None:
            delta = controller_error / (max(certificate.beta, certificate.floor) or 1.0)
        rate_per_s = _slowest_rate(certificate)
        certificates.append(
            BurstCertificate(
                longest,
                probability,
                most_events(resolved, inter_event_s),
                delta,
                rate_per_s,
                controller_error,
                state,
            )
        )
        if probability > _CERTAIN - excluded_probability(resolved):
            break
    return certificates


def _slowest_rate(certificate: ScenarioCertificate) -> float:
    """Return a rate ρ at which each bound decays, so that its value at 0 bounds its e^{ρt}-fold.

    Where there are several bounds, the value at 0 may be that of one that decays more slowly.
    """
    rates: list[float] = []
    part: ScenarioCertificate | None = certificate
    while part is not None and part.constants is not None:
        persists = part.floor_constants or part.persistent_constants
        rates.append(0.0 if persists else part.constants.rate_per_s)
        part = part.other
    return min(rates)


def _at_fixed_times(
    resolved: Scenario, losses: LossProcess, conditions: NetworkConditions
) -> tuple[RootMeanSquares | None, str | None]:
    """Return the bounds for the first rate with a small loop gain, else the lowest; or why there are none."""
    if not _is_covered(resolved):
        return None, "this needs the paper's trigger, and no disturbance, noise or observer"
    if (why := void_by_safe_input(resolved, conditions)) is not None:
        return None, why
    loop, trigger = loop_of(resolved), resolved.decaying
    decay = -max(spectral_abscissa(loop.H), spectral_abscissa(loop.A + loop.B @ loop.K))
    if decay <= 0:
        return None, "the models or A + BK do not decay"
    alpha = trigger.alpha_per_s if is_below_decay_rate(trigger.alpha_per_s, decay) else _SLOWER * decay
    if trigger.floor > 0:
        alpha = 0.0
    beta, p = max(trigger.beta, trigger.floor), losses.largest_probability
    moments, reason = None, None
    for share in _RATES:
        try:
            moments = root_mean_squares(*_gains(loop, share * alpha), conditions, beta, p)
        except (NoCertificateError, NotDecayingError) as error:
            reason = str(error)
        if moments and (share == 1 or moments.loop_gain < _CLEARLY_BELOW_1):
            break
    if moments is None:
        return None, reason
    return root_mean_squares(*_gains(loop, moments.rate_per_s), conditions, beta, p, refined=True), None


def _gains(loop: LoopMatrices, rate_per_s: float) -> tuple[ErrorGains, PlantGains]:
    error = error_gains(loop, rate_per_s)
    return error, PlantGains(error, loop.A, loop.B, loop.x0[:, None], rate_per_s)


def _paper(resolved: Scenario, losses: LossProcess) -> tuple[float | None, tuple[float, ...]]:
    """Return the rate and the moments at events under the paper's conditions."""
    if not _is_covered(resolved):
        return None, ()
    loop, alpha = loop_of(resolved), resolved.decaying.alpha_per_s
    decay = -max(spectral_abscissa(loop.H), spectral_abscissa(loop.A + loop.B @ loop.K))
    if resolved.decaying.floor > 0 or not is_below_decay_rate(alpha, decay):
        return None, ()
    error = error_gains(loop, alpha)
    try:
        return alpha, tuple(moment_at_events(error, losses, 0.0, order) for order in ORDERS)
    except (NoCertificateError, NotDecayingError):
        return None, ()


def _is_covered(resolved: Scenario) -> bool:
    coverage = resolved.coverage
    return not resolved.plant.disturbances and coverage.knows_state and coverage.is_decaying
