"""The gains of the errors e_s and e_c, which depend on the models alone.

:mod:`noack.theory.plant_gains` has the equations.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from noack.config.resolution import LoopMatrices
from noack.core.cached_method import cached_method
from noack.core.linear_systems import (
    Matrix,
    MatrixKey,
    Vector,
    matrix_key,
    matrix_of,
    spectral_abscissa,
)
from noack.theory.enclosure import (
    Outputs,
    factors,
    norm_bounds,
    response,
    response_until,
)
from noack.theory.kernel_bounds import KernelBounds, constant_kernel


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
        disturbed = float(self.forced.sum())
        return self.input_error.integral_on_grid(), self.mismatch.integral_on_grid(), disturbed


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
        followed = response(self.scaled_H, self.inverse_weight)
        found = followed.through_each(self.stacked)
        if self.contracts:  # ‖·‖_W is a Lyapunov function: no sum of missing events exceeds M
            norm = found[Output.WEIGHTED]
            found[Output.WEIGHTED] = replace(norm, highest=np.minimum(norm.highest, 1.0))
        return found

    @cached_property
    def contracts(self) -> bool:
        """Whether ‖e^{(H+αI)τ}‖_W ≤ 1 for all τ: (H+αI)ᵀWᵀW + WᵀW(H+αI) ⪯ 0, to rounding."""
        turned = self.weight @ self.scaled_H @ self.inverse_weight
        size = float(np.linalg.norm(turned, 2))
        return float(np.linalg.eigvalsh(turned + turned.T).max()) <= 1e-12 * size

    @cached_method
    def now(self, output: Output) -> float:
        """Return ‖C W^{−1}‖, the gain of the present e_s."""
        if output is Output.WEIGHTED:
            return 1.0
        return float(norm_bounds(self.outputs[output], self.inverse_weight[None])[0])

    def missing(self, output: Output, events: int, spacing_s: float) -> float:
        """Return Σ_{j<N} sup_{τ ≥ jδ} ‖C e^{(H+αI)τ} W^{−1}‖, the gain of N missing events."""
        return float(
            self.kernels[output].sups(spacing_s * np.arange(events, dtype=np.float64)).sum()
        )

    def missing_until(self, output: Output, events: int, due_s: float) -> float:
        """Return Σ_{j<N} sup_{τ ≤ (j+1)L} ‖C e^{(H+αI)τ} W^{−1}‖, for events at most L apart."""
        return self._all_missing_until(events, due_s)[output]

    @cached_method
    def _all_missing_until(self, events: int, due_s: float) -> Mapping[Output, float]:
        totals = dict.fromkeys(self.outputs, 0.0)
        for number in range(events):
            until_s = (number + 1) * due_s
            followed = response_until(self.scaled_H, self.inverse_weight, until_s)
            for output, kernel in followed.through_each(self.stacked).items():
                totals[output] += kernel.sup_on_grid()
        return totals

    @property
    def decays(self) -> bool:
        """Whether e^{(H+αI)τ} decays, or is constant in a hold."""
        return not self.scaled_H.any() or spectral_abscissa(self.scaled_H) < 0

    def growths(
        self, columns: Columns, until_s: float, cells: int, outputs: Outputs[Output]
    ) -> dict[Output, Growth]:
        """Return the growth of some outputs C e_s, with what drives e_s through these columns."""
        driven = np.hstack([columns.mismatch, columns.input_error])
        groups = (0, columns.mismatch.shape[1])
        kernels = response_until(self.scaled_H, driven, until_s, cells, groups)
        areas = dict.fromkeys(outputs.names, np.zeros(cells))
        if columns.disturbed.size:
            disturbed = response_until(self.scaled_H, columns.disturbed, until_s, cells)
            areas = {C: disturbed.areas_of_columns(self.outputs[C]) for C in outputs.names}
        return {
            output: Growth(mismatch, input_error, areas[output])
            for output, (mismatch, input_error) in kernels.through_groups(outputs).items()
        }

    @cached_method
    def stretch(self, until_s: float) -> float:
        """Return sup‖e^{(H+αI)τ}‖_W over τ ≤ ``until_s``, the growth of a sampled error."""
        if until_s == 0:
            return 1.0
        followed = response_until(self.scaled_H, self.inverse_weight, until_s)
        return followed.through(self.weight).sup_on_grid()

    @cached_method
    def hold_remainder(self, hold_s: float) -> float:
        """Bound ‖K(e^{−Hσ} − I + Hσ − ½H²σ²) W^{−1}‖ for |σ| ≤ ``hold_s``.

        It is at most σ³/6 sup‖K H³ e^{−Hs} W^{−1}‖.
        """
        if hold_s == 0:
            return 0.0
        third = self.outputs[Output.GAIN_CURVATURE] @ self.H
        responses = (response_until(G, self.inverse_weight, hold_s, 16) for G in (-self.H, self.H))
        return hold_s**3 / 6 * max(one.through(third).sup_on_grid() for one in responses)


def error_gains(loop: LoopMatrices, alpha_per_s: float) -> ErrorGains:
    """Return the gains of a resolved loop's models; loops with equal models share them."""
    weight = np.eye(loop.n) if loop.weight is None else loop.weight
    return _error_gains(*map(matrix_key, (loop.H, loop.K, weight)), alpha_per_s)


@lru_cache(maxsize=64)
def _error_gains(H: MatrixKey, K: MatrixKey, weight: MatrixKey, alpha_per_s: float) -> ErrorGains:
    return ErrorGains(matrix_of(H), matrix_of(K), matrix_of(weight), alpha_per_s)
