"""How large a reference is, how fast it changes, and from when on it jumps.

All limits are of the time until x_r first jumps. A polynomial is bounded on short parts of its
segment, on each by the sum of its coefficients about the part's begin; a wave by its amplitude.
"""

import math
from bisect import bisect_right

import numpy as np

from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix, Vector
from noack.core.references import Reference, ReferenceSegment

_PARTS = 64
"""Parts of a segment on which a polynomial of a degree above 1 is bounded."""
_ROUNDING = 1e-9
"""A difference between two segments is rounding up to this share of the largest x_r or u_r."""


class ReferenceLimits:
    """Limits of a reference of n states and m inputs, from the begin of a run to the first jump of x_r."""

    def __init__(self, reference: Reference, horizon_ns: int) -> None:
        self._n = reference.n
        ends_ns = [*reference.since_ns, horizon_ns]
        self._parts: list[tuple[ReferenceSegment, float]] = []
        self._steps: list[tuple[float, Vector]] = []
        """When x_r goes on with another u_r, in s, and the difference."""
        self.jump_s: float | None = None
        """When x_r first jumps; None: never."""
        for place, (segment, end_ns) in enumerate(zip(reference.segments, ends_ns, strict=True)):
            begin_ns = segment.begin_ns
            if begin_ns >= horizon_ns:
                break
            if place:
                before, _ = self._parts[-1]
                left, right = before.at((begin_ns - before.begin_ns) * 1e-9), segment.at(0.0)
                step, size = np.abs(right - left), max(float(np.abs([left, right]).max()), self._size)
                if (step[: self._n] > _ROUNDING * size).any():
                    self.jump_s = begin_ns / NS_PER_S
                    break
                if (step > _ROUNDING * size).any():
                    self._steps.append((begin_ns / NS_PER_S, step))
            self._parts.append((segment, (min(end_ns, horizon_ns) - begin_ns) * 1e-9))

    @property
    def _size(self) -> float:
        return float(max(np.abs(part.polynomial[0]).max() for part, _ in self._parts))

    def largest(self, M: Matrix) -> Vector:
        """Return the largest |M [x_r; u_r]|, (rows of M,)."""
        return np.asarray(
            np.max([_largest(_image(part, M), length_s) for part, length_s in self._parts], axis=0)
        )

    def largest_change(self, within_s: float) -> Vector:
        """Return the largest change of x_r and u_r within a time, (n + m,)."""
        rates = [_largest(_derivative(part), length_s) for part, length_s in self._parts]
        changes = within_s * np.max(rates, axis=0)
        if not self._steps:
            return np.asarray(changes)
        times_s = [at_s for at_s, _ in self._steps]
        together = [
            np.sum([step for _, step in self._steps[i : bisect_right(times_s, at_s + within_s)]], axis=0)
            for i, at_s in enumerate(times_s)
        ]
        return np.asarray(changes + np.max(together, axis=0))

    def residual(self, A: Matrix, B: Matrix) -> Vector:
        """Return the largest |A x_r + B u_r − dx_r/dt|, (n,): rounding, or that of a curve between rows."""
        n, AB = self._n, np.hstack([A, B])
        worst = np.zeros(n)
        for part, length_s in self._parts:
            flow, slope = _image(part, AB), _derivative(part)
            polynomial = flow.polynomial - slope.polynomial[:, :n]
            sines, cosines = flow.sines - slope.sines[:, :n], flow.cosines - slope.cosines[:, :n]
            rest = ReferenceSegment(0, polynomial, part.hz, sines, cosines)
            worst = np.maximum(worst, _largest(rest, length_s))
        scale = _ROUNDING * np.abs(AB) @ self.largest(np.eye(AB.shape[1]))
        return np.where(worst > scale, worst, 0.0)

    def is_at_rest_until(self, t_s: float) -> bool:
        """Whether u_r is 0 up to a time."""
        for part, _ in self._parts:
            inputs = np.vstack([part.polynomial, part.sines, part.cosines])[:, self._n :]
            if part.begin_ns < t_s * NS_PER_S and inputs.any():
                return False
        return True


def _image(part: ReferenceSegment, M: Matrix) -> ReferenceSegment:
    return ReferenceSegment(0, part.polynomial @ M.T, part.hz, part.sines @ M.T, part.cosines @ M.T)


def _derivative(part: ReferenceSegment) -> ReferenceSegment:
    """Return the derivative, with as many coefficients."""
    powers, omega = np.arange(1, len(part.polynomial))[:, None], 2 * math.pi * part.hz[:, None]
    polynomial = np.vstack([powers * part.polynomial[1:], np.zeros((1, part.polynomial.shape[1]))])
    return ReferenceSegment(0, polynomial, part.hz, -omega * part.cosines, omega * part.sines)


def _largest(part: ReferenceSegment, length_s: float) -> Vector:
    """Return a bound of the absolute values on a segment."""
    count = _PARTS if np.any(part.polynomial[2:]) else 1
    step_s, degree = length_s / count, len(part.polynomial)
    largest = np.zeros(part.polynomial.shape[1])
    if count == 1 and degree > 1:  # linear: at one of both ends
        end = part.polynomial[0] + length_s * part.polynomial[1]
        largest = np.maximum(np.abs(part.polynomial[0]), np.abs(end))
    else:
        sizes, powers = step_s ** np.arange(degree), range(degree)
        for begin in range(count):
            # The coefficients about the begin of the part: Σ_j C(j, k) t^{j−k} c_j.
            t_s = begin * step_s
            shift = np.array([
                [math.comb(j, k) * t_s ** (j - k) if j >= k else 0.0 for j in powers] for k in powers
            ])  # fmt: skip
            largest = np.maximum(largest, sizes @ np.abs(shift @ part.polynomial))
    waves = np.hypot(part.sines, part.cosines).sum(axis=0)
    return np.asarray(largest + waves)
