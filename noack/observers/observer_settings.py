"""The settings that every kind of observer has, and the discrete-time model that observers use.

native/loop/observer.c is what an observer does. Over a step h of the plant the model is x⁺ = Âd x +
B̂d u + q, y = C x + v. The time between two measurements is T = steps · h. At the end:
observability of a pair (A, C), and pole placement for an observer.
"""

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from typing import ClassVar, NamedTuple, Self

import numpy as np

from netem.core.core_library import CData
from netem.core.settings_section import ScenarioSection, Table
from noack.core.core_library import new_handle, new_structure
from noack.core.linear_systems import Matrix, Vector
from noack.core.pole_placement import place_poles
from noack.settings.values import Row, require_length

_RANK_TOLERANCE = 1e-9
"""Least singular value of a scaled matrix of full rank; eigenvalues this close to 1 do not decay."""
_POLE_TOLERANCE = 1e-6
"""Largest distance of a placed eigenvalue from the one that was asked for."""


class NoiseVariances(NamedTuple):
    """Variances of the random disturbances and the noise of a scenario, entry by entry."""

    at_state: Vector  # Of the disturbances at = "state", (n,)
    at_input: Vector  # Of the disturbances at = "input", (m,)
    output: Vector  # Of the measurement noise v, (p,)


class EstimationModel(NamedTuple):
    """The model on the plant's time grid, with the covariances of its noise."""

    Ad: Matrix  # Âd, (n, n)
    Bd: Matrix  # B̂d, (n, m)
    Gd: Matrix  # Effect of a disturbance w of ẋ that is constant over a step, (n, n)
    C: Matrix  # (p, n)
    Q: Matrix  # Covariance of q, (n, n)
    R: Matrix  # Covariance of v, (p, p)
    steps: int  # Steps of the plant between two measurements

    def process_covariance(self, at_state: Vector, at_input: Vector) -> Matrix:
        """Return the covariance of q for independent disturbances with these variances."""
        return _covariance(self.Gd, at_state) + _covariance(self.Bd, at_input)

    def between_measurements(self) -> tuple[Matrix, Matrix]:
        """Return Â^(T), and the covariance of the process noise over T, (n, n) each."""
        A, Q = np.eye(len(self.Ad)), np.zeros_like(self.Q)
        for _ in range(self.steps):
            A, Q = self.Ad @ A, self.Ad @ Q @ self.Ad.T + self.Q
        return A, Q


def _covariance(through: Matrix, variance: Vector) -> Matrix:
    return np.asarray(through @ np.diag(variance) @ through.T)


class ObserverSettings(ScenarioSection):
    """Settings of an observer."""

    example: ClassVar[Table]
    """Settings of this kind for two states, one input and one output, for property tests."""

    kind: str
    """The kind of observer."""
    initial_estimate: Row | None = None
    """x̂ before the first measurement, n entries; by default x(0) if the sensor starts from it,
    else 0."""

    def check(self, n: int, m: int, p: int, noise: NoiseVariances) -> None:
        """Require settings that fit n states, m inputs, p outputs and the scenario's noise.

        Raises:
            ValueError: a setting does not fit; the message begins with the key.
        """
        require_length(self.initial_estimate, "observer.initial_estimate", n, "one per state")

    def resolved(self, A: Matrix, C: Matrix, period_ns: float) -> Self:
        """Return settings with an explicit gain, in place of data from which the gain is computed.

        A is Â^(T) between two measurements, T the period.

        Raises:
            CallerError: there is no such gain.
        """
        return self

    def assumed_model(self, model: EstimationModel, noise: NoiseVariances) -> EstimationModel:
        """Return the model with the covariances that the observer assumes."""
        return model

    def stated(self, assumed: EstimationModel) -> Self:
        """Return settings with the covariances that the observer assumes, which depend on no other table."""
        return self

    @abstractmethod
    def steady_gain(self, assumed: EstimationModel) -> Matrix | None:
        """Return L in the steady state, (n, p); None if none is found."""

    def with_gains(self, assumed: EstimationModel) -> Self:
        """Return settings with the gain of each measurement, if it is known before the run.

        Raises:
            CallerError: the settings state other gains.
        """
        return self

    @abstractmethod
    def gains_of(self, assumed: EstimationModel) -> Iterator[Matrix]:
        """Yield L of every measurement, (n, p), without end."""

    @abstractmethod
    def numbers(self, assumed: EstimationModel) -> dict[str, object]:
        """Return the fields of a ``noack_observer`` that differ between the kinds."""

    def observer(self, assumed: EstimationModel, estimate: Mapping[str, object]) -> CData:
        """Return a new ``noack_observer`` with the fields of its estimate."""
        n, m = assumed.Bd.shape
        model = {"n": n, "m": m, "p": len(assumed.C), "Ad": assumed.Ad, "Bd": assumed.Bd, "C": assumed.C}
        return new_handle(
            "observer", new_structure("noack_observer", model | self.numbers(assumed) | {**estimate})
        )


def unobservable_mode(A: Matrix, C: Matrix, *, stable_too: bool = False) -> complex | None:
    """Return an eigenvalue of A whose mode does not appear in y = C x; None if there is none.

    The test of Popov, Belevitch and Hautus: the columns of [λI − A; C] are independent. By default
    only modes that do not decay are tested (detectability), with ``stable_too`` all modes
    (observability).
    """
    n = len(A)
    scale = max(float(np.linalg.norm(A, 2)), 1.0)
    scaled_C = C / max(float(np.linalg.norm(C, 2)), np.finfo(float).tiny)
    for eigenvalue in np.linalg.eigvals(A):
        if abs(eigenvalue) < 1 - _RANK_TOLERANCE and not stable_too:
            continue
        tested = np.vstack([(eigenvalue * np.eye(n) - A) / scale, scaled_C])
        if np.linalg.svd(tested, compute_uv=False)[-1] < _RANK_TOLERANCE:
            return complex(eigenvalue)
    return None


def observer_gain(A: Matrix, C: Matrix, poles: tuple[complex, ...]) -> Matrix:
    """Return L, shape (n, p), for which (I − L C) A has these eigenvalues.

    L is the state feedback of the dual pair (Aᵀ, (CA)ᵀ). The poles are n eigenvalues, each complex
    one with its conjugate.

    Raises:
        ValueError: the eigenvalues cannot be placed.
    """
    if unobservable_mode(A, C, stable_too=True) is not None:
        raise ValueError("(Â, C) is not observable")
    gain = np.ascontiguousarray(-place_poles(A.T, (C @ A).T, np.array(poles)).T)
    reached = np.linalg.eigvals((np.eye(len(A)) - gain @ C) @ A)
    error = np.abs(np.sort_complex(reached) - np.sort_complex(np.array(poles))).max()
    if not error < _POLE_TOLERANCE:
        raise ValueError(f"rounding moves them by {error:.1g}; take poles farther apart")
    return gain
