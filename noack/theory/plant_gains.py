"""The gains of a loop that a certificate needs, between all pairs of signals.

All signals are scaled by e^{αt}, so that a decaying bound becomes a constant one. With K = U R (U
has orthonormal columns), the input error is p = u − K x, which acts on the plant through B U:

    x' = (A + BK) x + B p,      e_s' = H e_s − E x − B p,      E = A + BK − H

and, by identity (I1), e_c is e_s plus the contributions of the missing events. The outputs of
interest are the weighted norm W, the state itself, E x, and K H x (the error rate of a held input).
"""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import ClassVar, NamedTuple, Self

import numpy as np

from noack.core.cached_method import cached_method
from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix, Vector, discretise, matrix_key
from noack.theory.enclosure import (
    Outputs,
    ResponseBounds,
    factors,
    response,
    response_until,
)
from noack.theory.error_gains import Columns, ErrorGains, Growth, Output
from noack.theory.forcing import Forcing
from noack.theory.kernel_bounds import KernelBounds


class Coefficients(NamedTuple):
    """sup‖C x‖ ≤ ``free`` + ``gain`` · sup‖p‖."""

    free: float
    gain: float


@dataclass(frozen=True)
class PlantGains:
    """Gains of one known plant, A (n, n) and B (n, m).

    ``start`` is x(0) as a column, (n, 1), or a matrix that maps the unit ball to a set with x(0).
    α of the scaling may differ from that of the models.
    """

    error: ErrorGains
    A: Matrix
    B: Matrix
    start: Matrix
    alpha_per_s: float
    further_outputs: Mapping[str, Matrix] = field(default_factory=dict, kw_only=True)
    """Further matrices C, (k, n), by name: sup‖C x‖ is bounded for them, too."""
    forcing: Forcing | None = field(default=None, kw_only=True)
    """The disturbances; they need α = 0."""

    is_one_plant: ClassVar = True
    """Whether A and B are the plant's, and not the centre of a box."""

    of_start: ClassVar = {"states", "results of PlantGains.start_up"}
    """The kept results that depend on x(0)."""

    def at_start(self, start: Matrix) -> Self:
        """Return the same plant from another x(0); all other results are shared."""
        if np.array_equal(start, self.start):
            return self
        other = replace(self, start=start)
        known = {name: value for name, value in vars(self).items() if name not in vars(other)}
        vars(other).update({k: v for k, v in known.items() if k not in self.of_start})
        return other

    @cached_property
    def key(self) -> Hashable:
        """What equal plants have in common, whatever their x(0)."""
        own = {one.name: getattr(self, one.name) for one in fields(self) if one.name != "start"}
        matrices = [matrix_key(one) for one in own.values() if isinstance(one, np.ndarray)]
        outputs = [(name, matrix_key(C)) for name, C in self.further_outputs.items()]
        others = type(self), id(self.error), self.alpha_per_s, id(self.forcing)
        return *others, *matrices, *outputs

    @cached_property
    def input_matrix(self) -> Matrix:
        """B U."""
        return self.B @ self.error.split_K[0]

    @cached_property
    def closed_loop(self) -> Matrix:
        """A + BK + αI."""
        return self.A + self.B @ self.error.K + self.alpha_per_s * np.eye(len(self.A))

    @cached_property
    def split_mismatch(self) -> tuple[Matrix, Matrix]:
        """L_E, R_E with E = L_E R_E; W L_E has orthonormal columns, so ‖R_E x‖ = ‖E x‖_W."""
        E = self.A + self.B @ self.error.K - self.error.H
        L, R = factors(self.error.weight @ E)
        return self.error.inverse_weight @ L, R

    @cached_property
    def outputs(self) -> Mapping[str, Matrix]:
        """C of each output C x."""
        return {
            Output.STATE: np.eye(len(self.A)),
            Output.WEIGHTED: self.error.weight,
            Output.MISMATCH: self.split_mismatch[1],
            Output.GAIN_RATE: self.error.outputs[Output.GAIN_RATE],
            Output.GAIN_CURVATURE: self.error.outputs[Output.GAIN_CURVATURE],
            **self.further_outputs,
        }

    @cached_property
    def stacked(self) -> Outputs[str]:
        """All outputs, whose bounds are computed at once."""
        return Outputs(self.outputs)

    @cached_property
    def states(self) -> Mapping[str, Coefficients]:
        """sup‖C x‖ from x(0), the disturbances and the input error.

        Raises:
            NotDecayingError: α is not below the decay rate of e^{(A+BK)τ}.
        """
        start = response(self.closed_loop, self.start).through_each(self.stacked)
        return {
            output: Coefficients(
                start[output].sup() + self.disturbed(C), self.forced[output].integral()
            )
            for output, C in self.outputs.items()
        }

    def disturbed(self, C: Matrix) -> float:
        """Return the part of sup‖C x‖ from the disturbances: min(∫k, duration · sup k) of each."""
        total = 0.0
        for followed, duration_s in zip(self._disturbed, self._forcing.durations_s, strict=True):
            kernel = followed.through(C)
            at_most = kernel.integral()
            if np.isfinite(duration_s):
                at_most = min(at_most, float(duration_s) * kernel.sup())
            total += at_most
        return total + self._normally_disturbed(C)

    def _normally_disturbed(self, C: Matrix) -> float:
        """Return the part from normal disturbances: their sum in x is normal, too.

        At the end of a period x = S v, S Sᵀ the stationary covariance. Within it C e^{Mτ} x, M = A
        + BK, is bounded by Taylor's formula.
        """
        normal = self._forcing.normal
        if normal is None:
            return 0.0
        M, h, S = self.closed_loop, normal.period_s, self._deviations
        growth = float(np.exp(np.linalg.norm(M, 2) * h))
        bend = 0.5 * h**2 * growth * np.linalg.norm(C, 2) * np.linalg.norm(M @ M @ S, 2)
        spread = np.linalg.norm(C @ S, 2) + h * np.linalg.norm(C @ M @ S, 2) + bend
        pushed = np.linalg.norm(normal.columns, axis=0).sum() * np.linalg.norm(C, 2) * growth * h
        return float(normal.radius * spread + normal.limit * pushed) * (1 + 1e-6)

    @cached_property
    def _deviations(self) -> Matrix:
        """S with S Sᵀ the stationary covariance of x under the normal disturbances."""
        from scipy.linalg import solve_discrete_lyapunov

        normal = self._forcing.normal
        assert normal is not None
        period_ns = round(normal.period_s * NS_PER_S)
        step, pushed = discretise(self.closed_loop, normal.columns, period_ns)
        return deviations(np.asarray(solve_discrete_lyapunov(step, pushed @ pushed.T)))

    @cached_property
    def _disturbed(self) -> list[ResponseBounds]:
        return [response(self.closed_loop, column[:, None]) for column in self._forcing.columns.T]

    @property
    def _forcing(self) -> Forcing:
        n, m = self.B.shape
        return self.forcing or Forcing(np.zeros((n, 0)), np.zeros(0), np.zeros(m))

    @cached_property
    def forced(self) -> Mapping[str, KernelBounds]:
        """‖C e^{(A+BK+αI)τ} B U‖ for every output."""
        return self._forced.through_each(self.stacked)

    @cached_property
    def _forced(self) -> ResponseBounds:
        return response(self.closed_loop, self.input_matrix)

    @cached_method
    def on_grid(self, until_s: float, cells: int) -> tuple[Vector, Mapping[str, Vector]]:
        """Return the gains of a missing event's error, and of the input error, on equal cells.

        Returns:
            sup‖R e^{(H+αI)τ} W^{−1}‖ over each cell, and ∫‖C e^{(A+BK+αI)τ} B U‖ over each cell for
            every output.
        """
        error = self.error
        lost = response_until(error.scaled_H, error.inverse_weight, until_s, cells)
        forced = response_until(self.closed_loop, self.input_matrix, until_s, cells)
        areas = {output: one.area for output, one in forced.through_each(self.stacked).items()}
        return lost.through(error.outputs[Output.GAIN]).highest, areas

    @cached_method
    def start_up(self, start_s: float) -> tuple[float, Mapping[str, float]]:
        """Return the effect of zero input before ``start_s``, where p = −K x.

        Returns:
            sup‖p‖ over the start, and its contribution to every sup‖C x‖.
        """
        if start_s == 0:
            return 0.0, dict.fromkeys(self.outputs, 0.0)
        drift = self.A + self.alpha_per_s * np.eye(len(self.A))
        free = response_until(drift, self.start, start_s)
        R = self.error.split_K[1]
        error = free.through(R).sup_on_grid()
        for column in self._forcing.limited.T:
            pushed = response_until(drift, column[:, None], start_s)
            error += pushed.through(R).integral_on_grid()
        return error, {
            output: error * start_s * self.forced[output].sup() for output in self.outputs
        }

    @property
    def columns(self) -> Columns:
        """The columns through which e_s is driven."""
        return Columns(self.split_mismatch[0], self.input_matrix, self._forcing.limited)

    @cached_method
    def growth(self, until_s: float, cells: int) -> Growth:
        """Return the growth of ‖e_s‖_W over ``until_s``, on a grid."""
        error = self.error
        return error.growths(self.columns, until_s, cells, error.stacked_norm)[Output.WEIGHTED]

    @cached_method
    def growths(self, until_s: float, cells: int) -> Mapping[Output, Growth]:
        """Return the growth of every output C e_s over ``until_s``, on a grid."""
        return self.error.growths(self.columns, until_s, cells, self.error.stacked)


def deviations(covariance: Matrix) -> Matrix:
    """Return S with S Sᵀ = the covariance, (n, n)."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
