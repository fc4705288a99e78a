"""The Kalman filter (Kalman 1960), with the covariance update of Bucy and Joseph.

At every step of the plant::

    x̂ ← Âd x̂ + B̂d u
    P ← Âd P Âdᵀ + Q

At a measurement::

    S = C P Cᵀ + R
    L = P Cᵀ S⁻¹
    x̂ ← x̂ + L (y − C x̂)
    P ← (I − L C) P (I − L C)ᵀ + L R Lᵀ

With this update P stays symmetric and positive semidefinite for any L.

While no measurement is missing, the sequence of gains is the same in all runs. So a resolved scenario states
it, with a last gain for all later measurements, if the gains become constant: ``observer.gains``. The filter
uses exactly these numbers, and so do certificates. From the first missing measurement on, L follows from P.
"""

from collections.abc import Iterator
from itertools import chain, islice, repeat
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from netem.core.core_library import reals_at
from netem.core.errors import CallerError
from noack.core.core_library import core, pointer_to
from noack.core.linear_systems import Matrix
from noack.observers.observer_settings import EstimationModel, NoiseVariances, ObserverSettings
from noack.settings.values import Deviations, MatrixRows, require_length, require_shape, rows_of

_MOST_GAINS = 1000
"""Gains that are not constant after so many measurements are not stated."""
_CONSTANT = 1e-8
"""Largest change of a constant gain from one measurement to the next, as a share of its largest entry."""
_SAME = 1e-6
"""Stated gains differ at most by this share from those that follow from the covariances."""


class KalmanSettings(ObserverSettings):
    """The time-varying Kalman filter of the model, with Joseph's covariance update."""

    example: ClassVar = {
        "kind": "kalman",
        "input_std": [0.2],
        "noise_std": [0.01],
        "initial_std": [1.0, 1.0],
    }

    kind: Literal["kalman"]
    process_std: Deviations | None = None
    """Standard deviation of w in ẋ = Âx + B̂u + w, constant over a step of the plant, n entries; by
    default that of the random disturbances at = "state"."""
    input_std: Deviations | None = None
    """Standard deviation of the disturbance of u, constant over a step, m entries; by default that
    of the random disturbances at = "input"."""
    Q: MatrixRows | None = None
    """Instead of process_std and input_std: covariance of the noise added to x in a plant step, n x
    n."""
    noise_std: Deviations | None = None
    """Standard deviation of v, p entries; by default that of the measurement."""
    R: MatrixRows | None = None
    """Instead of noise_std: covariance of v, p x p."""
    initial_std: Deviations
    """Standard deviation of x − x̂ before the first measurement, n entries: P(0) = diag(·²)."""
    gains: Annotated[tuple[MatrixRows, ...], Field(min_length=1, max_length=_MOST_GAINS)] | None = None
    """L at the first measurements, n x p each; the last one holds for all later measurements. A resolved
    scenario has them. They follow from the covariances, so leave them out."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        for key, others in (("Q", ("process_std", "input_std")), ("R", ("noise_std",))):
            for other in others:
                if getattr(self, key) is not None and getattr(self, other) is not None:
                    raise ValueError(f"{key}: give either {key} or {other}")
        return self

    def check(self, n: int, m: int, p: int, noise: NoiseVariances) -> None:
        super().check(n, m, p, noise)
        for key, expected, what in (
            ("process_std", n, "state"),
            ("input_std", m, "input"),
            ("noise_std", p, "output"),
            ("initial_std", n, "state"),
        ):
            require_length(getattr(self, key), f"observer.{key}", expected, f"one per {what}")
        require_shape(self.Q, "observer.Q", (n, n), "a covariance of states")
        require_shape(self.R, "observer.R", (p, p), "a covariance of outputs")
        for gain in self.gains or ():
            require_shape(gain, "observer.gains", (n, p), "one row per state, a column per output")
        _require_covariance("Q", self.Q, definite=False)
        _require_covariance("R", self.R, definite=True)
        output = noise.output if self.noise_std is None else self.noise_std
        if self.R is None and not all(np.array(output) > 0):
            raise ValueError(
                "observer.noise_std: the filter needs a noise above 0 on every output; "
                "give noise_std or R, or plant.measurement's noise"
            )
        at_state = noise.at_state if self.process_std is None else self.process_std
        at_input = noise.at_input if self.input_std is None else self.input_std
        if not any(at_state) and not any(at_input) and not np.any(self.Q or 0):
            raise ValueError(
                "observer.process_std: without process noise the Kalman gain tends to 0; "
                "give process_std, input_std or Q, or random disturbances of the plant"
            )

    def assumed_model(self, model: EstimationModel, noise: NoiseVariances) -> EstimationModel:
        Q, R = model.Q, model.R
        if self.Q is not None:
            Q = np.array(self.Q)
        elif self.process_std is not None or self.input_std is not None:
            at_state = noise.at_state if self.process_std is None else np.square(self.process_std)
            at_input = noise.at_input if self.input_std is None else np.square(self.input_std)
            Q = model.process_covariance(at_state, at_input)
        if self.R is not None:
            R = np.array(self.R)
        elif self.noise_std is not None:
            R = np.diag(np.square(self.noise_std))
        return model._replace(Q=Q, R=R)

    def stated(self, assumed: EstimationModel) -> Self:
        Q, R = (rows_of((M + M.T) / 2) for M in (assumed.Q, assumed.R))
        given = {"process_std": None, "input_std": None, "noise_std": None}
        return self.model_copy(update={**given, "Q": Q, "R": R})

    def steady_gain(self, assumed: EstimationModel) -> Matrix | None:
        """Return L from the discrete algebraic Riccati equation; None if its solver fails."""
        # Imported here: a sensor does not need this large module.
        from scipy.linalg import solve_discrete_are

        (A, Q), C, R = assumed.between_measurements(), assumed.C, assumed.R
        try:
            predicted = solve_discrete_are(A.T, C.T, Q, R)
        except (np.linalg.LinAlgError, ValueError):  # the entries' magnitudes differ too much
            return None
        return np.asarray(np.linalg.solve(C @ predicted @ C.T + R, C @ predicted).T)

    def with_gains(self, assumed: EstimationModel) -> Self:
        computed = self._constant_gains(assumed)
        if self.gains is None:
            gains = None if computed is None else tuple(map(rows_of, computed))
            return self.model_copy(update={"gains": gains})
        stated = np.array(self.gains)
        expected = None if computed is None else computed[np.arange(len(stated)).clip(max=len(computed) - 1)]
        if expected is None or np.abs(stated - expected).max() > _SAME * np.abs(expected).max():
            raise CallerError(
                "observer.gains: not those that follow from the model and the covariances; leave them out"
            )
        return self

    def _constant_gains(self, assumed: EstimationModel) -> Matrix | None:
        """Return the gains until they are constant, (k, n, p); None: they do not become constant."""
        found = list[Matrix]()
        for gain in islice(self._computed_gains(assumed), _MOST_GAINS):
            found.append(gain)
            if len(found) > 1 and np.abs(gain - found[-2]).max() <= _CONSTANT * np.abs(gain).max():
                return np.array(found)
        return None

    def gains_of(self, assumed: EstimationModel) -> Iterator[Matrix]:
        if self.gains is None:
            return self._computed_gains(assumed)
        stated = np.array(self.gains)
        return chain(stated, repeat(stated[-1]))

    def _computed_gains(self, assumed: EstimationModel) -> Iterator[Matrix]:
        """Yield the gains that follow from the covariances."""
        (n, m), p = assumed.Bd.shape, len(assumed.C)
        observer = self.model_copy(update={"gains": None}).observer(assumed, {})
        zeros = np.zeros(max(p, m))
        nothing = pointer_to(zeros, "double *")
        while True:
            core.noack_observer_gain(observer)
            yield reals_at(observer.gain, n, p).copy()
            core.noack_observer_correct(observer, nothing)
            for _ in range(assumed.steps):
                core.noack_observer_predict(observer, nothing)

    def numbers(self, assumed: EstimationModel) -> dict[str, object]:
        covariances = {"P": np.diag(np.square(self.initial_std)), "Q": assumed.Q, "R": assumed.R}
        stated = None if self.gains is None else np.array(self.gains)
        gains = {"gains": stated, "gain_count": 0 if stated is None else len(stated)}
        return {"kind": core.NOACK_KALMAN} | covariances | gains


def _require_covariance(key: str, rows: MatrixRows | None, *, definite: bool) -> None:
    if rows is None:
        return
    matrix = np.array(rows)
    if not np.allclose(matrix, matrix.T, rtol=1e-12, atol=0.0):
        raise ValueError(f"observer.{key}: must be symmetric")
    smallest = np.linalg.eigvalsh(matrix)[0]
    if definite and smallest < np.finfo(float).tiny:
        raise ValueError(f"observer.{key}: must be positive definite")
    # Rounding may leave a singular covariance with a small negative eigenvalue.
    if smallest < -1e-12 * np.abs(matrix).max():
        raise ValueError(f"observer.{key}: must be positive semidefinite")
