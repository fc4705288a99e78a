"""The Luenberger observer: a constant gain, given or computed from poles.

x̂(t_k) = x̂⁻ + L (y − C x̂⁻), where x̂⁻ ← Âd x̂ + B̂d u at every step of the plant. If the plant equals
the model, the error follows e(t_k) = (I − L C) Â^(T) e(t_(k−1)).
"""

from collections.abc import Iterator
from itertools import chain, repeat
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import FiniteFloat, model_validator

from netem.core.errors import CallerError
from noack.core.core_library import core
from noack.core.linear_systems import Matrix
from noack.observers.observer_settings import EstimationModel, NoiseVariances, ObserverSettings, observer_gain
from noack.settings.values import MatrixRows, require_shape

Pole = FiniteFloat | tuple[FiniteFloat, ...]


class LuenbergerSettings(ObserverSettings):
    """x̂(t_k) = x̂⁻ + L (y − C x̂⁻); Â, B̂ and the inputs since t_(k−1) predict x̂⁻."""

    example: ClassVar = {"kind": "luenberger", "poles_per_s": [-20.0, -25.0]}

    kind: Literal["luenberger"]
    gain: MatrixRows | None = None
    """L by rows, n x p."""
    first_gain: MatrixRows | None = None
    """The gain at the first measurement, n x p; by default as later."""
    poles_per_s: tuple[Pole, ...] | None = None
    """Instead of gain: n poles s of the error in continuous time; a pair [re, im] stands for re ±
    im·j. With L, (I − LC)e^(ÂT) has the eigenvalues e^(sT), where T is the time between
    measurements."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.gain is None) == (self.poles_per_s is None):
            raise ValueError("gain: give either gain or poles_per_s")
        for pole in self.poles_per_s or ():
            if isinstance(pole, tuple) and len(pole) != 2:
                raise ValueError("poles_per_s: each is a number, or a pair [re, im]")
            if (pole[0] if isinstance(pole, tuple) else pole) >= 0:
                raise ValueError("poles_per_s: need negative real parts, else the error grows")
            if isinstance(pole, tuple) and pole[1] <= 0:
                raise ValueError("poles_per_s: a pair [re, im] needs im > 0; write a real pole as a number")
        return self

    def check(self, n: int, m: int, p: int, noise: NoiseVariances) -> None:
        super().check(n, m, p, noise)
        for key in ("gain", "first_gain"):
            reason = "one row per state, a column per output"
            require_shape(getattr(self, key), f"observer.{key}", (n, p), reason)
        if self.poles_per_s is not None and len(self.poles) != n:
            raise ValueError(
                f"observer.poles_per_s: expected {n} poles (one per state, a pair counts twice), "
                f"found {len(self.poles)}"
            )

    @property
    def poles(self) -> tuple[complex, ...]:
        """The poles one by one."""
        poles: list[complex] = []
        for pole in self.poles_per_s or ():
            if isinstance(pole, tuple):
                poles += [complex(*pole), complex(*pole).conjugate()]
            else:
                poles.append(complex(pole))
        return tuple(poles)

    def resolved(self, A: Matrix, C: Matrix, period_ns: float) -> Self:
        if self.poles_per_s is None:
            return self
        try:
            z = tuple(complex(np.exp(pole * period_ns * 1e-9)) for pole in self.poles)
            gain = observer_gain(A, C, z)
        except ValueError as error:
            raise CallerError(f"observer.poles_per_s: cannot be placed: {error}") from None
        rows = tuple(tuple(row) for row in gain.tolist())
        return self.model_copy(update={"gain": rows, "poles_per_s": None})

    def steady_gain(self, assumed: EstimationModel) -> Matrix:
        return np.array(self.gain)

    def gains_of(self, assumed: EstimationModel) -> Iterator[Matrix]:
        gain = np.array(self.gain)
        return chain([gain if self.first_gain is None else np.array(self.first_gain)], repeat(gain))

    def numbers(self, assumed: EstimationModel) -> dict[str, object]:
        first = None if self.first_gain is None else np.array(self.first_gain)
        gains = {"gain": np.array(self.gain), "first_gain": first}
        return {"kind": core.NOACK_LUENBERGER} | gains
