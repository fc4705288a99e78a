"""The gains of a loop that a certificate needs, between all pairs of signals.

All signals are scaled by e^{αt}, so that a decaying bound becomes a constant one. With K = U R (U
has orthonormal columns), the input error is p = u − K x, which acts on the plant through B U:

    x' = (A + BK) x + B p,      e_s' = H e_s − E x − B p,      E = A + BK − H

and, by identity (I1), e_c is e_s plus the contributions of the missing events. The outputs of
interest are the weighted norm W, the state itself, E x, and K H x (the error rate of a held input).

:class:`Forcing` describes disturbances; :class:`ErrorGains` has the gains of e_s and e_c, which
depend on the models alone; :class:`PlantGains` those of one known plant.
"""

import warnings
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from functools import cached_property, lru_cache
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.cached_method import cached_function, cached_method
from noack.core.clock import NS_PER_S
from noack.core.linear_systems import (
    Matrix,
    MatrixKey,
    Vector,
    discretise,
    matrix_key,
    matrix_of,
    spectral_abscissa,
)
from noack.scenario.resolution import LoopMatrices
from noack.theory.bounds.enclosure import (
    KernelBounds,
    NotDecayingError,
    Outputs,
    ResponseBounds,
    constant_kernel,
    factors,
    norm_bounds,
    response,
    response_until,
)
from noack.theory.bounds.stacked_norms import ROUNDING, spectral_norm

Counts = NDArray[np.int64]
_AT_ONCE = 64
"""Missing events whose responses are computed at once."""


class NormalForcing(NamedTuple):
    """Disturbances D ξ, ξ of k independent standard normal values, constant over each period."""

    columns: Matrix
    """D, (n, k)."""
    period_s: float
    limit: float
    """Assumed bound of every single value of ξ."""
    radius: float
    """Assumed bound of ‖v‖ for n independent standard normal values v, at every period's end."""


class Forcing(NamedTuple):
    """Disturbances: ẋ = Ax + Bu + Σ_i D_i s_i, |s_i| ≤ 1 at every time, and normal ones."""

    columns: Matrix
    """D_i, (n, k)."""
    durations_s: Vector
    """The time for which s_i is not 0, (k,); infinite if it never ends."""
    at_input: Vector
    """Bound of what is added to u, included in the columns, (m,)."""
    normal: NormalForcing | None = None

    @property
    def limited(self) -> Matrix:
        """Columns with the bounds of all values, normal ones included, (n, k')."""
        if self.normal is None:
            return self.columns
        return np.hstack([self.columns, self.normal.limit * self.normal.columns])


class Output(StrEnum):
    """The output matrix C of a state or error."""

    STATE = "I"
    WEIGHTED = "W"
    MISMATCH = "E"
    GAIN = "K"
    GAIN_RATE = "KH"
    GAIN_CURVATURE = "KHH"


class Columns(NamedTuple):
    """The columns through which e_s is driven."""

    mismatch: Matrix
    """L_E, E = L_E R_E"""
    input_error: Matrix
    """B U"""
    disturbed: Matrix
    """D_i"""


class Growth(NamedTuple):
    """The growth of ‖C e_s‖ after a reset; C = W if no output is named."""

    mismatch: KernelBounds
    """‖C e^{Hτ} L_E‖, E = L_E R_E"""
    input_error: KernelBounds
    """‖C e^{Hτ} B U‖"""
    forced: Vector
    """Σ_i ∫‖C e^{Hτ} D_i‖ over each cell of the grid, from the disturbances."""

    @property
    def totals(self) -> tuple[float, float, float]:
        """The integrals over the grid: of the input error, the mismatch, the disturbances."""
        driven = (self.input_error.integral_on_grid(), self.mismatch.integral_on_grid(), self.forced.sum())
        return float(driven[0]), float(driven[1]), float(driven[2])

    def means(self, times_s: Vector) -> tuple[float, float, float]:
        """Return the means over some times of the integrals up to each."""
        cells = self.forced.shape[-1]
        # A time that is a node but for rounding counts as that node.
        nodes = np.sort(np.ceil(times_s / times_s.max() * cells * (1 - 1e-9)))
        # The share of the times that are after the start of each cell.
        weights = 1 - np.searchsorted(nodes, np.arange(cells), side="right") / len(nodes)
        by_input, mismatched = (float(k.area @ weights) for k in (self.input_error, self.mismatch))
        return by_input, mismatched, float(self.forced @ weights)


@dataclass(frozen=True)
class ErrorGains:
    """Gains of the models, which depend on H (n, n), K (m, n), W (n, n) and α of the scaling."""

    H: Matrix
    K: Matrix
    weight: Matrix
    alpha_per_s: float

    @cached_property
    def inverse_weight(self) -> Matrix:
        """W^{−1}."""
        return np.asarray(np.linalg.inv(self.weight))

    @cached_property
    def scaled_H(self) -> Matrix:
        """H + αI."""
        return self.H + self.alpha_per_s * np.eye(len(self.H))

    @cached_property
    def split_K(self) -> tuple[Matrix, Matrix]:
        """U, R with K = U R."""
        return factors(self.K)

    @cached_property
    def outputs(self) -> Mapping[Output, Matrix]:
        """C of each output C e_c."""
        R = self.split_K[1]
        return {
            Output.WEIGHTED: self.weight,
            Output.GAIN: R,
            Output.GAIN_RATE: R @ self.H,
            Output.GAIN_CURVATURE: R @ self.H @ self.H,
        }

    @cached_property
    def stacked(self) -> Outputs[Output]:
        """All outputs, whose bounds are computed at once."""
        return Outputs(self.outputs)

    @cached_property
    def stacked_norm(self) -> Outputs[Output]:
        """The trigger's norm alone."""
        return Outputs({Output.WEIGHTED: self.weight})

    @cached_property
    def kernels(self) -> Mapping[Output, KernelBounds]:
        """‖C e^{(H+αI)τ} W^{−1}‖ for every output.

        Raises:
            NotDecayingError: α is not below the decay rate of e^{Hτ}.
        """
        if not self.scaled_H.any():  # a hold: a missed update's contribution does not decay
            return {output: constant_kernel(self.now(output)) for output in self.outputs}
        responses = response(self.scaled_H, self.inverse_weight)
        kernels = responses.through_each(self.stacked)
        if self.contracts:  # ‖·‖_W is a Lyapunov function: no sum of missing events exceeds M
            norm = kernels[Output.WEIGHTED]
            kernels[Output.WEIGHTED] = replace(norm, highest=np.minimum(norm.highest, 1.0))
        return kernels

    @cached_property
    def contracts(self) -> bool:
        """Whether ‖e^{(H+αI)τ}‖_W ≤ 1 for all τ: (H+αI)ᵀWᵀW + WᵀW(H+αI) ⪯ 0, to rounding."""
        transformed = self.weight @ self.scaled_H @ self.inverse_weight
        size = float(np.linalg.norm(transformed, 2))
        return float(np.linalg.eigvalsh(transformed + transformed.T).max()) <= 1e-12 * size

    @cached_method
    def now(self, output: Output) -> float:
        """Return ‖C W^{−1}‖, the gain of the present e_s."""
        if output is Output.WEIGHTED:
            return 1.0
        return float(norm_bounds(self.outputs[output], self.inverse_weight[None])[0])

    def missing(self, output: Output, events: int | Counts, inter_event_s: float | Vector) -> Vector:
        """Return Σ_{j<N} sup_{τ ≥ jδ} ‖C e^{(H+αI)τ} W^{−1}‖, the gain of N missing events.

        N and δ are those of one loop or of several, (…).
        """
        return sum_of_sups(self.kernels[output], events, inter_event_s)

    def missing_until(self, output: Output, events: int, due_s: float) -> float:
        """Return Σ_{j<N} sup_{τ ≤ (j+1)L} ‖C e^{(H+αI)τ} W^{−1}‖, for events at most L apart."""
        return self._all_missing_until(events, due_s)[output]

    @cached_method
    def _all_missing_until(self, events: int, due_s: float) -> Mapping[Output, float]:
        totals = dict.fromkeys(self.outputs, 0.0)
        for first in range(0, events, _AT_ONCE):
            until_s = np.asarray(due_s * np.arange(first + 1.0, min(first + _AT_ONCE, events) + 1.0))
            responses = response_until(self.scaled_H, self.inverse_weight, until_s)
            for output, kernel in responses.through_each(self.stacked).items():
                totals[output] += float(kernel.sup_on_grid().sum())
        return totals

    @cached_property
    def decays(self) -> bool:
        """Whether e^{(H+αI)τ} decays, or is constant in a hold."""
        return not self.scaled_H.any() or spectral_abscissa(self.scaled_H) < 0

    def growths(
        self, columns: Columns, until_s: float | Vector, cells: int, outputs: Outputs[Output]
    ) -> dict[Output, Growth]:
        """Return the growth of some outputs C e_s, with what drives e_s through these columns."""
        pair = columns.mismatch, columns.input_error
        lead = np.broadcast_shapes(*(column.shape[:-2] for column in pair))
        alike = [np.broadcast_to(column, (*lead, *column.shape[-2:])) for column in pair]
        driven, groups = np.concatenate(alike, axis=-1), (0, columns.mismatch.shape[-1])
        kernels = response_until(self.scaled_H, driven, until_s, cells, groups)
        areas = dict.fromkeys(outputs.names, np.zeros(cells))
        if columns.disturbed.size:
            disturbed = response_until(self.scaled_H, columns.disturbed, until_s, cells)
            areas = {C: disturbed.areas_of_columns(self.outputs[C]) for C in outputs.names}
        return {
            output: Growth(mismatch, input_error, areas[output])
            for output, (mismatch, input_error) in kernels.through_groups(outputs).items()
        }

    def stretch(self, until_s: float) -> float:
        """Return sup‖e^{(H+αI)τ}‖_W over τ ≤ ``until_s``, the growth of a sampled error."""
        return self.now_until(until_s)[Output.WEIGHTED]

    @cached_method
    def now_until(self, until_s: float) -> Mapping[Output, float]:
        """Return sup‖C e^{(H+αI)τ} W^{−1}‖ over τ ≤ ``until_s`` for every output."""
        if until_s == 0:
            return {output: self.now(output) for output in self.outputs}
        responses = response_until(self.scaled_H, self.inverse_weight, until_s)
        kernels = responses.through_each(self.stacked)
        return {output: float(kernel.sup_on_grid()) for output, kernel in kernels.items()}

    def age_gains(self, hold_s: float) -> Mapping[Output, float]:
        """Return gains g_C: an input of age σ ≤ ``hold_s`` adds at most Σ g_C ‖C x_c‖ to ‖u − Kx‖.

        They are those of Taylor's formula: σ of K H, σ²/2 of K H², and the remainder of W.
        """
        return {
            Output.GAIN_RATE: hold_s,
            Output.GAIN_CURVATURE: hold_s**2 / 2,
            Output.WEIGHTED: self.hold_remainder(hold_s),
        }

    @cached_method
    def hold_remainder(self, hold_s: float) -> float:
        """Bound ‖K(e^{−Hσ} − I + Hσ − ½H²σ²) W^{−1}‖ for |σ| ≤ ``hold_s``.

        It is at most σ³/6 sup‖K H³ e^{−Hs} W^{−1}‖.
        """
        if hold_s == 0:
            return 0.0
        third = self.outputs[Output.GAIN_CURVATURE] @ self.H
        responses = (response_until(G, self.inverse_weight, hold_s, 16) for G in (-self.H, self.H))
        sups = (followed.through(third).sup_on_grid() for followed in responses)
        return float(hold_s**3 / 6 * max(sups))


def sum_of_sups(kernel: KernelBounds, events: int | Counts, inter_event_s: float | Vector) -> Vector:
    """Return Σ_{j<N} sup_{τ ≥ jδ} k(τ), (…)."""
    numbers = np.arange(np.max(events, initial=0), dtype=np.float64)
    sups = kernel.sups(np.asarray(inter_event_s)[..., None] * numbers)
    missing = numbers < np.asarray(events)[..., None]
    return np.asarray(np.where(missing, sups, 0.0).sum(axis=-1))


def error_gains(loop: LoopMatrices, alpha_per_s: float) -> ErrorGains:
    """Return the gains of a resolved loop's models; loops with equal models share them."""
    weight = np.eye(loop.n) if loop.weight is None else loop.weight
    keys = matrix_key(loop.H), matrix_key(loop.K), matrix_key(weight)
    return _error_gains(*keys, alpha_per_s)


@lru_cache(maxsize=64)
def _error_gains(H: MatrixKey, K: MatrixKey, weight: MatrixKey, alpha_per_s: float) -> ErrorGains:
    return ErrorGains(matrix_of(H), matrix_of(K), matrix_of(weight), alpha_per_s)


class Coefficients(NamedTuple):
    """sup‖C x‖ ≤ ``free`` + ``gain`` · sup‖p‖, of one loop or of several, (…)."""

    free: Vector
    gain: Vector


@dataclass(frozen=True)
class PlantGains:
    """Gains of one known plant, A (n, n) and B (n, m); or of several, (…, n, n) and (…, n, m).

    ``start`` is x(0) as a column, (n, 1), or a matrix that maps the unit ball to a set with x(0).
    α of the scaling may differ from that of the models. Several plants (:meth:`together`) have the
    same models; what differs among them has a leading axis, and so have the results.
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

    @property
    def cache_key(self) -> Hashable:
        """The common properties of equal plants without disturbances."""
        values = [getattr(self, entry.name) for entry in fields(self)]
        outputs = [(name, matrix_key(C)) for name, C in self.further_outputs.items()]
        matrices = [matrix_key(value) for value in values if isinstance(value, np.ndarray)]
        return type(self), id(self.error), self.alpha_per_s, *outputs, *matrices

    @cached_property
    def input_matrix(self) -> Matrix:
        """B U."""
        return self.B @ self.error.split_K[0]

    @cached_property
    def closed_loop(self) -> Matrix:
        """A + BK + αI."""
        return self.A + self.B @ self.error.K + self.alpha_per_s * np.eye(len(self.error.H))

    @property
    def _mismatch(self) -> Matrix:
        """E."""
        return self.A + self.B @ self.error.K - self.error.H

    @cached_property
    def split_mismatch(self) -> tuple[Matrix, Matrix]:
        """L_E, R_E with E = L_E R_E; W L_E has orthonormal columns, so ‖R_E x‖ = ‖E x‖_W."""
        L, R = factors(self.error.weight @ self._mismatch)
        return self.error.inverse_weight @ L, R

    @cached_property
    def outputs(self) -> Mapping[str, Matrix]:
        """C of each output C x."""
        return {
            Output.STATE: np.eye(len(self.error.H)),
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
        return {
            output: Coefficients(self.free[output].sup() + self.disturbed(C), self.forced[output].integral())
            for output, C in self.outputs.items()
        }

    @cached_property
    def free(self) -> Mapping[str, KernelBounds]:
        """‖C e^{(A+BK+αI)τ} x(0)‖ for every output."""
        return response(self.closed_loop, self.start).through_each(self.stacked)

    def disturbed(self, C: Matrix) -> float:
        """Return the part of sup‖C x‖ from the disturbances: min(∫k, duration · sup k) of each."""
        total = 0.0
        for followed, duration_s in zip(self._disturbed, self._forcing.durations_s, strict=True):
            kernel = followed.through(C)
            at_most = float(kernel.integral())
            if np.isfinite(duration_s):
                at_most = min(at_most, float(duration_s * kernel.sup()))
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
        M = self.closed_loop
        h = normal.period_s
        S = self._deviations
        growth = float(np.exp(np.linalg.norm(M, 2) * h))
        bend = 0.5 * h**2 * growth * np.linalg.norm(C, 2) * np.linalg.norm(M @ M @ S, 2)
        spread = np.linalg.norm(C @ S, 2) + h * np.linalg.norm(C @ M @ S, 2) + bend
        entered = np.linalg.norm(normal.columns, axis=0).sum() * np.linalg.norm(C, 2) * growth * h
        # The inflation exceeds the rounding of the covariance, as estimated.
        return float(normal.radius * spread + normal.limit * entered) * (1 + 1e-6)

    @cached_property
    def _deviations(self) -> Matrix:
        """S with S Sᵀ the stationary covariance of x under the normal disturbances."""
        normal = self._forcing.normal
        assert normal is not None
        period_ns = round(normal.period_s * NS_PER_S)
        step, increments = discretise(self.closed_loop, normal.columns, period_ns)
        return deviations(stationary_covariance(step, increments @ increments.T))

    @cached_property
    def _disturbed(self) -> list[ResponseBounds]:
        return [response(self.closed_loop, column[:, None]) for column in self._forcing.columns.T]

    @property
    def _forcing(self) -> Forcing:
        n, m = self.B.shape[-2:]
        return self.forcing or Forcing(np.zeros((n, 0)), np.zeros(0), np.zeros(m))

    @cached_property
    def forced(self) -> Mapping[str, KernelBounds]:
        """‖C e^{(A+BK+αI)τ} B U‖ for every output."""
        return self._forced.through_each(self.stacked)

    @cached_property
    def _forced(self) -> ResponseBounds:
        return response(self.closed_loop, self.input_matrix)

    @cached_method
    def start_up(self, start_s: float) -> tuple[Vector, Mapping[str, Vector]]:
        """Return the effect of zero input before ``start_s``, where p = −K x.

        Returns:
            sup‖p‖ over the start, (…), and its contribution to every sup‖C x‖.
        """
        if start_s == 0:
            return np.zeros(()), dict.fromkeys(self.outputs, np.zeros(()))
        drift = self.A + self.alpha_per_s * np.eye(len(self.error.H))
        free = response_until(drift, self.start, start_s)
        R = self.error.split_K[1]
        error = free.through(R).sup_on_grid()
        for column in self._forcing.limited.T:
            entered = response_until(drift, column[:, None], start_s)
            error = error + entered.through(R).integral_on_grid()
        return error, {output: error * start_s * self.forced[output].sup() for output in self.outputs}

    @property
    def columns(self) -> Columns:
        """The columns through which e_s is driven."""
        return Columns(self.split_mismatch[0], self.input_matrix, self._forcing.limited)

    @cached_property
    def driven(self) -> Mapping[Output, tuple[KernelBounds, KernelBounds]]:
        """‖C e^{(H+αI)τ} B U‖ and ‖C e^{(H+αI)τ} L_E‖ for every output C e_c.

        Raises:
            NotDecayingError: α is not below the decay rate of e^{Hτ}.
        """
        error, columns = self.error, self.columns

        def kernels(driven: Matrix) -> Mapping[Output, KernelBounds]:
            if error.scaled_H.any():
                return response(error.scaled_H, driven).through_each(error.stacked)
            norms = {C: spectral_norm(M @ driven) * ROUNDING for C, M in error.outputs.items()}
            return {output: constant_kernel(norm) for output, norm in norms.items()}

        by_input, mismatched = kernels(columns.input_error), kernels(columns.mismatch)
        return {output: (by_input[output], mismatched[output]) for output in error.outputs}

    @cached_method
    def growth(self, until_s: float | Vector, cells: int) -> Growth:
        """Return the growth of ‖e_s‖_W over ``until_s``, on a grid."""
        error = self.error
        return error.growths(self.columns, until_s, cells, error.stacked_norm)[Output.WEIGHTED]

    @cached_method
    def growths(self, until_s: float, cells: int) -> Mapping[Output, Growth]:
        """Return the growth of every output C e_s over ``until_s``, on a grid."""
        return self.error.growths(self.columns, until_s, cells, self.error.stacked)


@cached_function(16, key=lambda plant: plant.cache_key)
def first_equal(plant: PlantGains) -> PlantGains:
    """Return the first of several equal plants, which have no disturbances; the others use its gains."""
    return plant


def deviations(covariance: Matrix) -> Matrix:
    """Return S with S Sᵀ = the covariance, (n, n)."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def stationary_covariance(step: Matrix, added: Matrix) -> Matrix:
    """Return P = F P Fᵀ + Q for the step F, whose spectral radius is below 1, and Q, (n, n) each.

    Raises:
        NotDecayingError: F decays so slowly that P is not known within rounding.
    """
    from scipy.linalg import LinAlgWarning, solve_discrete_lyapunov  # slow to import

    try:
        with warnings.catch_warnings(action="error", category=LinAlgWarning):
            return np.asarray(solve_discrete_lyapunov(step, added))
    except (LinAlgWarning, np.linalg.LinAlgError, ValueError):
        raise NotDecayingError("a covariance is not known within rounding") from None
