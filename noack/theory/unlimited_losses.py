"""What is certified for a scenario whose network does not limit the losses.

* The certificate for at most m consecutive losses holds for a whole run if no longer burst happens.
  Until then events are at least δ apart, so a run of T seconds has at most ⌊T/δ⌋ + 1 of them. The
  probability that so many packets keep the limit follows from the chain of the losses.
* Moments at every fixed time, and at events (:mod:`noack.theory.random_losses`).
* Almost surely, x decays at every rate below that of the moments. Under the paper's conditions it
  does so for every loss probability below 1.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from noack.config.resolution import loop_of
from noack.config.scenario import Scenario
from noack.core.clock import NS_PER_S
from noack.core.linear_systems import spectral_abscissa
from noack.impairments.loss_guarantee import LongestBurst, LossGuarantee
from noack.impairments.loss_process import LossProcess, loss_process
from noack.impairments.markov_chain import NotPredictableError
from noack.theory.assumptions import below
from noack.theory.certificate_terms import NetworkConditions, VoidError
from noack.theory.error_gains import error_gains
from noack.theory.kernel_bounds import NotDecayingError
from noack.theory.plant_gains import PlantGains
from noack.theory.random_losses import Moments, moment_at_events, moments
from noack.theory.run_conditions import most_events
from noack.theory.scenario_certificates import CertificateScope

ORDERS = (1, 2)
_MOST_BURST = 64
_CERTAIN = 1 - 1e-9
_SLOWER = 0.9


class BurstCertificate(NamedTuple):
    """The certificate for at most m consecutive losses, and the probability of a run with it."""

    most: int
    """m."""
    probability: float
    """Lower bound of the probability that no run's burst is longer."""
    events: int
    """Upper bound of the number of events in a run."""
    delta: float
    """Δ."""
    state: float
    """Bound of ‖x‖ at t = 0, and so at all times."""


@dataclass(frozen=True)
class UnlimitedLosses:
    """Statements about a loop whose losses are random and not limited."""

    largest_probability: float
    """The largest probability that an update is lost, given any outcomes before it."""
    is_independent: bool
    horizon_s: float
    bursts: tuple[BurstCertificate, ...]
    """For increasing m, as long as there are certificates."""
    moments: tuple[Moments, ...]
    """For r = 1 and 2, under the schedule's conditions; those that exist."""
    at_events: tuple[float, ...]
    """Bounds of (E(‖e_c‖_W e^{αt}/β)ʳ)^{1/r} at events, r = 1 and 2, the paper's conditions."""
    sure_rate_per_s: float | None
    """Under the schedule, x almost surely decays at every rate below it; None: not certified."""
    paper_rate_per_s: float | None
    """The same under the paper's conditions."""
    void: str | None
    """Why there are no moments; None if there are."""

    def to_json(self) -> dict[str, Any]:
        """Return all fields for JSON."""
        return {
            **{name: getattr(self, name) for name in self.__dataclass_fields__},
            "bursts": [one._asdict() for one in self.bursts],
            "moments": [one._asdict() for one in self.moments],
        }


def unlimited_losses(
    resolved: Scenario, scope: CertificateScope, conditions: NetworkConditions
) -> UnlimitedLosses:
    """Return what is certified for a scenario's own plant without any limit on the losses.

    Raises:
        NotPredictableError: the losses are no Markov chain over the packets.
    """
    losses = loss_process(resolved.network.link)
    found, void = _moments(resolved, losses, conditions)
    paper_rate, at_events = _paper(resolved, losses)
    return UnlimitedLosses(
        losses.largest_probability,
        losses.is_independent,
        resolved.timing.horizon_ns / NS_PER_S,
        tuple(_bursts(resolved, scope, losses, conditions)),
        tuple(found),
        at_events,
        found[0].rate_per_s if found and found[0].rate_per_s > 0 else None,
        paper_rate,
        void,
    )


def _bursts(
    resolved: Scenario, scope: CertificateScope, losses: LossProcess, conditions: NetworkConditions
) -> list[BurstCertificate]:
    found: list[BurstCertificate] = []
    for most in range(_MOST_BURST + 1):
        certificate = scope.certificate(conditions._replace(dropouts=most, constraints=()))
        constants, spacing_s = certificate.constants, certificate.inter_event_s
        if constants is None or not spacing_s:
            break
        events = most_events(resolved, spacing_s)
        try:
            kept = losses.keeps(LossGuarantee((LongestBurst(most),)), events)
        except NotPredictableError:
            break
        state = float(certificate.state(np.zeros(1))[0])
        found.append(BurstCertificate(most, kept, events, constants.delta, state))
        if kept > _CERTAIN:
            break
    return found


def _moments(
    resolved: Scenario, losses: LossProcess, conditions: NetworkConditions
) -> tuple[list[Moments], str | None]:
    if not _is_covered(resolved):
        return [], "moments need the paper's trigger, and no disturbance, noise or observer"
    loop, trigger = loop_of(resolved), resolved.decaying
    decay = -max(spectral_abscissa(loop.H), spectral_abscissa(loop.A + loop.B @ loop.K))
    alpha = trigger.alpha_per_s if below(trigger.alpha_per_s, decay) else _SLOWER * decay
    if trigger.floor > 0:
        alpha = 0.0
    if decay <= 0:
        return [], "the models or A + BK do not decay"
    error = error_gains(loop, alpha)
    plant = PlantGains(error, loop.A, loop.B, loop.x0[:, None], alpha)
    level, found = max(trigger.beta, trigger.floor), []
    for order in ORDERS:
        try:
            found.append(
                moments(error, plant, conditions, level, losses.largest_probability, order)
            )
        except (VoidError, NotDecayingError) as reason:
            return found, str(reason)
    return found, None


def _paper(resolved: Scenario, losses: LossProcess) -> tuple[float | None, tuple[float, ...]]:
    """Return the rate and the moments at events under the paper's conditions."""
    if not _is_covered(resolved):
        return None, ()
    loop, alpha = loop_of(resolved), resolved.decaying.alpha_per_s
    decay = -max(spectral_abscissa(loop.H), spectral_abscissa(loop.A + loop.B @ loop.K))
    if resolved.decaying.floor > 0 or not below(alpha, decay):
        return None, ()
    error = error_gains(loop, alpha)
    try:
        return alpha, tuple(moment_at_events(error, losses, 0.0, order) for order in ORDERS)
    except (VoidError, NotDecayingError):
        return None, ()


def _is_covered(resolved: Scenario) -> bool:
    coverage = resolved.coverage
    return not resolved.plant.disturbances and coverage.knows_state and coverage.is_decaying
