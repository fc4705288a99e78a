"""Bounds of the estimation error e = x̂ − x at the measurements, as the sensor computes x̂.

With an observer of gains L_k, and s steps of the plant between two measurements,

    e_k = (I − L_k C)(Âˢ e_{k−1} + Σ_i Âⁱ d_{k,i}) + L_k v_k,    e_0 from the first estimate
    d   = (Â − A) x + (B̂ − B) u − B w_u − G w_x                   (discrete-time matrices, a step)

Normal sources make a normal error, whose
covariance is computed. The gains do not depend on data: those of a Kalman filter are computed until
they have settled. The
sum over all past sources of ‖W Φ(k, j) S‖ is largest at some k; beyond the computed ones it is
bounded in a norm in which (I − L C) Âˢ contracts. Without an observer x̂ = y and e = v.
"""

from collections.abc import Sequence
from functools import cached_property
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from noack.config.resolution import loop_of
from noack.config.scenario import Scenario
from noack.config.state_estimation import assumed_model
from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix, discretise
from noack.theory.certificate import EstimationBound
from noack.theory.contraction import spectral_norms
from noack.theory.enclosure import NotDecayingError, factors
from noack.theory.gains import Forcing
from noack.theory.persistent_causes import noise_bound, noise_deviations, normal_bounds

Stack = NDArray[np.float64]

MISMATCH = "Â − A"
"""Name of the output by which the plant's steps differ from the model's."""

_MOST_GAINS = 1500
_SETTLED = 1e-9
_MOST_STEPS = 100_000
_TAIL_SHARE = 1e-4
_ENTRIES = 20_000
"""Of the effects that are computed together."""
_ROUNDING = 1 + 1e-6


class EstimationError:
    """The estimation error of a resolved scenario whose plant is A (n, n), B (n, m)."""

    def __init__(self, resolved: Scenario, A: Matrix, B: Matrix, forcing: Forcing | None) -> None:
        loop, period_ns = loop_of(resolved), resolved.timing.plant_period_ns
        self._loop, self._resolved = loop, resolved
        self._weight = np.eye(loop.n) if loop.weight is None else loop.weight
        self._period_s = period_ns / NS_PER_S
        self._noise = noise_bound(resolved)
        self._noise_deviations = noise_deviations(resolved)
        self._model = model = assumed_model(resolved)
        Ad, Bd = discretise(A, B, period_ns)
        n = loop.n
        self._pushes = self._normal_pushes = np.zeros((n, 0))
        if forcing is not None:
            self._pushes = discretise(A, forcing.columns, period_ns)[1]
            if forcing.normal is not None:
                self._normal_pushes = discretise(A, forcing.normal.columns, period_ns)[1]
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
        first = loop.x0 if known else np.zeros(loop.n)
        if observer.initial_estimate is not None:
            first = np.array(observer.initial_estimate)
        start = (self._rest(0) @ (first - loop.x0))[None, :, None]
        nothing = np.zeros((0, loop.n, 1))
        fixed = self._peak([nothing] * len(self._gains), alpha_per_s, start)
        for sources in self._persistent_sources:
            fixed += self._excess(sources, alpha_per_s)
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
        fixed = sum(self._peak(sources[-2:], 0.0) for sources in self._persistent_sources)
        spread = float(np.linalg.norm(W @ self._settled_covariance @ W.T, 2))
        fixed += self._radius * np.sqrt(spread) * _ROUNDING
        return self._with_model_error(fixed, 0.0)

    @cached_property
    def _radius(self) -> float:
        """Bound of n standard normal values, of which e is a linear function; 0 if not needed."""
        bounds = normal_bounds(self._resolved)
        return 0.0 if bounds is None else bounds.radius(self._loop.n)

    @cached_property
    def _persistent_sources(self) -> list[list[Stack]]:
        """The effects of bounded noise and of each bounded disturbance on the measurements."""
        found = [self._sources(column[:, None], 0.0) for column in self._pushes.T]
        if self._noise.any():
            found.append([(L * self._noise).T[:, :, None] for L in self._gains])
        return found

    @cached_property
    def _covariances(self) -> list[tuple[Matrix, Matrix]]:
        """F_k, and the covariance of what each measurement adds to e."""
        sources, found = self._sources(self._normal_pushes, 0.0), []
        for k, L in enumerate(self._gains):
            pushed, noise = np.hstack([*sources[k]]), L * self._noise_deviations
            found.append((self._rest(k) @ self._between, pushed @ pushed.T + noise @ noise.T))
        return found

    @cached_property
    def _settled_covariance(self) -> Matrix:
        from scipy.linalg import solve_discrete_lyapunov

        F, added = self._covariances[-1]
        _contraction(F)
        return np.asarray(solve_discrete_lyapunov(F, added))

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
        seen = float(np.linalg.norm(W @ np.linalg.inv(factor), 2))
        beyond = float(np.linalg.norm(factor @ (P - settled) @ factor.T, 2))
        return float(max(largest, scale * seen * np.sqrt(beyond)) * _ROUNDING)

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
    def _gains(self) -> list[Matrix]:
        """L_k until it has settled.

        Raises:
            NotDecayingError: it does not settle in so many measurements.
        """
        assert self._resolved.observer is not None
        found: list[Matrix] = []
        for L in islice(self._resolved.observer.gains(self._model), _MOST_GAINS):
            if found and np.abs(L - found[-1]).max() <= _SETTLED * np.abs(L).max() * (
                1 - self._spectral_radius(L)
            ):
                return [*found, L]
            found.append(L)
        raise NotDecayingError(f"the observer's gain changes for {_MOST_GAINS} measurements")

    def _spectral_radius(self, L: Matrix) -> float:
        F = (np.eye(len(L)) - L @ self._model.C) @ self._between
        return float(min(np.abs(np.linalg.eigvals(F)).max(), 1.0))

    @cached_property
    def _between(self) -> Matrix:
        return np.linalg.matrix_power(self._model.Ad, self._model.steps)

    def _rest(self, k: int) -> Matrix:
        """I − L_k C."""
        return np.eye(self._loop.n) - self._gains[k] @ self._model.C

    def _sources(self, columns: Matrix, alpha_per_s: float) -> list[Stack]:
        """Return the effects of the steps before each measurement on its error."""
        effects, power = [], columns
        for i in range(self._model.steps):
            effects.append(np.exp(alpha_per_s * self._period_s * (i + 1)) * power)
            power = self._model.Ad @ power
        stack = np.array(effects)
        return [self._rest(k) @ stack for k in range(len(self._gains))]

    def _steps(self, alpha_per_s: float) -> list[Matrix]:
        growth = self._growth(alpha_per_s)
        return [growth * self._rest(k) @ self._between for k in range(len(self._gains))]

    def _peak(
        self, sources: Sequence[Stack], alpha_per_s: float, start: Stack | None = None
    ) -> float:
        """Return sup_k Σ_j ‖W Φ(k, j) S_j‖, scaled; the last gain and source apply from then on."""
        steps = self._steps(alpha_per_s)[-len(sources) :]
        old = sources[0] if start is None else np.concatenate([start, sources[0]])
        largest = _sizes(self._weight, old)
        for step, new in zip(steps[1:-1], sources[1:-1], strict=True):
            old = np.concatenate([step @ old, new])
            largest = max(largest, _sizes(self._weight, old))
        factor, rate = _contraction(steps[-1])
        seen = float(np.linalg.norm(self._weight @ np.linalg.inv(factor), 2))
        last, total, W = sources[-1], 0.0, self._weight
        powers = _powers(steps[-1], min(_ENTRIES // max(old.size, last.size) + 1, 256))
        for _ in range(_MOST_STEPS // (len(powers) - 1)):
            # The same for every number of further measurements, (powers,).
            olds, lasts = powers[1:, None] @ old, powers[:, None] @ last
            totals = total + np.cumsum(_sizes(W, lasts[:-1]))
            largests = np.maximum.accumulate(np.maximum(_sizes(W, olds) + totals, largest))
            rests = seen * (_sizes(factor, lasts[1:]) / (1 - rate) + _sizes(factor, olds))
            enough = np.flatnonzero(rests <= _TAIL_SHARE * largests)
            number = enough[0] if len(enough) else -1
            largest, rest, total = largests[number], rests[number], totals[-1]
            if len(enough):
                break
            old, last = olds[-1], lasts[-1]
        return float((largest + rest) * _ROUNDING)

    def _excess(self, sources: Sequence[Stack], alpha_per_s: float) -> float:
        """Return sup_k of Σ_j ‖W Φ(k, j) S_j‖ minus its value for settled gains, scaled."""
        if len(sources) == 2:  # settled from the start on
            return 0.0
        total, W = self._peak(sources[-2:], 0.0), self._weight
        growth, scale, steps = self._growth(alpha_per_s), 1.0, self._steps(0.0)
        old, settled = sources[0], sources[-1]
        largest = float(_sizes(W, old)) - total
        for step, new in zip(steps[1:-1], sources[1:-1], strict=True):
            old, scale = np.concatenate([step @ old, new]), scale * growth
            settled = np.concatenate([steps[-1] @ settled, sources[-1]])
            largest = max(largest, scale * (float(_sizes(W, old)) - total))
        # From then on the effects of these sources, and those with settled gains, follow F.
        factor, _ = _contraction(growth * steps[-1])
        seen = float(np.linalg.norm(W @ np.linalg.inv(factor), 2))
        return max(largest, scale * seen * float(_sizes(factor, old - settled)), 0.0) * _ROUNDING


def _sizes(C: Matrix, stacks: Stack) -> Stack:
    """Return Σ‖C S‖ over stacks of S, (..., k, n, r) → (...)."""
    flat = (C @ stacks).reshape(-1, len(C), stacks.shape[-1])
    return np.asarray(spectral_norms(flat).reshape(stacks.shape[:-2]).sum(axis=-1))


def _powers(step: Matrix, count: int) -> Stack:
    """Return the powers 0 … count of a matrix, (count + 1, n, n)."""
    found = [np.eye(len(step))]
    for _ in range(count):
        found.append(step @ found[-1])
    return np.array(found)


def _contraction(step: Matrix) -> tuple[Matrix, float]:
    """Return T and ν < 1 with ‖T F T⁻¹‖ ≤ ν.

    Raises:
        NotDecayingError: there is none.
    """
    from scipy.linalg import solve_discrete_lyapunov

    reason = "the observer's error does not decay as fast as the bounds"
    if not np.abs(np.linalg.eigvals(step)).max() < 1:
        raise NotDecayingError(reason)
    try:
        P = solve_discrete_lyapunov(step.T, np.eye(len(step)))
        factor = np.linalg.cholesky(0.5 * (P + P.T)).T
    except (np.linalg.LinAlgError, ValueError):
        raise NotDecayingError(reason) from None
    rate = float(np.linalg.norm(factor @ step @ np.linalg.inv(factor), 2)) * (1 + 1e-9)
    if not rate < 1:
        raise NotDecayingError(reason)
    return np.asarray(factor), rate
