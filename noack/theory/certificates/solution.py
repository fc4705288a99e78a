"""Tight certificates: guaranteed bounds of a loop, for the longest inter-event time.

The bounds are the solution of the inequalities of :mod:`noack.theory.certificates.inequalities`.
The minimum inter-event time δ is the time that ‖e_s‖_W needs from 0 to β under these bounds. If an
assumed δ gives a time of at least δ, it holds by induction over the events; the largest such δ is
used.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from noack.core.number_format import apart_from
from noack.theory.bounds.certificate_terms import (
    CertificatePart,
    Constants,
    NetworkConditions,
    NoCertificateError,
    TriggerBound,
)
from noack.theory.bounds.error_growth import LONGEST_S
from noack.theory.bounds.gains import ErrorGains, PlantGains
from noack.theory.certificates.error_rows import Signal
from noack.theory.certificates.inequalities import MOST_MISSING, ErrorInequalities, PartSolution

_FIRST_WITHOUT_BOUND = {
    Signal.AGE_INPUT: "already the part of u − Kx from the age of the input reproduces itself",
    Signal.AFTER_TEST: "already ‖e_s‖ at the tests reproduces itself",
    Signal.ESTIMATION_ERROR: "already the error of the estimate reproduces itself",
    Signal.INPUT_ERROR: "‖u − Kx‖ reproduces itself through updates that are lost, late or held",
    Signal.MISMATCH: "‖u − Kx‖ reproduces itself through the difference of plant and model",
    Signal.ONE: "no bound is confirmed",
}
"""What is said of the first signal that has no bound."""
_INTER_EVENT_SETTLED = 1e-3
"""Relative change of δ at which the search for it ends."""
_MOST_ROUNDS = 200
"""Limit of this search; without a consistent δ the least one is used."""


class Problem(NamedTuple):
    """The inequalities of a loop, whose constants are sought.

    All inequalities are linear in functions of time, for given events. So they may be divided into
    parts: what decays is one part, what persists another one. All parts bound e_c in the same way,
    since the sum of solutions of different inequalities bounds nothing. The threshold is at least the
    sum of the parts' ``least_event_error``, so the next event needs one part that reaches its own.
    """

    parts: tuple[CertificatePart, ...]
    conditions: NetworkConditions
    earlier_error: float = 0.0
    """Bound of sup‖p‖ of the first part while the plant still applies its first inputs at a set-point."""
    longest: bool = True
    """Whether the longest δ is sought; otherwise only if there is no certificate without it."""


def solve(
    error: ErrorGains, plant: PlantGains, conditions: NetworkConditions, bound: TriggerBound
) -> Constants:
    """Return the constants of one part that are certified for all times; see :class:`Problem`.

    Raises:
        NoCertificateError: the loop gain is not below 1.
        NotDecayingError: a mode of the loop decays more slowly than the threshold.
    """
    (constants,) = solve_problem(Problem((CertificatePart(error, plant, bound),), conditions))
    return constants


@np.errstate(all="ignore")
def solve_problem(problem: Problem) -> list[Constants]:
    """Return the constants of the parts of a problem.

    Raises:
        NoCertificateError: there is no certificate.
        NotDecayingError: a mode of a loop decays more slowly than the threshold.
    """
    parts, conditions, earlier_error, longest = problem
    drifts = conditions.delay_s > 0 and all(part.error.decays for part in parts)
    inequalities = [
        ErrorInequalities(part, conditions, earlier_error if index == 0 else 0.0, drifts=drifts)
        for index, part in enumerate(parts)
    ]
    guaranteed_s = max(part.bound.times.shortest_s for part in parts)
    least_s = max(conditions.spacing_s, guaranteed_s)
    is_separated = all(
        any(bound.least_event_error is not None for bound in part.bound.all_bounds) for part in parts
    )
    inter_event_s = least_s
    if is_separated and (longest or not _all_exist(_solutions(inequalities, least_s))):
        inter_event_s = _longest_inter_event_s(inequalities, least_s)
    shortest_s = least_s if is_separated else guaranteed_s
    between_s = inter_event_s if inter_event_s > least_s else shortest_s
    return [
        _constants(solution, inter_event_s)._replace(inter_event_s=between_s or None)
        for solution in _solutions(inequalities, inter_event_s)
    ]


def _longest_inter_event_s(inequalities: Sequence[ErrorInequalities], least_s: float) -> float:
    """Return the longest inter-event time that implies itself, or ``least_s``."""
    assumed_s = max(LONGEST_S, least_s)
    for _ in range(_MOST_ROUNDS):
        if assumed_s <= least_s:
            break
        solutions, implied_s = _solutions(inequalities, assumed_s), math.inf
        if not _all_exist(solutions):
            break
        # Often what persists, which is the last part, gives a time of at most the least one.
        for part, solution in zip(reversed(inequalities), reversed(solutions), strict=True):
            if implied_s > least_s:
                implied_s = min(implied_s, part.inter_event_s(solution))
        if implied_s >= assumed_s:
            return assumed_s
        # Iterate from above.
        is_shorter = implied_s < (1 - _INTER_EVENT_SETTLED) * assumed_s
        assumed_s = max(implied_s if is_shorter else (1 - _INTER_EVENT_SETTLED) * implied_s, least_s)
    return least_s


def _solutions(inequalities: Sequence[ErrorInequalities], inter_event_s: float) -> list[PartSolution]:
    return [part.solution(inter_event_s) for part in inequalities]


def _all_exist(solutions: Sequence[PartSolution]) -> bool:
    return all(solution.constants is not None for solution in solutions)


def _constants(solution: PartSolution, inter_event_s: float) -> Constants:
    """Return the constants of a part; raise NoCertificateError if there are none."""
    if solution.constants is not None:
        return solution.constants
    gain = solution.loop_gain
    if math.isinf(gain) and inter_event_s == 0:
        raise NoCertificateError("events may be arbitrarily close, so that any number may be in flight")
    if solution.missing_events > MOST_MISSING:
        raise NoCertificateError(
            f"up to {solution.missing_events:,} updates may be missing at once, lost or in flight; bounds "
            f"are computed for at most {MOST_MISSING:,}"
        )
    if gain < 1:
        raise NoCertificateError("its bounds are too large for floating point")
    raise NoCertificateError(
        f"the loop gain of the errors is {apart_from(1, gain)}, not below 1: "
        f"{_FIRST_WITHOUT_BOUND[solution.failing]}",
        gain,
    )
