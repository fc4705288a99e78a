"""Bounds of a scenario's disturbances and noise, and of the estimation error that they cause.

They act as long as the run lasts. Normally distributed values have no bound, so bounds are assumed
for each of them, and for their sums in the state and in the estimation error. A run exceeds any of
these bounds with at most the probability ``certificate.exceedance_probability``: each of them with
that probability divided by their number.

With an observer of gains L_k, and s steps of the plant between two measurements, e = x̂ − x is

    e_k = (I − L_k C)(Âˢ e_{k−1} + Σ_i Âⁱ d_{k,i}) + L_k v_k,    e_0 from the first estimate
    d   = (Â − A) x + (B̂ − B) u − B w_u − G w_x                   (discrete-time matrices, a step)

Normal sources make a normal error, whose covariance is computed. The gains do not depend on data:
those of a Kalman filter are computed until they have settled. The sum over all past sources of ‖W
Φ(k, j) S‖ is largest at some k; beyond the computed ones it is bounded in a norm in which (I − L C)
Âˢ contracts. Without an observer x̂ = y and e = v.
"""

import math
import warnings
from functools import cached_property
from itertools import islice
from typing import NamedTuple

import numpy as np

from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix, discretise
from noack.scenario.estimation import assumed_model
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from noack.theory.bounds.certificate_terms import EstimationBound
from noack.theory.bounds.enclosure import NotDecayingError, factors
from noack.theory.bounds.gains import Forcing, NormalForcing, stationary_covariance
from noack.theory.bounds.stacked_norms import (
    Stack,
    product_along_last,
    spectral_norm,
    spectral_norms_along_last,
)

MISMATCH = "Â − A"
"""Name of the output by which the plant's steps differ from the model's."""
_MOST_GAINS, _SETTLED = 1500, 1e-9
"""Maximum number of gains of an observer, and the relative change at which they have settled."""
_MOST_STEPS, _TAIL_SHARE = 100_000, 1e-4
"""Maximum number of measurements over which sources are summed, and largest share of the remainder."""
_ENTRIES = 100_000
"""Entries of the effects that are computed together."""
_ROUNDING = 1 + 1e-6
"""Exceeds the rounding of sums over up to 100,000 measurements, as estimated."""


class NormalBounds(NamedTuple):
    """Bounds of normal values that a run exceeds with at most some probability."""

    probability: float
    """The probability that one value exceeds its bound."""

    def radius(self, size: int) -> float:
        """Return the bound of ‖v‖ for independent standard normal values v, (size,)."""
        # Imported here because the import is slow.
        from scipy.special import chdtri

        return math.sqrt(float(chdtri(size, self.probability)))

    @property
    def limit(self) -> float:
        """The bound of a single value."""
        return self.radius(1)


def normal_bounds(resolved: Scenario) -> NormalBounds | None:
    """Return the bounds for a run; None if nothing is normally distributed."""
    timing, plant = resolved.timing, resolved.plant
    values = sum(int(disturbance.deviations().any(axis=0).sum()) for disturbance in plant.disturbances)
    noisy = any(plant.measurement.noise_std or ())
    if not values and not noisy:
        return None
    # At each step the values, their sum in x, and the estimation error.
    steps = timing.last_step + 1
    return NormalBounds(resolved.certificate.exceedance_probability / (steps * (values + 2)))


def excluded_probability(resolved: Scenario) -> float:
    """Return the largest probability that a run exceeds the bounds of normal values."""
    return 0.0 if normal_bounds(resolved) is None else resolved.certificate.exceedance_probability


def bound_forcing(resolved: Scenario, B: Matrix) -> Forcing | None:
    """Return the disturbances of a plant with the input matrix B, (n, m); None if it has none."""
    disturbances = resolved.plant.disturbances
    if not disturbances:
        return None
    bounds = normal_bounds(resolved)
    period_s = resolved.timing.plant_period_ns / NS_PER_S
    n, m = B.shape
    columns, durations_s = [np.zeros((n, 0))], list[float]()
    normal = [np.zeros((n, 0))]
    at_input = np.zeros(m)
    for disturbance in disturbances:
        extent, deviations = disturbance.extent(), disturbance.deviations()
        if disturbance.at == "input":
            at_input = at_input + np.abs(extent).sum(axis=1)
            if bounds is not None:
                at_input = at_input + bounds.limit * np.abs(deviations).sum(axis=1)
            extent, deviations = B @ extent, B @ deviations
        extent = extent[:, extent.any(axis=0)]
        columns.append(extent)
        normal.append(deviations[:, deviations.any(axis=0)])
        # The last step begins before the end.
        durations_s += [disturbance.duration_s + period_s] * extent.shape[1]
    D = np.hstack(normal)
    of_normal = None
    if bounds is not None and D.size:
        of_normal = NormalForcing(D, period_s, bounds.limit, bounds.radius(n))
    return Forcing(np.hstack(columns), np.array(durations_s), at_input, of_normal)


class EstimationError:
    """The estimation error of a resolved scenario whose plant is A (n, n), B (n, m)."""

    def __init__(self, resolved: Scenario, A: Matrix, B: Matrix, forcing: Forcing | None) -> None:
        loop, period_ns = loop_of(resolved), resolved.timing.plant_period_ns
        self._loop, self._resolved = loop, resolved
        self._weight = np.eye(loop.n) if loop.weight is None else loop.weight
        self._period_s = period_ns / NS_PER_S
        self._noise_deviations, self._noise = resolved.plant.measurement.noise(loop.n)
        self._model = model = assumed_model(resolved)
        Ad, Bd = discretise(A, B, period_ns)
        n = loop.n
        self._state_increments = self._normal_increments = np.zeros((n, 0))
        if forcing is not None:
            self._state_increments = discretise(A, forcing.columns, period_ns)[1]
            if forcing.normal is not None:
                self._normal_increments = discretise(A, forcing.normal.columns, period_ns)[1]
        input_basis, _ = factors(loop.K)
        self._from_input = (model.Bd - Bd) @ input_basis
        self._from_state, self.output = factors(model.Ad - Ad + (model.Bd - Bd) @ loop.K)

    @property
    def further_outputs(self) -> dict[str, Matrix]:
        """The matrix C of which the bounds use sup‖C x‖."""
        return {} if self._resolved.observer is None else {MISMATCH: self.output}

    def decaying(self, alpha_per_s: float) -> EstimationBound:
        """Return the bound of the part from the start, scaled by e^{αt}.

        At the start there is the first estimate, and the gains have not settled.

        Raises:
            NotDecayingError: the estimation error decays more slowly.
        """
        observer, loop = self._resolved.observer, self._loop
        if observer is None:
            return EstimationBound()
        known = self._resolved.network.initial_sync == "known_state"
        initial_estimate = loop.known_x0 if known else np.zeros(loop.n)
        if observer.initial_estimate is not None:
            initial_estimate = np.array(observer.initial_estimate)
        start = (self._correction[0] @ (initial_estimate - loop.x0))[None, :, None]
        nothing = np.zeros((len(self._gains), 0, loop.n, 1))
        fixed = self._peak(nothing, alpha_per_s, start)
        for sources, peak in zip(self._persistent_sources, self._settled_peaks, strict=True):
            fixed += self._excess(sources, peak, alpha_per_s)
        if self._radius:
            fixed += self._radius * self._excess_deviation(alpha_per_s)
        return self._with_model_error(fixed, alpha_per_s)

    def persistent(self) -> EstimationBound:
        """Return the bound of the part from noise and disturbances, when the gains have settled.

        Raises:
            NotDecayingError: the estimation error does not decay.
        """
        W = self._weight
        if self._resolved.observer is None:
            spread = float(np.linalg.norm(W * self._noise_deviations, 2))
            fixed = float(np.linalg.norm(np.abs(W) @ self._noise)) + self._radius * spread
            return EstimationBound(fixed)
        fixed = sum(self._settled_peaks)
        spread = float(np.linalg.norm(W @ self._settled_covariance @ W.T, 2))
        fixed += self._radius * np.sqrt(spread) * _ROUNDING
        return self._with_model_error(fixed, 0.0)

    @cached_property
    def _radius(self) -> float:
        """Bound of ‖v‖ for n standard normal values v, of which e is a linear function; 0 if not needed."""
        bounds = normal_bounds(self._resolved)
        return 0.0 if bounds is None else bounds.radius(self._loop.n)

    @cached_property
    def _persistent_sources(self) -> list[Stack]:
        """The effects of bounded noise and of each bounded disturbance on the measurements."""
        effects = [self._sources(column[:, None], 0.0) for column in self._state_increments.T]
        if self._noise.any():
            effects.append((self._gains * self._noise).transpose(0, 2, 1)[..., None])
        return effects

    @cached_property
    def _settled_peaks(self) -> list[float]:
        """The largest sum of these effects when the gains have settled."""
        return [self._peak(sources[-2:], 0.0) for sources in self._persistent_sources]

    @cached_property
    def _covariances(self) -> list[tuple[Matrix, Matrix]]:
        """F_k, and the covariance of what each measurement adds to e."""
        sources, covariances = self._sources(self._normal_increments, 0.0), []
        for k, L in enumerate(self._gains):
            effect, noise = np.hstack([*sources[k]]), L * self._noise_deviations
            covariances.append((self._correction[k] @ self._between, effect @ effect.T + noise @ noise.T))
        return covariances

    @cached_property
    def _settled_covariance(self) -> Matrix:
        F, added = self._covariances[-1]
        _contraction(F)
        return stationary_covariance(F, added)

    def _excess_deviation(self, alpha_per_s: float) -> float:
        """Return sup_k of the root of ‖W (P_k − P_∞) Wᵀ‖, scaled."""
        W, settled = self._weight, self._settled_covariance
        growth = self._growth(alpha_per_s)
        P, scale, largest = np.zeros_like(settled), 1 / growth, 0.0
        for F, added in self._covariances:
            P, scale = F @ P @ F.T + added, scale * growth
            above = float(np.linalg.eigvalsh(W @ (P - settled) @ W.T).max())
            largest = max(largest, scale * np.sqrt(max(above, 0.0)))
        # From then on P − P_∞ follows F.
        factor, _ = _contraction(growth * F)
        output_gain = float(np.linalg.norm(W @ np.linalg.inv(factor), 2))
        beyond = float(np.linalg.norm(factor @ (P - settled) @ factor.T, 2))
        return float(max(largest, scale * output_gain * np.sqrt(beyond)) * _ROUNDING)

    def _growth(self, alpha_per_s: float) -> float:
        """e^{αT}, T the time between two measurements."""
        return float(np.exp(alpha_per_s * self._period_s * self._model.steps))

    def _with_model_error(self, fixed: float, alpha_per_s: float) -> EstimationBound:
        gains = [
            self._peak(self._sources(columns, alpha_per_s), alpha_per_s) if columns.any() else 0.0
            for columns in (self._from_state, self._from_input)
        ]
        return EstimationBound(fixed, {MISMATCH: gains[0]}, gains[1])

    @cached_property
    def _gains(self) -> Stack:
        """L_k until it has settled, (k, n, p).

        Raises:
            NotDecayingError: it does not settle in ``_MOST_GAINS`` measurements.
        """
        assert self._resolved.observer is not None
        gains: list[Matrix] = []
        for L in islice(self._resolved.observer.gains(self._model), _MOST_GAINS):
            if gains:
                changed, least = np.abs(L - gains[-1]).max(), _SETTLED * np.abs(L).max()
                if changed <= least and changed <= least * (1 - self._spectral_radius(L)):
                    return np.array([*gains, L])
            gains.append(L)
        raise NotDecayingError(f"the observer's gain changes for {_MOST_GAINS} measurements")

    def _spectral_radius(self, L: Matrix) -> float:
        F = (np.eye(len(L)) - L @ self._model.C) @ self._between
        return float(min(np.abs(np.linalg.eigvals(F)).max(), 1.0))

    @cached_property
    def _between(self) -> Matrix:
        return np.linalg.matrix_power(self._model.Ad, self._model.steps)

    @cached_property
    def _correction(self) -> Stack:
        """I − L_k C, (k, n, n)."""
        return np.eye(self._loop.n) - self._gains @ self._model.C

    def _sources(self, columns: Matrix, alpha_per_s: float) -> Stack:
        """Return the effects of the steps before each measurement on it, (k, steps, n, r)."""
        effects, power = [], columns
        for i in range(self._model.steps):
            effects.append(np.exp(alpha_per_s * self._period_s * (i + 1)) * power)
            power = self._model.Ad @ power
        return np.asarray(self._correction[:, None] @ np.array(effects))

    def _steps(self, alpha_per_s: float) -> Stack:
        return np.asarray(self._growth(alpha_per_s) * self._correction @ self._between)

    def _peak(self, sources: Stack, alpha_per_s: float, start: Stack | None = None) -> float:
        """Return sup_k Σ_j ‖W Φ(k, j) S_j‖, scaled; the last gain and source apply from then on."""
        steps, W = self._steps(alpha_per_s)[-len(sources) :], self._weight
        old = sources[0] if start is None else np.concatenate([start, sources[0]])
        sums, old = _accumulated(W, _last_axis(old), steps[1:-1], sources[1:-1])
        factor, rate = _contraction(steps[-1])
        output_gain = spectral_norm(W @ np.linalg.inv(factor))
        last, total, largest = _last_axis(sources[-1]), 0.0, sums.max()
        powers = _powers(steps[-1], min(_ENTRIES // max(old.size, last.size) + 1, 256))
        transformed = factor @ powers[1:]

        def bound_remainders(powers: slice) -> Stack:
            by_new = _sums(transformed[powers], last) / (1 - rate)
            return np.asarray(output_gain * (by_new + _sums(transformed[powers], old)))

        for _ in range(_MOST_STEPS // len(transformed)):
            # The same for every number of further measurements, (powers,).
            totals = total + np.cumsum(_sums(W @ powers[:-1], last))
            sums = _sums(W @ powers[1:], old) + totals
            largest_so_far = np.maximum.accumulate(np.maximum(sums, largest))
            last_remainder = bound_remainders(slice(-1, None))[0]
            if last_remainder <= _TAIL_SHARE * largest_so_far[-1]:  # the remainders fall
                remainders = bound_remainders(slice(None))
                first_small = np.argmax(remainders <= _TAIL_SHARE * largest_so_far)
                return float((largest_so_far[first_small] + remainders[first_small]) * _ROUNDING)
            total, largest = totals[-1], largest_so_far[-1]
            old, last = product_along_last(powers[-1], old), product_along_last(powers[-1], last)
        return float((largest + last_remainder) * _ROUNDING)

    def _excess(self, sources: Stack, total: float, alpha_per_s: float) -> float:
        """Return sup_k of Σ_j ‖W Φ(k, j) S_j‖ minus the total for settled gains, scaled."""
        if len(sources) == 2:  # settled from the start on
            return 0.0
        growth, steps, W = self._growth(alpha_per_s), self._steps(0.0), self._weight
        sums, old = _accumulated(W, _last_axis(sources[0]), steps[1:-1], sources[1:-1])
        powers, new = _powers(steps[-1], len(sources) - 2), _last_axis(sources[-1])
        settled = np.concatenate([product_along_last(power, new) for power in powers[::-1]], axis=2)
        scales = growth ** np.arange(len(sums))
        # From then on the effects of these sources, and those with settled gains, follow F.
        factor, _ = _contraction(growth * steps[-1])
        output_gain = spectral_norm(W @ np.linalg.inv(factor))
        unsettled = spectral_norms_along_last(product_along_last(factor, old - settled))
        remainder = scales[-1] * output_gain * unsettled.sum()
        return float(max((scales * (sums - total)).max(), remainder, 0.0) * _ROUNDING)


def _last_axis(sources: Stack) -> Stack:
    """Return matrices along the last axis instead of the first, (k, n, r) → (n, r, k)."""
    return np.ascontiguousarray(sources.transpose(1, 2, 0))


def _accumulated(C: Matrix, old: Stack, steps: Stack, sources: Stack) -> tuple[Stack, Stack]:
    """Follow effects S, (n, r, j), through steps, each of which adds further sources.

    Returns:
        Σ‖C S‖ before and after each step, (steps + 1,), and all effects at the end.
    """
    pending, sums = [old], []
    for step, new in zip(steps, sources, strict=True):
        old = np.concatenate([product_along_last(step, old), _last_axis(new)], axis=2)
        pending.append(old)
        if len(pending) * old.size > _ENTRIES:
            sums.append(_add_norms(C, pending))
            pending = []
    return np.concatenate([*sums, _add_norms(C, pending)]), old


def _add_norms(C: Matrix, effects: list[Stack]) -> Stack:
    """Return Σ‖C S‖ over each of several numbers of S, (n, r, j) each."""
    if not effects:
        return np.zeros(0)
    counts = np.cumsum([0, *(effect.shape[2] for effect in effects[:-1])])
    norms = spectral_norms_along_last(product_along_last(C, np.concatenate(effects, axis=2)))
    return np.asarray(np.add.reduceat(norms, counts))


def _sums(matrices: Stack, effects: Stack) -> Stack:
    """Return Σ‖C S‖ over S, (n, r, j), for each C, (k, q, n) → (k,)."""
    k, q, n = matrices.shape
    products = matrices.reshape(-1, n) @ effects.reshape(n, -1)
    values = products.reshape(k, q, *effects.shape[1:]).transpose(1, 2, 0, 3)
    norms = spectral_norms_along_last(values.reshape(*values.shape[:2], -1))
    return np.asarray(norms.reshape(k, -1).sum(axis=1))


def _powers(step: Matrix, count: int) -> Stack:
    """Return the powers 0 … count of a matrix, (count + 1, n, n)."""
    powers = [np.eye(len(step))]
    for _ in range(count):
        powers.append(step @ powers[-1])
    return np.array(powers)


def _contraction(step: Matrix) -> tuple[Matrix, float]:
    """Return T and ν < 1 with ‖T F T⁻¹‖ ≤ ν.

    Raises:
        NotDecayingError: there is none.
    """
    from scipy.linalg import solve_discrete_lyapunov  # slow to import

    reason = "the observer's error does not decay as fast as the bounds"
    if not np.abs(np.linalg.eigvals(step)).max() < 1:
        raise NotDecayingError(reason)
    try:
        with warnings.catch_warnings(action="ignore"):  # of an inaccurate P, which is checked
            P = solve_discrete_lyapunov(step.T, np.eye(len(step)))
        factor = np.linalg.cholesky(0.5 * (P + P.T)).T
    except (np.linalg.LinAlgError, ValueError):
        raise NotDecayingError(reason) from None
    rate = float(np.linalg.norm(factor @ step @ np.linalg.inv(factor), 2)) * (1 + 1e-9)
    if not rate < 1:
        raise NotDecayingError(reason)
    return np.asarray(factor), rate
