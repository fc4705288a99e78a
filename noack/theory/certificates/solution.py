"""Tight certificates: guaranteed bounds of a loop, for the longest inter-event time.

The bounds are the solution of the inequalities of :mod:`noack.theory.certificates.inequalities`.
The minimum inter-event time δ is the time that ‖e_s‖_W needs from 0 to β under these bounds. If an
assumed δ gives a time of at least δ, it holds by induction over the events; the largest such δ is
used. The constants are sharpened by the flow between two updates
(:mod:`noack.theory.certificates.deliveries.sharpened_constants`).
"""

import contextlib
import math
from collections import defaultdict
from collections.abc import Generator, Hashable, Sequence
from typing import NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from noack.core.cached_method import cached_function
from noack.core.linear_systems import Vector
from noack.core.number_format import apart_from
from noack.theory.bounds.certificate_terms import (
    CertificatePart,
    Constants,
    NetworkConditions,
    NoCertificateError,
    TriggerBound,
)
from noack.theory.bounds.enclosure import NotDecayingError
from noack.theory.bounds.error_growth import LONGEST_S
from noack.theory.bounds.gains import ErrorGains, PlantGains
from noack.theory.certificates.deliveries.sharpened_constants import can_be_sharpened, sharpened_constants
from noack.theory.certificates.error_rows import BoundMethod
from noack.theory.certificates.inequalities import ErrorInequalities, LoopConstants

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
    structured: bool = True
    """Whether p = u − Kx consists at every time of the errors of the events and of the age of the
    input. Otherwise it is only known that its norm is at most π."""
    longest: bool = True
    """Whether the longest δ is sought; otherwise only if there is no certificate without it."""

    @property
    def batch_key(self) -> Hashable:
        """The common properties of problems that are solved together; None if this one is alone."""
        plants = [part.plant.batch_key for part in self.parts]
        if None in plants:
            return None
        terms = [(part.bound, part.estimation) for part in self.parts]
        return repr((*self[1:], *terms)), *plants


Result = TypeVar("Result")
Search = Generator[Problem, list[Constants], Result]
"""A search for a certificate: it yields problems, and receives the constants of their parts.

An error of a problem is raised where it was yielded.
"""
_MOST_TOGETHER = 256
"""Number of one-state problems that are solved together: the memory grows with the squared states."""
_UNSOLVED_ERRORS = (NotDecayingError, np.linalg.LinAlgError, OverflowError)


def run_searches(searches: Sequence[Search[Result]]) -> list[Result]:
    """Return the results of searches; their like problems are solved together.

    Raises:
        NoCertificateError, NotDecayingError: a search does not handle this error of its problem.
    """
    results: dict[int, Result] = {}
    answers: dict[int, list[Constants] | Exception | None] = dict.fromkeys(range(len(searches)))
    with np.errstate(all="ignore"):
        while answers:
            open_problems: dict[int, Problem] = {}
            for number, answer in answers.items():
                search = searches[number]
                try:
                    if isinstance(answer, Exception):
                        open_problems[number] = search.throw(answer)
                    else:  # the first value is None
                        open_problems[number] = search.send(cast("list[Constants]", answer))
                except StopIteration as end:
                    results[number] = end.value
            answers = dict(zip(open_problems, _answers([*open_problems.values()]), strict=True))
    return [results[number] for number in range(len(searches))]


def run_search(search: Search[Result]) -> Result:
    """Return the result of one search; see :func:`run_searches`."""
    (answer,) = run_searches([search])
    return answer


def _answers(problems: Sequence[Problem]) -> list[list[Constants] | Exception]:
    """Return the constants of each problem, or its error."""
    alike = defaultdict[Hashable, list[int]](list)
    for index, problem in enumerate(problems):
        key = problem.batch_key if len(problems) > 1 else None
        alike[("alone", index) if key is None else key].append(index)
    groups: list[list[int]] = []
    for indices in alike.values():
        states = len(problems[indices[0]].parts[0].error.H)
        width = max(_MOST_TOGETHER // states**2, 1)
        groups += (indices[begin : begin + width] for begin in range(0, len(indices), width))
    answers: dict[int, list[Constants] | Exception] = {}
    for indices in groups:
        try:
            solved = _solve_together([problems[index] for index in indices])
            answers.update(zip(indices, solved, strict=True))
        except _UNSOLVED_ERRORS as error:
            if len(indices) == 1:
                answers[indices[0]] = error
            else:  # of one of them
                answers.update((index, _answers([problems[index]])[0]) for index in indices)
    return [answers[index] for index in range(len(problems))]


def solve(
    error: ErrorGains,
    plant: PlantGains,
    conditions: NetworkConditions,
    bound: TriggerBound,
    *,
    structured: bool = True,
) -> Constants:
    """Return the constants of one part that are certified for all times; see :class:`Problem`.

    Raises:
        NoCertificateError: the loop gain is not below 1.
        NotDecayingError: a mode of the loop decays more slowly than the threshold.
    """
    problem = Problem((CertificatePart(error, plant, bound),), conditions, structured=structured)
    return run_search(sharpened(problem))


def sharpened(problem: Problem) -> Search[Constants]:
    """Search for the constants of a problem of one part, sharpened where that is possible.

    Raises: as :func:`solve`.
    """
    (constants,) = yield problem
    (part,), conditions, *_ = problem
    is_plain = problem.structured and problem.earlier_error == 0.0
    if problem.longest and is_plain and can_be_sharpened(part):
        with contextlib.suppress(np.linalg.LinAlgError, NotDecayingError):
            return sharpened_once(constants, part, conditions)
    return constants


def _sharpening_key(constants: Constants, part: CertificatePart, conditions: NetworkConditions) -> Hashable:
    # The id is that of one plant only, because the part is kept, and keeps its plant.
    return id(part.plant), constants, repr((part.bound, conditions))


sharpened_once = cached_function(32, _sharpening_key)(sharpened_constants)
"""Sharpen constants; runs, their claims and reports need those of the same scenario repeatedly."""


def _solve_together(problems: Sequence[Problem]) -> list[list[Constants] | Exception]:
    """Return the constants of like problems, or the reason why there is no certificate.

    Raises:
        NotDecayingError: a mode of a loop decays more slowly than the threshold.
    """
    example = problems[0]
    conditions, count = example.conditions, len(problems)
    inequalities = []
    for index, part in enumerate(example.parts):
        plants = [problem.parts[index].plant for problem in problems]
        together = part._replace(plant=part.plant.together(plants))
        earlier = example.earlier_error if index == 0 else 0.0
        inequalities.append(ErrorInequalities(together, conditions, earlier))
    guaranteed_s = max(part.bound.times.shortest_s for part in example.parts)
    least_s = max(conditions.spacing_s, guaranteed_s)
    is_separated = all(
        any(bound.least_event_error is not None for bound in part.bound.all_bounds) for part in example.parts
    )
    searched = np.full(count, is_separated)
    if is_separated and not example.longest:
        searched = ~_smallest_constants(inequalities, np.full(count, least_s)).exists
    inter_event_s = _longest_inter_event_s(inequalities, searched, least_s)
    smallest = _smallest_constants(inequalities, inter_event_s)
    rates = [part.error.alpha_per_s for part in example.parts]
    shortest_s = least_s if is_separated else guaranteed_s
    between_s = np.where(inter_event_s > least_s, inter_event_s, shortest_s).tolist()
    return [smallest.of_loop(loop, rates, between_s[loop] or None) for loop in range(count)]


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

    def of_loop(
        self, loop: int, rates_per_s: Sequence[float], inter_event_s: float | None
    ) -> list[Constants] | Exception:
        """Return the constants of the parts of a loop, or the reason for having none."""
        if self.exists[loop]:
            return [
                part.of_loop(loop, rate, inter_event_s)
                for part, rate in zip(self.parts, rates_per_s, strict=True)
            ]
        gain = float(self.loop_gain[loop])
        if math.isinf(gain) and not self.is_spaced[loop]:
            return NoCertificateError("events may be arbitrarily close, so that any number may be in flight")
        if gain < 1:
            return NoCertificateError("its bounds are too large for floating point")
        return NoCertificateError(f"the loop gain of the errors is {apart_from(1, gain)}, not below 1", gain)


def _smallest_constants(
    inequalities: Sequence[ErrorInequalities], inter_event_s: Vector
) -> _SmallestConstants:
    """Return the constants of all parts with the first method for e_c that has a certificate."""
    infinite = np.full(len(inter_event_s), np.inf)
    best = _SmallestConstants((), infinite > 0, infinite < 0, infinite, inter_event_s > 0)
    for method in inequalities[0].methods:
        if not all(method in part.methods for part in inequalities):
            continue
        parts = [part.constants(inter_event_s, method) for part in inequalities]
        exists, gain = np.ones(len(infinite), dtype=bool), infinite
        for part in parts:
            gain = np.where(exists & ~part.exists, part.loop_gain, gain)
            exists = exists & part.exists
        is_new = exists & ~best.exists
        drifts = np.where(is_new, method is BoundMethod.DRIFTING, best.drifts)
        if best.parts:
            parts = [
                LoopConstants(*(np.where(is_new, *pair) for pair in zip(new, old, strict=True)))
                for new, old in zip(parts, best.parts, strict=True)
            ]
        gain = np.where(is_new | best.exists, best.loop_gain, np.minimum(gain, best.loop_gain))
        best = best._replace(parts=parts, drifts=drifts, exists=best.exists | exists, loop_gain=gain)
        if best.exists.all():
            break
    return best
