"""The search for a whole witness: a document that :mod:`noack_check.proof` accepts."""

import contextlib
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from noack.theory.witnesses.assumptions import (
    first_assumptions,
    first_event_s,
    inter_event_s,
    next_assumptions,
)
from noack.theory.witnesses.coordinates import Frames, floats, simulated_frames
from noack.theory.witnesses.search import Found, Search, refined
from noack_check.balls import number
from noack_check.check import RejectedError
from noack_check.loop import Loop
from noack_check.model import Model
from noack_check.proof import Proof, compares_error, prove, prove_bound, read_assumptions

_MARGINS = (1e-6, 1e-5, 1e-4, 1e-3)
"""Margins of the inequalities, in the coordinates of the search, until the checker accepts."""
_SHARES = (0.2, 0.42, 0.64)
"""ν between 2r and twice the loop's rate of decay, as shares; three, then one more by interpolation."""
_ROOM, _NEAR = 1 + 1e-6, 1.04
_MOST_LOSSES = 24
_MOST_GUESSES = 6


class NoWitnessError(ArithmeticError):
    """No witness was found; the message says what fails first."""


class Witness(NamedTuple):
    """A document, and what the checker found it to prove."""

    document: Mapping[str, object]
    proof: Proof


def find_witness(
    loop: Loop, outputs: Sequence[str] = ("x", "e_c"), *, ultimate: Sequence[str] = ()
) -> Witness:
    """Return a witness for bounds of some outputs, and of what follows from them.

    Args:
        loop: the loop.
        outputs: those that are bounded from the start on.
        ultimate: those that are bounded in the limit t → ∞.

    Raises:
        NoWitnessError: none was found.
    """
    if loop.losses > _MOST_LOSSES:
        raise NoWitnessError(f"M − 1 = {loop.losses} consecutive losses: at most {_MOST_LOSSES} are searched")
    rates = _Rates(loop)
    if rates.slowest <= 0:
        raise NoWitnessError("the loop does not decay without losses")
    if compares_error(loop):
        return _by_threshold(loop, rates, outputs, ultimate)
    with contextlib.suppress(NoWitnessError):
        return _by_quadratic_forms(loop, rates, outputs, ultimate)
    return _by_quadratic_forms(loop, _Rates(loop, slow=True), outputs, ultimate)


def _by_threshold(loop: Loop, rates: "_Rates", outputs: Sequence[str], ultimate: Sequence[str]) -> Witness:
    """Return a witness for a rule that compares ‖W e_s‖: its drift bounds e_s and times between events."""
    document = first_assumptions(loop, rates.rate)
    for _ in range(_MOST_GUESSES):
        search = _OutputSearch(loop, rates, document)
        levels = search.best_decay("drift", starts=True)[1].levels
        following = next_assumptions(loop, document, levels)
        if following is None:
            break
        document = following
    else:
        raise NoWitnessError("errors: the sensor's error may be larger than each guess of it")
    bounds = search.bounds(outputs, ultimate)
    entry = search.bound("drift")
    document["bounds"] = [*bounds, entry]
    numbers = entry["numbers"]
    assert isinstance(numbers, dict)
    drift = tuple(float(np.sqrt(numbers.get(name, 0.0))) for name in ("level 1", "level 2"))
    document["inter_event_s"] = apart = inter_event_s(loop, rates.rate, drift)
    document["first_event_s"] = first_event_s(loop, drift, apart)
    return _proven(loop, document)


def _by_quadratic_forms(
    loop: Loop, rates: "_Rates", outputs: Sequence[str], ultimate: Sequence[str]
) -> Witness:
    """Return a witness for another rule: e_s has quadratic forms as other outputs have."""
    document = first_assumptions(loop, rates.rate)
    bounds = _OutputSearch(loop, rates, document).bounds([*outputs, "e_s"], ultimate)
    if not bounds:
        raise NoWitnessError("the solver finds no quadratic forms at any rate of decay")
    return _proven(loop, {**document, "bounds": bounds})


def _proven(loop: Loop, document: Mapping[str, object]) -> Witness:
    try:
        return Witness(document, prove(loop, document))
    except RejectedError as error:
        raise NoWitnessError(str(error)) from None


class _Rates:
    """The rates of decay of a loop: that of the bounds, r, and the largest that ν may have, halved."""

    def __init__(self, loop: Loop, *, slow: bool = False) -> None:
        closed = floats(loop.A + loop.B * loop.gain)
        own = [closed] if loop.holds else [closed, floats(loop.H)]
        self.slowest = min(-float(np.linalg.eigvals(M).real.max()) for M in own)
        threshold, level = float(loop.rule.rate), float(loop.rule.level)
        wanted = threshold if level else (0.01 if slow else 0.3) * self.slowest
        self.shares = (0.01, 0.04, 0.15) if slow else _SHARES
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
    """

    def __init__(self, loop: Loop, rates: _Rates, document: Mapping[str, object]) -> None:
        self._loop, self._rates, self.document = loop, rates, document
        self._rate = number(rates.rate)
        self._assumed = read_assumptions(loop, self._rate, document)
        self._frames = simulated_frames(self._model(rates.decay(rates.shares[0])))
        self._share: float | None = None

    def _model(self, decay: float) -> Model:
        assumed = self._assumed
        return Model(
            self._loop,
            self._rate,
            number(decay),
            assumed.errors,
            later=assumed.later,
            later_at_start=assumed.later_at_start,
            is_exact=False,
        )

    def bounds(self, outputs: Sequence[str], ultimate: Sequence[str]) -> list[dict[str, object]]:
        """Return the entries of those outputs for which there is one."""
        found = []
        for starts, names in ((True, outputs), (False, ultimate)):
            for output in names:
                with contextlib.suppress(NoWitnessError):
                    found.append(self.bound(output, starts=starts))
        return found

    def bound(self, output: str, *, starts: bool = True) -> dict[str, object]:
        """Return the entry of a document for an output, from the start on or in the limit.

        ν is found by coarse solutions. The best of them gives the coordinates for accurate ones, of
        which the first that is accepted and not much larger than the coarse one is taken.
        """
        decay, coarse = self.best_decay(output, starts=starts)
        frames, why = refined(self._frames, coarse), f"{output}: the solver finds no quadratic forms"
        accepted: list[tuple[float, dict[str, object]]] = []
        for margin in _MARGINS:
            for coordinates in (frames, self._frames) if margin == _MARGINS[0] else (frames,):
                found = self._solve(output, decay, coordinates, starts=starts, margin=margin)
                if found is None:
                    continue
                entry = _entry(output, decay, found, starts=starts)
                try:
                    prove_bound(self._loop, self._rate, entry, self._assumed)
                except RejectedError as error:
                    why = str(error)
                    frames = refined(coordinates, found)
                else:
                    accepted.append((found.size, entry))
                    if found.size < _NEAR * coarse.size:
                        return entry
            if accepted:
                return min(accepted, key=lambda pair: pair[0])[1]
        raise NoWitnessError(why)

    def best_decay(self, output: str, *, starts: bool) -> tuple[float, Found]:
        """Return ν with its coarse solution; the first output tries all shares, the others its neighbours."""
        found: dict[float, Found] = {}
        first = self._share
        self._try(
            output, starts, self._rates.shares if first is None else (first, min(1.5 * first, 0.9)), found
        )
        if first is not None and min(found, key=lambda share: found[share].size, default=first) == first:
            self._try(output, starts, [0.65 * first], found)
        if not found:
            raise NoWitnessError(f"{output}: the solver finds no quadratic forms at any rate of decay")
        if len(found) == 3:
            # the lowest point of a parabola
            sizes = [np.log(each.size) for each in found.values()]
            fit = np.polyfit(list(found), sizes, 2)
            if fit[0] > 0:
                lowest = float(np.clip(-fit[1] / (2 * fit[0]), min(found) / 2, 0.9))
                if min(abs(lowest - share) for share in found) > 0.03:
                    self._try(output, starts, [lowest], found)
        best = min(found, key=lambda share: found[share].size)
        self._share = self._share or best
        return self._rates.decay(best), found[best]

    def _try(self, output: str, starts: bool, shares: Sequence[float], found: dict[float, Found]) -> None:
        for share in shares:
            decay = self._rates.decay(share)
            solution = self._solve(
                output, decay, self._frames, starts=starts, margin=_MARGINS[0], tolerance=1e-3
            )
            if solution is not None:
                found[share] = solution

    def _solve(
        self,
        output: str,
        decay: float,
        frames: Frames,
        *,
        starts: bool,
        margin: float,
        tolerance: float = 1e-8,
    ) -> Found | None:
        search = Search(self._model(decay), frames)
        found = search.solve(output, starts=starts, margin=margin, tolerance=tolerance)
        return found if found.status in {"Solved", "AlmostSolved"} else None


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
