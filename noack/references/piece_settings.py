"""The settings that every piece of a reference has, and the signal that a piece describes."""

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field, FiniteFloat

from netem.core.settings_section import ScenarioSection
from noack.core.linear_systems import Vector

TimeS = Annotated[FiniteFloat, Field(ge=0, le=1e7)]
"""A simulated time of a run."""


@dataclass(frozen=True)
class OutputSignal:
    """The value of an output: Σ_k polynomial_k τ^k + sine · sin 2πfτ + cosine · cos 2πfτ."""

    polynomial: Vector  # (powers,)
    hz: float = 0.0
    sine: float = 0.0
    cosine: float = 0.0

    def derivatives(self, t_s: float, count: int) -> Vector:
        """Return the value and the first derivatives at τ = t_s, (count,)."""
        values, polynomial = np.zeros(count), np.polynomial.Polynomial(self.polynomial)
        turn, omega = 2 * math.pi * self.hz * t_s, 2 * math.pi * self.hz
        for k in range(count):
            phase = turn + k * math.pi / 2  # the derivative of a sine is one a quarter turn ahead
            wave = self.sine * math.sin(phase) + self.cosine * math.cos(phase)
            values[k] = float(polynomial(t_s)) + omega**k * wave
            polynomial = polynomial.deriv()
        return values

    def from_time(self, t_s: float) -> "OutputSignal":
        """Return the same signal with τ = 0 at t_s."""
        degree = len(self.polynomial)
        factorials = np.array([math.factorial(k) for k in range(degree)], float)
        polynomial = OutputSignal(self.polynomial).derivatives(t_s, degree) / factorials
        sine, cosine = math.sin(2 * math.pi * self.hz * t_s), math.cos(2 * math.pi * self.hz * t_s)
        return OutputSignal(
            polynomial,
            self.hz,
            self.sine * cosine - self.cosine * sine,
            self.sine * sine + self.cosine * cosine,
        )


def joining(start: Vector, end: Vector, duration_s: float) -> OutputSignal:
    """Return the polynomial with these derivatives at 0 and at ``duration_s``, (k,) each.

    It has degree 2k − 1 (two-point Hermite interpolation). The times are scaled to 1 to solve for
    it.
    """
    k = len(start)
    scales = duration_s ** np.arange(k)
    powers = np.arange(2 * k)
    rows, unit = np.zeros((2 * k, 2 * k)), np.ones(2 * k)
    for order in range(k):
        rows[order, order] = math.factorial(order)
        rows[k + order] = unit  # the derivative of each power at 1
        unit = unit * (powers - order)
    values = np.concatenate([start * scales, end * scales])
    return OutputSignal(np.linalg.solve(rows, values) / duration_s**powers)


class PieceSettings(ScenarioSection):
    """Settings of a piece of a reference."""

    kind: str
    """The kind of piece."""


class OutputPiece(PieceSettings):
    """A piece that one output follows."""

    output: str
    """The output that follows it: the name of one of [[outputs]], or of a state."""
    from_s: TimeS
    """When it begins; before its first piece an output is 0."""
    until_s: TimeS | None = None
    """When it ends; the output then keeps its value. By default it ends at the output's next piece."""
    join_s: TimeS = 0.0
    """Time in which the output goes over from its earlier value to this piece, smoothly; 0: at once."""

    @abstractmethod
    def signal(self, start: float) -> OutputSignal:
        """Return the piece's signal; τ is the time since its begin, ``start`` the value before it."""
