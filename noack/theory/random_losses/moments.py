"""Bounds of a loop without a limit on consecutive losses: bursts, and moments.

Each update is lost with a probability of at most p̄, whatever happened before. |v| is the r-th
moment norm, (E‖v‖ʳ)^{1/r}, r = 1 or 2, and ρ = p̄^{1/r}. With all signals scaled by e^{αt}, at
every fixed time

    |C e_c| ≤ ‖C W⁻¹‖ a + f_C(a, m, π) + ℓ_C(m, π)            (I1): in flight, and lost
    |C x|   ≤ free_C + gain_C π
    π = |p| ≤ |K e_c| + σ (|KH x| + |KH e_c|) + r(σ) (|x|_W + |e_c|_W)
    a = |e_s|_W ≤ ḡβ + I_E m + I_B π,    m = |R_E x|

A missing event's part of e_c is what E x and B p have added since the event before it. All that has
ever been added is D_C = ∫‖C e^{(H+αI)s} L_E‖ ds m + ∫‖C e^{(H+αI)s} B U‖ ds π, so ℓ_C ≤ ρ D_C. But
an event has no more than c_i = β sup ‖C e^{(H+αI)τ} W⁻¹‖, and what is added to it after the last
test, if there have been i − 1 more since; and all i are lost with a probability of at most p̄ⁱ. So
their sum is at most S_J = c_1 + … + c_J, where J is like a random number with P(J ≥ i) ≤ min(1,
p̄ⁱ D_C/c_i):

    ℓ_C ≤ (Σ_i (S_iʳ − S_{i−1}ʳ) min(1, p̄ⁱ D_C/c_i))^{1/r} + ρ/(1 − ρ) √(h d_C D_C)

d_C the rate at which C e_c can grow; the last term is for r = 2, and 0 without a period h of tests.
This is concave: any tangent bounds it, and then the inequalities are linear. Without h and delay
there is a bound for every p̄ < 1.

At an event of the continuous trigger, where ‖e_s‖_W = β, the distribution of the number of missing
events is known exactly, and (I1) gives a bound by itself: :func:`moment_at_events`.

A run ends. Up to its horizon the certificates for at most m consecutive losses bound each run by its
own longest burst: :func:`moments_of_runs` bounds the mean of the largest ‖e_c‖ and ‖x‖ of a run.

Almost surely, x decays at every rate below that of the moments. Under the paper's conditions it does
so for every loss probability below 1. :func:`unlimited_losses` says all of this of a scenario.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix, Vector, spectral_abscissa
from noack.impairments.loss_guarantee import LongestBurst, LossGuarantee
from noack.impairments.loss_prediction import LossProcess, loss_process
from noack.impairments.markov_chain import NotPredictableError
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from noack.theory.bounds.contraction import Stack
from noack.theory.bounds.enclosure import NotDecayingError, response, response_until
from noack.theory.bounds.gains import ErrorGains, Output, PlantGains, error_gains
from noack.theory.bounds.terms import NetworkConditions, NoCertificateError
from noack.theory.certificates.assumptions import below
from noack.theory.certificates.conditions import most_events
from noack.theory.certificates.inequalities import solve_inequalities
from noack.theory.certificates.scenario_certificates import CertificateScope

_TERMS = 1024
_CELLS = 64
_MOST_LOST, _ROUNDS, _SETTLED, _FIRST = 256, 30, 0.999, 1e6
_A, _PI, _ONE = np.eye(3)
"""a, π and 1; every other signal is bounded by a combination of them."""
ORDERS = (1, 2)
_MOST_BURST = 64
_CERTAIN = 1 - 1e-9
_ROUNDING = 1e-9
"""Above the relative error of a probability, which is a sum of products of numbers that are not negative."""
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

    If exactly the last J updates are lost, ‖e_c‖_W e^{αt}/β ≤ S_J = 1 + g_1 + … + g_J with g_j =
    sup_{τ≥jδ}‖e^{(H+αI)τ}‖_W. So the bound is (Σ_j P(J ≥ j) (S_jʳ − S_{j−1}ʳ))^{1/r}, S_{−1} = 0. In
    a norm in which the models contract, and for independent losses, it is at most 1/(1 − p) for
    r = 1 and √(1 + p)/(1 − p) for r = 2.

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
    sums = 1.0 + np.cumsum(np.append(0.0, gains))
    # Number kN + j, j ≤ N, adds at most r g_N ((k + 1) S_N)^{r−1}; P(J ≥ kN + j) ≤ longestᵏ P(J ≥ j).
    later = (1 - longest) ** -order - 1  # Σ_{k≥1} (k + 1)^{r−1} longestᵏ
    beyond = order * gains[-1] * sums[-1] ** (order - 1) * tails.sum() * later
    return float((1.0 + tails @ np.diff(sums**order) + beyond) ** (1 / order)) * (1 + _ROUNDING)


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
    candidates = [
        _Inequalities(error, plant, conditions, beta, largest_probability, higher_order).solve()
        for higher_order in ORDERS[order - 1 :]  # a mean is at most the root mean square
    ]
    if not any(np.isfinite(candidate.state) for candidate in candidates):
        loop_gain = min(candidate.loop_gain for candidate in candidates)
        raise NoCertificateError(f"the loop gain of the moments is {loop_gain:.3g}, not below 1")
    return Moments(order, *map(min, zip(*(candidate[1:] for candidate in candidates), strict=True)))


class _Inequalities:
    """The inequalities; every signal is bounded by a row: multiples of a and π, and a constant."""

    def __init__(
        self,
        error: ErrorGains,
        plant: PlantGains,
        conditions: NetworkConditions,
        beta: float,
        probability: float,
        order: int,
    ) -> None:
        if not error.scaled_H.any():
            raise NotDecayingError("a hold does not decay")
        self._error, self._plant, self._conditions = error, plant, conditions
        self._beta, self._probability, self._order = beta, probability, order
        self._start_error, self._start = plant.start_up(conditions.start_s)
        columns, delay_s = (plant.split_mismatch[0], plant.input_matrix), conditions.delay_s
        self._drive = [response(error.scaled_H, D) for D in columns]
        self._recent = [response_until(error.scaled_H, D, delay_s) for D in columns if delay_s > 0]
        self._signals = self._state(Output.MISMATCH), _PI + self._start_error * _ONE
        self._missing = {output: self._missing_events(output) for output in error.outputs}

    def solve(self) -> Moments:
        """Return the bounds, infinite ones with a loop gain if there are none.

        Each round bounds the concave terms by their tangents at the bounds that hold already.
        """
        rate_per_s, state = self._error.alpha_per_s, self._state(Output.STATE)
        best = Moments(self._order, rate_per_s, *(np.inf,) * 5)
        values = np.array([*(_FIRST * self._beta,) * 2, 1.0])
        for _ in range(_ROUNDS):
            controller = {output: self._controller_error(output, values) for output in self._missing}
            rows = self._rows(controller)
            solution = solve_inequalities(rows[:, :2], rows[:, 2])
            values = np.append(solution.bound, 1.0)
            loop_gain = float(solution.loop_gain)
            if not np.isfinite(values).all():
                return best._replace(loop_gain=min(best.loop_gain, loop_gain))
            signals = (_A, controller[Output.WEIGHTED], _PI, state)
            a, e_c, pi, x = (float(row @ values) for row in signals)
            refined = Moments(self._order, rate_per_s, a, e_c, pi, x, loop_gain)
            if refined.state > _SETTLED * best.state:
                break
            best = refined
        return best

    def _rows(self, controller: Mapping[Output, Vector]) -> Matrix:
        """Return the rows that bound a and π, (2, 3)."""
        conditions, error = self._conditions, self._error
        pi = controller[Output.GAIN] + error.hold_remainder(conditions.hold_s) * (
            self._state(Output.WEIGHTED) + controller[Output.WEIGHTED]
        )
        pi += conditions.hold_s * (self._state(Output.GAIN_RATE) + controller[Output.GAIN_RATE])
        a = self._beta * error.stretch(conditions.sampling_s) * _ONE
        if conditions.sampling_s > 0:
            growth = self._plant.growth(conditions.sampling_s, _CELLS)
            areas = growth.mismatch.integral_on_grid(), growth.input_error.integral_on_grid()
            a = a + self._driven(areas)
        return np.array([a, pi])

    def _driven(self, gains: Iterable[Stack]) -> Vector:
        """Return the row of what E x and B p do with these gains."""
        return sum((gain * row for gain, row in zip(gains, self._signals, strict=False)), np.zeros(3))

    def _state(self, output: Output) -> Vector:
        free, gain = self._plant.states[output]
        return np.asarray(gain * _PI + (free + self._start[output]) * _ONE)

    def _missing_events(self, output: Output) -> "_Missing":
        """Return what bounds the missing events' part of C e_c, and the present error."""
        error, C, conditions = self._error, self._error.outputs[output], self._conditions
        delay_s, kernels = conditions.delay_s, [drive.through(C) for drive in self._drive]
        ages_s = delay_s + conditions.spacing_s * np.arange(float(_MOST_LOST))
        ceilings = self._beta * error.kernels[output].sups(ages_s)
        present = error.now(output) * _A
        if delay_s > 0:
            present = present + error.kernels[output].sup(delay_s) * _A
        return _Missing(
            present,
            self._driven(recent.through(C).integral_on_grid() for recent in self._recent),
            self._driven(kernel.integral() for kernel in kernels),
            conditions.sampling_s * self._driven(kernel.sup(delay_s) for kernel in kernels),
            ceilings,
        )

    def _controller_error(self, output: Output, values: Vector) -> Vector:
        """The bound of |C e_c|, as tight as can be where the signals have these values."""
        share = self._probability ** (1 / self._order)
        missing = self._missing[output]
        lost = [share * (missing.whole - missing.recent)]
        whole, overshoot = missing.whole @ values, missing.overshoot @ values
        if share < 1 and whole > 0 and (self._order > 1 or overshoot == 0):
            row = missing.burst(self._probability, self._order, float(whole))
            if overshoot > 0:
                ratio = np.sqrt(whole / overshoot)
                row = row + share / (1 - share) / 2 * (ratio * missing.overshoot + missing.whole / ratio)
            lost.append(row)
        best = min(lost, key=lambda row: float(row @ values))
        return np.asarray(missing.present + missing.recent + best)


class _Missing(NamedTuple):
    """What bounds the part of C e_c that missing events have; rows but for the last."""

    present: Vector
    """Of e_s, now and when the oldest update in flight was sent."""
    recent: Vector
    """What has been added to e_s while updates in flight were sent."""
    whole: Vector
    """What has ever been added to e_s."""
    overshoot: Vector
    """What is added to e_s between two tests, at most."""
    ceilings: Vector
    """What the i-th last event since the last delivery has at most, without the overshoot."""

    def burst(self, probability: float, order: int, whole: float) -> Vector:
        """Bound (Σ_i (S_iʳ − S_{i−1}ʳ) min(1, p^i D/c_i))^{1/r} by its tangent at a value of D."""
        c, powers = self.ceilings, probability ** np.arange(1.0, len(self.ceilings) + 1)
        sums = np.cumsum(np.append(0.0, c))
        weights = np.ones_like(c) if order == 1 else sums[1:] + sums[:-1]
        few = powers * whole < c
        # Beyond the last one c_i is not larger, and (S_iʳ − S_{i−1}ʳ)/c_i at most r S_iʳ⁻¹.
        ratio = probability / (1 - probability)
        beyond = ratio if order == 1 else 2 * ratio * (sums[-1] + c[-1] / (1 - probability))
        slope = float((weights * powers)[few].sum() + powers[-1] * beyond)
        value = float(((weights * c)[~few].sum() + slope * whole) ** (1 / order))
        tangent = slope / (order * value ** (order - 1)) if slope else 0.0
        return np.asarray(tangent * self.whole + (value - tangent * whole) * _ONE)


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
    """For r = 1 and 2; none if there is no certificate."""
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
            "runs": [moment._asdict() for moment in self.runs],
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
    bursts = _bursts(resolved, scope, losses, conditions)
    paper_rate, at_events = _paper(resolved, losses)
    return UnlimitedLosses(
        losses.largest_probability,
        losses.is_independent,
        resolved.timing.horizon_ns / NS_PER_S,
        tuple(bursts),
        tuple(moments_of_runs(bursts)),
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
    for longest in range(_MOST_BURST + 1):
        certificate = scope.certificate(conditions._replace(dropouts=longest, constraints=()))
        constants, spacing_s = certificate.constants, certificate.inter_event_s
        if constants is None or not spacing_s:
            break
        events = most_events(resolved, spacing_s)
        try:
            probability = losses.keeps(LossGuarantee((LongestBurst(longest),)), events)
        except NotPredictableError:
            break
        persists = certificate.floor_constants or certificate.persistent_constants
        rate_per_s = 0.0 if persists else constants.rate_per_s
        bounds = (float(bound(np.zeros(1))[0]) for bound in (certificate.controller_error, certificate.state))
        certificates.append(
            BurstCertificate(longest, probability, events, constants.delta, rate_per_s, *bounds)
        )
        if probability > _CERTAIN:
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
        solutions: list[Moments] = []
        reason = None
        for share in _RATES:
            error = error_gains(loop, share * alpha)
            plant = PlantGains(error, loop.A, loop.B, loop.x0[:, None], share * alpha)
            p = losses.largest_probability
            try:
                solutions.append(moments(error, plant, conditions, level, p, order))
            except (NoCertificateError, NotDecayingError) as error_found:
                reason = str(error_found)
            if solutions and (share == 1 or solutions[-1].loop_gain < _CLEARLY):
                break
        if not solutions:
            return bounds, reason
        bounds.append(solutions[-1])
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
