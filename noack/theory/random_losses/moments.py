"""Bounds of a loop without a limit on consecutive losses: bursts, and moments.

Each update is lost with a probability of at most p̄, whatever happened before. |v| is the r-th
moment norm, (E‖v‖ʳ)^{1/r}, r = 1 or 2, and ρ = p̄^{1/r}. With all signals scaled by e^{αt}, at
every fixed time

    |C e_c| ≤ ‖C W⁻¹‖ a + f_C(a, m, π) + ρ ℓ_C(a, m, π)          (I1): in flight, and lost
    |C x|   ≤ free_C + gain_C π
    π = |p| ≤ |K e_c| + σ (|KH x| + |KH e_c|) + r(σ) (|x|_W + |e_c|_W)
    a = |e_s|_W ≤ ḡβ + I_E m + I_B π,    m = |R_E x|

A missing event's part of e_c is what E x and B p have added since the event before it. So all lost
events together contribute at most ρ (∫‖C e^{(H+αI)s} L_E‖ ds m + ∫‖C e^{(H+αI)s} B U‖ ds π). If the
trigger is tested every h, they contribute at most ρ a Σ_j sup_{τ≥jh} ‖C e^{(H+αI)τ} W⁻¹‖, too. The
inequalities are linear; their solution bounds every moment if their spectral radius is below 1. It
is smaller at a rate below the trigger's, whose threshold decays faster than needed then.

At an event of the continuous trigger, where ‖e_s‖_W = β, the number of missing events is known in
distribution, and (I1) gives a bound by itself: :func:`moment_at_events`. Almost surely, x decays at
every rate below that of the moments. Under the paper's conditions it does so for every loss
probability below 1. :func:`unlimited_losses` says all of this of a scenario.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Vector, spectral_abscissa
from noack.impairments.loss_guarantee import LongestBurst, LossGuarantee
from noack.impairments.loss_prediction import LossProcess, loss_process
from noack.impairments.markov_chain import NotPredictableError
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from noack.theory.bounds.enclosure import KernelBounds, NotDecayingError, response, response_until
from noack.theory.bounds.gains import ErrorGains, Output, PlantGains, error_gains
from noack.theory.bounds.terms import NetworkConditions, NoCertificateError
from noack.theory.certificates.assumptions import below
from noack.theory.certificates.conditions import most_events
from noack.theory.certificates.inequalities import solve_inequalities
from noack.theory.certificates.scenario_certificates import CertificateScope

_TERMS = 1024
_CELLS = 64
_A, _PI, _ONE = np.eye(3)
"""a, π and 1; every other signal is bounded by a combination of them."""
ORDERS = (1, 2)
_MOST_BURST = 64
_CERTAIN = 1 - 1e-9
_SLOWER = 0.9
_RATES = (1.0, 0.5, 0.25, 1e-3)
"""Shares of the trigger's rate at which moments are tried, until one of the smaller ones has a loop
gain that is clearly below 1: near 1 the bounds are large."""
_CLEARLY = 0.9


class Moments(NamedTuple):
    """Bounds of (E‖·‖ʳ)^{1/r}, each multiplied by e^{−rate·t}, at every fixed time t."""

    order: int
    """r."""
    rate_per_s: float
    sensor_error: float
    """Of ‖e_s‖_W."""
    controller_error: float
    """Of ‖e_c‖_W."""
    input_error: float
    """Of ‖u − Kx‖, from the first applied input on."""
    state: float
    """Of ‖x‖."""
    loop_gain: float
    """Spectral radius of the inequalities; below 1."""


def moment_at_events(error: ErrorGains, losses: LossProcess, spacing_s: float, order: int) -> float:
    """Bound (E(‖e_c‖_W e^{αt}/β)ʳ)^{1/r} just before an event of the continuous trigger.

    It is Σ_{j≥0} P(the last j updates are lost)^{1/r} sup_{τ≥jδ}‖e^{(H+αI)τ}‖_W. In a norm in
    which the models contract it is at most 1/(1 − p^{1/r}) for independent losses.

    Args:
        error: the gains of the models.
        losses: the losses.
        spacing_s: δ, a lower bound of the inter-event time; 0 is always valid.
        order: r.

    Raises:
        NoCertificateError: the probability of long bursts does not fall.
        NotDecayingError: α is not below the decay rate of e^{Hτ}.
    """
    tails, longest = losses.tails(_TERMS)
    if not longest < 1:
        raise NoCertificateError("bursts of losses may be arbitrarily long")
    gains = error.kernels[Output.WEIGHTED].sups(spacing_s * np.arange(1.0, _TERMS + 1))
    powers, ratio = tails ** (1 / order), longest ** (1 / order)
    beyond = gains[-1] * powers.sum() * ratio / (1 - ratio)  # a burst of N + j: longest · tails[j]
    return float(1.0 + powers @ gains + beyond)


def moments(
    error: ErrorGains,
    plant: PlantGains,
    conditions: NetworkConditions,
    beta: float,
    largest_probability: float,
    order: int,
) -> Moments:
    """Bound the moments of all signals at every fixed time; ``conditions.dropouts`` has no effect.

    Args:
        error: the gains of the models.
        plant: the gains of the plant.
        conditions: of the schedule.
        beta: β: after a test, ‖e_s‖_W ≤ βe^{−αt}.
        largest_probability: p̄, the largest probability of a loss, given the past.
        order: r.

    Raises:
        NoCertificateError: the spectral radius of the inequalities is not below 1.
        NotDecayingError: α is not below the decay rate of the models, or of A + BK.
    """
    share = largest_probability ** (1 / order)
    ways = (False, True) if conditions.spacing_s > 0 else (False,)
    solved = [
        _Inequalities(error, plant, conditions, beta, share, by_tests=by).solve() for by in ways
    ]
    best = min(solved, key=lambda solution: solution.get("state", np.inf))
    if "state" not in best:
        gain = min(solution["loop_gain"] for solution in solved)
        raise NoCertificateError(f"the loop gain of the moments is {gain:.3g}, not below 1")
    return Moments(order=order, rate_per_s=error.alpha_per_s, **best)


class _Inequalities:
    """The inequalities; every signal is bounded by a row: multiples of a and π, and a constant.

    ``share`` is ρ. ``by_tests``: count a lost event at every test; else the drive since the last.
    """

    def __init__(
        self, error: ErrorGains, plant: PlantGains, conditions: NetworkConditions, beta: float,
        share: float, *, by_tests: bool,
    ) -> None:  # fmt: skip
        self._error, self._plant, self._conditions = error, plant, conditions
        self._beta, self._share, self._by_tests = beta, share, by_tests
        self._start_error, self._start = plant.start_up(conditions.start_s)
        if not by_tests:
            if not error.scaled_H.any():
                raise NotDecayingError("a hold does not decay")
            columns = plant.split_mismatch[0], plant.input_matrix
            self._all_drive = [response(error.scaled_H, D) for D in columns]
        if conditions.delay_s > 0:
            columns = plant.split_mismatch[0], plant.input_matrix
            self._recent_drive = [
                response_until(error.scaled_H, D, conditions.delay_s) for D in columns
            ]

    def solve(self) -> dict[str, float]:
        """Return the bounds by the names of ``Moments``; only the loop gain if there are none."""
        conditions, error = self._conditions, self._error
        remainder = error.hold_remainder(conditions.hold_s)
        controller = {output: self._controller_error(output) for output in error.outputs}
        pi = controller[Output.GAIN] + remainder * (
            self._state(Output.WEIGHTED) + controller[Output.WEIGHTED]
        )
        pi += conditions.hold_s * (self._state(Output.GAIN_RATE) + controller[Output.GAIN_RATE])
        a = self._beta * error.stretch(conditions.sampling_s) * _ONE
        if conditions.sampling_s > 0:
            growth = self._plant.growth(conditions.sampling_s, _CELLS)
            a = a + growth.mismatch.integral_on_grid() * self._state(Output.MISMATCH)
            a += growth.input_error.integral_on_grid() * self._input
        rows = np.array([a, pi])
        solution = solve_inequalities(rows[:, :2], rows[:, 2])
        loop_gain = float(solution.loop_gain)
        if not np.isfinite(solution.bound).all():
            return {"loop_gain": loop_gain}
        values = np.append(solution.bound, 1.0)
        return {
            "sensor_error": float(values[0]),
            "controller_error": float(controller[Output.WEIGHTED] @ values),
            "input_error": float(values[1]),
            "state": float(self._state(Output.STATE) @ values),
            "loop_gain": loop_gain,
        }

    @property
    def _input(self) -> Vector:
        """The bound of |p|, before the first input of the controller, too."""
        return _PI + self._start_error * _ONE

    def _state(self, output: Output) -> Vector:
        free, gain = self._plant.states[output]
        return np.asarray(gain * _PI + (free + self._start[output]) * _ONE)

    def _controller_error(self, output: Output) -> Vector:
        """The bound of |C e_c|: the present error, updates in flight, lost updates."""
        error, C, delay_s = self._error, self._error.outputs[output], self._conditions.delay_s
        drives, bound = (self._state(Output.MISMATCH), self._input), error.now(output) * _A
        recent = [0.0, 0.0]
        if delay_s > 0:
            recent = [
                float(drive_response.through(C).integral_on_grid())
                for drive_response in self._recent_drive
            ]
            bound = bound + error.kernels[output].sup(delay_s) * _A
        for drive, area in zip(drives, recent, strict=True):
            bound = bound + (1.0 if self._by_tests else 1 - self._share) * area * drive
        if self._by_tests:
            sups = _sum_of_sups(error.kernels[output], delay_s, self._conditions.spacing_s)
            return bound + self._share * sups * _A
        for drive, kernel in zip(drives, self._all_drive, strict=True):
            bound = bound + self._share * kernel.through(C).integral() * drive
        return bound


def _sum_of_sups(kernel: KernelBounds, first_s: float, spacing_s: float) -> float:
    """Bound Σ_{j≥0} sup k(τ) over τ ≥ first + j·spacing."""
    sups = kernel.sups(first_s + spacing_s * np.arange(_TERMS, dtype=np.float64))
    last_s = first_s + spacing_s * (_TERMS - 1)
    if kernel.tail_rate_per_s == 0:
        return np.inf
    # The sups fall: from the last one on, their sum is at most their integral over the spacing.
    longer_s = max(float(kernel.edges_s[-1]) - last_s, 0.0) + 1 / kernel.tail_rate_per_s
    return float(sups.sum() + sups[-1] * longer_s / spacing_s)


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

    def to_json(self) -> dict[str, object]:
        """Return all fields for JSON."""
        return {
            **{name: getattr(self, name) for name in self.__dataclass_fields__},
            "bursts": [burst._asdict() for burst in self.bursts],
            "moments": [moment._asdict() for moment in self.moments],
        }


def unlimited_losses(
    resolved: Scenario, scope: CertificateScope, conditions: NetworkConditions
) -> UnlimitedLosses:
    """Return what is certified for a scenario's own plant without any limit on the losses.

    Raises:
        NotPredictableError: the losses are no Markov chain over the packets.
    """
    losses = loss_process(resolved.network.link)
    bounds, void = _moments(resolved, losses, conditions)
    paper_rate, at_events = _paper(resolved, losses)
    return UnlimitedLosses(
        losses.largest_probability,
        losses.is_independent,
        resolved.timing.horizon_ns / NS_PER_S,
        tuple(_bursts(resolved, scope, losses, conditions)),
        tuple(bounds),
        at_events,
        bounds[0].rate_per_s if bounds and bounds[0].rate_per_s > 0 else None,
        paper_rate,
        void,
    )


def _bursts(
    resolved: Scenario, scope: CertificateScope, losses: LossProcess, conditions: NetworkConditions
) -> list[BurstCertificate]:
    certificates: list[BurstCertificate] = []
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
        certificates.append(BurstCertificate(most, kept, events, constants.delta, state))
        if kept > _CERTAIN:
            break
    return certificates


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
    bounds: list[Moments] = []
    level = max(trigger.beta, trigger.floor)
    for order in ORDERS:
        found: list[Moments] = []
        reason = None
        for share in _RATES:
            error = error_gains(loop, share * alpha)
            plant = PlantGains(error, loop.A, loop.B, loop.x0[:, None], share * alpha)
            p = losses.largest_probability
            try:
                found.append(moments(error, plant, conditions, level, p, order))
            except (NoCertificateError, NotDecayingError) as error_found:
                reason = str(error_found)
            if found and (share == 1 or found[-1].loop_gain < _CLEARLY):
                break
        if not found:
            return bounds, reason
        bounds.append(found[-1])
    return bounds, None


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
    except (NoCertificateError, NotDecayingError):
        return None, ()


def _is_covered(resolved: Scenario) -> bool:
    coverage = resolved.coverage
    return not resolved.plant.disturbances and coverage.knows_state and coverage.is_decaying
