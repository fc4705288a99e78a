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
from noack.theory.bounds.gains import Columns, Growth, Output, PlantGains
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
        self.mean_s, self.highest = float(self.ages_s.mean()), np.zeros(())
        self.longest_s, self.stretch = longest_s, plant.error.stretch(longest_s)
        self.fixed, self.shares, self.root_output = after.beta, after.shares, after.root_output
        # The trigger tests x_s − x̂, and may compare it with x̂.
        self.estimation = 1 + sum(
            share * spectral_norm(outputs[C] @ plant.error.inverse_weight)
            for C, share in after.shares.items()
        )
        zero = np.zeros(())
        self.driven: tuple[Vector, Vector, Vector] = (zero, zero, zero)
        if longest_s > 0:
            growth = plant.growth(longest_s, COARSE_CELLS)
            self.driven, self.highest = growth.means(self.ages_s), growth.input_error.sup_on_grid()

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
    plant: PlantGains, level: Vector, mismatch: Vector, input_error: Vector, error_gain: Vector, start: Vector
) -> Vector:
    """Return times before which ‖e_s‖_W, starting at ``start``, cannot reach ``level``, (…, loops).

    Let ρ(r) = sup_{s≤r} ‖e_s‖_W. The part of e_c that equals the present e_s is bounded by ρ:

        ρ(r) ≤ ∫₀^r ‖W e^{Hs} L_E‖ sup‖R_E x‖ + ‖W e^{Hs} B U‖ (π' + k · ρ(r−s)) ds

    and further terms from the disturbances and ``start``. This is iterated from ρ = ``level``;
    every iterate is a bound until the level is reached.

    Args:
        plant: one plant, or as many as there are values, (loops,).
        level: one ‖e_s‖_W or several of each loop, (…, loops).
        mismatch: sup‖R_E x‖, (loops,).
        input_error: π', the input error without the effect of the present e_s, (loops,).
        error_gain: k = ‖K W^{−1}‖, (loops,).
        start: ‖e_s‖_W at first, (loops,).
    """
    window_s = _first_windows_s(plant, level, mismatch, input_error, error_gain)
    is_open, shape, loops = (level > start).ravel(), level.shape, level.shape[-1]
    level, window_s = level.ravel(), window_s.ravel()
    known_s, cells = np.zeros(level.size), np.full(level.size, COARSE_CELLS)
    while is_open.any():
        # All searches with the fewest cells together; e_s grows over the window of each.
        count = int(cells[is_open].min())
        places = np.flatnonzero(is_open & (cells == count))
        loop = places % loops
        columns = Columns(*(column[loop] if column.ndim == 3 else column for column in plant.columns))
        error = plant.error
        growth = error.growths(columns, window_s[places], count, error.stacked_norm)[Output.WEIGHTED]
        started = [
            size and size * error.stretch(until_s)
            for size, until_s in zip(start[loop].tolist(), window_s[places].tolist(), strict=True)
        ]
        first_cells = _first_crossed(
            growth,
            level[places],
            mismatch[loop],
            input_error[loop],
            error_gain[loop],
            np.array(started),
        )
        # The next window: the cell of the crossing with more cells, or twice the time.
        for place, edge_s, cell in zip(places.tolist(), growth.mismatch.edges_s, first_cells, strict=True):
            if cell < count:
                known_s[place] = max(known_s[place], edge_s[cell])
                is_open[place] = count != _FINE_CELLS
                window_s[place], cells[place] = edge_s[cell + 1], _FINE_CELLS
            elif window_s[place] >= LONGEST_S:
                known_s[place], is_open[place] = window_s[place], False
            else:  # not reached, also after a coarse grid's overestimate: extend the window
                known_s[place], window_s[place] = window_s[place], 2 * window_s[place]
    return known_s.reshape(shape)


def _first_windows_s(
    plant: PlantGains, level: Vector, mismatch: Vector, input_error: Vector, error_gain: Vector
) -> Vector:
    """Return twice the times to the level at the speed at which e_s can grow at first, limited."""
    growth = plant.growth(_SHORTEST_S, 1)
    speed = growth.mismatch.sup_on_grid() * mismatch
    speed = speed + growth.input_error.sup_on_grid() * (input_error + error_gain * level)
    speed = speed + growth.forced.sum(axis=-1) / _SHORTEST_S
    windows_s = np.where(speed > 0, 2 * level / np.where(speed > 0, speed, 1.0), LONGEST_S)
    return windows_s.clip(_SHORTEST_S, LONGEST_S)


def _first_crossed(
    growth: Growth, level: Vector, mismatch: Vector, input_error: Vector, error_gain: Vector, started: Vector
) -> list[int]:
    """Return the first cell of each loop in which the level may be reached, or their number."""
    areas = growth.mismatch.area * mismatch[:, None]
    areas = areas + growth.input_error.area * input_error[:, None]
    fixed = np.cumsum(areas + growth.forced, axis=-1) + started[:, None]
    rho = np.repeat(level[:, None], fixed.shape[-1], axis=1)
    echoing = np.broadcast_to(growth.input_error.area, rho.shape)
    for _ in range(_PICARD_ROUNDS):
        echo = [np.convolve(area, r)[: len(r)] for area, r in zip(echoing, rho, strict=True)]
        before, rho = rho, np.minimum(level[:, None], fixed + error_gain[:, None] * np.array(echo))
        if np.array_equal(before, rho):
            break
    crossed = rho >= level[:, None]
    cells: list[int] = np.where(crossed.any(axis=1), crossed.argmax(axis=1), rho.shape[1]).tolist()
    return cells
