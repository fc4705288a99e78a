"""The search for a whole witness: a document that :mod:`noack_check.proof` accepts."""

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from noack.theory.witnesses.assumptions import (
    first_assumptions,
    first_event_s,
    inter_event_s,
    next_assumptions,
    observer_decay,
    require_few,
    without_drift,
)
from noack.theory.witnesses.coordinates import floats, simulated_frames
from noack.theory.witnesses.effort import MOST_WORK, Effort, NoWitnessError, WorkLimitError
from noack.theory.witnesses.line_search import search_lowest
from noack.theory.witnesses.search import Found, Search, refined
from noack.theory.witnesses.semidefinite import Accuracy
from noack.theory.witnesses.templates import Templates
from noack_check.balls import number
from noack_check.check import RejectedError
from noack_check.loop import Loop
from noack_check.model import Model
from noack_check.proof import Proof, compares_error, prove, prove_bound, read_assumptions

_COARSE = Accuracy(gap=1e-3, feasibility=1e-3, improves_steps=False)
_ATTEMPTS = (
    (1e-5, Accuracy(gap=1e-3, feasibility=2e-8, improves_steps=False)),
    *(
        (margin, Accuracy(gap=1e-8, feasibility=1e-8, improves_steps=True))
        for margin in (1e-6, 1e-5, 1e-4, 1e-3)
    ),
)
"""Margins of the inequalities, in the coordinates of the search, until the checker accepts."""
_COARSE_MARGIN = 1e-6
_FIRST_SHARE, _FIRST_SLOW_SHARE, _FIRST_CLOCK_SHARE = 0.42, 0.04, 0.02
"""ν is between 2r and twice the loop's rate of decay, at a share."""
_MOST_TRIES, _FEW_TRIES, _LARGE = 5, 2, 1.0
"""Shares that are tried for an output, also for a problem that is large: its work is above a limit."""
_ROOM, _NEAR = 1 + 1e-6, 1.04
_PIECES = (4, 16)
"""Of the period of a periodic rule, until there is a witness."""
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
    progress: Callable[[float], None] = lambda share: None,
    most_work: float = MOST_WORK,
) -> Witness:
    """Return a witness for bounds of some outputs, and of what follows from them.

    Args:
        loop: the loop.
        outputs: those that are bounded from the start on.
        ultimate: those that are bounded in the limit t → ∞.
        progress: called with the completed share.
        most_work: limit of the search, see :class:`Effort`.

    Raises:
        NoWitnessError: none was found.
    """
    if loop.losses > _MOST_LOSSES:
        raise NoWitnessError(f"M − 1 = {loop.losses} consecutive losses: at most {_MOST_LOSSES} are searched")
    rates = _Rates(loop)
    if rates.slowest <= 0:
        raise NoWitnessError("the loop does not decay without losses")
    effort = Effort(progress, most_work)
    effort.expect(_EXPECTED * (1 + len(outputs) + len(ultimate)))
    wanted = _Wanted(outputs, ultimate)
    if loop.times.period > 0:
        return _by_clock(loop, wanted, effort)
    if not compares_error(loop):
        with contextlib.suppress(NoWitnessError):
            return _by_quadratic_forms(loop, rates, wanted, effort)
        return _by_quadratic_forms(loop, _Rates(loop, slow=0.01), wanted, effort)
    try:
        return _by_threshold(loop, rates, wanted, effort)
    except WorkLimitError:
        raise
    except NoWitnessError as error:
        with contextlib.suppress(NoWitnessError):
            return _by_quadratic_forms(loop, rates, wanted, effort)
        raise error


class _Wanted(NamedTuple):
    """Outputs to bound: from the start on, and in the limit."""

    outputs: Sequence[str]
    ultimate: Sequence[str]


def _by_threshold(loop: Loop, rates: "_Rates", wanted: _Wanted, effort: Effort) -> Witness:
    """Return a witness for a rule that compares ‖W e_s‖: its drift bounds e_s and times between events."""
    document, search = _confirmed(loop, rates, effort)
    entry = search.bound("drift")
    document["bounds"] = [*search.bounds(wanted), entry]
    numbers = entry["numbers"]
    assert isinstance(numbers, dict)
    drift = tuple(float(np.sqrt(numbers.get(name, 0.0))) for name in ("level 1", "level 2"))
    document["inter_event_s"] = apart = inter_event_s(loop, rates.rate, drift)
    document["first_event_s"] = first_event_s(loop, drift, apart)
    return _proven(loop, document)


def _confirmed(
    loop: Loop, rates: "_Rates", effort: Effort, shares: dict[str, float] | None = None
) -> tuple[dict[str, object], "_OutputSearch"]:
    """Return a document with assumptions that the bound of the drift confirms, and the search with them."""
    document = first_assumptions(loop, rates.rate)
    for _ in range(_MOST_GUESSES):
        search = _OutputSearch(loop, rates, document, effort, shares)
        levels = search.best_share("drift", starts=True)[1].levels
        following = next_assumptions(loop, document, levels)
        if following is None:
            return document, search
        document = following
        effort.expect(_EXPECTED)
    raise NoWitnessError("errors: the sensor's error may be larger than each guess of it")


def coarse_sizes(loop: Loop, outputs: Sequence[str], effort: Effort, shares: dict[str, float]) -> list[float]:
    """Return rough bounds of outputs at all times, which are at most little too small.

    Args:
        loop: the loop.
        outputs: the outputs.
        effort: counts the work.
        shares: for ν of outputs, from a similar loop; those of this one replace them.

    Raises:
        NoWitnessError: some output has none.
    """
    rates = _Rates(loop)
    if rates.slowest <= 0:
        raise NoWitnessError("the loop does not decay without losses")
    if loop.times.period > 0 or not compares_error(loop):
        document = without_drift(loop, first_assumptions(loop, rates.rate))
        search = _OutputSearch(loop, rates, document, effort, shares)
    else:
        _, search = _confirmed(loop, rates, effort, shares)
    return [search.best_share(output, starts=True)[1].size for output in outputs]


def _by_quadratic_forms(loop: Loop, rates: "_Rates", wanted: _Wanted, effort: Effort) -> Witness:
    """Return a witness for any rule: e_s has quadratic forms, too, and each test may be an event."""
    document = without_drift(loop, first_assumptions(loop, rates.rate))
    search = _OutputSearch(loop, rates, document, effort)
    sensor = search.bound("e_s")
    return _proven(loop, {**document, "bounds": [*search.bounds(wanted), sensor]})


def _by_clock(loop: Loop, wanted: _Wanted, effort: Effort) -> Witness:
    """Return a witness for a periodic rule, with the fewest parts of its period for which there is one."""
    for pieces in _PIECES:
        for share in (0.3, 0.02):
            rates = _Rates(loop, slow=share)
            rates.first_share = _FIRST_CLOCK_SHARE
            document = {**first_assumptions(loop, rates.rate), "pieces": pieces}
            effort.expect(_EXPECTED)
            search, (output, *_) = _OutputSearch(loop, rates, document, effort), wanted.outputs
            if not search.has_solution(output):
                continue
            bounds = search.bounds(wanted)
            if bounds:
                return _proven(loop, {**document, "bounds": bounds})
    raise NoWitnessError("the solver finds no quadratic forms at any rate of decay")


def _proven(loop: Loop, document: Mapping[str, object]) -> Witness:
    try:
        return Witness(document, prove(loop, document))
    except RejectedError as error:
        raise NoWitnessError(str(error)) from None


class _Rates:
    """The rates of decay of a loop: that of the bounds, r, and the largest that ν may have, halved.

    ``slow`` is r, without a threshold that decays, as a share of the latter; then ν is small, too.
    """

    def __init__(self, loop: Loop, *, slow: float | None = None) -> None:
        closed = floats(loop.A + loop.B * loop.gain)
        own = [closed] if loop.holds else [closed, floats(loop.H)]
        self.slowest = min(-float(np.linalg.eigvals(M).real.max()) for M in own)
        self.slowest = min(self.slowest, observer_decay(loop))
        threshold, level = float(loop.rule.rate), float(loop.rule.level)
        wanted = threshold if level else (slow or 0.3) * self.slowest
        self.first_share = _FIRST_SLOW_SHARE if slow else _FIRST_SHARE
        if loop.holds or (level and not threshold):
            self.rate = 0.0
        else:
            self.rate = wanted if wanted < 0.95 * self.slowest else 0.8 * self.slowest

    def decay(self, share: float) -> float:
        """Return ν at a share of what is possible."""
        return 2 * self.rate + 2 * (self.slowest - self.rate) * share


class _OutputSearch:
    """The search for the bounds of one loop; ν of the first output is the first guess for the others.

    Args:
        loop: the loop.
        rates: its rates of decay.
        document: a witness's document with its assumptions.
        effort: counts the work.
        shares: for ν of outputs from the start on, of a similar loop; those of this one replace them.
    """

    def __init__(
        self,
        loop: Loop,
        rates: _Rates,
        document: Mapping[str, object],
        effort: "Effort",
        shares: dict[str, float] | None = None,
    ) -> None:
        self._loop, self._rates, self._effort = loop, rates, effort
        self._similar = {} if shares is None else shares
        self._rate = number(rates.rate)
        require_few(document)
        try:
            self._assumed = read_assumptions(loop, self._rate, document)
        except RejectedError as error:
            raise NoWitnessError(str(error)) from None
        self._templates = Templates(self._model)
        self._frames = simulated_frames(self._templates.model)
        self._search = Search(self._templates, self._frames)
        self._best: dict[tuple[str, bool], tuple[float, Found]] = {}
        self._share: float | None = None

    def _model(self, decay: float) -> Model:
        assumed = self._assumed
        return Model(
            self._loop,
            self._rate,
            number(decay),
            assumed.errors,
            assumed.noise,
            later=assumed.later,
            later_at_start=assumed.later_at_start,
            pieces=assumed.pieces,
            is_exact=False,
        )

    def bounds(self, wanted: _Wanted) -> list[dict[str, object]]:
        """Return the entries of those outputs for which there is one."""
        found = []
        for starts, names in ((True, wanted.outputs), (False, wanted.ultimate)):
            for output in names:
                with contextlib.suppress(NoWitnessError):
                    found.append(self.bound(output, starts=starts))
        return found

    def bound(self, output: str, *, starts: bool = True) -> dict[str, object]:
        """Return the entry of a document for an output, from the start on or in the limit.

        ν is found by coarse solutions. Accurate ones follow, with larger margins and in coordinates of
        the one before, until one is accepted that is not much larger than the coarse one.
        """
        share, coarse = self.best_share(output, starts=starts)
        decay, why = self._rates.decay(share), f"{output}: {self._nothing_found()}"
        accepted: list[tuple[float, dict[str, object]]] = []
        for is_last, found in self._accurate(output, decay, coarse, starts=starts):
            entry = _entry(output, decay, found, starts=starts)
            try:
                prove_bound(self._loop, self._rate, entry, self._assumed)
            except RejectedError as error:
                why = str(error)
            else:
                accepted.append((found.size, entry))
                if found.size < _NEAR * coarse.size:
                    return entry
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
        search, attempts = self._search, list(enumerate(_ATTEMPTS))
        if self._is_large(output):  # the coarse one is as accurate
            yield False, coarse
            search = Search(self._templates, refined(search.frames, coarse))
            del attempts[0]
        last = coarse
        for index, (margin, accuracy) in attempts:
            found = self._solve(search, output, decay, starts=starts, margin=margin, accuracy=accuracy)
            if found is not None:
                last = found
                yield index > 1, found
            search = Search(self._templates, refined(search.frames, last))

    def _nothing_found(self) -> str:
        """Return that there is no solution, and what was assumed."""
        later = self._assumed.later
        events = f" with {later} later event{'s' * (later > 1)}" if later else ""
        return f"the solver finds no quadratic forms{events}"

    def best_share(self, output: str, *, starts: bool) -> tuple[float, Found]:
        """Return the share for ν with its coarse solution."""
        key = output, starts
        if key not in self._best:
            found = self._tried(output, starts=starts)
            if not found:
                raise NoWitnessError(f"{output}: {self._nothing_found()}")
            best = min(found, key=lambda share: found[share].size)
            self._share = self._share or best
            self._best[key] = best, found[best]
            if starts:
                self._similar[output] = best
        return self._best[key]

    def has_solution(self, output: str) -> bool:
        """Return whether the solver finds forms that bound an output from the start on."""
        try:
            self.best_share(output, starts=True)
        except WorkLimitError:
            raise
        except NoWitnessError:
            return False
        return True

    def _tried(self, output: str, *, starts: bool) -> dict[float, Found]:
        """Return coarse solutions by their shares."""
        found: dict[float, Found] = {}
        margin, accuracy = _ATTEMPTS[0] if self._is_large(output) else (_COARSE_MARGIN, _COARSE)

        def size(share: float) -> float:
            decay = self._rates.decay(share)
            solution = self._solve(
                self._search, output, decay, starts=starts, margin=margin, accuracy=accuracy
            )
            if solution is None:
                return math.inf
            found[share] = solution
            return solution.size

        if starts and output in self._similar and math.isfinite(size(self._similar[output])):
            return found
        most = _MOST_TRIES
        if self._is_large(output):
            most = 1 if self._share else _FEW_TRIES
        search_lowest(size, self._share or self._rates.first_share, most, upwards=not self._share)
        return found

    def _is_large(self, output: str) -> bool:
        return self._templates.work(output) > _LARGE

    def _solve(
        self, search: Search, output: str, decay: float, *, starts: bool, margin: float, accuracy: Accuracy
    ) -> Found | None:
        self._effort.add(output, self._templates.work(output))
        return search.solve(output, decay, starts=starts, margin=margin, accuracy=accuracy)


def _entry(output: str, decay: float, found: Found, *, starts: bool) -> dict[str, object]:
    """Return the entry of a document: symmetric matrices, multipliers that are not negative."""
    numbers = {
        name: value
        if name.startswith("c")
        else max(value, 0.0) * (_ROOM if name.startswith("level") else 1.0)
        for name, value in found.numbers.items()
    }
    matrices = {name: ((V + V.T) / 2).tolist() for name, V in found.matrices.items()}
    return {
        "output": output, "decay": decay, "from_start": starts, "matrices": matrices, "numbers": numbers,
    }  # fmt: skip
