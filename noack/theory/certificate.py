"""Tight certificates: guaranteed bounds of a loop, for the longest time between events.

The bounds are the solution of the inequalities of :mod:`noack.theory.error_inequalities`. The
minimum inter-event time δ is the time that ‖e_s‖_W needs from 0 to β under these bounds. If an
assumed δ gives a time of at least δ, it holds by induction over the events; the largest such δ is
used.
"""

import contextlib
import math
from collections.abc import Sequence

import numpy as np

from noack.core.linear_systems import Vector, spectral_abscissa
from noack.theory.certificate_terms import (
    MEASURED,
    Constants,
    EstimationBound,
    NetworkConditions,
    Part,
    VoidError,
)
from noack.theory.error_gains import ErrorGains, Output
from noack.theory.error_growth import LONGEST_S, TriggerBound
from noack.theory.error_inequalities import ErrorInequalities, ErrorWay
from noack.theory.kernel_bounds import NotDecayingError
from noack.theory.plant_gains import PlantGains
from noack.theory.sharpened_bounds import InvariantEllipsoids, SharpenedBounds

_SETTLED = 1e-3
_SHARPER = 0.99
"""Bounds from the flow are computed again if Δ has become smaller by this factor."""
_ATTEMPTS = 200


def solve(
    error: ErrorGains,
    plant: PlantGains,
    conditions: NetworkConditions,
    bound: TriggerBound,
    earlier_error: float = 0.0,
    *,
    estimation: EstimationBound = MEASURED,
    structured: bool = True,
    longest: bool = True,
) -> Constants:
    """Return the constants that are certified for all times.

    ``structured``: at every time, p = u − Kx consists of the errors of the events and of the age of
    the input. Otherwise it is only known that its norm is at most π.

    ``earlier_error``: bound of sup‖p‖ while the plant still applies inputs of an earlier run.
    ``longest``: search for the longest δ; otherwise only if there is no certificate without it.

    Raises:
        VoidError: the loop gain is not below 1.
        NotDecayingError: a mode of the loop decays more slowly than the threshold.
    """
    part = Part(error, plant, bound, estimation)
    (found,) = solve_sum([part], conditions, earlier_error, structured=structured, longest=longest)
    if longest and structured and earlier_error == 0.0 and _is_reset_flow(part, conditions):
        with contextlib.suppress(np.linalg.LinAlgError, NotDecayingError):
            return _sharpened(found, part, conditions)
    return found


def _is_reset_flow(part: Part, conditions: NetworkConditions) -> bool:
    """Return whether a loop without inputs follows each delivery, and a test at every time.

    Then :mod:`noack.theory.sharpened_bounds` applies.
    """
    error, plant, bound, estimation = part
    is_ideal = conditions == NetworkConditions(
        conditions.dropouts, constraints=conditions.constraints
    )
    is_plain = bound == TriggerBound(bound.beta, bound.reached, bound.shares, unit=bound.unit)
    is_known = plant.is_one_plant and plant.forcing is None and estimation == MEASURED
    rates_agree = plant.alpha_per_s == error.alpha_per_s
    return (
        is_ideal and is_plain and is_known and rates_agree and spectral_abscissa(error.scaled_H) < 0
    )


def _sharpened(found: Constants, part: Part, conditions: NetworkConditions) -> Constants:
    """Return the constants with the bounds from the flow between deliveries."""
    error, plant, bound, _ = part
    dropouts, unit = conditions.dropouts, bound.beta if bound.unit is None else bound.unit
    size = found.overshoot * unit

    def plain(spacing_s: float | None) -> Vector:
        """Bound ‖e_c‖_W while at most 0, 1, … events are missing."""
        missing = [error.missing(Output.WEIGHTED, j, spacing_s or 0.0) for j in range(dropouts + 1)]
        return (1 + np.array(missing)) * size

    errors = plain(found.inter_event_s)
    ellipsoids = InvariantEllipsoids(plant, float(errors[-1]))
    while True:
        before = found
        known = SharpenedBounds(
            found.input_error,
            found.state,
            found.state_weighted,
            found.mismatch,
            found.inter_event_s,
        )
        known, errors = ellipsoids.sharpened(known, errors, bound.reached, size)
        errors = np.minimum(errors, plain(known.inter_event_s))
        delta = float(errors[-1]) / unit
        found = found._replace(**known._asdict(), delta=min(delta, found.delta))
        if not found.delta < _SHARPER * before.delta:
            return found


def solve_sum(
    parts: Sequence[Part],
    conditions: NetworkConditions,
    earlier_error: float = 0.0,
    *,
    structured: bool = True,
    longest: bool = True,
) -> list[Constants]:
    """Return the constants of several parts, whose bounds hold when they are added.

    All inequalities are linear in functions of time, for given events. So the causes may be
    divided: what decays is one part, what persists another one. All parts bound e_c in the same
    way, since the sum of solutions of different inequalities bounds nothing. The threshold is at
    least the sum of the parts' ``reached``, so the next event needs one part that reaches its own.
    The ``earlier_error`` is that of the first part.

    Raises: as :func:`solve`.
    """
    first, *others = parts
    steps = [ErrorInequalities(first, conditions, earlier_error)]
    steps += [ErrorInequalities(part, conditions, 0.0) for part in others]
    if structured and parts[0].plant.is_one_plant:
        for step in steps:
            step.use_windows()

    def constants(spacing_s: float, inter_event_s: float | None) -> list[Constants]:
        found, _ = _smallest(steps, spacing_s)
        return [one._replace(inter_event_s=inter_event_s) for one in found]

    apart_s = max(part.bound.apart_s for part in parts)
    least_s = max(conditions.spacing_s, apart_s)
    if any(all(one.reached is None for one in part.bound.every) for part in parts):
        return constants(least_s, apart_s or None)
    void = None
    if not longest:
        try:
            return constants(least_s, least_s or None)
        except VoidError as error:
            void = error
    spacing_s = LONGEST_S
    for _ in range(_ATTEMPTS):
        if spacing_s <= least_s:
            break
        found_s = math.inf
        try:
            found, way = _smallest(steps, spacing_s)
        except VoidError:
            break
        for step, one in zip(reversed(steps), reversed(found), strict=True):
            found_s = min(found_s, step.inter_event_s(one, way))
            if found_s <= least_s:  # often by what persists, which is the last part
                break
        if found_s >= spacing_s:
            return constants(spacing_s, spacing_s)
        # Iterate from above to the largest spacing that is consistent with itself.
        spacing_s = found_s if found_s < (1 - _SETTLED) * spacing_s else (1 - _SETTLED) * found_s
    if void is not None:
        raise void
    return constants(least_s, least_s or None)


def _smallest(
    steps: Sequence[ErrorInequalities], spacing_s: float
) -> tuple[list[Constants], ErrorWay]:
    """Return the constants of all parts with the way to bound e_c that bounds x tighter.

    Raises:
        VoidError: no loop gain is below 1.
    """
    found, void = list[tuple[list[Constants], ErrorWay]](), VoidError("")
    for way in ErrorWay:
        if all(way in step.ways for step in steps):
            try:
                found.append(([step.constants(spacing_s, way) for step in steps], way))
            except VoidError as error:
                void = min(void, error, key=lambda one: one.loop_gain)
    if not found:
        raise void
    return min(found, key=lambda one: sum(constants.state for constants in one[0]))
