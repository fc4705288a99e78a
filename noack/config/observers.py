"""Settings of how a plant is measured, and of the observer that estimates its state from that."""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Discriminator, FiniteFloat, model_validator

from noack.core.linear_systems import Vector
from noack.settings.matrices import Row, Rows, require_length, require_shape, require_squares
from noack.settings.section import ScenarioSection

Pole = FiniteFloat | tuple[FiniteFloat, ...]


class Measurement(ScenarioSection):
    """What is measured of the plant: y = C x + v."""

    C: Rows | None = None
    """C by rows, p x n; unless given, every state is measured."""
    noise_std: Row | None = None
    """Standard deviation of a normally distributed v, p entries; unless given, zeros."""
    noise_bound: Row | None = None
    """Bound of a uniformly distributed v, p entries, which is added to the other."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        require_squares(self.noise_std or (), "noise_std", "standard deviations")
        require_squares(self.noise_bound or (), "noise_bound", "bounds")
        return self

    def outputs(self, n: int) -> int:
        """Number of measured outputs p of a plant of n states."""
        return n if self.C is None else len(self.C)

    def selects_all(self, n: int) -> bool:
        """Whether C is the identity."""
        return self.C is None or (
            np.shape(self.C) == (n, n) and bool((np.array(self.C) == np.eye(n)).all())
        )

    @property
    def is_noisy(self) -> bool:
        """Whether there is any noise."""
        return any(self.noise_std or ()) or any(self.noise_bound or ())

    def variance(self, n: int) -> Vector:
        """Variance of v, shape (p,)."""
        found = np.zeros(self.outputs(n))
        if self.noise_std is not None:
            found = found + np.square(self.noise_std)
        return found if self.noise_bound is None else found + np.square(self.noise_bound) / 3

    def check(self, n: int, why: str) -> None:
        """Require shapes that fit a model of n states.

        Raises:
            ValueError: one does not; the message begins with the key.
        """
        place, p = "plant.measurement", self.outputs(n)
        require_shape(self.C, f"{place}.C", (p, n), f"{why}; one row per output")
        for key in ("noise_std", "noise_bound"):
            require_length(getattr(self, key), f"{place}.{key}", p, "one per measured output")


class LuenbergerSettings(ScenarioSection):
    """x̂(t_k) = x̂⁻ + L (y − C x̂⁻), x̂⁻ being predicted by Â, B̂ and the input since t_(k−1)."""

    kind: Literal["luenberger"]
    """What the observer is."""
    gain: Rows | None = None
    """L by rows, n x p."""
    poles_per_s: tuple[Pole, ...] | None = None
    """Or: n poles of the error in continuous time, s; a pair [re, im] stands for re ± im·j. L gives
    (I − LC)e^(ÂT) the eigenvalues e^(sT), T the time between measurements."""
    initial_estimate: Row | None = None
    """x̂ before the first measurement, n entries; by default 0, or x(0) where that is known."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.gain is None) == (self.poles_per_s is None):
            raise ValueError("gain: give either gain or poles_per_s")
        for pole in self.poles_per_s or ():
            if isinstance(pole, tuple) and len(pole) != 2:
                raise ValueError("poles_per_s: each is a number, or a pair [re, im]")
            if (pole[0] if isinstance(pole, tuple) else pole) >= 0:
                raise ValueError("poles_per_s: must have negative real parts, for the error to die")
            if isinstance(pole, tuple) and pole[1] <= 0:
                raise ValueError(
                    "poles_per_s: a pair [re, im] needs im > 0; write a real pole as a number"
                )
        return self

    def check(self, n: int, m: int, p: int) -> None:
        """Require shapes that fit.

        Raises:
            ValueError: one does not; the message begins with the key.
        """
        require_shape(self.gain, "observer.gain", (n, p), "one row per state, a column per output")
        require_length(self.initial_estimate, "observer.initial_estimate", n, "one per state")
        if self.poles_per_s is not None and len(self.poles) != n:
            raise ValueError(
                f"observer.poles_per_s: expected {n} poles (one per state, a pair counts twice), "
                f"found {len(self.poles)}"
            )

    @property
    def poles(self) -> tuple[complex, ...]:
        """The poles one by one."""
        found: list[complex] = []
        for pole in self.poles_per_s or ():
            if isinstance(pole, tuple):
                found += [complex(*pole), complex(*pole).conjugate()]
            else:
                found.append(complex(pole))
        return tuple(found)


class KalmanSettings(ScenarioSection):
    """The time-varying Kalman filter of the model, its covariance in Joseph's form."""

    kind: Literal["kalman"]
    """What the observer is."""
    process_std: Row | None = None
    """Standard deviation of w in ẋ = Âx + B̂u + w, held over a step of the plant, n entries; by
    default that of the random disturbances at = "state"."""
    input_std: Row | None = None
    """Standard deviation of what is added to u, held likewise, m entries; by default that of the
    random disturbances at = "input"."""
    Q: Rows | None = None
    """Or: covariance of what is added to x in a step of the plant, n x n."""
    noise_std: Row | None = None
    """Standard deviation of v, p entries; by default that of the measurement."""
    R: Rows | None = None
    """Or: covariance of v, p x p."""
    initial_std: Row
    """Standard deviation of x − x̂ before the first measurement, n entries: P(0) = diag(·²)."""
    initial_estimate: Row | None = None
    """x̂ before the first measurement, n entries; by default 0, or x(0) where that is known."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        for key in ("process_std", "input_std", "noise_std", "initial_std"):
            require_squares(getattr(self, key) or (), key, "standard deviations")
        for key, others in (("Q", ("process_std", "input_std")), ("R", ("noise_std",))):
            for other in others:
                if getattr(self, key) is not None and getattr(self, other) is not None:
                    raise ValueError(f"{key}: give either {key} or {other}")
        return self

    def check(self, n: int, m: int, p: int) -> None:
        """Require shapes that fit, and covariances.

        Raises:
            ValueError: one does not; the message begins with the key.
        """
        for key, expected, what in (
            ("process_std", n, "state"), ("input_std", m, "input"), ("noise_std", p, "output"),
            ("initial_std", n, "state"), ("initial_estimate", n, "state"),
        ):  # fmt: skip
            require_length(getattr(self, key), f"observer.{key}", expected, f"one per {what}")
        require_shape(self.Q, "observer.Q", (n, n), "a covariance of states")
        require_shape(self.R, "observer.R", (p, p), "a covariance of outputs")
        for key, least in (("Q", 0.0), ("R", np.finfo(float).tiny)):
            if (rows := getattr(self, key)) is None:
                continue
            matrix = np.array(rows)
            if not np.allclose(matrix, matrix.T, rtol=1e-12, atol=0.0):
                raise ValueError(f"observer.{key}: must be symmetric")
            # As singular as rounding leaves it, Q is still one.
            if np.linalg.eigvalsh(matrix)[0] < least - 1e-12 * np.abs(matrix).max() * (key == "Q"):
                definite = "semidefinite" if key == "Q" else "definite"
                raise ValueError(f"observer.{key}: must be positive {definite}")


AnyObserver = Annotated[LuenbergerSettings | KalmanSettings, Discriminator("kind")]
