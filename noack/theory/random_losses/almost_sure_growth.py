"""The growth of a time-triggered loop under random losses, in mean square and in almost all runs.

Let s be a number for each step of the outcomes' chain, from one state to another with a loss or a
delivery, and f the frequencies of the steps. By Jensen's inequality, after k periods

    E log‖z‖² − k f·s ≤ log E(‖z‖² exp(−Σ s)),

and the right side follows the operator of the second moments in which each step is multiplied by
exp(−s). So ‖z‖ grows in almost all runs by at most exp(f·s/2) √ρ(s) per period, for every s: where
s = 0 this is the growth in mean square. f·s + log ρ(s) is convex. It is the lower, the more the
states remember: here the length of the present burst of losses and that of the one before.
"""

import math
from typing import NamedTuple

import numpy as np

from noack.core.clock import NEVER_NS
from noack.core.linear_systems import Vector
from noack.core.number_format import at_most
from noack.guarantee.loss_guarantee import LossGuarantee
from noack.impairments.loss_prediction import LossProcess, OutcomeChain
from noack.impairments.markov_chain import Array, NotPredictableError
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from noack.theory.bounds.contraction import EPSILON
from noack.theory.bounds.stacked_norms import Stack
from noack.theory.margins.exact_matrices import IntervalMatrix, inverse
from noack.theory.margins.scenario_times import intervals_ns, loop_times
from noack.theory.margins.time_triggered_loop import TimeTriggeredLoop
from noack.theory.random_losses.mean_square_growth import (
    PeriodMaps,
    mean_square_growth,
    require_few_slots,
    second_moments,
)

_MEMORIES = ((0, 0), (4, 0), (4, 4), (12, 0), (12, 4))
"""Lengths up to which the present burst and the one before are told apart."""
_SHORT, _CLOSE = 4, 1.02
"""Longer bursts are told apart only if the bound is already below this: that takes seconds."""
_MOST_POWERS, _PRECISION = 400, 1e-11
"""Powers of the operator by which ρ(s) is found, and its relative change at which they end: only the
search for s uses it."""
_ITERATIONS = 40
"""Limit of the search for s."""


class RandomGrowth(NamedTuple):
    """Factors per period."""

    mean_square: float
    """Upper bound of the growth of √(E‖z‖²), exact up to 1e-6."""
    almost_sure: float
    """Upper bound of the growth of ‖z‖ in almost all runs."""

    @property
    def text(self) -> str:
        """The conclusion as a sentence."""
        factor = f"{self.mean_square:.6g}"
        square = f"√E‖z‖² of the loop's state z changes by the factor {factor} per period"
        if self.mean_square < 1:
            return f"{square}: stable in mean square and almost surely"
        sure = f"almost surely ‖z‖ changes by at most the factor {at_most(self.almost_sure, 6)}"
        verdict = "stable"
        if self.almost_sure >= 1:
            verdict = f"not decided, as this is {at_most(self.almost_sure - 1, 2)} too large to prove decay"
        return f"{square}: not stable in mean square; {sure} per period: {verdict}"


def random_growth(resolved: Scenario, losses: LossProcess) -> RandomGrowth:
    """Return the growth of a scenario's loop under random losses that nothing limits.

    Raises:
        NotPredictableError: loop and losses have too many states, or the sensor is not
            time-triggered.
    """
    shortest_ns, longest_ns = intervals_ns(resolved)
    if shortest_ns != longest_ns:
        raise NotPredictableError("the times between updates are not known")
    loop, times = loop_of(resolved), loop_times(resolved, longest_ns)
    if times.timeout_ns < NEVER_NS:
        raise NotPredictableError("controller.update_timeout_s: the input depends on the update's age")
    require_few_slots(times)
    exact = TimeTriggeredLoop(loop.A, loop.B, loop.K, loop.H, times)
    try:
        maps = [(exact.period(slot, True), exact.period(slot, False)) for slot in range(times.slots)]
    except OverflowError:
        raise NotPredictableError("the loop grows beyond 1e308 within a period") from None
    outcomes = losses.outcomes(LossGuarantee())
    mean_square = almost_sure = mean_square_growth(maps, outcomes)
    if times.slots == 1:
        almost_sure = min(mean_square, almost_sure_growth(*maps[0], outcomes))
    return RandomGrowth(mean_square, almost_sure)


def almost_sure_growth(delivered: IntervalMatrix, lost: IntervalMatrix, outcomes: OutcomeChain) -> float:
    """Bound the growth of ‖z‖ per period in almost all runs.

    Args:
        delivered: M₀, (N, N).
        lost: M₁, (N, N).
        outcomes: outcomes of the updates.

    Raises:
        NotPredictableError: there are too many states, or what happens in the long run is decided
            by the beginning.
    """
    maps, recurrent, best = PeriodMaps.of([(delivered, lost)]), outcomes.recurrent(), math.inf
    for present, before in _MEMORIES:
        if present > _SHORT and best > _CLOSE:
            break
        try:
            best = min(best, _TiltedBound(maps, _with_history(recurrent, present, before)).bound())
        except NotPredictableError:
            if best == math.inf:
                raise
            break
        if best < 1:
            break
    return best


def _with_history(chain: OutcomeChain, present: int, before: int) -> OutcomeChain:
    """Return the chain whose states know the lengths of two bursts up to these numbers."""
    count = (present + 1) * (before + 1)
    places = np.arange(count)
    current, last = np.divmod(places, before + 1)
    after_loss, after_delivery = np.zeros((count, count)), np.zeros((count, count))
    after_loss[places, np.minimum(current + 1, present) * (before + 1) + last] = 1.0
    after_delivery[places, np.minimum(current, before)] = 1.0
    lost, delivered = np.kron(after_loss, chain.lost), np.kron(after_delivery, chain.delivered)
    return OutcomeChain(np.asarray(lost, np.float64), np.asarray(delivered, np.float64)).recurrent()


class _TiltedBound:
    """The bound as a function of s, by which the probabilities of the steps are tilted, and its minimum."""

    def __init__(self, maps: PeriodMaps, chain: OutcomeChain) -> None:
        self._period_maps, self._chain = maps, chain
        self._matrices = np.array(maps.reduced[0])
        self._chances = np.array([chain.delivered, chain.lost])
        self._steps = np.nonzero(self._chances)
        self._shares = chain.distribution()[self._steps[1]] * self._chances[self._steps]
        modes, size = len(chain.lost), len(self._matrices[0])
        self._forward = self._backward = np.tile(np.eye(size), (modes, 1, 1))

    def bound(self) -> float:
        """Return the bound for the best s that is found."""
        from scipy.optimize import minimize  # slow to import

        start = np.zeros(len(self._shares))
        # Too many states are refused before the search.
        M0, M1 = self._matrices
        second_moments(M0, M1, self._tilted(start))
        s = minimize(self._value, start, jac=True, method="L-BFGS-B", options={"maxiter": _ITERATIONS}).x
        radius = self._period_maps.radius_bound(self._tilted(s))
        exponent = self._mean(s) + math.log(radius)
        return math.exp(exponent / 2) * (1 + 1e-12)

    def _mean(self, s: Vector) -> float:
        """Return an upper bound of f · s, with the rounding of the frequencies f.

        The distribution of the states is the last row of the inverse of P − I with ones in its last
        column. That its entries are rounded moves each share by at most u times a column sum of the inverse.
        """
        chances = self._chances[self._steps]
        by_state = np.bincount(self._steps[1], chances * s, len(self._chain.lost))
        sizes = np.bincount(self._steps[1], chances * np.abs(s), len(self._chain.lost))
        equations = self._chain.lost + self._chain.delivered - np.eye(len(by_state))
        equations[:, -1] = 1.0
        if (inverse_equations := inverse(equations)) is None:
            raise NotPredictableError("the frequencies of the losses could not be enclosed")
        shares, radii = (
            inverse_equations.middle[-1],
            inverse_equations.radius[-1] + EPSILON * inverse_equations.magnitude.sum(axis=0),
        )
        error = (radii + (len(s) + 4) * EPSILON * np.abs(shares)) @ sizes
        return float(shares @ by_state + error * (1 + 1e-9))

    def _tilted(self, s: Vector) -> OutcomeChain:
        chances = self._chances.copy()
        chances[self._steps] *= np.exp(-s)
        return OutcomeChain(chances[1], chances[0])

    def _value(self, s: Vector) -> tuple[float, Vector]:
        """Return f·s + log ρ(s) and its gradient, by powers of the operator and its adjoint."""
        chain = self._tilted(s)
        chances = np.array([chain.delivered, chain.lost])
        X, Y, radius, before = self._forward, self._backward, 0.0, -1.0
        for _ in range(_MOST_POWERS):
            X, radius = _scaled(_mapped_moments(self._matrices, chances, X))
            Y, _ = _scaled(_mapped_moments(self._matrices.transpose(0, 2, 1), chances.transpose(0, 2, 1), Y))
            if abs(radius - before) <= _PRECISION * radius:
                break
            before = radius
        self._forward, self._backward = X, Y
        is_lost, source, target = self._steps
        M = self._matrices[is_lost]
        weights = chances[self._steps] * np.einsum(
            "eab,eab->e", Y[target], M @ X[source] @ M.transpose(0, 2, 1)
        )
        value = float(self._shares @ s) + math.log(max(radius, 1e-300))
        return value, self._shares - weights / max(float(weights.sum()), 1e-300)


def _mapped_moments(maps: Stack, chances: Array, X: Stack) -> Stack:
    before = np.einsum("oij,iab->ojab", chances, X)
    return np.asarray((maps[:, None] @ before @ maps.transpose(0, 2, 1)[:, None]).sum(axis=0))


def _scaled(X: Stack) -> tuple[Stack, float]:
    size = float(np.einsum("iaa->", X))
    return X / max(size, 1e-300), size
