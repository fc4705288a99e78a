"""Robust certificates: bounds that hold for every plant of an uncertainty box around the model.

Let A = Â + Ã and B = B̂ + B̃, with each entry of |Ã| and |B̃| at most the box's half-width. With
u = K x + p, the plant is the model with the model error w = Ã x + B̃ u as an additional input:

    x' = (Â + B̂K) x + B̂ p + w

Each |w_i| is bounded by the half-widths and the suprema of the coordinates. Each coordinate is
bounded by the peak gains (∫ of impulse responses) of the model's closed loop. The result is a
linear inequality between non-negative numbers. If the spectral radius of its matrix is below 1, its
solution holds for all plants of the box, including time-varying ones.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, Vector
from noack.theory.contraction import logarithmic_norm
from noack.theory.enclosure import NotDecayingError, ResponseBounds, factors, response
from noack.theory.gains import Coefficients, ErrorGains, Growth, Output


@dataclass(frozen=True)
class BoxGains:
    """All plants of a box, in the form of a plant for :func:`noack.theory.certificate.solve`.

    Args:
        error: gains of the models.
        A_model, B_model: the box's centre, (n, n) and (n, m).
        halfwidth_A, halfwidth_B: the box, (n, n) and (n, m).
        start: x(0) as a column, (n, 1); or a matrix that maps the unit ball to a set with x(0).
        alpha_per_s: α of the scaling.
    """

    error: ErrorGains
    A_model: Matrix
    B_model: Matrix
    halfwidth_A: Matrix
    halfwidth_B: Matrix
    start: Matrix
    alpha_per_s: float

    @cached_property
    def outputs(self) -> Mapping[Output, Matrix]:
        """C of each output C x; the model error w is added to ``MISMATCH``."""
        return {
            Output.STATE: np.eye(len(self.A_model)),
            Output.WEIGHTED: self.error.weight,
            Output.MISMATCH: self._split_nominal[1],
            Output.GAIN_RATE: self.error.outputs[Output.GAIN_RATE],
        }

    @cached_property
    def states(self) -> Mapping[Output, Coefficients]:
        """sup‖C x‖ from x(0) and from the input error.

        Raises:
            NotDecayingError: the model decays too slowly, or the box is too large.
        """
        free, gain = self._mistakes
        found = {
            output: Coefficients(
                gains.start + float(gains.from_mistakes @ free),
                gains.pushed + float(gains.from_mistakes @ gain),
            )
            for output, gains in self._peaks.items()
        }
        nominal = found[Output.MISMATCH]
        # sup‖(R_E x, w)‖ ≤ sup‖R_E x‖ + sup‖w‖
        found[Output.MISMATCH] = Coefficients(
            nominal.free + float(np.linalg.norm(free)), nominal.gain + float(np.linalg.norm(gain))
        )
        return found

    def start_up(self, start_s: float) -> tuple[float, Mapping[Output, float]]:
        """Return the effect of zero input before ``start_s``: p = −K x, x' = A x for every A.

        With zero input w = Ã x, which the bound of w covers.
        """
        if start_s == 0:
            return 0.0, dict.fromkeys(self.outputs, 0.0)
        R, box = self.error.split_K[1], float(np.linalg.norm(self.halfwidth_A, 2))
        # ‖e^{As}‖ ≤ e^{μs}; the logarithmic norm μ of a sum is at most the sum of both norms.
        mu = max(logarithmic_norm(self.A_model) + box, 0.0) + self.alpha_per_s
        size = float(np.linalg.norm(self.start, 2)) * math.exp(mu * start_s)
        turn = float(np.linalg.norm(R @ self.A_model, 2)) + float(np.linalg.norm(R, 2)) * box
        first = float(np.linalg.norm(R @ self.start, 2)) * math.exp(self.alpha_per_s * start_s)
        error = first + start_s * turn * size
        kick = error * start_s
        from_kick = self._mistakes_of(kick * np.array([g.kicked for g in self._coordinates]))
        found = {
            output: kick * gains.kicked + float(gains.from_mistakes @ from_kick)
            for output, gains in self._peaks.items()
        }
        found[Output.MISMATCH] += float(np.linalg.norm(from_kick))
        return error, found

    def growth(self, until_s: float, cells: int) -> Growth:
        """Return the growth of ‖e_s‖_W over ``until_s``, on a grid."""
        known, mistaken = self._split_nominal[0], self._mistaken_rows
        # If H is the closed loop of the box's centre, there is no nominal mismatch.
        apart = self._split_nominal[1].any() or not self._rows
        forced = np.concatenate([known, mistaken], axis=1) if apart else mistaken
        return self.error.growth(forced, self._input_matrix, until_s, cells)

    @cached_property
    def _closed_loop(self) -> Matrix:
        shift = self.alpha_per_s * np.eye(len(self.A_model))
        return self.A_model + self.B_model @ self.error.K + shift

    @cached_property
    def _split_nominal(self) -> tuple[Matrix, Matrix]:
        return factors(self.A_model + self.B_model @ self.error.K - self.error.H)

    @cached_property
    def _input_matrix(self) -> Matrix:
        return self.B_model @ self.error.split_K[0]

    @cached_property
    def _rows(self) -> list[int]:
        """Rows of A and B that are uncertain."""
        uncertain = np.concatenate([self.halfwidth_A, self.halfwidth_B], axis=1).any(axis=1)
        return [int(i) for i in np.flatnonzero(uncertain)]

    @cached_property
    def _mistaken_rows(self) -> Matrix:
        return np.eye(len(self.A_model))[:, self._rows]

    @cached_property
    def _responses(self) -> tuple[ResponseBounds, ResponseBounds, list[ResponseBounds]]:
        """Responses of the model's closed loop to x(0), to p, and to each w_i."""
        return (
            response(self._closed_loop, self.start),
            response(self._closed_loop, self._input_matrix),
            [response(self._closed_loop, column[:, None]) for column in self._mistaken_rows.T],
        )

    def _peaks_at(self, C: Matrix) -> "_PeakGains":
        start, pushed, mistaken = self._responses
        forced = pushed.through(C)
        return _PeakGains(
            start.through(C).sup(),
            forced.integral(),
            forced.sup(),
            np.array([w.through(C).integral() for w in mistaken]),
        )

    @cached_property
    def _peaks(self) -> Mapping[Output, "_PeakGains"]:
        return {output: self._peaks_at(C) for output, C in self.outputs.items()}

    @cached_property
    def _coordinates(self) -> list["_PeakGains"]:
        """Peak gains of each coordinate of x and of K x."""
        rows = np.concatenate([np.eye(len(self.A_model)), self.error.K])
        return [self._peaks_at(row[None]) for row in rows]

    @cached_property
    def _halfwidths(self) -> Matrix:
        """Half-widths Δ with |w| ≤ Δ |(x, u)|."""
        return np.concatenate([self.halfwidth_A, self.halfwidth_B], axis=1)[self._rows]

    def _mistakes_of(self, coordinates: Vector) -> Vector:
        """Return sup|w| from bounds of |(x, K x)| that were computed without w."""
        from_w = np.array([gains.from_mistakes for gains in self._coordinates])
        loop = self._halfwidths @ from_w
        if len(loop) and np.abs(np.linalg.eigvals(loop)).max() >= 1:
            raise NotDecayingError("the uncertainty box is too large for the loop's gains")
        solved: Vector = np.linalg.solve(np.eye(len(loop)) - loop, self._halfwidths @ coordinates)
        return solved

    @cached_property
    def _mistakes(self) -> tuple[Vector, Vector]:
        """sup|w_i| ≤ free_i + gain_i sup‖p‖."""
        inputs = np.linalg.norm(self.error.split_K[0], axis=1)
        pushed = np.array([gains.pushed for gains in self._coordinates])
        pushed[len(self.A_model) :] += inputs  # u = K x + p
        return (
            self._mistakes_of(np.array([gains.start for gains in self._coordinates])),
            self._mistakes_of(pushed),
        )


class _PeakGains(NamedTuple):
    """sup‖C x‖ ≤ start + pushed · sup‖p‖ + kicked · ∫‖p‖ + from_mistakes · |w|."""

    start: float
    pushed: float
    kicked: float
    from_mistakes: Vector
