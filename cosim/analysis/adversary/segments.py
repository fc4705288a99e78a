"""Computes segments: from each of many states to its next event, with the objective's value.

Cells, polynomials and crossings are those of :mod:`cosim.simulation.continuous.continuous_loop`;
here they are computed for all states at once.

Within a cell an output y of the loop is a polynomial of degree 18, up to rounding. The integral of
|y|² is computed by a Gauss–Legendre rule that is exact for this degree. The supremum is searched at
17 points. From every point that is higher than its neighbours and close to the maximum, Newton's
method refines it to rounding. The supremum can be missed only if |y|² has two maxima within 1/16 of
a cell. Then the slope has three zeros there, and |y|² varies by at most 1e-6 of its fourth
derivative, per cell.
"""

import math

import numpy as np

from cosim.analysis.adversary.objective import Measure, Objective, weight_of
from cosim.analysis.adversary.pattern_flow import Flags, Segments
from cosim.analysis.adversary.polynomial_curves import Stack, curve_stack, peak_squares, powers
from cosim.simulation.continuous.continuous_loop import ContinuousLoop
from cosim.simulation.continuous.exact_flow import DEGREE, taylor_terms
from noack.core.linear_systems import Matrix, Vector

_LARGEST = 1e100
_SLACK = 1e-13
_POINTS = np.linspace(0.0, 1.0, 17)
_GRAMIAN_POINTS = 12
_CLOSE = 0.95
"""A sampled |y|² next to a maximum is at least this share of it; lower points are not refined."""


class OutputCurve:
    """An output at fixed points, shares of parts of cells.

    Its Taylor coefficients over a cell are ``taylor``, (p + 1, q, 3n).
    """

    def __init__(self, taylor: Stack, points: Vector) -> None:
        self._q, self._points = taylor.shape[1], len(points)
        self._at_points = powers(points, DEGREE)
        self._taylor = _columns(taylor)
        self._whole = _columns(np.tensordot(self._at_points, taylor, 1))

    def taylor(self, z: Matrix, u: Vector) -> Stack:
        """Return y's coefficients over [0, u] of the cell, rescaled to [0, 1]; (N, p + 1, q)."""
        whole = (z @ self._taylor).reshape(len(z), DEGREE + 1, self._q)
        return np.asarray(whole * powers(u, DEGREE)[:, :, None])

    def squares(self, z: Matrix, u: Vector) -> Stack:
        """Return |y|² at the points, (N, points)."""
        y = np.empty((len(z), self._points, self._q))
        whole = u == 1.0
        y[whole] = (z[whole] @ self._whole).reshape(-1, self._points, self._q)
        y[~whole] = self._at_points @ self.taylor(z[~whole], u[~whole])
        return np.asarray(np.einsum("aki,aki->ak", y, y))


class Supremum(OutputCurve):
    """The supremum of |y| over parts of cells."""

    def __init__(self, taylor: Stack) -> None:
        super().__init__(taylor, _POINTS)

    def __call__(self, z: Matrix, u: Vector, known: Vector) -> Vector:
        """Return the suprema over [0, u] of cells, (N,), that start at scaled states z, (N, 3n).

        Results below ``known``, (N,), may be inaccurate.
        """
        squares = self.squares(z, u)
        highest = np.asarray(squares.max(axis=1))
        lowest = _CLOSE * np.maximum(highest, np.maximum(known, 0.0) ** 2)
        around = np.pad(squares, ((0, 0), (1, 1)))
        peak = (squares >= around[:, :-2]) & (squares >= around[:, 2:])
        rows, points = np.nonzero(peak & (squares >= lowest[:, None]))
        if len(rows):
            taylor = self.taylor(z[rows], u[rows])
            np.maximum.at(highest, rows, peak_squares(taylor, _POINTS[points], _POINTS[1]))
        return np.asarray(np.sqrt(highest))


class SquareIntegral(OutputCurve):
    """The integral of |y|² over parts of cells of a width in seconds."""

    def __init__(self, taylor: Stack, width_s: float) -> None:
        points, weights = np.polynomial.legendre.leggauss(DEGREE + 1)
        super().__init__(taylor, (points + 1) / 2)
        self._weights = width_s * weights / 2

    def __call__(self, z: Matrix, u: Vector, known: Vector | None = None) -> Vector:
        """Return the integrals over [0, u] of cells, (N,), that start at states z, (N, 3n)."""
        return np.asarray(u * (self.squares(z, u) @ self._weights))


def _columns(terms: Stack) -> Matrix:
    """Return terms (p, q, N) as a matrix (N, p q), the right factor for states in rows."""
    return np.ascontiguousarray(terms.reshape(-1, terms.shape[2]).T)


class SegmentFlow:
    """Follows states to their next events, at most to the horizon.

    With ``known_start``, sensor and controller start from x(0), so there is no event at t = 0.
    """

    def __init__(
        self, system: ContinuousLoop, measure: Measure, horizon_s: float, *, known_start: bool
    ) -> None:
        self.system, self.measure, self.horizon_s = system, measure, horizon_s
        self.known_start = known_start
        trigger = system.decaying
        self._gramians: dict[float, Matrix] = {}
        self._floor_from_s = math.inf
        if trigger.floor > 0:
            self._floor_from_s = math.log(trigger.beta / trigger.floor) / trigger.alpha_per_s
        late_rate = 0.0 if measure.floor else measure.rate_per_s
        self._decaying = _Phase(system, measure, trigger.alpha_per_s, measure.rate_per_s)
        self._floored = _Phase(system, measure, 0.0, late_rate)

    @property
    def objective(self) -> Objective:
        """The objective."""
        return self.measure.objective

    def start(self) -> Segments:
        """As :meth:`PatternFlow.start`: sensor and controller have x(0)."""
        x0, zero = self.system.loop.x0, np.zeros(1)
        z = np.concatenate([x0, np.zeros(2 * len(x0))])[None]
        return Segments(zero, z, zero > 0, zero + self.objective.nothing)

    def after_events(self, t_s: Vector, z: Matrix, delivered: Flags) -> Matrix:
        """As :meth:`PatternFlow.after_events`: e_s ← 0, and e_c ← 0 if the update arrives."""
        z, n = z.copy(), z.shape[1] // 3
        z[:, n : 2 * n] = 0.0
        z[delivered, 2 * n :] = 0.0
        return z

    def features(self, t_s: Vector, z: Matrix) -> Matrix:
        """As :meth:`PatternFlow.features`."""
        scaled = z / self.measure.level(t_s)[:, None]
        return np.asarray(scaled / (np.abs(scaled).max() or 1.0))

    def promise(self, t_s: Vector, z: Matrix, window_s: float) -> Vector:
        """As :meth:`PatternFlow.promise`: the integral of the output's square."""
        if window_s not in self._gramians:
            self._gramians[window_s] = _gramian(self.system, self.measure, window_s)
        scaled = z / self.measure.level(t_s)[:, None]
        return np.asarray(np.einsum("ai,ij,aj->a", scaled, self._gramians[window_s], scaled))

    def __call__(self, t_s: Vector, z: Matrix, known: float = -math.inf) -> Segments:
        """As :meth:`PatternFlow.__call__`, with z = (x, e_s, e_c), (N, 3n)."""
        measure, nothing = self.measure, np.full(len(t_s), self.measure.objective.nothing)
        found = Segments(t_s.copy(), z.copy(), np.zeros(len(t_s), bool), nothing)
        first_until_s = min(self._floor_from_s, self.horizon_s)
        for phase, from_s, until_s in (
            (self._decaying, -math.inf, first_until_s),
            (self._floored, self._floor_from_s, self.horizon_s),
        ):
            now = (found.end_s >= from_s) & (found.end_s < until_s) & ~found.is_event
            these = np.flatnonzero(now & (found.value < math.inf))
            part = phase.follow(found.end_s[these], found.z[these], until_s, known)
            found.value[these] = measure.objective.joined(found.value[these], part.value)
            found.end_s[these], found.z[these], found.is_event[these] = part[:3]
        if measure.output is None:
            between_events = found.is_event & ((t_s > 0) | (not self.known_start))
            return found._replace(value=np.where(between_events, t_s - found.end_s, -math.inf))
        return found


class _Phase:
    """An interval with exponential decay of threshold and level, at ``alpha`` and ``rate``."""

    def __init__(
        self, system: ContinuousLoop, measure: Measure, alpha_per_s: float, rate_per_s: float
    ) -> None:
        n, generator = system.loop.n, system.generator
        self._system, self._measure = system, measure
        self._alpha_per_s, self._rate_per_s = alpha_per_s, rate_per_s
        self._width_s = system.flow.width_s
        self._across = system.flow.powers[1].T
        self._curves = curve_stack(DEGREE)
        self._state = _columns(taylor_terms(generator, self._width_s))
        identity = np.eye(3 * n)
        scaled = taylor_terms(generator + alpha_per_s * identity, self._width_s)
        error = weight_of(system) @ scaled[:, n : 2 * n]
        self._error = _columns(error)
        self._control = _columns(np.tensordot(self._curves.from_taylor, error, 1))
        self._slack = _SLACK * max(float(np.abs(self._control).sum(axis=0).max()), 1.0)
        self._objective: Supremum | SquareIntegral | None = None
        if measure.output is not None:
            terms = taylor_terms(generator + rate_per_s * identity, self._width_s)
            output, width_s = measure.output @ terms, self._width_s
            additive = measure.objective.additive
            self._objective = SquareIntegral(output, width_s) if additive else Supremum(output)

    def follow(self, t_s: Vector, z: Matrix, until_s: float, known: float) -> Segments:
        """Follow states at times below ``until_s``."""
        count, width_s, measure = len(t_s), self._width_s, self._measure
        nothing = np.full(count, measure.objective.nothing)
        found = Segments(np.full(count, until_s), z.copy(), np.zeros(count, bool), nothing)
        span, level = (until_s - t_s) / width_s, measure.level(t_s)
        trigger = self._system.decaying
        threshold = np.maximum(trigger.beta * np.exp(-trigger.alpha_per_s * t_s), trigger.floor)
        going, cell = np.arange(count), 0
        while len(going):
            scale = math.exp(self._alpha_per_s * width_s * cell) / threshold[going]
            sane = np.abs(z).max(axis=1) * np.maximum(scale, 1.0) < _LARGEST
            if not sane.all():
                lost = going[~sane]
                found.value[lost], found.end_s[lost] = math.inf, t_s[lost] + cell * width_s
                going, z, scale = going[sane], z[sane], scale[sane]
            until = np.minimum(span[going] - cell, 1.0)
            exits = self._exits(z * scale[:, None])
            crossed = exits <= until
            until[crossed] = exits[crossed]
            these = going[crossed]
            found.is_event[these] = True
            found.end_s[these] = t_s[these] + (cell + until[crossed]) * width_s
            if self._objective is not None:
                scale = math.exp(self._rate_per_s * width_s * cell) / level[going]
                so_far = found.value[going]
                value = self._objective(z * scale[:, None], until, np.maximum(so_far, known))
                found.value[going] = measure.objective.joined(so_far, value)
            ended = crossed | (span[going] <= cell + 1)
            found.z[going[ended]] = self._within(z[ended], until[ended])
            going, z = going[~ended], z[~ended] @ self._across
            cell += 1
        return found

    def _exits(self, scaled: Matrix) -> Vector:
        """Return where W e_s / threshold leaves the unit ball in the cell, (N,); NaN if nowhere."""
        shape = (-1, DEGREE + 1, self._system.loop.n)
        control = (scaled @ self._control).reshape(shape)
        reach = np.einsum("aki,aki->ak", control, control).max(axis=1)
        largest = np.abs(scaled).max(axis=1)
        near = np.flatnonzero(reach > 1.0 - self._slack * (1.0 + largest))
        exits = np.full(len(scaled), np.nan)
        exits[near] = self._curves.first_exits((scaled[near] @ self._error).reshape(shape))
        return exits

    def _within(self, z: Matrix, u: Vector) -> Matrix:
        """Return the state at position u ∈ [0, 1] of the cell."""
        terms = (z @ self._state).reshape(len(z), DEGREE + 1, z.shape[1])
        return np.asarray(np.einsum("ak,aki->ai", powers(u, DEGREE), terms))


def _gramian(system: ContinuousLoop, measure: Measure, window_s: float) -> Matrix:
    """Return ∫₀^window e^{Gᵀs} Cᵀ C e^{Gs} ds, scaled like the objective; CᵀC for event times."""
    n = system.loop.n
    if measure.output is None:  # the initial speed of e_s
        speed = weight_of(system) @ system.generator[n : 2 * n]
        return np.asarray(speed.T @ speed)
    from scipy.linalg import expm

    generator = system.generator + measure.rate_per_s * np.eye(3 * n)
    points, weights = np.polynomial.legendre.leggauss(_GRAMIAN_POINTS)
    total = np.zeros_like(generator)
    for s, weight in zip((points + 1) / 2 * window_s, weights / 2 * window_s, strict=True):
        y = measure.output @ expm(generator * s)
        total += weight * (y.T @ y)
    return total
