"""The growth of e_s between two tests of a trigger, and from an event until it can reach a level.

:class:`ErrorGrowth` bounds e_s from a test on until the next one; :func:`first_passage_s` bounds the
time from an event until the next one by iterating a Volterra inequality (Gripenberg, Londen and
Staffans, *Volterra Integral and Functional Equations*, 1990).
"""

import math
from collections.abc import Mapping

import numpy as np

from noack.core.linear_systems import Vector
from noack.theory.bounds.certificate_terms import TriggerBound
from noack.theory.bounds.gains import Growth, PlantGains
from noack.theory.bounds.stacked_norms import spectral_norm

COARSE_CELLS = 64
"""Cells of a time between two tests or events, over which growths of errors are bounded."""
_FINE_CELLS = 256
"""Cells of a window of time: at first, and where the level is reached."""
_SHORTEST_S, LONGEST_S = 1e-9, 1e6
"""Limits of the window."""
_PICARD_ROUNDS = 8
"""Iterations of Volterra's inequality, each of which gives a bound."""


class ErrorGrowth:
    """The growth of e_s without a test: from the bound after a test, or from 0 after an event.

    Then ‖e_s‖_W ≤ ``fixed`` + ``estimation`` η + Σ_C ``shares``_C sup‖C x‖ =: b. Until the next
    test, sup‖e_s‖_W ≤ ``stretch`` b + ``driven`` · (sup‖p‖, sup‖R_E x‖, 1).

    ``ages_s``: b bounds the mean of ‖e_s‖_W over the times of these ages; by default only ``longest_s``.
    """

    def __init__(
        self, plant: PlantGains, longest_s: float, after: TriggerBound, ages_s: Vector | None = None
    ) -> None:
        outputs = plant.outputs
        self.ages_s = np.array([longest_s]) if ages_s is None else ages_s
        self.mean_s, self.highest = float(self.ages_s.mean()), 0.0
        self.longest_s, self.stretch = longest_s, plant.error.stretch(longest_s)
        self.fixed, self.shares, self.root_output = after.beta, after.shares, after.root_output
        # The trigger tests x_s − x̂, and may compare it with x̂.
        self.estimation = 1 + sum(
            share * spectral_norm(outputs[C] @ plant.error.inverse_weight)
            for C, share in after.shares.items()
        )
        self.driven = (0.0, 0.0, 0.0)
        if longest_s > 0:
            growth = plant.growth(longest_s, COARSE_CELLS)
            self.driven, self.highest = growth.means(self.ages_s), float(growth.input_error.sup_on_grid())

    def after_test(self, states: Mapping[str, float]) -> float:
        """Return b, given bounds of sup‖C x‖; not linear in them."""
        shares = sum(share * states[C] for C, share in self.shares.items() if self.root_output != C)
        return math.hypot(self.fixed, states.get(self.root_output, 0.0)) + shares


def list_growths(plant: PlantGains, sampling_s: float, bound: TriggerBound) -> list[ErrorGrowth]:
    """Return how e_s grows after a test, and from 0 after an event, or one growth for both."""
    tested_s, untested_s = sampling_s + bound.window_s, sampling_s + bound.untested_s
    if bound.merges_growths:
        return [ErrorGrowth(plant, max(tested_s, untested_s), bound)]
    growths = []
    if bound.is_tested:
        growths.append(ErrorGrowth(plant, tested_s, bound, _mean_ages_s(bound, sampling_s)))
    if bound.untested_s > 0 or not bound.is_tested:
        growths.append(ErrorGrowth(plant, untested_s, TriggerBound(0.0, None)))
    return growths


def _mean_ages_s(bound: TriggerBound, sampling_s: float) -> Vector | None:
    """Return the ages of the e_s of which the bound is that of a mean, at most, if it is one."""
    if not (bound.is_mean and bound.window_s):
        return None
    if sampling_s == 0:
        return bound.window_s * np.arange(1, COARSE_CELLS + 1) / COARSE_CELLS
    # The trapezoid of the two tests i and i + 1 before the last one.
    tests = np.arange(1, round(bound.window_s / sampling_s) + 1)
    return sampling_s * np.concatenate([tests, tests + 1])


def first_passage_s(
    plant: PlantGains, *, level: float, mismatch: float, input_error: float, error_gain: float, start: float
) -> float:
    """Return a time before which ‖e_s‖_W, starting at ``start``, cannot reach ``level``.

    Let ρ(r) = sup_{s≤r} ‖e_s‖_W. The part of e_c that equals the present e_s is bounded by ρ:

        ρ(r) ≤ ∫₀^r ‖W e^{Hs} L_E‖ sup‖R_E x‖ + ‖W e^{Hs} B U‖ (π' + k · ρ(r−s)) ds

    and further terms from the disturbances and ``start``. This is iterated from ρ = ``level``;
    every iterate is a bound until the level is reached.

    Args:
        plant: the plant.
        level: ‖e_s‖_W.
        mismatch: sup‖R_E x‖.
        input_error: π', the input error without the effect of the present e_s.
        error_gain: k = ‖K W^{−1}‖.
        start: ‖e_s‖_W at first.
    """
    known_s, cells = 0.0, COARSE_CELLS
    if level <= start:
        return known_s
    window_s = _first_window_s(plant, level, mismatch, input_error, error_gain)
    while True:
        growth, started = plant.growth(window_s, cells), start and start * plant.error.stretch(window_s)
        cell = _first_crossed(growth, level, mismatch, input_error, error_gain, started)
        edges_s = growth.mismatch.edges_s
        # The next window: the cell of the crossing with more cells, or twice the time.
        if cell < cells:
            known_s = max(known_s, float(edges_s[cell]))
            if cells == _FINE_CELLS:
                return known_s
            window_s, cells = float(edges_s[cell + 1]), _FINE_CELLS
        elif window_s >= LONGEST_S:
            return window_s
        else:  # not reached, also after a coarse grid's overestimate: extend the window
            known_s, window_s = window_s, 2 * window_s


def _first_window_s(
    plant: PlantGains, level: float, mismatch: float, input_error: float, error_gain: float
) -> float:
    """Return twice the time to the level at the speed at which e_s can grow at first, limited."""
    growth = plant.growth(_SHORTEST_S, 1)
    speed = float(growth.mismatch.sup_on_grid()) * mismatch
    speed += float(growth.input_error.sup_on_grid()) * (input_error + error_gain * level)
    speed += float(growth.forced.sum()) / _SHORTEST_S
    return min(max(2 * level / speed if speed > 0 else LONGEST_S, _SHORTEST_S), LONGEST_S)


def _first_crossed(
    growth: Growth, level: float, mismatch: float, input_error: float, error_gain: float, started: float
) -> int:
    """Return the first cell in which the level may be reached, or the number of cells."""
    areas = growth.mismatch.area * mismatch + growth.input_error.area * input_error + growth.forced
    fixed = np.cumsum(areas) + started
    rho = np.full(len(fixed), level)
    for _ in range(_PICARD_ROUNDS):
        echo = np.convolve(growth.input_error.area, rho)[: len(rho)]
        before, rho = rho, np.minimum(level, fixed + error_gain * echo)
        if np.array_equal(before, rho):
            break
    crossed = rho >= level
    return int(crossed.argmax()) if crossed.any() else len(rho)
