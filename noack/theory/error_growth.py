"""How e_s grows: from what a trigger guarantees after a test, and from 0 after an event."""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from noack.theory.error_gains import Output
from noack.theory.plant_gains import PlantGains

COARSE_CELLS = 64
_FINE_CELLS = 256
_SHORTEST_S, LONGEST_S = 1e-9, 1e6
_PICARD_ROUNDS = 8


class TriggerBound(NamedTuple):
    """What a trigger guarantees about e_s, scaled.

    After each of its tests ‖e_s‖_W ≤ β + Σ_C share_C sup‖C x‖.
    """

    beta: float
    """β, in the units of ‖W x‖."""
    reached: float | None
    """The smallest ‖e_s‖_W at an event; None if it may be arbitrarily small."""
    shares: Mapping[str, float] = MappingProxyType({})
    """share_C by the name of C in :attr:`PlantGains.outputs`."""
    untested_s: float = 0.0
    """After an event the trigger is not tested for this time: e_s grows from 0 for up to h more."""
    is_tested: bool = True
    """Whether there is a test at all; without one, only the time since the event bounds e_s."""
    ago_s: float = 0.0
    """The bound is that of ‖e_s‖_W at some time up to this long before the test. An event comes no
    earlier than this after the last one, unless ‖e_s‖_W has exceeded ``reached``."""
    apart_s: float = 0.0
    """Events are at least this far apart, whatever happens to e_s."""
    due_s: float = math.inf
    """Events are at most this far apart."""
    also: tuple["TriggerBound", ...] = ()
    """Further bounds that hold at the same time; only their e_s is used, not their times."""
    unit: float | None = None
    """Unit of the constants Δ and β̃/β; by default β."""

    @property
    def every(self) -> tuple["TriggerBound", ...]:
        """This bound and the further ones."""
        return (self, *self.also)


class ErrorGrowth:
    """The growth of e_s without a test: from the bound after a test, or from 0 after an event.

    sup‖e_s‖_W ≤ ``fixed`` + ``estimation`` η + Σ_C ``shares``_C sup‖C x‖ + ``input_error`` sup‖p‖
    """

    def __init__(self, plant: PlantGains, longest_s: float, after: TriggerBound) -> None:
        stretch, outputs = plant.error.stretch(longest_s), plant.outputs
        self.fixed, self.input_error = stretch * after.beta, 0.0
        # The trigger tests x_s − x̂, and may compare it with x̂.
        self.estimation = stretch * (1 + sum(
            share * float(np.linalg.norm(outputs[C] @ plant.error.inverse_weight, 2))
            for C, share in after.shares.items()
        ))  # fmt: skip
        shares = {C: stretch * share for C, share in after.shares.items()}
        if longest_s > 0:
            growth = plant.growth(longest_s, COARSE_CELLS)
            mismatch = growth.mismatch.integral_on_grid()
            shares[Output.MISMATCH] = shares.get(Output.MISMATCH, 0.0) + mismatch
            self.input_error = growth.input_error.integral_on_grid()
            self.fixed += float(growth.forced.sum())
        self.shares: Mapping[str, float] = shares


def growths_of(plant: PlantGains, sampling_s: float, bound: TriggerBound) -> list[ErrorGrowth]:
    """Return the growth from the bound after a test, and from 0 after an event."""
    found = []
    if bound.is_tested:
        found.append(ErrorGrowth(plant, sampling_s + bound.ago_s, bound))
    if bound.untested_s > 0 or not bound.is_tested:
        found.append(ErrorGrowth(plant, sampling_s + bound.untested_s, TriggerBound(0.0, None)))
    return found


def first_passage_s(
    plant: PlantGains,
    level: float,
    mismatch: float,
    input_error: float,
    own: float,
    start: float = 0.0,
) -> float:
    """Return a time before which ‖e_s‖_W, starting at ``start``, cannot reach ``level``.

    Let ρ(r) = sup_{s≤r} ‖e_s‖_W. The part of e_c that equals the present e_s is bounded by ρ:

        ρ(r) ≤ ∫₀^r ‖W e^{Hs} L_E‖ sup‖R_E x‖ + ‖W e^{Hs} B U‖ (π' + own · ρ(r−s)) ds

    and further terms from the disturbances and ``start``. This is iterated from ρ = ``level``;
    every iterate is a bound until the level is reached.

    ``level`` is ‖e_s‖_W at an event, ``mismatch`` sup‖R_E x‖, ``own`` ‖K W^{−1}‖, and
    ``input_error`` π', the input error without the effect of the present e_s.
    """
    if level <= start:
        return 0.0
    window_s = _first_window_s(plant, level, mismatch, input_error + own * level)
    cells = COARSE_CELLS
    known_s = 0.0
    while True:
        growth = plant.growth(window_s, cells)
        areas = growth.mismatch.area * mismatch + growth.input_error.area * input_error
        fixed = np.cumsum(areas + growth.forced)
        if start:
            fixed += start * plant.error.stretch(window_s)
        rho = np.full(cells, level)
        for _ in range(_PICARD_ROUNDS):
            echo = np.convolve(growth.input_error.area, rho)[:cells]
            rho = np.minimum(level, fixed + own * echo)
        crossed = np.flatnonzero(rho >= level)
        if len(crossed):
            known_s = max(known_s, float(growth.mismatch.edges_s[crossed[0]]))
            if cells == _FINE_CELLS:
                return known_s
            window_s, cells = float(growth.mismatch.edges_s[crossed[0] + 1]), _FINE_CELLS
        elif window_s >= LONGEST_S:
            return window_s
        else:  # not reached, also after a coarse grid's overestimate: extend the window
            known_s, window_s = window_s, 2 * window_s


def _first_window_s(plant: PlantGains, level: float, mismatch: float, input_error: float) -> float:
    """Return the first search window: twice the time to ``level`` at the initial speed, limited."""
    start = plant.growth(_SHORTEST_S, 1)
    speed = start.mismatch.sup_on_grid() * mismatch + start.input_error.sup_on_grid() * input_error
    speed += float(start.forced.sum()) / _SHORTEST_S
    if not speed > 0:
        return LONGEST_S
    return min(max(2 * level / speed, _SHORTEST_S), LONGEST_S)
