"""The paper's own results: their assumptions, their chain of arguments, their evaluation.

The loop (docs/theory.md, "The loop"). The plant is ẋ = Ax + Bu (eq:plant). Sensor and controller
run the same model ẋ_s = H x_s, ẋ_c = H x_c between updates (eq:ModSensor, eq:ModCont), H = Â + B̂K,
or H = 0 for a hold; u = K x_c. At an event t_k the sensor sends x and sets x_s = x, whether the
update arrives or not. A delivered update sets x_c = x. An event happens when ‖e_s‖ exceeds βe^{−αt}
(eq:thre), e_s = x_s − x and e_c = x_c − x.

(I1) is an identity, because both models have the same matrix and differ by jumps only:

    x_c(t) − x_s(t) = Σ_{k=r+1..q} e^{H(t−t_k)} e_s(t_k⁻)

q is the last event, r the last one whose update the controller has. It holds for every plant,
linear or not, and for every pattern of losses; eq:LossEv2 is the paper's case of it.

(I1) → eq:LossEv3. With the triangle inequality and ‖e_s(t_k⁻)‖ ≤ βe^{−αt_k},

    ‖e_c(t)‖ ≤ βe^{−αt} + Σ_k βe^{−αt_k} ‖e^{H(t−t_k)}‖.

Both sides can be computed along a run. Without the second step, ‖e_c‖ ≤ ‖e_s‖ + Σ ‖e^{H(t−t_k)}
e_s(t_k⁻)‖ holds for every trigger. :class:`MissedEvents` evaluates the right-hand side of (I1), and
:class:`ErrorMonitor` both bounds, from the sensor's errors and the controller's updates.

eq:LossEv3 → Theorem 1 (th:ContError). The times t − t_k are bounded by those that e_s needs to
reach the threshold: δ̄_j (eq:deltaa, eq:deltak), from the growth of an unstable A with distinct
eigenvalues (Proposition 1, prop:unstable). With at most M − 1 consecutive losses this gives ‖e_c‖ ≤
Δβe^{−αt}, Δ of eq:Normec. δ̄_j depends on the trajectory and on A, so Δ is known after a run only.
Theorem 3 (th:ContErrorZOH, eq:NormecZOH) is the same for H = 0.

Theorem 1 → Theorem 2 (th:consensus). With ‖e^{(A+BK)t}‖ ≤ c e^{−ᾱt} and 0 < α < ᾱ, the loop driven
by e_c gives the bound of the state, eq:normXt; and ė_s = H e_s − E x − BK e_c (eq:miet_errdyn)
gives the minimum inter-event time, eq:tau with eq:Htil. :func:`theorem_1`, which Theorem 3 needs,
too, and :func:`theorem_2` evaluate them. c and ᾱ are free, and the best values are used. F̄ may be
negative, and F depends on t_i: a bound for all t_i uses the larger of F's values at t_i = 0 and t_i
→ ∞. Norms are Euclidean, as in the paper.

What the paper assumes and certificates do not: Proposition 1, whose condition the paper's own
example violates; a continuous trigger; a network and an input without delay. The list, with a
verdict for a scenario, is in ``noack/theory/certificates/assumptions.py``.
"""

import math
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from netem.core.row_operations import row_norms
from noack.core.linear_systems import (
    Matrix,
    MatrixKey,
    Propagator,
    Vector,
    exponential,
    matrix_key,
    matrix_of,
    spectral_abscissa,
    transition,
)
from noack.scenario.resolution import LoopMatrices
from noack.theory.response_bounds import NotDecayingError, bound_response
from noack.trigger_policies.trigger_rule import Policy, TriggerRule

_PART_NUMBERS = 2**20
"""Numbers in the jumps that are computed at once."""
_RATE_RESOLUTION, _NEAREST_RATE = 1e-2, 0.98
"""As shares of the range of ᾱ: the accuracy of the search, and the largest ᾱ; c is infinite at the end."""
_FIRST_STEP, _STEPS_UNTIL_DOUBLED = 1 / 64, 64
"""Times at which ‖e^{Gt}‖ is sampled: the first step, times ‖G‖; steps until it is doubled."""
_LAST_TIME = 50.0
"""The last of them, times the difference between the decay rates of loop and threshold."""
_GOLDEN = (math.sqrt(5) - 1) / 2
"""The golden section."""
_THEOREM_1_CELLS = 256
"""Cells over which its suprema are bounded."""
_GAMMAS = np.geomspace(1e-3, 1e3, 61)
"""γ of Theorem 1 that are tried, per second, (61,)."""


class MissedJumps(NamedTuple):
    """Jumps that x_c misses: p pairs of a measurement and an event that is missing there."""

    at: NDArray[np.int64]
    """(p,) place of the measurement."""
    event_ns: NDArray[np.int64]
    """(p,) t_k."""
    ages_ns: NDArray[np.int64]
    """(p,) t − t_k."""
    jumps: Matrix
    """(p, n) e^{H(t−t_k)} e_s(t_k⁻)."""

    def sums(self, measurements: int) -> Matrix:
        """Return the sum of the jumps at each measurement, (measurements, n)."""
        columns = [np.bincount(self.at, jumps, measurements) for jumps in self.jumps.T]
        return np.column_stack(columns)


class MissedEvents:
    """Follows the missed events along a run; times between measurements are near multiples of a period."""

    def __init__(self, H: Matrix, period_ns: int) -> None:
        self._propagate, self._period_ns = Propagator(H), period_ns
        # One entry per event that is still missing:
        self._sequences, self._times_ns = np.zeros(0, np.int64), np.zeros(0, np.int64)
        self._errors = np.zeros((0, len(H)))

    def take(
        self, t_ns: NDArray[np.int64], e_s: Matrix, events: NDArray[np.int64], received: NDArray[np.int64]
    ) -> Iterator[MissedJumps]:
        """Add k measurements; yield the jumps that are missed at them, some at a time.

        Args:
            t_ns: their times, (k,).
            e_s: e_s before any reset, (k, n).
            events: the sequence number of the event at each measurement, negative for none, (k,).
            received: that of the newest update that the controller has, negative for none, (k,).
        """
        # Events that are missing at first, and new ones.
        new = np.flatnonzero(events >= 0)
        sequences = np.append(self._sequences, events[new])
        times_ns = np.append(self._times_ns, t_ns[new])
        errors = np.concatenate([self._errors, e_s[new]])
        # Each is missing until an update arrives that is not older; some still are at the end.
        begins = np.append(np.zeros(len(self._sequences), np.int64), new)
        ends = np.maximum(np.searchsorted(np.maximum.accumulate(received), sequences), begins)
        lasting = ends == len(t_ns)
        self._sequences, self._times_ns = sequences[lasting], times_ns[lasting]
        self._errors = errors[lasting]
        # Pairs of a measurement and an event that is missing there.
        lengths = ends - begins
        totals = np.cumsum(lengths)
        begin, batch = 0, max(_PART_NUMBERS // errors.shape[1], 1)
        while begin < len(lengths):
            earlier = totals[begin - 1] if begin else 0
            last = max(int(np.searchsorted(totals, earlier + batch, "right")), begin + 1)
            event = np.repeat(np.arange(begin, last), lengths[begin:last])
            measurement = np.arange(len(event)) - (totals - lengths)[event] + earlier + begins[event]
            ages_ns = t_ns[measurement] - times_ns[event]
            jumps = self._propagate.advance_by(errors.take(event, axis=0), ages_ns, self._period_ns)
            yield MissedJumps(measurement, times_ns[event], ages_ns, jumps)
            begin = last


class ErrorBounds(NamedTuple):
    """Bounds of ‖e_c‖_W at k measurements, and the right-hand side of (I1) there."""

    identity: Vector
    """(k,)"""
    printed: Vector
    """(k,) the paper's formula; NaN for other triggers than the paper's."""
    missed: Matrix
    """(k, n) x_c − x_s by (I1): the sum of the missed jumps."""


class ErrorMonitor:
    """Computes the bounds along a run; times between its measurements are near multiples of a period.

    H is the matrix of both models between updates. The cost is that of a few array operations for
    each pair of a measurement and an event that is missing there.
    """

    def __init__(self, H: Matrix, trigger: Policy, period_ns: int) -> None:
        self._trigger = trigger
        self._missed = MissedEvents(H, period_ns)
        self._weight = np.eye(len(H)) if trigger.weight is None else trigger.weight
        self._growths = _growths(matrix_key(H), matrix_key(self._weight))

    def take(
        self, t_ns: NDArray[np.int64], e_s: Matrix, events: NDArray[np.int64], received: NDArray[np.int64]
    ) -> ErrorBounds:
        """Add k measurements, as :meth:`MissedEvents.take` does."""
        count = len(t_ns)
        weighted = e_s if self._trigger.weight is None else e_s @ self._weight.T
        identity = np.where(events >= 0, 0.0, row_norms(weighted))
        printed, missed = self._thresholds(t_ns), np.zeros_like(e_s)
        for pairs in self._missed.take(t_ns, e_s, events, received):
            jumps = pairs.jumps if self._trigger.weight is None else pairs.jumps @ self._weight.T
            identity += np.bincount(pairs.at, row_norms(jumps), count)
            missed += pairs.sums(count)
            if isinstance(self._trigger, TriggerRule) and self._trigger.is_decaying:
                grown = self._growths.at(pairs.ages_ns) * self._thresholds(pairs.event_ns)
                printed += np.bincount(pairs.at, grown, count)
        return ErrorBounds(identity, printed, missed)

    def _thresholds(self, t_ns: NDArray[np.int64]) -> Vector:
        if isinstance(self._trigger, TriggerRule) and self._trigger.is_decaying:
            return self._trigger.thresholds(t_ns)
        return np.full(len(t_ns), np.nan)


class _Growths:
    """‖e^{Hτ}‖_W at the ages that events have."""

    def __init__(self, H: Matrix, weight: Matrix) -> None:
        self._H, self._weight = H, weight
        self._inverse = np.linalg.inv(weight)
        self._known = {0: 1.0}

    def at(self, ages_ns: NDArray[np.int64]) -> Vector:
        """Return the values at k ages, (k,)."""
        different, places = np.unique(ages_ns, return_inverse=True)
        if new := [age_ns for age_ns in different.tolist() if age_ns not in self._known]:
            moved = self._weight @ [transition(self._H, ns) for ns in new] @ self._inverse
            self._known |= zip(new, np.linalg.norm(moved, 2, axis=(1, 2)).tolist(), strict=True)
        return np.array([self._known[age_ns] for age_ns in different.tolist()])[places]


@lru_cache(maxsize=16)
def _growths(H: MatrixKey, weight: MatrixKey) -> _Growths:
    """Return the growths of some models; loops with equal models share them."""
    return _Growths(matrix_of(H), matrix_of(weight))


class Theorem2(NamedTuple):
    """Theorem 2 with its constants."""

    c: float
    """‖e^{(A+BK)t}‖ ≤ c e^{−ᾱt}."""
    alpha_bar_per_s: float
    """ᾱ."""
    delta: float
    """The given Δ."""
    a_hat: float
    """‖Â + B̂K‖."""
    a_tilde: float
    """‖Ã + B̃K‖."""
    inter_event_s: float
    """eq:tau, for every t_i."""
    state_start: float
    """c x₀: eq:normXt is ‖x‖ ≤ c x₀ e^{−ᾱt} + g (e^{−αt} − e^{−ᾱt})."""
    state_forced: float
    """g = βcΔ‖BK‖ / (ᾱ − α)."""

    def state(self, t_s: Vector, alpha_per_s: float) -> Vector:
        """Return the right-hand side of eq:normXt at times (k,)."""
        fast = np.exp(-self.alpha_bar_per_s * t_s)
        return self.state_start * fast + self.state_forced * (np.exp(-alpha_per_s * t_s) - fast)


def theorem_2(loop: LoopMatrices, beta: float, alpha_per_s: float, delta: float) -> Theorem2 | None:
    """Return Theorem 2 for a given Δ, with the c and ᾱ that give the longest inter-event time.

    None if no ᾱ meets 0 < α < ᾱ, or if a number overflows or underflows.
    """
    closed = loop.A + loop.B @ loop.K
    fastest = -spectral_abscissa(closed)
    if not 0 < alpha_per_s < fastest or not math.isfinite(np.linalg.norm(closed)):
        return None
    try:
        rate = _best_rate_per_s(loop, beta, alpha_per_s, delta, fastest)
        identity = np.eye(loop.n)
        c = bound_response(closed + rate * identity, identity, identity).largest
    except NotDecayingError:  # the decay is too slow to compute c in floating point
        return None
    best = _theorem_2(loop, beta, alpha_per_s, delta, rate, c)
    sizes = (best.c, best.state_start, best.state_forced)
    return None if math.isnan(best.inter_event_s) or not all(map(math.isfinite, sizes)) else best


def _best_rate_per_s(
    loop: LoopMatrices, beta: float, alpha_per_s: float, delta: float, fastest_per_s: float
) -> float:
    """Return the ᾱ between α and the loop's decay rate that gives about the longest inter-event time.

    Raises:
        NotDecayingError: a number overflows.
    """
    width = fastest_per_s - alpha_per_s
    t_s, logarithms = _sampled_norms(loop.A + loop.B @ loop.K, _LAST_TIME / width)

    def about_s(share: float) -> float:
        rate = alpha_per_s + share * width
        with np.errstate(over="ignore"):
            c = float(np.exp(np.max(logarithms + rate * t_s)))
        return _theorem_2(loop, beta, alpha_per_s, delta, rate, c).inter_event_s

    # At one end of the range c tends to infinity, at the other end 1/(ᾱ − α) does. The larger of
    # two values between leaves a smaller range, whose golden section is the other one.
    low, high = 0.0, _NEAREST_RATE
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    left_s, right_s = about_s(left), about_s(right)
    while high - low > _RATE_RESOLUTION:
        if left_s > right_s:
            high, right, right_s = right, left, left_s
            left = high - _GOLDEN * (high - low)
            left_s = about_s(left)
        else:
            low, left, left_s = left, right, right_s
            right = low + _GOLDEN * (high - low)
            right_s = about_s(right)
    return alpha_per_s + (right if right_s > left_s else left) * width


def _sampled_norms(generator: Matrix, until_s: float) -> tuple[Vector, Vector]:
    """Return times from 0 to about ``until_s``, and the logarithms of ‖e^{Gt}‖ there.

    Raises:
        NotDecayingError: a number overflows.
    """
    step_s = _FIRST_STEP / float(np.linalg.norm(generator))
    step, reached, t_s = exponential(step_s * generator), np.eye(len(generator)), 0.0
    times_s, matrices = [t_s], [reached]
    while t_s < until_s:
        for _ in range(_STEPS_UNTIL_DOUBLED):
            reached, t_s = step @ reached, t_s + step_s
            times_s.append(t_s)
            matrices.append(reached)
        step, step_s = step @ step, 2 * step_s
    if not np.isfinite(matrices).all():
        raise NotDecayingError("‖e^{Gt}‖ overflows")
    with np.errstate(divide="ignore"):  # norms that underflow
        return np.array(times_s), np.log(np.linalg.norm(np.array(matrices), 2, axis=(1, 2)))


def _theorem_2(
    loop: LoopMatrices, beta: float, alpha_per_s: float, delta: float, alpha_bar_per_s: float, c: float
) -> Theorem2:
    closed = loop.A + loop.B @ loop.K
    x0, BK = float(np.linalg.norm(loop.x0)), float(np.linalg.norm(loop.B @ loop.K, 2))
    a_hat, gap = float(np.linalg.norm(loop.H, 2)), alpha_bar_per_s - alpha_per_s
    a_tilde = float(np.linalg.norm(closed - loop.H, 2))
    start = a_tilde * c * (x0 - beta * delta * BK / gap)
    forced = (1 + a_tilde * c / gap) * beta * delta * BK
    # eq:Htil is monotonic in t_i; the sign of F̄ determines the direction.
    F = max(start, 0.0) / (a_hat + alpha_bar_per_s) + forced / (a_hat + alpha_per_s)
    inter_event_s = math.log1p(beta / F) / (a_hat + alpha_bar_per_s) if F > 0 else math.inf
    return Theorem2(
        c, alpha_bar_per_s, delta, a_hat, a_tilde, inter_event_s, c * x0, beta * c * delta * BK / gap
    )


class InterEventTrajectory(NamedTuple):
    """A trajectory between two events: k samples."""

    t_s: Vector
    """(k,), the first is the time of the event."""
    x_norm: Vector
    """(k,) ‖x‖."""
    model_norm: Vector
    """(k,) ‖e^{H(t−t_j)} x(t_j)‖."""


def longest_interval_s(
    interval: InterEventTrajectory, beta: float, alpha_per_s: float, kappa: float
) -> float:
    """Return Theorem 1's δ̄_j from the trajectory: the minimum over the free constant γ > 0.

    η_j e^{γ(t−t_j)} ≤ ‖x(t)‖ and ‖e^{H(t−t_j)}x(t_j)‖ ≤ ζ_j e^{−κ(t−t_j)} give (eq:deltaa, deltak)
    δ̄_j = ln((ζ_j + βe^{−αt_j})/η_j) / (γ + min(κ, α)). γ and η_j exist for every trajectory without
    zeros in the interval, growing or not. Without the growth of Proposition 1, δ̄_j is long.
    """
    passed_s = interval.t_s - interval.t_s[0]
    zeta = float((interval.model_norm * np.exp(kappa * passed_s)).max())
    level = beta * math.exp(-alpha_per_s * float(interval.t_s[0]))
    etas = (interval.x_norm * np.exp(-_GAMMAS[:, None] * passed_s)).min(axis=1)
    exists = etas > 0
    etas, gammas = etas[exists], _GAMMAS[exists]
    with np.errstate(over="ignore"):  # of a tiny η_j: it gives no interval
        ratios = (np.maximum(zeta, etas) + level) / etas
    intervals_s = np.log(ratios) / (gammas + min(kappa, alpha_per_s))
    return float(intervals_s.min(initial=math.inf))


def theorem_1(H: Matrix, alpha_per_s: float, longest_s: Sequence[float]) -> float:
    """Return Theorem 1's Δ (eq:Normec) between two deliveries, or Theorem 3's if H = 0.

    Args:
        H: matrix of the models, (n, n).
        alpha_per_s: α.
        longest_s: δ̄_j for the intervals between the missed events and after them, j = 1 … M−1.

    Returns:
        1 + Σ_k e^{αδ̃_k} sup‖e^{Hτ}‖ over 0 ≤ τ ≤ δ̃_k, with δ̃_k = Σ_{j≥k} δ̄_j.
    """
    delta = 1.0
    for k in range(len(longest_s)):
        reach_s = math.fsum(longest_s[k:])
        if not math.isfinite(reach_s) or alpha_per_s * reach_s > 700:
            return math.inf
        # ‖e^{H(t+s)}‖ ≤ ‖e^{Ht}‖ ‖e^{Hs}‖: over the cells, and within one, at as many times.
        cell_s = reach_s / _THEOREM_1_CELLS
        largest = math.prod(_largest_at(H, until_s) for until_s in (reach_s, cell_s))
        delta += math.exp(alpha_per_s * reach_s) * largest
    return delta


def _largest_at(H: Matrix, until_s: float) -> float:
    """Return the largest ‖e^{Ht}‖ at times from 0 to ``until_s``."""
    step = exponential(until_s / _THEOREM_1_CELLS * H)
    reached = [step]
    for _ in range(_THEOREM_1_CELLS - 1):
        reached.append(step @ reached[-1])
    return max(1.0, float(np.linalg.norm(np.stack(reached), 2, axis=(1, 2)).max()))
