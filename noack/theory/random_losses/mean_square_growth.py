"""A time-triggered loop with random, unlimited losses: its growth in mean square and almost surely.

From one transmission to the next the state z = (x, x_c, u, w) of the loop becomes M₀z if the update
is delivered and M₁z if it is lost. The outcomes are a chain of states; P_ij is the probability that
state j follows state i and the update is delivered, L_ij the same for a loss. The second moments
X_j = E[z zᵀ; state j] therefore follow

    X_j ← Σ_i (L_ij M₁ X_i M₁ᵀ + P_ij M₀ X_i M₀ᵀ),

and E‖z‖² grows exactly like the powers of this operator's spectral radius. Almost surely, ‖z‖ grows
per period by at most the root of that (Jensen). If the losses are independent, another bound is
exp((1 − p) E log‖F_k ⋯ F_1‖ / k) in any norm, with the maps F from a delivery to the next one.
What bursts add that are too long to be listed is bounded by a geometric series.
"""

import math
from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, Vector
from noack.impairments.loss_guarantee import LossGuarantee
from noack.impairments.loss_prediction import LossProcess, OutcomeChain
from noack.impairments.markov_chain import NotPredictableError
from noack.theory.bounds.contraction import Stack
from noack.theory.margins.exact_matrices import exactly
from noack.theory.margins.loss_margin import LossMargin
from noack.theory.margins.switched_system import Edge, SwitchedSystem

_MOST_ENTRIES = 2000
"""Largest size of the operator's matrix."""
_ABOVE = 1e-7
"""The upper bound of the growth is this share above the computed one."""
_WEIGHTS = (1.0, 1.5, 2.0, 3.0)
"""The norms are balanced for maps whose bursts count p^(weight · j/2)."""
_PAIRS, _TRIPLES = 40, 14
"""Bursts up to which products of two, and of three, are computed."""
_MOST_SLOTS = 100
_MOST_LIKELY, _LEAST_LIKELY = 0.93, 1e-12
"""Loss probability up to which almost all runs are examined; rarer bursts are bounded together."""


class RandomGrowth(NamedTuple):
    """Factors per period."""

    mean_square: float
    """Upper bound of the growth of √(E‖z‖²), exact up to 1e-6."""
    almost_sure: float
    """Upper bound of the growth of ‖z‖ in almost all runs."""

    @property
    def text(self) -> str:
        """What follows, as a sentence."""
        factor = f"{self.mean_square:.6g}"
        square = f"√E‖z‖² of the loop's state z changes by the factor {factor} per period"
        if self.mean_square < 1:
            return f"{square}: stable in mean square and almost surely"
        sure = f"almost surely ‖z‖ changes by at most the factor {self.almost_sure:.6g}"
        verdict = "stable" if self.almost_sure < 1 else "not decided"
        return f"{square}: not stable in mean square; {sure} per period: {verdict}"


def random_growth(margin: LossMargin, losses: LossProcess) -> RandomGrowth:
    """Return the growth of a loop under random losses that nothing limits.

    Raises:
        NotPredictableError: loop and losses have too many states, or the sensor is not
            time-triggered.
    """
    if margin.shortest_ns != margin.longest_ns:
        raise NotPredictableError("the times between updates are not known")
    slots = range(margin.loop.times.slots)
    if len(slots) > _MOST_SLOTS:
        raise NotPredictableError("the times of the loop repeat only after many periods")
    maps = [(margin.loop.period(slot, True), margin.loop.period(slot, False)) for slot in slots]
    unlimited = losses.outcomes(LossGuarantee())
    mean_square = almost_sure = mean_square_growth(maps, unlimited)
    p = losses.largest_probability
    if len(slots) == 1 and losses.is_independent and 0 < p < _MOST_LIKELY:
        bursts = range(math.ceil(math.log(_LEAST_LIKELY) / math.log(p)))
        between = [margin.maps(0, burst).middle for burst in bursts]
        longest, lost = margin.loop.state_after(0, bursts[-1]), maps[0][1]
        almost_sure = min(mean_square, sure_growth(between, p, longest, lost))
    return RandomGrowth(mean_square, almost_sure)


def mean_square_growth(maps: Sequence[tuple[Matrix, Matrix]], outcomes: OutcomeChain) -> float:
    """Return the growth of √(E‖z‖²) per period, as an upper bound that is exact up to 1e-6.

    Args:
        maps: M₀ (delivered) and M₁ (lost), (N, N) each, for every slot: period k uses the pair
            k modulo their number.
        outcomes: of the updates.

    Raises:
        NotPredictableError: there are too many states.
    """
    size = len(maps[0][0])
    # In these coordinates no direction grows much more than others, so the check below is accurate.
    edges = tuple(Edge(0, 0, exactly(map_)) for slot in maps for map_ in slot)
    T = SwitchedSystem(edges).balancing()[0]
    turned = T @ np.array(maps) @ np.linalg.inv(T)
    steps = (second_moments(delivered, lost, outcomes) for delivered, lost in turned)
    operator = reduce(lambda before, step: step @ before, steps)
    if not np.isfinite(operator).all():
        raise NotPredictableError("the loop's second moments exceed 1e308 within a few periods")
    radius = float(np.abs(np.linalg.eigvals(operator)).max())
    if radius == 0:
        return 0.0
    _check(operator, radius * (1 + _ABOVE), size)
    return float((radius * (1 + 2 * _ABOVE)) ** (0.5 / len(maps)))


def second_moments(delivered: Matrix, lost: Matrix, outcomes: OutcomeChain) -> Matrix:
    """Return the operator of one period on the stacked upper triangles of X_j.

    Raises:
        NotPredictableError: there are too many states.
    """
    size = len(delivered)
    if len(outcomes.lost) * size * (size + 1) // 2 > _MOST_ENTRIES:
        raise NotPredictableError("loop and losses together have too many states to compute with")
    operator = np.kron(outcomes.lost.T, _on_triangle(lost))
    return np.asarray(operator + np.kron(outcomes.delivered.T, _on_triangle(delivered)))


def _on_triangle(matrix: Matrix) -> Matrix:
    """Return the map of the upper triangle of X to that of M X Mᵀ."""
    i, j = np.triu_indices(len(matrix))
    straight = matrix[np.ix_(i, i)] * matrix[np.ix_(j, j)]
    return np.asarray(straight + matrix[np.ix_(i, j)] * matrix[np.ix_(j, i)] * (i != j))


def from_triangles(entries: Vector, size: int) -> Stack:
    """Return the symmetric matrices with these upper triangles, (number, size, size)."""
    i, j = np.triu_indices(size)
    stack = np.zeros((len(entries) // len(i), size, size))
    stack[:, i, j] = stack[:, j, i] = entries.reshape(-1, len(i))
    return stack


def triangles(stack: Stack) -> Vector:
    """Return the upper triangles of symmetric matrices, one after the other."""
    i, j = np.triu_indices(stack.shape[-1])
    return stack[:, i, j].ravel()


def _check(operator: Matrix, bound: float, size: int) -> None:
    """Check that the spectral radius is below a bound, by X_j > 0 with operator(X) < bound X.

    Raises:
        NotPredictableError: the check fails numerically.
    """
    modes = 2 * len(operator) // (size * (size + 1))
    identity = triangles(np.tile(np.eye(size), (modes, 1, 1)))
    resolvent = bound * np.eye(len(operator)) - operator
    solution = np.asarray(np.linalg.solve(resolvent, identity), dtype=np.float64)
    forms, images = (from_triangles(part, size) for part in (solution, operator @ solution))
    rounding = 1e-13 * len(operator) * float(np.abs(forms).max()) * max(bound, 1.0)
    for positive in (forms, bound * forms - images):
        if not float(np.linalg.eigvalsh(positive).min()) > rounding:
            raise NotPredictableError("the second moments could not be bounded numerically")


def sure_growth(
    between: Sequence[Matrix], probability: float, longest: Matrix, lost: Matrix
) -> float:
    """Bound the growth per period of almost all runs with independent losses.

    Args:
        between: F_j, the maps from a delivered update to the next one with j losses between them,
            (N, N) each, for all j below some number J.
        probability: p.
        longest: the loop's whole state after J − 1 losses, (S, N); F_{J−1} has some of its rows.
        lost: the map of this state over a period whose update is lost, (S, S).
    """
    counts = np.arange(len(between))
    likely: Vector = (1 - probability) * np.power(float(probability), counts)
    best = math.inf
    for weight in _WEIGHTS:
        shares = probability ** (weight * counts / 2)
        edges = [Edge(0, 0, exactly(F * share)) for F, share in zip(between, shares, strict=True)]
        T = SwitchedSystem(tuple(edges)).balancing()[0]
        undone: Matrix = np.asarray(np.linalg.inv(T), dtype=np.float64)
        maps = T @ np.array(between) @ undone
        first = float(np.linalg.norm(T, 2) * np.linalg.norm(longest @ undone, 2))
        rest = _left_out(maps, likely, probability, first, float(np.linalg.norm(lost, 2)))
        best = min(best, _mean_log_norm(maps, likely) + rest)
    # A delivery follows the last one after 1/(1 − p) periods on average.
    return math.exp(best * (1 - probability)) * (1 + 1e-9)


def _left_out(maps: Stack, likely: Vector, p: float, first: float, lost: float) -> float:
    """Bound what products with a burst of J = len(maps) losses or more add to the means.

    ‖F_{J+i}‖ is at most first · lost^{i+1}, and log⁺ of a product at most the sum of those of its
    up to three factors.
    """
    share = p ** len(maps)
    growth = max(math.log(max(lost, 1e-300)), 0.0)
    long = share * (max(math.log(max(first, 1e-300)), 0.0) + growth / (1 - p))  # E(i + 1)
    return long + 2 * share * (float(likely @ _log_norms(maps).clip(min=0.0)) + long)


def _mean_log_norm(maps: Stack, likely: Vector) -> float:
    """Bound the exponent per delivery: the least of E log‖F‖, E log‖FF‖/2 and E log‖FFF‖/3.

    Products with a long burst are bounded by the norms of their factors.
    """
    pairs, triples = (min(len(maps), most) for most in (_PAIRS, _TRIPLES))
    single = _log_norms(maps)
    two = np.add.outer(single, single)
    both = np.einsum("aij,bjk->abik", maps[:pairs], maps[:pairs])
    two[:pairs, :pairs] = _log_norms(both)
    three = np.add.outer(two, single)
    three[:triples, :triples, :triples] = _log_norms(
        np.einsum("abij,cjk->abcik", both[:triples, :triples], maps[:triples])
    )
    return min(
        float(likely @ single),
        float(likely @ two @ likely) / 2,
        float(np.einsum("abc,a,b,c", three, likely, likely, likely)) / 3,
    )


def _log_norms(matrices: Stack) -> Stack:
    norms = np.linalg.norm(matrices, 2, axis=(-2, -1))
    return np.asarray(np.log(np.maximum(norms, 1e-300)))
