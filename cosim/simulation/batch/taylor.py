"""The loop between events as Taylor polynomials with a bound on the truncation error.

In the coordinates (x_c, e_c, d) with e_c = x_c − x and d = x_s − x_c = e_s − e_c,

    ẋ_c = H x_c        ḋ = H d        ė_c = A e_c − E x_c        E = A + BK − H,

since A e_c − E x_c = H x_c − A x − BK x_c. Only e_c depends on the plant; x_c drives it. x_c and d
follow the models, which all plants share. x = x_c − e_c and e_s = e_c + d. After an event e_s is
exactly 0, since d = −e_c or both are 0. No small quantity is the difference of large ones: a small
mismatch E and the errors that it drives keep their relative accuracy.

The Taylor coefficients of degree k are H_k x_c, H_k d and A_k e_c + X_k x_c. Their tables are
computed once per plant:

    H_k = H^k/k!    A_k = A^k/k!    X_{k+1} = (A X_k − E H_k)/(k + 1),  X_0 = 0.

Truncation error. The powers of G = [[H, 0], [−E/σ, A]] have the blocks k! H_k, k! A_k and
k! X_k/σ. After a time of at most w, the polynomial of degree p omits Σ_{k>p} G^k w^k/k! applied to
(σ x_c, e_c), and ‖G^{p+1+j}‖ ≤ ‖G^{p+1}‖ κ η^j with η = ‖G⁴‖^{1/4} and κ = max_{r<4} ‖G^r‖/η^r. For
ηw ≤ (p + 2)/2 the sum is at most 2κ ‖G^{p+1}‖ w^{p+1}/(p + 1)!. It is kept below 2⁻⁵³, the rounding
error of the state itself. σ = ‖E‖/max(‖A‖, ‖H‖) balances the blocks, so that the truncation error
of the part driven by a small E is relative to E. All norms are Frobenius norms, which bound the
2-norms from above.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.simulation.batch.vector_lanes import (
    Lanes,
    Width,
    dot,
    filled,
    fma,
    load,
    magnitude,
    store,
    times,
)

Array = NDArray[np.float64]

DEGREES = (4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24)
"""The possible values of p."""
HIGHEST = 24
_NEGLIGIBLE = 2.0**-53
_MEASURED = 1e-12
_LESS_STRICT = tuple((_MEASURED / _NEGLIGIBLE) ** (1.0 / (p + 1)) for p in DEGREES)
_ROUNDED_UP = 1.0 + 1e-9


class Models(NamedTuple):
    """The state of a run."""

    x_c: Lanes
    e_c: Lanes
    d: Lanes


def powers(H: Array, at: int, table: Array, n: Width) -> None:
    """Fill a table with H^k/k!, k = 0 … HIGHEST + 1, each matrix in column-major order."""
    size = len(n)
    for j in range(size):
        store(table, j * size, filled(0.0, n))
        table[j * size + j] = 1.0
    for k in range(HIGHEST + 1):
        for j in range(size):
            place = (k * size + j) * size
            column = times(H, at, load(table, place, n), n)
            store(table, place + size * size, column * (1.0 / (k + 1)))


def driven(A: Array, at: int, E: Array, H_k: Array, table: Array, n: Width) -> None:
    """Fill a table with X_k, k = 0 … HIGHEST + 1, as :func:`powers` does."""
    size = len(n)
    for j in range(size):
        store(table, j * size, filled(0.0, n))
    for k in range(HIGHEST + 1):
        for j in range(size):
            place = (k * size + j) * size
            column = times(A, at, load(table, place, n), n) - times(E, 0, load(H_k, place, n), n)
            store(table, place + size * size, column * (1.0 / (k + 1)))


def square_sum(table: Array, at: int, n: Width) -> float:
    """Return the squared Frobenius norm of the matrix that starts at index ``at``."""
    size = len(n)
    total = filled(0.0, n)
    for j in range(size):
        column = load(table, at + j * size, n)
        total = fma(column, column, total)
    return dot(total, filled(1.0, n))


def reaches(
    H_k: Array, A_k: Array, X_k: Array, E: Array, sizes: Array, reach_s: Array,
    measured_s: Array, n: Width,
) -> None:  # fmt: skip
    """Compute the time over which the polynomial of each degree in DEGREES is accurate."""
    area = len(n) * len(n)
    widest = max(square_sum(A_k, area, n), square_sum(H_k, area, n))
    mismatch = square_sum(E, 0, n)
    # σ⁻²; if E or both matrices are 0, any value is valid.
    balance = widest / mismatch if widest > 0.0 and mismatch > 0.0 else 1.0
    for k in range(HIGHEST + 2):
        own = square_sum(H_k, k * area, n) + square_sum(A_k, k * area, n)
        sizes[k] = math.sqrt(own + square_sum(X_k, k * area, n) * balance)
    eta = math.sqrt(math.sqrt(24.0 * sizes[4]))
    kappa = 1.0
    if eta > 0.0:
        kappa = max(kappa, sizes[1] / eta, 2.0 * sizes[2] / eta**2, 6.0 * sizes[3] / eta**3)
    for i in range(len(reach_s)):
        p = DEGREES[i]
        left_out = 2.0 * kappa * sizes[p + 1]
        reach_s[i], measured_s[i] = 0.0, 0.0
        if left_out == 0.0:
            reach_s[i], measured_s[i] = math.inf, math.inf
        elif left_out < math.inf:
            most_s = (p + 2) / (2.0 * eta) if eta > 0.0 else math.inf
            carried_s = math.exp(math.log(_NEGLIGIBLE / left_out) / (p + 1))
            reach_s[i] = min(carried_s, most_s)
            measured_s[i] = min(carried_s * _LESS_STRICT[i], most_s)


def degree_for(reach_s: Array, window_s: float) -> int:
    """Return the lowest degree that is accurate over the window."""
    for i in range(len(reach_s) - 1):
        if window_s <= reach_s[i]:
            return DEGREES[i]
    return HIGHEST


def value(curve: Array, p: int, s: float, n: Width) -> Lanes:
    """Return Σ_{k≤p} c_k s^k."""
    total = load(curve, p * len(n), n)
    for k in range(p - 1, -1, -1):
        total = fma(total, s, load(curve, k * len(n), n))
    return total


def state_at(space: Any, p: int, s: float, n: Width) -> Models:
    """Return the state at a time on a piece, from the coefficients in ``BatchMemory``."""
    x_c, e_c = value(space.x_c, p, s, n), value(space.e_c, p, s, n)
    return Models(x_c, e_c, value(space.d, p, s, n))


def value_and_slope(curve: Array, p: int, s: float, n: Width) -> tuple[Lanes, Lanes]:
    """Return the polynomial and its derivative."""
    total, slope = load(curve, p * len(n), n), filled(0.0, n)
    for k in range(p - 1, -1, -1):
        slope = fma(slope, s, total)
        total = fma(total, s, load(curve, k * len(n), n))
    return total, slope


def number_and_slope(g: Array, degree: int, s: float) -> tuple[float, float]:
    """Return the polynomial and its derivative."""
    total, slope = g[degree], 0.0
    for k in range(degree - 1, -1, -1):
        slope = slope * s + total
        total = total * s + g[k]
    return total, slope


def bend(curve: Array, p: int, s: float, n: Width) -> float:
    """Return a bound on |ÿ| in [0, s].

    Entry by entry, N(s) = Σ_k |c_k| s^k bounds |y|, and its derivatives bound those of y. N and its
    derivatives are non-decreasing.
    """
    total, slope = magnitude(load(curve, p * len(n), n)), filled(0.0, n)
    half = slope
    for k in range(p - 1, -1, -1):
        half = fma(half, s, slope)
        slope = fma(slope, s, total)
        total = fma(total, s, magnitude(load(curve, k * len(n), n)))
    return _ROUNDED_UP * 2.0 * math.sqrt(dot(half, half))


def largest(curve: Array, p: int, s: float, n: Width) -> float:
    """Return a bound on |y|² in [0, s]."""
    total = magnitude(load(curve, p * len(n), n))
    for k in range(p - 1, -1, -1):
        total = fma(total, s, magnitude(load(curve, k * len(n), n)))
    return _ROUNDED_UP * dot(total, total)


def squared(curve: Array, p: int, signs: Lanes, out: Array, n: Width) -> None:
    """Write the coefficients of yᵀ S y (degree 2p, S diagonal): Σ_{i+j=k} c_i · S c_j."""
    size = len(n)
    for k in range(2 * p + 1):
        total = filled(0.0, n)
        for i in range(max(0, k - p), (k + 1) // 2):
            total = fma(load(curve, i * size, n), load(curve, (k - i) * size, n), total)
        total = total + total
        if k % 2 == 0:
            middle = load(curve, (k // 2) * size, n)
            total = fma(middle, middle, total)
        out[k] = dot(total, signs)
