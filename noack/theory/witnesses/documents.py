"""The search for a whole witness: a document that :mod:`noack.proof.search.results` accepts."""

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from noack.core.balls import number
from noack.core.progress import Progress, no_progress
from noack.proof.elaborate.errors import RejectedError
from noack.proof.elaborate.hybrid_system import Model
from noack.proof.elaborate.loop import Loop
from noack.proof.search.results import FoundBound, Proof, check_bound, compares_error, read_assumptions
from noack.proof.semidefinite import Accuracy
from noack.proof.statement_proof import joined, needs_gains, prove_by_forms, prove_by_gains
from noack.theory.witnesses.assumptions import (
    first_assumptions,
    inter_event_s,
    next_assumptions,
    observer_decay,
    require_few,
    without_drift,
)
from noack.theory.witnesses.coordinates import floats, simulated_frames
from noack.theory.witnesses.effort import MOST_WORK, Effort, NoWitnessError, WorkLimitError
from noack.theory.witnesses.gains import find_by_gains, find_gains
from noack.theory.witnesses.line_search import search_lowest
from noack.theory.witnesses.problem_size import require_small, work_of_loop
from noack.theory.witnesses.search import FREE, Found, Search, refined
from noack.theory.witnesses.templates import Templates

_COARSE = Accuracy(gap=1e-3, feasibility=1e-3, improves_steps=False)
_ATTEMPTS = (
    (1e-5, Accuracy(gap=1e-3, feasibility=2e-8, improves_steps=False)),
    *(
        (margin, Accuracy(gap=1e-8, feasibility=1e-8, improves_steps=True))
        for margin in (1e-6, 1e-5, 1e-4, 1e-3)
    ),
)
"""Margins of the inequalities, in the coordinates of the search, until the checker accepts."""
_ATTEMPTS_BY_TESTS = (
    *((margin, Accuracy(gap=1e-4, feasibility=1e-8, improves_steps=True)) for margin in (1e-8, 1e-7, 1e-6)),
    _ATTEMPTS[0],
)
"""Those of forms of each test, in which V changes little from test to test."""
_ATTEMPT_COUNTED = 1e-7, Accuracy(gap=1e-2, feasibility=1e-8, improves_steps=True)
"""That of forms which count silent tests."""
_COARSE_MARGIN = 1e-6
_FIRST_SHARE, _FIRST_SLOW_SHARE, _SMALLEST_SHARE = 0.42, 0.04, 0.02
"""ν is between 2r and twice the loop's rate of decay, at a share."""
_SMALL_SHARE = 0.05
"""Where the first shares have no solution; so in loops whose plant is known roughly."""
_MOST_TRIES, _FEW_TRIES, _LARGE = 5, 2, 1.0
"""Shares that are tried for an output, also for a problem that is large: its work is above a limit. Forms of
updates on their way then have no products with other states, so that the problem becomes smaller."""
_ROOM, _NEAR = 1 + 1e-6, 1.04
_PIECES, _PIECES_OF_TESTS = (4, 16), (1, 4, 32)
"""Of the period of a periodic rule, or of the time between two tests, until there is a witness."""
_COUNTED = 32, 128
"""Silent tests that are counted since an event, until there is a witness."""
_MOST_LOSSES = 24
_MOST_GUESSES = 6
_EXPECTED = 5
"""Problems that are solved for an output, about."""


class Witness(NamedTuple):
    """A document, and what the checker found it to prove."""

    document: Mapping[str, object]
    proof: Proof


def find_witness(
    loop: Loop,
    outputs: Sequence[str] = ("x", "e_c"),
    *,
    ultimate: Sequence[str] = (),
    near: Sequence[Mapping[str, object]] = (),
    progress: Progress = no_progress,
    most_work: float = MOST_WORK,
) -> Witness:
    """Return a witness for bounds of some outputs, and of what follows from them.

    Args:
        loop: the loop.
        outputs: those that are bounded from the start on.
        ultimate: those that are bounded in the limit t → ∞.
        near: documents of similar loops, say of the same plants under ideal conditions: the best ν of an
            output is nearly the same share of what is possible, so it is that of the first one with it.
        progress: called with the completed share.
        most_work: limit of the search, see :class:`Effort`.

    Without forms there may be bounds by gains, which take no search.

    Raises:
        NoWitnessError: none was found.
    """
    wanted = _Wanted(outputs, ultimate, [document for document in near if "bounds" in document])
    with np.errstate(over="ignore", invalid="ignore"):  # of huge states; the checker decides
        return forms_or_gains(
            lambda: _by_forms(loop, wanted, Effort(progress, most_work)),
            lambda: witness_by_gains(loop, wanted.by_gains),
        )


def forms_or_gains(by_forms: Callable[[], Witness], by_gains: Callable[[], Witness]) -> Witness:
    """Return a witness by quadratic forms, or one by gains.

    Raises:
        NoWitnessError: there is neither, for both reasons.
    """
    try:
        return by_forms()
    except NoWitnessError as of_forms:
        try:
            return by_gains()
        except NoWitnessError as of_gains:
            reasons = dict.fromkeys((str(of_forms), str(of_gains)))
            raise type(of_forms)("; ".join(reasons)) from None


def witness_by_gains(loop: Loop, outputs: Sequence[str]) -> Witness:
    """Return a witness without forms, in a second.

    Raises:
        NoWitnessError: nothing is proven by gains.
    """
    document = find_by_gains(loop, outputs)
    try:
        return Witness(document, prove_by_gains(loop, document))
    except RejectedError as error:
        raise NoWitnessError(str(error)) from None


def _by_forms(loop: Loop, wanted: "_Wanted", effort: Effort) -> Witness:
    """Return a witness with quadratic forms."""
    if loop.losses > _MOST_LOSSES:
        raise NoWitnessError(f"{loop.losses} lost in a row: a search covers at most {_MOST_LOSSES}")
    rates = _Rates(loop)
    if rates.slowest <= 0:
        raise NoWitnessError("the loop does not decay without losses")
    effort.expect(_EXPECTED * (1 + len(wanted.outputs) + len(wanted.ultimate)))
    if loop.times.period > 0 or loop.needs_tests_apart:
        return _by_clock(loop, wanted, effort)
    if not compares_error(loop):
        for slow in (None, 0.01):
            try:
                return _by_quadratic_forms(loop, _Rates(loop, slow=slow), wanted, effort)
            except NoWitnessError as error:
                reason = error
        with contextlib.suppress(NoWitnessError):
            return _by_clock(loop, wanted, effort, _PIECES_OF_TESTS[:-1])  # the last ones take minutes
        raise reason
    try:
        return _by_threshold(loop, rates, wanted, effort)
    except WorkLimitError:
        raise
    except NoWitnessError as error:
        with contextlib.suppress(NoWitnessError):
            return _by_quadratic_forms(loop, rates, wanted, effort)
        raise error


class _Wanted(NamedTuple):
    """Outputs to bound, from the start on and in the limit, and documents of similar loops."""

    outputs: Sequence[str]
    ultimate: Sequence[str]
    near: Sequence[Mapping[str, object]]

    @property
    def by_gains(self) -> Sequence[str]:
        """The outputs to bound by gains, which have a bound in the limit where they have one."""
        return *self.outputs, "e_s", *self.ultimate


def _by_threshold(loop: Loop, rates: "_Rates", wanted: _Wanted, effort: Effort) -> Witness:
    """Return a witness for a rule that compares ‖W e_s‖: its drift bounds e_s and times between events."""
    document, search = _confirmed(loop, rates, effort, rates.shares(wanted.near))
    of_drift = search.bound("drift")
    bounds = [*search.bounds(wanted), of_drift]
    drift = float(of_drift.bound.decaying), float(of_drift.bound.constant)
    document["inter_event_s"] = inter_event_s(loop, rates.rate, drift)
    return search.witness(document, bounds, wanted)


def _confirmed(
    loop: Loop, rates: "_Rates", effort: Effort, shares: "Shares", *, is_rough: bool = False
) -> tuple[dict[str, object], "_OutputSearch"]:
    """Return a document with assumptions that the bound of the drift confirms, and the search with them."""
    document = _with_blocks(loop, first_assumptions(loop, rates.rate))
    for _ in range(_MOST_GUESSES):
        search = _OutputSearch(loop, rates, document, shares, effort, is_rough=is_rough)
        levels = search.best_share("drift", starts=True)[1].levels
        following = next_assumptions(loop, document, levels)
        if following is None:
            return document, search
        document = following
        effort.expect(_EXPECTED)
    raise NoWitnessError("errors: the sensor's error may be larger than each guess of it")


def _with_blocks(loop: Loop, document: dict[str, object]) -> dict[str, object]:
    """Return a document whose forms have no products of updates on their way, if those would be large."""
    rate = document["rate"]
    assert isinstance(rate, float)
    if not document["later"]:
        return document
    with contextlib.suppress(RejectedError):  # the document says something else that is not so
        if work_of_loop(loop, number(rate), document) > _LARGE:
            return {**document, "blocks": True}
    return document


class RoughBounds(NamedTuple):
    """Bounds that are not proven."""

    sizes: Sequence[float]
    """Of the outputs at all times, at most little too small."""
    document: Mapping[str, object]
    """With each output's ν, for the search of a similar loop."""


def rough_bounds(
    loop: Loop, outputs: Sequence[str], near: Sequence[Mapping[str, object]], effort: Effort
) -> RoughBounds:
    """Return rough bounds of outputs at all times.

    Args:
        loop: the loop.
        outputs: the outputs.
        near: documents of similar loops, as :func:`find_witness` has them.
        effort: counts the work.

    Raises:
        NoWitnessError: some output has none.
    """
    rates = _Rates(loop)
    if rates.slowest <= 0:
        raise NoWitnessError("the loop does not decay without losses")
    shares = rates.shares(near)
    if loop.times.period > 0 or not compares_error(loop):
        document = without_drift(loop, first_assumptions(loop, rates.rate))
        search = _OutputSearch(loop, rates, document, shares, effort, is_rough=True)
    else:
        _, search = _confirmed(loop, rates, effort, shares, is_rough=True)
    sizes = [search.best_share(output, starts=True)[1].size for output in outputs]
    return RoughBounds(sizes, {"rate": rates.rate, "bounds": search.decays()})


def _by_quadratic_forms(loop: Loop, rates: "_Rates", wanted: _Wanted, effort: Effort) -> Witness:
    """Return a witness for any rule: e_s has quadratic forms, too, and each test may be an event."""
    document = _with_blocks(loop, without_drift(loop, first_assumptions(loop, rates.rate)))
    search = _OutputSearch(loop, rates, document, rates.shares(wanted.near), effort)
    sensor = search.bound("e_s")
    return search.witness(document, [*search.bounds(wanted), sensor], wanted)


def _by_clock(loop: Loop, wanted: _Wanted, effort: Effort, tried: Sequence[int] = ()) -> Witness:
    """Return a witness by forms at nodes of clocks, with the fewest pieces for which there is one.

    The clocks count from events of a periodic rule, or from tests that are an exact time apart. Without
    forms for a small ν there are none for larger ones, and no bound decays faster than one of a similar loop.
    ``tried``: numbers of pieces, if not all that are worth it.
    """
    by_tests = not loop.times.period > 0
    if loop.rule.memory is not None and loop.losses:
        raise NoWitnessError("with losses quadratic forms are not known for a rule with a dynamic variable")
    fastest = min((each["rate"] for each in wanted.near if isinstance(each["rate"], float)), default=math.inf)
    last: tuple[_OutputSearch, str] | None = None
    if not by_tests:  # a solver that fails with few pieces takes long, and more pieces may be needed
        rate = _Rates(loop, slow=0.3).rate
        require_small(
            loop,
            number(rate),
            {**first_assumptions(loop, rate), "pieces": _PIECES[-1]},
            effort.most_per_problem,
        )
    pairs = [(pieces, 0) for pieces in tried or (_PIECES_OF_TESTS if by_tests else _PIECES)]
    shares: tuple[float, ...] = (0.3, 0.02)
    if loop.rule.memory is not None and loop.holds:  # one test bounds no K e_s, the time since the event does
        pairs, shares = [(1, counted) for counted in _COUNTED], (0.3, 0.1, 0.02)
    for pieces, counted in pairs:
        for share in shares:
            rates = _Rates(loop, slow=share, by_tests=by_tests)
            if rates.rate > fastest and share != shares[-1]:
                continue
            rates.rate = min(rates.rate, fastest)
            rates.first_share, rates.moves = _SMALLEST_SHARE, (0,)
            document = {**first_assumptions(loop, rates.rate), "pieces": pieces}
            if by_tests:
                document["by_tests"] = True
            if counted:
                document["counted"] = counted
            effort.expect(_EXPECTED)
            search = _OutputSearch(loop, rates, document, rates.shares(wanted.near), effort)
            has_errors = not by_tests or loop.seen is None
            outputs = [output for output in wanted.outputs if has_errors or not output.startswith("e_")]
            if not outputs:
                continue
            last = search, outputs[0]
            if search.has_solution(outputs[0]) and (
                bounds := search.bounds(wanted._replace(outputs=outputs))
            ):
                return search.witness(document, bounds, wanted)
    if last is None:
        raise NoWitnessError("the solver finds no quadratic forms at any rate of decay")
    raise last[0].failure(last[1], starts=True)


Shares = dict[tuple[str, bool], float]
"""The share of an output's ν, by its name and whether it is bounded from the start on."""


class _Rates:
    """The rates of decay of a loop: that of the bounds, r, and the largest that ν may have, halved.

    ``slow`` is r, without a threshold that decays, as a share of the latter; then ν is small, too.
    """

    def __init__(self, loop: Loop, *, slow: float | None = None, by_tests: bool = False) -> None:
        moving = loop.n - loop.loads
        closed = floats(loop.A + loop.B * loop.gain)
        own = [M[:moving, :moving] for M in ([closed] if loop.holds else [closed, floats(loop.H)])]
        self.slowest = min(-float(np.linalg.eigvals(M).real.max()) for M in own)
        self.slowest = min(self.slowest, observer_decay(loop))
        if loop.rule.memory is not None:
            self.slowest = min(self.slowest, float(loop.rule.memory.decay) / 2)
        threshold, level = float(loop.rule.rate), float(loop.rule.level)
        wanted = threshold if level else (slow or 0.3) * self.slowest
        self.first_share = _FIRST_SLOW_SHARE if slow else _FIRST_SHARE
        self.moves: Sequence[int] = (0, -1, 1, -2, 2)
        if (loop.holds and not by_tests) or (level and not threshold):
            self.rate = 0.0
        else:
            self.rate = wanted if wanted < 0.95 * self.slowest else 0.8 * self.slowest

    def decay(self, share: float) -> float:
        """Return ν at a share of what is possible."""
        return 2 * self.rate + 2 * (self.slowest - self.rate) * share

    def shares(self, documents: Sequence[Mapping[str, object]]) -> Shares:
        """Return the shares that outputs have in the first document with them, of those with the same r."""
        found: Shares = {}
        for document in documents:
            bounds = document.get("bounds", ()) if document["rate"] == self.rate else ()  # none by gains
            assert isinstance(bounds, Sequence)
            for bound in bounds:
                share = (bound["decay"] / 2 - self.rate) / (self.slowest - self.rate)
                if 0 < share < 1:
                    found.setdefault((bound["output"], bound["from_start"]), share)
        return found


class _Proven(NamedTuple):
    """The entry of a document for an output, and what the checker found it to prove."""

    entry: Mapping[str, object]
    bound: FoundBound


class _OutputSearch:
    """The search for the bounds of one loop; ν of the first output is the first guess for the others.

    Args:
        loop: the loop.
        rates: its rates of decay.
        document: a witness's document with its assumptions.
        shares: for ν of outputs, from a similar loop; those of this one replace them.
        effort: counts the work.
        is_rough: no bound is to be proven.
    """

    def __init__(
        self,
        loop: Loop,
        rates: _Rates,
        document: Mapping[str, object],
        shares: Shares,
        effort: "Effort",
        *,
        is_rough: bool = False,
    ) -> None:
        self._loop, self._rates, self._effort, self._is_rough = loop, rates, effort, is_rough
        self._known, self._shares = dict(shares), shares
        self._rate = number(rates.rate)
        require_few(document)
        try:
            self._assumed = read_assumptions(loop, self._rate, document)
            require_small(loop, self._rate, document, effort.most_per_problem)
            self._templates = Templates(self._model)
        except ValueError as error:
            raise NoWitnessError(str(error)) from None
        self._frames = simulated_frames(self._templates.model)
        self._search = Search(self._templates, self._frames)
        self._best: dict[tuple[str, bool], tuple[float, Found]] = {}
        self._share: float | None = None

    def witness(
        self, document: Mapping[str, object], proven: Sequence["_Proven"], wanted: _Wanted
    ) -> Witness:
        """Return the witness of a document with bounds of this search, and those by gains if they are better.

        Raises:
            NoWitnessError: they do not prove what it assumes.
        """
        loop, document = self._loop, {**document, "bounds": [each.entry for each in proven]}
        try:
            proof = prove_by_forms(loop, document)
        except RejectedError as error:
            raise NoWitnessError(str(error)) from None
        with contextlib.suppress(NoWitnessError, RejectedError):
            gains = find_gains(loop, self._rates.rate, wanted.by_gains)
            both = joined(proof, prove_by_gains(loop, {**document, "gains": gains}))
            if needs_gains(proof, both):
                return Witness({**document, "gains": gains}, both)
        return Witness(document, proof)

    def _model(self, decay: float) -> Model:
        assumed = self._assumed
        return Model(
            self._loop,
            self._rate,
            number(decay),
            assumed.errors,
            assumed.noise,
            **assumed.of_model,
            is_exact=False,
        )

    def bounds(self, wanted: _Wanted) -> list["_Proven"]:
        """Return the bounds of those outputs for which there is one."""
        found = []
        for starts, names in ((True, wanted.outputs), (False, wanted.ultimate)):
            for output in names:
                with contextlib.suppress(NoWitnessError):
                    found.append(self.bound(output, starts=starts))
        return found

    def bound(self, output: str, *, starts: bool = True) -> "_Proven":
        """Return the bound of an output, from the start on or in the limit.

        ν is found by coarse solutions. Accurate ones follow, with larger margins and in coordinates of
        the one before, until one is accepted that is not much larger than the coarse one.
        """
        share, coarse = self.best_share(output, starts=starts)
        decay, why = self._rates.decay(share), f"{output}: {self._nothing_found()}"
        accepted: list[tuple[float, _Proven]] = []
        for is_last, found in self._accurate(output, decay, coarse, starts=starts):
            entry = _entry(output, decay, found, starts=starts)
            try:
                bound = check_bound(self._loop, self._rate, entry, self._assumed)
            except RejectedError as error:
                why = str(error)
            else:
                accepted.append((found.size, _Proven(entry, bound)))
                if found.size < _NEAR * coarse.size:
                    return accepted[-1][1]
            if accepted and is_last:
                break
        if accepted:
            return min(accepted, key=lambda pair: pair[0])[1]
        raise NoWitnessError(why)

    def _accurate(
        self, output: str, decay: float, coarse: Found, *, starts: bool
    ) -> Iterator[tuple[bool, Found]]:
        """Yield accurate solutions, with larger margins and in coordinates of the one before.

        With each comes whether more will not give a smaller bound.
        """
        by_tests = self._assumed.by_tests
        search, attempts = self._search, list(enumerate(_ATTEMPTS_BY_TESTS if by_tests else _ATTEMPTS))
        if self._is_direct(output, starts=starts):  # the coarse one is as accurate
            yield False, coarse
            search = Search(self._templates, refined(search.frames, coarse))
            del attempts[0]
        elif self._templates.work(output) > _LARGE:  # a margin in the first ones costs much
            search = Search(self._templates, refined(search.frames, coarse))
        last = coarse
        for index, (margin, accuracy) in attempts:
            found = self._solve(search, output, decay, starts=starts, margin=margin, accuracy=accuracy)
            if found is not None:
                last = found
                yield index > 1, found
            search = Search(self._templates, refined(search.frames, last))

    def failure(self, output: str, *, starts: bool) -> NoWitnessError:
        """Return why an output has no bound: what was assumed, and the inequality that fails first."""
        if (output, starts) in self._best:
            return NoWitnessError(f"{output}: the quadratic forms that the solver finds are not proven")
        return NoWitnessError(f"{output}: {self._nothing_found()}{self._first_missed(output, starts=starts)}")

    def _nothing_found(self) -> str:
        later = self._assumed.later
        events = f" with {later} later event{'s' * (later > 1)}" if later else ""
        return f"the solver finds no quadratic forms{events}"

    def _first_missed(self, output: str, *, starts: bool) -> str:
        """Return the inequality that is missed by most for the smallest ν, if the problem is not large."""
        work = self._templates.work(output)
        if self._is_rough or work > _LARGE:
            return ""
        self._effort.add(output, work)
        decay = self._rates.decay(_SMALLEST_SHARE)
        missed = self._search.shortfall(output, decay, starts=starts, accuracy=_COARSE)
        if missed is None or missed.share < _COARSE.gap:  # not distinct from the solver's errors
            return ""
        return f" (first fails {missed.name}, by {missed.share:.2g} V)"

    def best_share(self, output: str, *, starts: bool) -> tuple[float, Found]:
        """Return the share for ν with its coarse solution.

        Raises:
            NoWitnessError: there is none.
        """
        if not self.has_solution(output, starts=starts):
            raise self.failure(output, starts=starts)
        return self._best[output, starts]

    def decays(self) -> list[dict[str, object]]:
        """Return for each output that was searched its ν, as in the entry of a document."""
        return [
            {"output": output, "from_start": starts, "decay": self._rates.decay(share)}
            for (output, starts), (share, _) in self._best.items()
        ]

    def has_solution(self, output: str, *, starts: bool = True) -> bool:
        """Return whether the solver finds forms that bound an output."""
        key = output, starts
        if key not in self._best:
            found = self._tried(output, starts=starts)
            if not found:
                return False
            best = min(found, key=lambda share: found[share].size)
            self._share = self._share or best
            self._best[key] = best, found[best]
            self._shares[key] = best
        return True

    def _tried(self, output: str, *, starts: bool) -> dict[float, Found]:
        """Return coarse solutions by their shares."""
        found: dict[float, Found] = {}
        is_direct, known = self._is_direct(output, starts=starts), self._known.get((output, starts))
        margin, accuracy = _ATTEMPTS[0] if is_direct else (_COARSE_MARGIN, _COARSE)
        if self._assumed.counted:
            margin, accuracy = _ATTEMPT_COUNTED

        def size(share: float) -> float:
            decay = self._rates.decay(share)
            solution = self._solve(
                self._search, output, decay, starts=starts, margin=margin, accuracy=accuracy
            )
            if solution is None:
                return math.inf
            found[share] = solution
            return solution.size

        if known is not None:
            if math.isfinite(size(known)):
                return found
            del self._known[output, starts]
            return self._tried(output, starts=starts)
        most = _MOST_TRIES
        if is_direct or self._templates.work(output) > _LARGE:
            most = 1 if self._share else _FEW_TRIES
        first, upwards = self._share or self._rates.first_share, not self._share
        search_lowest(size, first, most, upwards=upwards, moves=self._rates.moves)
        if not found and first == _FIRST_SHARE and compares_error(self._loop):  # others have a smaller r
            search_lowest(size, _SMALL_SHARE, most, upwards=True, moves=(0, -2))
        return found

    def _is_direct(self, output: str, *, starts: bool) -> bool:
        """Return whether each solution is an accurate one: few are tried.

        With friction the first coordinates are too far off: a margin there costs much of the bound.
        """
        if (work := self._templates.work(output)) > _LARGE:
            return not self._effort.has_room(work)
        return (output, starts) in self._known and not self._is_rough and not self._loop.along

    def _solve(
        self, search: Search, output: str, decay: float, *, starts: bool, margin: float, accuracy: Accuracy
    ) -> Found | None:
        self._effort.add(output, self._templates.work(output))
        return search.solve(output, decay, starts=starts, margin=margin, accuracy=accuracy)


def _entry(output: str, decay: float, found: Found, *, starts: bool) -> dict[str, object]:
    """Return the entry of a document: symmetric matrices, multipliers that are not negative."""
    numbers = {
        name: value
        if name.startswith(FREE)
        else max(value, 0.0) * (_ROOM if name.startswith("level") else 1.0)
        for name, value in found.numbers.items()
    }
    matrices = {name: ((V + V.T) / 2).tolist() for name, V in found.matrices.items()}
    return {
        "output": output, "decay": decay, "from_start": starts, "matrices": matrices, "numbers": numbers,
    }  # fmt: skip
