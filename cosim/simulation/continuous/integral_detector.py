"""Event detector for the integral of a norm over the time since the last event."""

import math

import numpy as np
from scipy.optimize import brentq

from cosim.simulation.continuous.event_detector import LARGEST, DetectedEvent, DivergedError
from cosim.simulation.continuous.exact_flow import ExactFlow, taylor_terms
from noack.core.linear_systems import Matrix, Vector

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)
_QUADRATURE = 1e-13
_SHORTEST = 1e-9
_FINEST = 1e-15


class IntegralEventDetector:
    """Finds the first time at which ∫‖y‖dτ exceeds a decaying threshold; y is the loop's output.

    The integral never decreases and the threshold never increases, so they cross at most once. On
    a cell y is a polynomial. ∫‖y‖ is computed by Gauss-Legendre quadrature on intervals that are
    halved until the two halves agree with the whole to 1e-13 of the integral so far. ``output`` is
    C of y = C z, shape (r, N).
    """

    def __init__(
        self, flow: ExactFlow, generator: Matrix, output: Matrix, rate_per_s: float
    ) -> None:
        self._flow = flow
        self._rate_per_s = rate_per_s
        self._taylor: Matrix = output @ taylor_terms(generator, flow.width_s)

    def first_exit(
        self, z: Vector, t_s: float, threshold: float, span_s: float, auxiliary: float
    ) -> DetectedEvent:
        """As :meth:`EventDetector.first_exit`."""
        width_s, begin_s, cell = self._flow.width_s, 0.0, 0

        def excess(u: float) -> float:
            level = threshold * math.exp(-self._rate_per_s * (begin_s + u * width_s))
            return auxiliary + width_s * _norm_integral(y, 0.0, u, grain) - level

        while True:
            if not float(np.linalg.norm(z)) < LARGEST:
                raise DivergedError(t_s + begin_s)
            y, grain = self._taylor @ z, auxiliary / width_s
            last = min((span_s - begin_s) / width_s, 1.0)
            if auxiliary > threshold * math.exp(-self._rate_per_s * begin_s):
                return DetectedEvent(begin_s, z, auxiliary, exceeds=True)
            if excess(last) > 0:
                u = float(brentq(excess, 0.0, last, xtol=_FINEST, rtol=_FINEST))
                return self._reached(begin_s, z, u, auxiliary, y, exceeds=True)
            if begin_s + width_s >= span_s:
                return self._reached(begin_s, z, max(last, 0.0), auxiliary, y, exceeds=False)
            auxiliary += width_s * _norm_integral(y, 0.0, 1.0, grain)
            cell += 1
            begin_s = cell * width_s
            z = self._flow.powers[1] @ z

    def _reached(
        self, begin_s: float, z: Vector, u: float, auxiliary: float, y: Matrix, *, exceeds: bool
    ) -> DetectedEvent:
        width_s = self._flow.width_s
        auxiliary += width_s * _norm_integral(y, 0.0, u, auxiliary / width_s)
        z = self._flow.within_cell(z, u)
        return DetectedEvent(begin_s + u * width_s, z, auxiliary, exceeds)


def _norm_integral(y: Matrix, begin: float, end: float, grain: float) -> float:
    """Return ∫‖y(u)‖du over [begin, end], to 1e-13 times (the integral + ``grain``).

    y has the Taylor coefficients, shape (p + 1, r).
    """
    pending, total = [(begin, end)], 0.0
    while pending:
        a, b = pending.pop()
        middle = (a + b) / 2
        whole, left, right = (_gauss(y, *part) for part in ((a, b), (a, middle), (middle, b)))
        error = abs(left + right - whole)
        if error <= _QUADRATURE * (grain + total + left + right) or b - a <= _SHORTEST:
            total += left + right
        else:
            pending += [(middle, b), (a, middle)]
    return total


def _gauss(y: Matrix, a: float, b: float) -> float:
    u = (a + b) / 2 + (b - a) / 2 * _NODES
    values = np.vander(u, len(y), increasing=True) @ y
    return float(_WEIGHTS @ np.linalg.norm(values, axis=1)) * (b - a) / 2
