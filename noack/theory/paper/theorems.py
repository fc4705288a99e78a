"""The paper's formulas for its bounds: Theorems 1 and 2.

Theorem 1's Δ (eq:Normec) depends on the trajectory and on the true plant, so it can be computed
only after a run: :func:`theorem_1`. Theorem 2's minimum inter-event time (eq:tau, eq:Htil) needs
some Δ and constants c, ᾱ with ‖e^{(A+BK)t}‖ ≤ c e^{−ᾱt}. c and ᾱ are free, and the best values are
used. F̄ may be negative, and F depends on t_i: a bound for all t_i uses the larger of F's values at
t_i = 0 and t_i → ∞. Norms are Euclidean, as in the paper.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, Vector, spectral_abscissa
from noack.scenario.resolution import LoopMatrices
from noack.theory.bounds.enclosure import NotDecayingError, response, response_until

_SHARE, _NEAREST = 1e-2, 0.98
_GOLDEN = (math.sqrt(5) - 1) / 2
_CELLS = 256


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
    if not 0 < alpha_per_s < fastest:
        return None

    def at(share: float) -> Theorem2:
        rate = alpha_per_s + share * (fastest - alpha_per_s)
        return _theorem_2(loop, beta, alpha_per_s, delta, rate)

    # At one end of the range c tends to infinity, at the other end 1/(ᾱ − α) does. The larger of
    # two values between leaves a smaller range, whose golden section is the other one.
    low, high = 0.0, _NEAREST
    try:
        left, right = at(high - _GOLDEN * (high - low)), at(low + _GOLDEN * (high - low))
        while high - low > _SHARE:
            if left.inter_event_s > right.inter_event_s:
                high = low + _GOLDEN * (high - low)
                left, right = at(high - _GOLDEN * (high - low)), left
            else:
                low = high - _GOLDEN * (high - low)
                left, right = right, at(low + _GOLDEN * (high - low))
    except NotDecayingError:  # the decay is too slow to compute c in floating point
        return None
    best = max(left, right, key=lambda theorem: theorem.inter_event_s)
    sizes = (best.c, best.state_start, best.state_forced)
    return None if math.isnan(best.inter_event_s) or not all(map(math.isfinite, sizes)) else best


def _theorem_2(
    loop: LoopMatrices, beta: float, alpha_per_s: float, delta: float, alpha_bar_per_s: float
) -> Theorem2:
    closed, identity = loop.A + loop.B @ loop.K, np.eye(loop.n)
    c = float(response(closed + alpha_bar_per_s * identity, identity).through(identity).sup())
    x0, BK = float(np.linalg.norm(loop.x0)), float(np.linalg.norm(loop.B @ loop.K, 2))
    a_hat, gap = float(np.linalg.norm(loop.H, 2)), alpha_bar_per_s - alpha_per_s
    a_tilde = float(np.linalg.norm(closed - loop.H, 2))
    start = a_tilde * c * (x0 - beta * delta * BK / gap)
    forced = (1 + a_tilde * c / gap) * beta * delta * BK
    # eq:Htil is monotonic in t_i; the sign of F̄ determines the direction.
    F = max(start, 0.0) / (a_hat + alpha_bar_per_s) + forced / (a_hat + alpha_per_s)
    inter_event_s = math.log1p(beta / F) / (a_hat + alpha_bar_per_s) if F > 0 else math.inf
    return Theorem2(
        c, alpha_bar_per_s, delta, a_hat, a_tilde, inter_event_s,
        c * x0, beta * c * delta * BK / gap,
    )  # fmt: skip


class Interval(NamedTuple):
    """A trajectory between two events: k samples."""

    t_s: Vector
    """(k,), the first is the time of the event."""
    x_norm: Vector
    """(k,) ‖x‖."""
    model_norm: Vector
    """(k,) ‖e^{H(t−t_j)} x(t_j)‖."""


def longest_interval_s(interval: Interval, beta: float, alpha_per_s: float, kappa: float) -> float:
    """Return Theorem 1's δ̄_j from the trajectory: the minimum over the free constant γ > 0.

    η_j e^{γ(t−t_j)} ≤ ‖x(t)‖ and ‖e^{H(t−t_j)}x(t_j)‖ ≤ ζ_j e^{−κ(t−t_j)} give (eq:deltaa, deltak)
    δ̄_j = ln((ζ_j + βe^{−αt_j})/η_j) / (γ + min(κ, α)). γ and η_j exist for every trajectory without
    zeros in the interval, growing or not. Without the growth of Proposition 1, δ̄_j is long.
    """
    passed_s = interval.t_s - interval.t_s[0]
    zeta = float((interval.model_norm * np.exp(kappa * passed_s)).max())
    level = beta * math.exp(-alpha_per_s * float(interval.t_s[0]))
    found_s = math.inf
    gammas = np.geomspace(1e-3, 1e3, 61)
    etas = (interval.x_norm * np.exp(-gammas[:, None] * passed_s)).min(axis=1)
    for gamma, eta in zip(gammas.tolist(), etas.tolist(), strict=True):
        if eta > 0:
            ratio = (max(zeta, eta) + level) / eta
            found_s = min(found_s, math.log(ratio) / (gamma + min(kappa, alpha_per_s)))
    return found_s


def theorem_1(H: Matrix, alpha_per_s: float, longest_s: Sequence[float]) -> float:
    """Return Theorem 1's Δ (eq:Normec) between two deliveries, or Theorem 3's if H = 0.

    Args:
        H: matrix of the models, (n, n).
        alpha_per_s: α.
        longest_s: δ̄_j for the intervals between the missed events and after them, j = 1 … M−1.

    Returns:
        1 + Σ_k e^{αδ̃_k} sup‖e^{Hτ}‖ over 0 ≤ τ ≤ δ̃_k, with δ̃_k = Σ_{j≥k} δ̄_j.
    """
    delta, identity = 1.0, np.eye(len(H))
    for k in range(len(longest_s)):
        reach_s = math.fsum(longest_s[k:])
        if not math.isfinite(reach_s) or alpha_per_s * reach_s > 700:
            return math.inf
        followed = response_until(H, identity, reach_s, _CELLS)
        delta += math.exp(alpha_per_s * reach_s) * float(followed.through(identity).sup_on_grid())
    return delta
