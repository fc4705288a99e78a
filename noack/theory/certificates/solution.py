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
from numpy.typing import NDArray

from noack.core.linear_systems import Vector
from noack.core.number_format import apart_from
from noack.theory.bounds.certificate_terms import (
    CertificatePart,
    Constants,
    NetworkConditions,
    NoCertificateError,
    TriggerBound,
)
from noack.theory.bounds.error_growth import LONGEST_S
from noack.theory.bounds.gains import Counts, ErrorGains, PlantGains
from noack.theory.certificates.error_rows import BoundMethod, Signal
from noack.theory.certificates.inequalities import MOST_MISSING, ErrorInequalities, LoopConstants

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
    parts: what decays is one part, what persists another one. All parts bound e_c by the same
    method, since the sum of solutions of different inequalities bounds nothing. The threshold is at
    least the sum of the parts' ``least_event_error``, so the next event needs one part that reaches its own.
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
    conditions, inequalities = problem.conditions, []
    for index, part in enumerate(problem.parts):
        earlier = problem.earlier_error if index == 0 else 0.0
        inequalities.append(ErrorInequalities(part, conditions, earlier))
    guaranteed_s = max(part.bound.times.shortest_s for part in problem.parts)
    least_s = max(conditions.spacing_s, guaranteed_s)
    is_separated = all(
        any(bound.least_event_error is not None for bound in part.bound.all_bounds) for part in problem.parts
    )
    searched = np.full(1, is_separated)
    if is_separated and not problem.longest:
        searched = ~_smallest_constants(inequalities, np.full(1, least_s)).exists
    inter_event_s = _longest_inter_event_s(inequalities, searched, least_s)
    smallest = _smallest_constants(inequalities, inter_event_s)
    rates = [part.error.alpha_per_s for part in problem.parts]
    shortest_s = least_s if is_separated else guaranteed_s
    between_s = float(inter_event_s[0]) if inter_event_s[0] > least_s else shortest_s
    return smallest.of_loop(0, rates, between_s or None)


def _longest_inter_event_s(
    inequalities: Sequence[ErrorInequalities], searched: NDArray[np.bool_], least_s: float
) -> Vector:
    """Return the longest inter-event time of each loop that implies itself, or ``least_s``.

    It is ``least_s`` where the loop is not searched, or has no certificate.
    """
    inter_event_s = np.where(searched, LONGEST_S, least_s)
    is_open = searched & (inter_event_s > least_s)
    for _ in range(_MOST_ROUNDS):
        if not is_open.any():
            break
        smallest = _smallest_constants(inequalities, inter_event_s)
        is_open, implied_s = is_open & smallest.exists, np.full(len(inter_event_s), np.inf)
        inter_event_s = np.where(smallest.exists, inter_event_s, least_s)
        for part, constants in zip(reversed(inequalities), reversed(smallest.parts), strict=True):
            # Often what persists, which is the last part, gives a time of at most the least one.
            loops = is_open & (implied_s > least_s)
            passed_s = part.inter_event_s(
                mismatch=constants.mismatch,
                earlier_input_error=constants.earlier_input_error,
                estimation_error=constants.estimation_error,
                drifts=smallest.drifts,
                searched=loops,
            )
            implied_s = np.where(loops, np.minimum(implied_s, passed_s), implied_s)
        is_open &= implied_s < inter_event_s
        # Iterate from above.
        shorter = implied_s < (1 - _INTER_EVENT_SETTLED) * inter_event_s
        next_s = np.where(shorter, implied_s, (1 - _INTER_EVENT_SETTLED) * implied_s)
        inter_event_s = np.where(is_open, np.maximum(next_s, least_s), inter_event_s)
        is_open &= inter_event_s > least_s
    return np.where(is_open, least_s, inter_event_s)


class _SmallestConstants(NamedTuple):
    """The constants of all parts of several loops, with the first method that has a certificate."""

    parts: Sequence[LoopConstants]
    drifts: NDArray[np.bool_]
    """Where the method is ``DRIFTING``, (loops,)."""
    exists: NDArray[np.bool_]
    loop_gain: Vector
    """(loops,) that of the first part that has no certificate; the smaller one of both methods."""
    is_spaced: NDArray[np.bool_]
    """Where the assumed inter-event time is above 0, (loops,)."""
    failing: Counts
    """(loops,) of the part and the method of this loop gain: the first signal without a bound."""

    def of_loop(
        self, loop: int, rates_per_s: Sequence[float], inter_event_s: float | None
    ) -> list[Constants]:
        """Return the constants of the parts of a loop; raise NoCertificateError if there are none."""
        if self.exists[loop]:
            return [
                part.of_loop(loop, rate, inter_event_s)
                for part, rate in zip(self.parts, rates_per_s, strict=True)
            ]
        gain = float(self.loop_gain[loop])
        if math.isinf(gain) and not self.is_spaced[loop]:
            raise NoCertificateError("events may be arbitrarily close, so that any number may be in flight")
        if (missing := int(self.parts[0].missing_events[loop])) > MOST_MISSING:
            raise NoCertificateError(
                f"up to {missing:,} updates may be missing at once, lost or in flight; bounds are computed "
                f"for at most {MOST_MISSING:,}"
            )
        if gain < 1:
            raise NoCertificateError("its bounds are too large for floating point")
        raise NoCertificateError(
            f"the loop gain of the errors is {apart_from(1, gain)}, not below 1: "
            f"{_FIRST_WITHOUT_BOUND[Signal(int(self.failing[loop]))]}",
            gain,
        )


def _smallest_constants(
    inequalities: Sequence[ErrorInequalities], inter_event_s: Vector
) -> _SmallestConstants:
    """Return the constants of all parts with the first method for e_c that has a certificate."""
    infinite = np.full(len(inter_event_s), np.inf)
    none = np.zeros(len(inter_event_s), dtype=np.int64)
    best = _SmallestConstants((), infinite > 0, infinite < 0, infinite, inter_event_s > 0, none)
    for method in inequalities[0].methods:
        if not all(method in part.methods for part in inequalities):
            continue
        parts = [part.constants(inter_event_s, method) for part in inequalities]
        exists, gain, failing = np.ones(len(infinite), dtype=bool), infinite, none
        for part in parts:
            is_first = exists & ~part.exists
            gain, failing = (
                np.where(is_first, new, old) for new, old in ((part.loop_gain, gain), (part.failing, failing))
            )
            exists = exists & part.exists
        is_new = exists & ~best.exists
        drifts = np.where(is_new, method is BoundMethod.DRIFTING, best.drifts)
        if best.parts:
            parts = [
                LoopConstants(*(np.where(is_new, *pair) for pair in zip(new, old, strict=True)))
                for new, old in zip(parts, best.parts, strict=True)
            ]
        is_smaller = ~(is_new | best.exists) & (gain < best.loop_gain)
        best = _SmallestConstants(
            parts,
            drifts,
            best.exists | exists,
            np.where(is_smaller, gain, best.loop_gain),
            best.is_spaced,
            np.where(is_smaller, failing, best.failing),
        )
        if best.exists.all():
            break
    return best
