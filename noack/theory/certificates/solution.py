"""Tight certificates: guaranteed bounds of a loop, for the longest time between events.

The bounds are the solution of the inequalities of :mod:`noack.theory.certificates.inequalities`.
The minimum inter-event time δ is the time that ‖e_s‖_W needs from 0 to β under these bounds. If an
assumed δ gives a time of at least δ, it holds by induction over the events; the largest such δ is
used.

**Sharpened by the flow between two deliveries**, for the paper's conditions. Given ‖e_c‖_W ≤ D at
all times, an ellipsoid ‖Λx‖ ≤ 1 is found that x never leaves
(:mod:`noack.theory.certificates.delivery_flow`). It bounds x and E x, and the flow from it bounds K
e_c. After an event e_s begins at 0; after r it is C_r z(t_k), C_r = (0, I) e^{Fr} − e^{(H+αI)r} (0,
I), as long as no update is received. At the event z(t_k) is (ξ, 0), or up to it ‖e_c‖_W ≤ D', since
one event less is missing than may be. So the next event comes later than certified without the
flow, and D is smaller with this longer time. Every step uses bounds that hold already. Λ comes from
a Lyapunov equation with three parameters. They are chosen by samples; what they give is checked
with all enclosures.
"""

import contextlib
import math
from collections import defaultdict
from collections.abc import Generator, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from noack.core.cached_method import cached_method
from noack.core.linear_systems import Matrix, Vector, solve_lyapunov, spectral_abscissa
from noack.theory.bounds.contraction import Stack
from noack.theory.bounds.enclosure import NotDecayingError
from noack.theory.bounds.gains import ErrorGains, Output, PlantGains
from noack.theory.bounds.terms import (
    MEASURED,
    Constants,
    EstimationBound,
    NetworkConditions,
    NoCertificateError,
    Part,
    TriggerBound,
)
from noack.theory.bounds.trigger_bounds import LONGEST_S
from noack.theory.certificates.delivery_flow import (
    ROUNDING,
    DeliveryFlow,
    Reach,
    Starts,
    bend_of_error,
    error_after,
    errors_after_losses,
)
from noack.theory.certificates.inequalities import BoundMethod, ErrorInequalities, LoopConstants

_SETTLED = 1e-3
_SHARPER = 0.99
"""Bounds from the flow are computed again if Δ has become smaller by this factor."""
_ATTEMPTS = 200
_MARGINS = (1.0, 1.01, 1.02, 1.05, 1.08, 1.12, 1.2, 1.35)
"""Factors of the ellipsoid's computed size that are tried."""
_STARTS = [(-1.5, -2.0, -7.0), (0.0, -7.0, -7.0), (-1.5, 0.0, -1.0), (-1.5, -7.0, -1.0)]
"""Parameters of the ellipsoid that are tried first."""
_DIRECTIONS = np.vstack([np.eye(3), -np.eye(3)])
_WIDTHS = (1.5, 1.5, 1.5, 0.8, 0.8, 0.4, 0.4, 0.2)
"""Changes of one parameter in each round of the search."""
_COARSE, _FINE = np.exp(np.arange(-9.0, 13.0, 3.0)), np.exp(np.linspace(-2.0, 2.0, 9))
"""Multipliers μ: all of them, and around the best one."""
_NODES, _CRITICAL = 16, 4
_SHORT, _MOST_STEPS = 0.005, 16
_ILL_CONDITIONED = 1e8
_LEAST_SHARE = 1e-6


class Problem(NamedTuple):
    """The inequalities of a loop, whose constants are sought.

    All inequalities are linear in functions of time, for given events. So they may be divided into
    parts: what decays is one part, what persists another one. All parts bound e_c by the same
    method, since the sum of solutions of different inequalities bounds nothing. The threshold is at
    least the sum of the parts' ``reached``, so the next event needs one part that reaches its own.
    """

    parts: tuple[Part, ...]
    conditions: NetworkConditions
    earlier_error: float = 0.0
    """Bound of sup‖p‖ of the first part while the plant still applies inputs of an earlier run."""
    structured: bool = True
    """Whether p = u − Kx consists at every time of the errors of the events and of the age of the
    input. Otherwise it is only known that its norm is at most π."""
    longest: bool = True
    """Whether the longest δ is sought; otherwise only if there is no certificate without it."""

    @property
    def likeness(self) -> Hashable:
        """What problems must have in common to be solved together; None if this one is alone."""
        plants = [part.plant.likeness for part in self.parts]
        if None in plants:
            return None
        terms = [(part.bound, part.estimation) for part in self.parts]
        return repr((*self[1:], *terms)), *plants


Found = TypeVar("Found")
Search = Generator[Problem, list[Constants], Found]
"""A search for a certificate: it yields problems, and receives the constants of their parts.

An error of a problem is raised where it was yielded.
"""
_TOGETHER = 256
"""So many problems of one state are solved together: the memory grows with the squared states."""
_UNSOLVED = (NotDecayingError, np.linalg.LinAlgError, OverflowError)


def completed(searches: Sequence[Search[Found]]) -> list[Found]:
    """Return the results of searches; their like problems are solved together.

    Raises:
        NoCertificateError, NotDecayingError: a search does not handle this error of its problem.
    """
    results: dict[int, Found] = {}
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


def completed_alone(search: Search[Found]) -> Found:
    """Return the result of one search; see :func:`completed`."""
    (found,) = completed([search])
    return found


def _answers(problems: Sequence[Problem]) -> list[list[Constants] | Exception]:
    """Return the constants of each problem, or its error."""
    alike = defaultdict[Hashable, list[int]](list)
    for place, problem in enumerate(problems):
        likeness = problem.likeness if len(problems) > 1 else None
        alike[("alone", place) if likeness is None else likeness].append(place)
    groups: list[list[int]] = []
    for places in alike.values():
        states = len(problems[places[0]].parts[0].error.H)
        width = max(_TOGETHER // states**2, 1)
        groups += (places[first : first + width] for first in range(0, len(places), width))
    answers: dict[int, list[Constants] | Exception] = {}
    for places in groups:
        try:
            found = _solved([problems[place] for place in places])
            answers.update(zip(places, found, strict=True))
        except _UNSOLVED as error:
            if len(places) == 1:
                answers[places[0]] = error
            else:  # of one of them
                answers.update((place, _answers([problems[place]])[0]) for place in places)
    return [answers[place] for place in range(len(problems))]


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
    """Return the constants of one part that are certified for all times; see :class:`Problem`.

    Raises:
        NoCertificateError: the loop gain is not below 1.
        NotDecayingError: a mode of the loop decays more slowly than the threshold.
    """
    part = Part(error, plant, bound, estimation)
    return completed_alone(
        sharpened(Problem((part,), conditions, earlier_error, structured, longest))
    )


def sharpened(problem: Problem) -> Search[Constants]:
    """Search for the constants of a problem of one part, sharpened where that is possible.

    Raises: as :func:`solve`.
    """
    (constants,) = yield problem
    (part,), conditions, *_ = problem
    is_plain = problem.structured and problem.earlier_error == 0.0
    if problem.longest and is_plain and _is_reset_flow(part, conditions):
        with contextlib.suppress(np.linalg.LinAlgError, NotDecayingError):
            return _sharpened(constants, part, conditions)
    return constants


def _is_reset_flow(part: Part, conditions: NetworkConditions) -> bool:
    """Return whether a loop without inputs follows each delivery, and a test at every time.

    Then :mod:`noack.theory.certificates.solution` applies.
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


def _sharpened(constants: Constants, part: Part, conditions: NetworkConditions) -> Constants:
    """Return the constants with the bounds from the flow between deliveries."""
    error, plant, bound, _ = part
    dropouts, unit = conditions.dropouts, bound.beta if bound.unit is None else bound.unit
    size = constants.overshoot * unit

    def plain(spacing_s: float | None) -> Vector:
        """Bound ‖e_c‖_W while at most 0, 1, … events are missing."""
        missing = [error.missing(Output.WEIGHTED, j, spacing_s or 0.0) for j in range(dropouts + 1)]
        return (1 + np.array(missing)) * size

    errors = plain(constants.inter_event_s)
    ellipsoids = InvariantEllipsoids(plant, float(errors[-1]))
    while True:
        before = constants
        known = SharpenedBounds(
            constants.input_error,
            constants.state,
            constants.state_weighted,
            constants.mismatch,
            constants.inter_event_s,
        )
        known, errors = ellipsoids.sharpened(known, errors, bound.reached, size)
        errors = np.minimum(errors, plain(known.inter_event_s))
        delta = float(errors[-1]) / unit
        constants = constants._replace(**known._asdict(), delta=min(delta, constants.delta))
        if not constants.delta < _SHARPER * before.delta:
            return constants


def _solved(problems: Sequence[Problem]) -> list[list[Constants] | Exception]:
    """Return the constants of like problems, or the reason why there is no certificate.

    Raises:
        NotDecayingError: a mode of a loop decays more slowly than the threshold.
    """
    first = problems[0]
    conditions, count = first.conditions, len(problems)
    steps = []
    for place, part in enumerate(first.parts):
        plants = [problem.parts[place].plant for problem in problems]
        together = part._replace(plant=part.plant.together(plants))
        earlier = first.earlier_error if place == 0 else 0.0
        steps.append(ErrorInequalities(together, conditions, earlier))
        if first.structured and first.parts[0].plant.is_one_plant:
            steps[-1].use_windows()
    apart_s = max(part.bound.apart_s for part in first.parts)
    least_s = max(conditions.spacing_s, apart_s)
    is_separated = all(
        any(bound.reached is not None for bound in part.bound.every) for part in first.parts
    )
    searched = np.full(count, is_separated)
    if is_separated and not first.longest:
        searched = ~_smallest(steps, np.full(count, least_s)).exists
    spacing_s = _longest_s(steps, searched, least_s)
    smallest = _smallest(steps, spacing_s)
    rates = [part.error.alpha_per_s for part in first.parts]
    shortest_s = least_s if is_separated else apart_s
    between_s = np.where(spacing_s > least_s, spacing_s, shortest_s).tolist()
    return [smallest.of_loop(loop, rates, between_s[loop] or None) for loop in range(count)]


def _longest_s(
    steps: Sequence[ErrorInequalities], searched: NDArray[np.bool_], least_s: float
) -> Vector:
    """Return the largest spacing of each loop that is consistent with itself, or ``least_s``.

    It is ``least_s`` where the loop is not searched, or has no certificate.
    """
    spacing_s = np.where(searched, LONGEST_S, least_s)
    is_open = searched & (spacing_s > least_s)
    for _ in range(_ATTEMPTS):
        if not is_open.any():
            break
        smallest = _smallest(steps, spacing_s)
        is_open, found_s = is_open & smallest.exists, np.full(len(spacing_s), np.inf)
        spacing_s = np.where(smallest.exists, spacing_s, least_s)
        for step, constants in zip(reversed(steps), reversed(smallest.parts), strict=True):
            # Often what persists, which is the last part, gives a time of at most the least one.
            which = is_open & (found_s > least_s)
            passed_s = step.inter_event_s(constants, smallest.drifts, which)
            found_s = np.where(which, np.minimum(found_s, passed_s), found_s)
        is_open &= found_s < spacing_s
        # Iterate from above.
        shorter = found_s < (1 - _SETTLED) * spacing_s
        next_s = np.where(shorter, found_s, (1 - _SETTLED) * found_s)
        spacing_s = np.where(is_open, np.maximum(next_s, least_s), spacing_s)
        is_open &= spacing_s > least_s
    return np.where(is_open, least_s, spacing_s)


class _Smallest(NamedTuple):
    """The constants of all parts of several loops, with the method that bounds x tighter."""

    parts: Sequence[LoopConstants]
    drifts: NDArray[np.bool_]
    """Where the method is ``DRIFTING``, (loops,)."""
    exists: NDArray[np.bool_]
    loop_gain: Vector
    """(loops,) that of the first part that has no certificate; the smaller one of both methods."""
    is_spaced: NDArray[np.bool_]
    """Where events are assumed to be apart, (loops,)."""

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
            return NoCertificateError(
                "events may be arbitrarily close, so that any number may be in flight"
            )
        return NoCertificateError(f"the loop gain of the errors is {gain:.3g}, not below 1", gain)


def _smallest(steps: Sequence[ErrorInequalities], spacing_s: Vector) -> _Smallest:
    """Return the constants of all parts with the method for e_c that bounds x tighter."""
    none = np.full(len(spacing_s), np.inf)
    best = _Smallest((), none > 0, none < 0, none, spacing_s > 0)
    sizes = none
    for method in BoundMethod:
        if not all(method in step.methods for step in steps):
            continue
        parts = [step.constants(spacing_s, method) for step in steps]
        exists, gain = np.ones(len(none), dtype=bool), none
        for part in parts:
            gain = np.where(exists & ~part.exists, part.loop_gain, gain)
            exists = exists & part.exists
        size = np.where(exists, sum(part.state for part in parts), np.inf)
        better = exists & ((size < sizes) | ~best.exists)
        drifts = np.where(better, method is BoundMethod.DRIFTING, best.drifts)
        if best.parts:
            parts = [
                LoopConstants(*(np.where(better, *pair) for pair in zip(one, other, strict=True)))
                for one, other in zip(parts, best.parts, strict=True)
            ]
        sizes = np.where(better, size, sizes)
        gain = np.where(better | best.exists, best.loop_gain, np.minimum(gain, best.loop_gain))
        best = best._replace(
            parts=parts, drifts=drifts, exists=best.exists | exists, loop_gain=gain
        )
    return best


class SharpenedBounds(NamedTuple):
    """Bounds of all times; see :class:`noack.theory.bounds.terms.Constants`."""

    input_error: float
    state: float
    state_weighted: float
    mismatch: float
    inter_event_s: float | None


@dataclass(frozen=True)
class InvariantEllipsoids:
    """The ellipsoids ‖Λx‖ ≤ 1 that x does not leave under bounds of e_c."""

    plant: PlantGains
    largest: float
    """The largest D, for which Λ is chosen."""

    def sharpened(
        self, known: SharpenedBounds, errors: Vector, level: float | None, size: float
    ) -> tuple[SharpenedBounds, Vector]:
        """Return the smaller of the known bounds and those from the flow.

        Args:
            known: bounds that hold.
            errors: bounds of ‖e_c‖_W while at most 0, 1, … events have been lost.
            level: ‖e_s‖_W at an event, at least; None if it may be arbitrarily small.
            size: bound of ‖e_s‖_W.
        """
        limit = float(errors[-1])
        reach = self.within(limit)
        if reach is None:
            return known, errors
        flow, inverse = self.flow, reach.size * reach.starts.inverse
        gain = self.plant.error.split_K[1] @ flow.inverse

        def of_state(C: Matrix) -> float:
            return float(np.linalg.norm(C @ inverse, 2)) * ROUNDING

        sharper = SharpenedBounds(
            min(known.input_error, reach.sup(np.hstack([np.zeros_like(gain), gain]))),
            min(known.state, of_state(flow.inverse)),
            min(known.state_weighted, of_state(np.eye(flow.n))),
            min(known.mismatch, of_state(flow.mismatch)),
            known.inter_event_s,
        )
        if level is None or not known.inter_event_s:
            return sharper, errors
        at_event = max(float(errors_at_events(errors)[-1]), _LEAST_SHARE * limit)
        bend = bend_of_error(reach, level)
        at_events = replace(reach, limit=at_event)
        next_s = _next_event_s(at_events, level, known.inter_event_s, bend)
        kernel = self.plant.error.kernels[Output.WEIGHTED]
        errors = errors_after_losses(reach, errors, size, level, next_s, kernel, bend)
        return sharper._replace(inter_event_s=next_s), errors

    def within(self, limit: float) -> Reach | None:
        """Return the flow from an ellipsoid for these bounds; None if none is found."""
        starts = self._starts
        if starts is None or np.linalg.cond(starts.shape) > _ILL_CONDITIONED:
            return None
        (size,) = self._sizes(starts.inverse[None], limit)
        if not math.isfinite(size):
            return None
        reaches = (Reach(starts, size * margin, limit) for margin in _MARGINS)
        return next((reach for reach in reaches if reach.is_invariant()), None)

    @cached_property
    def flow(self) -> DeliveryFlow:
        """The flow between two deliveries."""
        return DeliveryFlow(self.plant)

    @cached_property
    def _starts(self) -> Starts | None:
        """Λ for a small bound of ‖x‖: a pattern search over its three parameters."""
        with np.errstate(all="ignore"):
            tried = np.array(_STARTS)
            merits = self._merits(tried)
            best, merit = tried[merits.argmin()], merits.min()
            for width in _WIDTHS:
                tried = best + width * _DIRECTIONS
                merits = self._merits(tried)
                if merits.min() < merit:
                    best, merit = tried[merits.argmin()], merits.min()
            (factor,) = self._factors(best[None])
        return Starts(self.flow, np.linalg.inv(factor)) if math.isfinite(merit) else None

    def _merits(self, parameters: Matrix) -> Vector:
        """Return the bounds of ‖x‖ that some parameters give, (c,)."""
        factors = self._factors(parameters)
        usable = np.isfinite(factors).all(axis=(1, 2))
        merits = np.full(len(parameters), np.inf)
        if usable.any():
            factors = factors[usable]
            sizes = self._sizes(factors, self.largest)
            merits[usable] = sizes * np.linalg.norm(self.flow.inverse @ factors, 2, axis=(1, 2))
        return merits

    def _factors(self, parameters: Matrix) -> Stack:
        """Return Λ⁻¹ with Λ⁻¹Λ⁻ᵀ = X, (M + νI)X + X(M + νI)ᵀ = −Q, (c, n, n); not finite if none.

        M = A + BK, and Q is BK Kᵀ Bᵀ with shares of the identity and of x(0) x(0)ᵀ. Its scale is
        arbitrary.
        """
        factors = np.full((len(parameters), self.flow.n, self.flow.n), np.nan)
        for index, (logit, all_x, x0) in enumerate(parameters.clip(-15.0, 15.0)):
            by_input, by_all, by_start = self._grown(float(logit))
            X = by_input + math.exp(all_x) * by_all + math.exp(x0) * by_start
            with contextlib.suppress(np.linalg.LinAlgError):
                factors[index] = np.linalg.cholesky(X)
        return factors

    @cached_method
    def _grown(self, logit: float) -> list[Matrix]:
        """Return X for each of the three parts of Q, for ν that follows from ``logit``."""
        flow, n = self.flow, self.flow.n
        share = 0.1 + 0.85 / (1 + math.exp(-logit))
        rate = share * -spectral_abscissa(flow.closed_loop)
        moved = flow.closed_loop + rate * np.eye(n)
        solutions = []
        for columns in (flow.BK, np.eye(n), flow.start):
            Q = columns @ columns.T / max(float((columns**2).sum()), 1e-300)
            if not np.isfinite(Q).all():
                raise np.linalg.LinAlgError("the squares of the entries overflow")
            X = solve_lyapunov(moved, -Q)
            solutions.append(np.asarray(0.5 * (X + X.T)))
        return solutions

    @cached_property
    def _nodes(self) -> Stack:
        """The flow at some nodes."""
        edges_s, states = self.flow.edges_s, self.flow.states
        count = len(edges_s) - 1
        late = edges_s.searchsorted(np.geomspace(float(edges_s[1]), float(edges_s[-1]), _NODES))
        even = np.linspace(1, count, _NODES).astype(int)
        return np.asarray(states[sorted({*late.clip(1, count), *even})])

    def _sizes(self, factors: Stack, limit: float) -> Vector:
        """Return about the smallest c for which ‖Λx‖ ≤ c is invariant and contains x(0), (c,).

        At a node it does not exceed c if c² ≥ μ/(1 − λ) for some μ, λ the largest eigenvalue of
        ‖ΛΦξ‖² − μ‖Nξ‖²/D² on ‖Λξ‖ = 1, (Φ, N) ξ = e^{Fτ} (ξ, 0).
        """
        n, shapes = self.flow.n, np.linalg.inv(factors)
        image, error = (
            np.asarray(Y.swapaxes(-1, -2) @ Y)
            for Y in (
                shapes[:, None] @ self._nodes[:, :n] @ factors[:, None],
                self._nodes[:, n:] @ factors[:, None] / limit,
            )
        )
        largest = np.linalg.norm(shapes @ self.flow.start, 2, axis=(1, 2)) ** 2 * ROUNDING
        which, nodes = np.nonzero(np.linalg.eigvalsh(image)[..., -1] >= 1)
        if len(which):
            image, error = image[which, nodes], error[which, nodes]
            squares, best = _squares(image, error, np.tile(_COARSE, (len(which), 1)))
            order = np.lexsort((-squares, which))  # the largest of each candidate first
            rank = np.arange(len(which)) - np.searchsorted(which[order], which[order])
            last = order[rank < _CRITICAL]
            squares, _ = _squares(image[last], error[last], best[last, None] * _FINE)
            np.maximum.at(largest, which[last], squares)
        return np.asarray(np.sqrt(largest))


def errors_at_events(errors: Vector) -> Vector:
    """Bound ‖e_c‖_W after each event: 0 if it is received; a lost one was not missing before."""
    return np.append(0.0, errors[:-1])


def _next_event_s(at_events: Reach, level: float, known_s: float, bend: float) -> float:
    """Return a time before which ‖e_s‖_W cannot reach ``level`` after an event.

    It is at least the known one. Over a step s, e_s differs from its chord by at most s²/8 times a
    bound of its second derivative, which holds as long as ‖e_s‖_W is below the level.
    """
    flow, found_s = at_events.starts.flow, known_s
    if not (0 < known_s < math.inf and 0 < bend < math.inf):
        return known_s
    size, tries = at_events.sup(error_after(flow, found_s)), 0
    slope = size / found_s
    while size < level:
        step_s = min(math.sqrt(4 * (level - size) / bend), found_s)
        if slope * step_s > 0.99 * (level - size):
            step_s = 0.99 * (level - size) / slope
        while tries < _MOST_STEPS and step_s > _SHORT * found_s:
            later, tries = at_events.sup(error_after(flow, found_s + step_s)), tries + 1
            if max(size, later) + step_s**2 / 8 * bend < level:
                break
            step_s *= 0.6
        else:
            return found_s
        slope = (later - size) / step_s
        found_s, size = found_s + step_s, later
    return found_s


def _squares(image: Stack, error: Stack, multipliers: Matrix) -> tuple[Vector, Vector]:
    """Return the smallest c² over the multipliers, (k, j), and its multiplier, for k nodes."""
    forms = image[:, None] - multipliers[..., None, None] * error[:, None]
    left = np.linalg.eigvalsh(forms)[..., -1]
    squares = np.where(left < 1, multipliers / (1 - left.clip(min=0.0)), np.inf)
    best = squares.argmin(axis=1)
    rows = np.arange(len(squares))
    return squares[rows, best], multipliers[rows, best]
