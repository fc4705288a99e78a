"""The gains of a Kalman filter with measurements an exact time apart: they are the same in all runs.

With the covariance P before a measurement and L(P) = P Cᵀ (C P Cᵀ + R)⁻¹, that before the next one is

    ric(P) = Φ ((I − LC) P (I − LC)ᵀ + L R Lᵀ) Φᵀ + Q_T,   Φ = e^{AT}.

L(P) makes the inner matrix the least one, in the order of quadratic forms. For a fixed L it is monotone in P.
So ric is monotone where C P Cᵀ + R is positive definite: a lower and an upper matrix, rounded outwards at
each step, enclose P. If ric(P̄ + X) ≤ P̄ + X and ric(P̄ − X) ≥ P̄ − X, all later P are between both.
"""

from collections.abc import Sequence
from typing import NamedTuple, Self

from flint import arb, arb_mat

from noack_check.balls import around_zero, identity, is_positive, transpose, zeros
from noack_check.keys import RefusedError

_MOST_GAINS = 1000
"""Gains at more measurements than these have to be within one ball."""
_CONSTANT = 1e-6
"""Half-width of this ball, as a share of :meth:`KalmanFilter.scale`."""
ROUNDED = 1e-8
"""noack's gains differ by at most this share from exact ones."""
_FIRST_TRY, _NEXT_TRY = 1e-6, 0.2
"""Changes of P in a step, as a share of it, at which X is tried."""
_LEAST = 1e-30
"""X is at least such a share of P̄."""
_MOST_DOUBLINGS = 40


class _Step(NamedTuple):
    """What happens to P in a time: P becomes Φ P Φᵀ + Q."""

    flow: arb_mat
    added: arb_mat

    def then(self, other: Self) -> "_Step":
        """Return the step of both times."""
        flow = other.flow
        return _Step(flow * self.flow, flow * self.added * transpose(flow) + other.added)


class KalmanFilter:
    """The filter of a model, in balls.

    Args:
        flow: e^{Ah} of a step of the plant, (n, n).
        added: covariance of the noise in such a step, (n, n).
        steps: of the plant, from one measurement to the next one.
        C: (p, n).
        R: covariance of the noise of measurements, (p, p).
        start: covariance before the first measurement, (n, n).

    Raises:
        RefusedError: matrices do not fit, or a covariance is not symmetric.
    """

    def __init__(
        self, flow: arb_mat, added: arb_mat, steps: int, C: arb_mat, R: arb_mat, start: arb_mat
    ) -> None:
        n, p = flow.nrows(), C.nrows()
        for key, M, size in (("Q", added, n), ("R", R, p), ("initial_std", start, n)):
            if (M.nrows(), M.ncols()) != (size, size):
                raise RefusedError(f"observer.{key}: not of {size} rows and columns")
            if not M.overlaps(transpose(M)):
                raise RefusedError(f"observer.{key}: not symmetric")
        self._n, self._C, self._R, self._start = n, C, _symmetric(R), start
        step, power = _Step(identity(n), zeros(n, n)), _Step(flow, _symmetric(added))
        for bit in range(steps.bit_length()):
            step, power = step.then(power) if steps >> bit & 1 else step, power.then(power)
        self._step = step

    def gains(self) -> tuple[arb_mat, ...]:
        """Return L at the first measurements, in balls, of which the last one has those at all later ones.

        Raises:
            RefusedError: they are not proven to become nearly constant.
        """
        found: list[arb_mat] = []
        low = high = self._start
        limit = _FIRST_TRY
        while len(found) < _MOST_GAINS:
            within = _between(low, high)
            if found and self._change(middle := ((low + high) / 2).mid()) < limit:
                limit *= _NEXT_TRY
                if (last := self._later(middle, low, high)) is not None:
                    return (*found, last)
            gain = self._rounded(within, ROUNDED)
            if gain is None:
                break
            found.append(gain)
            low, high = self._enclosed(low, -1), self._enclosed(high, 1)
        raise RefusedError(
            f"observer.kind: the Kalman filter's gains are not proven to be constant after {_MOST_GAINS} "
            "measurements"
        )

    def _rounded(self, P: arb_mat, most: float) -> arb_mat | None:
        """Return L with room for noack's rounding; None if it is not known to a share of its size.

        |L_ij|² ≤ P_ii (S⁻¹)_jj, S = CPCᵀ + R.
        """
        gain, inverse = self._gain(P)
        scale = [[(P[i, i] * inverse[j, j]).sqrt() for j in range(inverse.nrows())] for i in range(self._n)]
        rows = range(self._n)
        balls = arb_mat([[around_zero(ROUNDED * size) for size in row] for row in scale])
        is_near = all(
            gain[i, j].rad() <= most * arb(size.abs_upper()) for i in rows for j, size in enumerate(scale[i])
        )
        return gain + balls if is_near else None

    def _gain(self, P: arb_mat) -> tuple[arb_mat, arb_mat]:
        """Return L(P) and (C P Cᵀ + R)⁻¹."""
        CP = self._C * P
        S = _symmetric(CP * transpose(self._C) + self._R)
        try:
            inverse = S.inv()
        except ZeroDivisionError:
            inverse = None
        if inverse is None or not is_positive(S):
            raise RefusedError("observer.R: C P Cᵀ + R is not proven to be positive definite")
        return transpose(CP) * inverse, inverse

    def _riccati(self, P: arb_mat) -> arb_mat:
        gain, _ = self._gain(P)
        rest = identity(self._n) - gain * self._C
        corrected = rest * P * transpose(rest) + gain * self._R * transpose(gain)
        return _symmetric(self._step.flow * corrected * transpose(self._step.flow) + self._step.added)

    def _enclosed(self, P: arb_mat, sign: int) -> arb_mat:
        """Return an exact matrix below (sign −1) or above ric(P), by the sums of the radii of its rows."""
        following = self._riccati(P)
        enclosed = following.mid()
        for i, row in enumerate(following.tolist()):
            moved = enclosed[i, i] + sign * sum((entry.rad() for entry in row), arb(0))
            enclosed[i, i] = moved.upper() if sign > 0 else moved.lower()
        return enclosed

    def _change(self, P: arb_mat) -> arb:
        """Return by which share of it P changes in a step."""
        change, size = (self._riccati(P) - P).mid(), _sizes(P)
        rows = range(self._n)
        shares = [abs(change[i, j]) / (size[i] * size[j]).sqrt() for i in rows for j in rows]
        return max(shares, key=float)

    def _later(self, P: arb_mat, low: arb_mat, high: arb_mat) -> arb_mat | None:
        """Return L at all later measurements, if ric keeps P from P̄ − X to P̄ + X, and it is there now."""
        X = self._proposed(P)
        try:
            is_kept = (
                all(entry.is_finite() for entry in X.entries())
                and is_positive(P + X - high)
                and is_positive(low - P + X)
                and is_positive(P + X - self._riccati(P + X))
                and is_positive(self._riccati(P - X) - P + X)
            )
            return self._rounded(_between(P - X, P + X), _CONSTANT) if is_kept else None
        except RefusedError:  # X is too large
            return None

    def _proposed(self, P: arb_mat) -> arb_mat:
        """Return Σ Fⁱ D Fⁱᵀ, where D is as large as the change of P; F is what ric multiplies changes by."""
        gain, _ = self._gain(P)
        F = (self._step.flow * (identity(self._n) - gain * self._C)).mid()
        share = 4 * self._n * self._change(P) + _LEAST
        X = share * _diagonal(_sizes(P))
        for _ in range(_MOST_DOUBLINGS):
            X, F = (X + F * X * transpose(F)).mid(), (F * F).mid()
        return _symmetric(X).mid()


def _between(low: arb_mat, high: arb_mat) -> arb_mat:
    """Return a ball of all P from low to high: |P − low|²_ij ≤ D_ii D_jj, where D is their difference."""
    n, D = low.nrows(), high - low
    sizes = [arb(D[i, i].abs_upper()) for i in range(n)]
    return low + arb_mat([[around_zero((a * b).sqrt()) for a in sizes] for b in sizes])


def _symmetric(M: arb_mat) -> arb_mat:
    return (M + transpose(M)) / 2


def _diagonal(entries: Sequence[arb]) -> arb_mat:
    n = len(entries)
    return arb_mat([[entries[i] if i == j else 0 for j in range(n)] for i in range(n)])


def _sizes(P: arb_mat) -> list[arb]:
    """Return the diagonal of P, with a small part of the largest entry where it is nearly 0."""
    entries = [P[i, i].mid() for i in range(P.nrows())]
    least = _LEAST * max(entries, key=float)
    return [entry.max(least) if least > 0 else arb(1) for entry in entries]
