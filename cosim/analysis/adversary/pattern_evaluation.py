"""Evaluates the objective on a run of the reference simulator; suprema are enclosed, not sampled.

Within a cell |y|² is a polynomial of degree 36. In the Bernstein basis its largest coefficient is
an upper bound, and its first and last coefficients are values of the polynomial. Intervals are
halved until the upper bounds exceed the largest value found by at most a share of 1e-12.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from cosim.analysis.adversary.objective import Measure, Objective
from cosim.analysis.adversary.polynomial_curves import curve_stack, powers
from cosim.analysis.adversary.segments import SquareIntegral
from cosim.simulation.continuous.continuous_run import ContinuousRun
from cosim.simulation.continuous.exact_flow import DEGREE, taylor_terms
from noack.core.linear_systems import Matrix, Vector

_RESOLUTION = 1e-12
_FINEST = 2.0**-40


class Valued(NamedTuple):
    """The value of a run."""

    value: float
    at_s: float | None
    """Where a supremum is reached, or the later of the two closest events."""


def evaluate(run: ContinuousRun, measure: Measure) -> Valued:
    """Return the objective along a run; infinite if the run diverged.

    The inter-event time has the sign of the objective: negative, or −∞ with fewer than two events.
    """
    if measure.output is None:
        between_s = np.diff(run.event_s)
        if not len(between_s):
            return Valued(-math.inf, None)
        shortest = int(between_s.argmin())
        return Valued(-float(between_s[shortest]), float(run.event_s[shortest + 1]))
    if run.diverged_at_s is not None:
        return Valued(math.inf, run.diverged_at_s)
    if measure.objective is Objective.COST:
        return Valued(_integral(run, measure.output), None)
    best = Valued(0.0, 0.0)
    for part in _parts(run, measure, measure.output):
        best = _highest(*part, best)
    return best


def _cells(run: ContinuousRun, cuts_s: Vector) -> Iterator[tuple[float, float, Vector]]:
    """Yield start, width and (x, e_s, e_c) of all parts of cells between events and cuts."""
    flow = run.system.flow
    ends_s = [*run.event_s.tolist(), run.horizon_s]
    # With a first packet the run starts at event 0.
    for state, end_s in zip((run.start, *run.after), ends_s, strict=True):
        stops_s = [*cuts_s[(cuts_s > state.t_s) & (cuts_s < end_s)].tolist(), end_s]
        t_s, z = state.t_s, np.concatenate(state[1:])
        for stop_s in stops_s:
            while t_s < stop_s:
                width_s = min(flow.width_s, stop_s - t_s)
                yield t_s, width_s, z
                z = flow.within_cell(z, width_s / flow.width_s)
                t_s = t_s + width_s if width_s == flow.width_s else stop_s


def _parts(
    run: ContinuousRun, measure: Measure, output: Matrix
) -> Iterator[tuple[float, float, Vector]]:
    """Yield start, width and Bernstein coefficients of |y|², scaled, over each part of a cell."""
    system, cuts_s = run.system, np.empty(0)
    identity = np.eye(len(system.generator))
    width_s = system.flow.width_s
    if measure.floor and measure.rate_per_s:
        cuts_s = np.array([math.log(measure.beta / measure.floor) / measure.rate_per_s])
    rates = (measure.rate_per_s, 0.0)
    terms = [output @ taylor_terms(system.generator + r * identity, width_s) for r in rates]
    for begin_s, part_s, z in _cells(run, cuts_s):
        late = bool(len(cuts_s) and begin_s >= cuts_s[0])
        taylor = (terms[late] @ z) / float(measure.level(np.array([begin_s]))[0])
        taylor = taylor * powers(np.array([part_s / width_s]), DEGREE).T
        yield begin_s, part_s, curve_stack(DEGREE).squares(taylor[None])[0]


def _highest(begin_s: float, part_s: float, squares: Vector, best: Valued) -> Valued:
    """Return the larger of ``best`` and sup |y| over a part, to a relative accuracy of 1e-12."""
    pending = [(0.0, 1.0, squares)]
    while pending:
        start, width, squares = pending.pop()
        for u, square in ((start, squares[0]), (start + width, squares[-1])):
            if square > best.value**2:
                best = Valued(math.sqrt(square), begin_s + u * part_s)
        if squares.max() > best.value**2 * (1 + _RESOLUTION) and width > _FINEST:
            left, right = curve_stack(DEGREE).halves(squares)
            pending += [(start, width / 2, left), (start + width / 2, width / 2, right)]
    return best


def _integral(run: ContinuousRun, output: Matrix) -> float:
    flow = run.system.flow
    whole = SquareIntegral(output @ taylor_terms(run.system.generator, flow.width_s), flow.width_s)
    _, widths_s, z = zip(*_cells(run, np.empty(0)), strict=True)
    return float(whole(np.array(z), np.array(widths_s) / flow.width_s).sum())
