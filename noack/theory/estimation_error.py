"""Bounds of the estimation error e = x̂ − x at the measurements, as the sensor computes x̂.

With an observer of gains L_k, and s steps of the plant between two measurements,

    e_k = (I − L_k C)(Âˢ e_{k−1} + Σ_i Âⁱ d_{k,i}) + L_k v_k,    e_0 from the first estimate
    d   = (Â − A) x + (B̂ − B) u − B w_u − G w_x                   (discrete-time matrices, a step)

The gains do not depend on data: those of a Kalman filter are computed until they have settled. The
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
from noack.theory.enclosure import NotDecayingError, factors
from noack.theory.gains import Forcing
from noack.theory.persistent_causes import noise_bound

Stack = NDArray[np.float64]

MISMATCH = "Â − A"
"""Name of the output by which the plant's steps differ from the model's."""

_MOST_GAINS = 1500
_SETTLED = 1e-9
_MOST_STEPS = 100_000
_TAIL_SHARE = 1e-4
_ROUNDING = 1 + 1e-6


class EstimationError:
    """The estimation error of a resolved scenario whose plant is A (n, n), B (n, m)."""

    def __init__(self, resolved: Scenario, A: Matrix, B: Matrix, forcing: Forcing | None) -> None:
        loop, period_ns = loop_of(resolved), resolved.timing.plant_period_ns
        self._loop, self._resolved = loop, resolved
        self._weight = np.eye(loop.n) if loop.weight is None else loop.weight
        self._period_s = period_ns / NS_PER_S
        self._noise = noise_bound(resolved)
        self._model = model = assumed_model(resolved)
        Ad, Bd = discretise(A, B, period_ns)
        n = loop.n
        self._pushes = np.zeros((n, 0))
        if forcing is not None:
            self._pushes = discretise(A, forcing.columns, period_ns)[1]
        input_basis, _ = factors(loop.K)
        self._from_input = (model.Bd - Bd) @ input_basis
        self._from_state, self.output = factors(model.Ad - Ad + (model.Bd - Bd) @ loop.K)

    @property
    def further_outputs(self) -> dict[str, Matrix]:
        """The matrix C of which the bounds use sup‖C x‖."""
        return {} if self._resolved.observer is None else {MISMATCH: self.output}

    def decaying(self, alpha_per_s: float) -> EstimationBound:
        """Return the bound of the part from the first estimate, scaled by e^{αt}.

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
        return self._with_model_error(fixed, alpha_per_s)

    def persistent(self) -> EstimationBound:
        """Return the bound of the part from noise and disturbances.

        Raises:
            NotDecayingError: the estimation error does not decay.
        """
        if self._resolved.observer is None:
            return EstimationBound(float(np.linalg.norm(np.abs(self._weight) @ self._noise)))
        noise = [(L * self._noise).T[:, :, None] for L in self._gains]
        fixed = self._peak(noise, 0.0)
        for column in self._pushes.T:
            fixed += self._peak(self._sources(column[:, None], 0.0), 0.0)
        return self._with_model_error(fixed, 0.0)

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
                1 - self._radius(L)
            ):
                return [*found, L]
            found.append(L)
        raise NotDecayingError(f"the observer's gain changes for {_MOST_GAINS} measurements")

    def _radius(self, L: Matrix) -> float:
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

    def _peak(
        self, sources: Sequence[Stack], alpha_per_s: float, start: Stack | None = None
    ) -> float:
        """Return sup_k Σ_j ‖W Φ(k, j) S_j‖, scaled; the last gain and source apply from then on."""
        growth = np.exp(alpha_per_s * self._period_s * self._model.steps)
        steps = [growth * self._rest(k) @ self._between for k in range(len(self._gains))]
        old = sources[0] if start is None else np.concatenate([start, sources[0]])
        largest = _sizes(self._weight, old)
        for step, new in zip(steps[1:-1], sources[1:-1], strict=True):
            old = np.concatenate([step @ old, new])
            largest = max(largest, _sizes(self._weight, old))
        factor, rate = _contraction(steps[-1])
        seen = float(np.linalg.norm(self._weight @ np.linalg.inv(factor), 2))
        last, total = sources[-1], 0.0
        for _ in range(_MOST_STEPS):
            old = steps[-1] @ old
            total += _sizes(self._weight, last)
            largest = max(largest, _sizes(self._weight, old) + total)
            last = steps[-1] @ last
            rest = seen * (_sizes(factor, last) / (1 - rate) + _sizes(factor, old))
            if rest <= _TAIL_SHARE * largest:
                break
        return float((largest + rest) * _ROUNDING)


def _sizes(C: Matrix, stack: Stack) -> float:
    """Return Σ‖C S‖ over a stack."""
    return float(np.linalg.norm(C @ stack, 2, axis=(1, 2)).sum()) if len(stack) else 0.0


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
