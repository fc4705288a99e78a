"""The search for a whole witness: a document that :mod:`noack_check.proof` accepts."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from flint import arb
from scipy.linalg import expm, solve_continuous_lyapunov

from noack.core.linear_systems import Matrix
from noack.theory.witnesses.coordinates import Frames, floats, simulated_frames
from noack.theory.witnesses.search import Found, Search, refined
from noack_check.balls import matrix, number
from noack_check.check import RejectedError
from noack_check.loop import Loop
from noack_check.model import Model, thresholds
from noack_check.norms import growth
from noack_check.proof import Bound, Proof, compares_error, prove, prove_bound, prove_first_event

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
    document: dict[str, object] = {"rate": rates.rate}
    chain = _chain(loop, rates.rate)
    if chain is not None and compares_error(loop):
        document["chain"] = chain
    search = _OutputSearch(loop, rates)
    if not compares_error(loop):
        bounds = search.bounds([*outputs, "e_s"], ultimate)
        if not bounds:  # at a smaller rate of decay, perhaps
            rates = _Rates(loop, slow=True)
            document["rate"] = rates.rate
            bounds = _OutputSearch(loop, rates).bounds([*outputs, "e_s"], ultimate)
        if not bounds:
            raise NoWitnessError("the solver finds no quadratic forms at any rate of decay")
        document["bounds"] = bounds
    else:
        if loop.holds:
            document["overshoot"] = search.overshoot()
        bounds = search.bounds(outputs, ultimate)
        drift = search.bound("drift")
        document["bounds"] = [*bounds, drift]
        document["inter_event_s"] = apart = _inter_event_s(loop, rates.rate, drift)
        document["first_event_s"] = _first_event_s(loop, drift, apart)
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
    """The search for the bounds of one loop; ν of the first output is the first guess for the others."""

    def __init__(self, loop: Loop, rates: _Rates) -> None:
        self._loop, self._rates = loop, rates
        self._overshoot: arb | None = None
        self._frames = simulated_frames(self._model(rates.decay(rates.shares[0])))
        self._share: float | None = None

    def _model(self, decay: float) -> Model:
        rate, chain = number(self._rates.rate), self._overshoot
        return Model(self._loop, rate, number(decay), chain, is_exact=False)

    def overshoot(self) -> float:
        """Return a largest ‖W e_s‖ between tests, in thresholds, that the facts about w may use.

        These facts lead to a bound of the drift, and it to the next guess.

        Raises:
            NoWitnessError: no guess is confirmed.
        """
        sampling = float(arb(self._loop.times.sampling).mid())
        units = [float(each) for each in thresholds(self._loop, number(self._rates.rate))]
        guess = 1.0 if not sampling else 1.1
        for _ in range(_MOST_GUESSES):
            self._overshoot = number(guess)
            if not sampling:
                return guess
            levels = self._best_decay("drift", starts=True)[1].levels
            needed = 1 + sampling * max(D / unit for D, unit in zip(levels, units, strict=True) if unit)
            if needed < guess:
                return guess
            guess = 1 + (needed - 1) * 1.3
        raise NoWitnessError(
            f"overshoot: the sensor's error may grow to {guess:.3g} thresholds between tests"
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
        decay, coarse = self._best_decay(output, starts=starts)
        frames, why = refined(self._frames, coarse), f"{output}: the solver finds no quadratic forms"
        accepted: list[tuple[float, dict[str, object]]] = []
        for margin in _MARGINS:
            for coordinates in (frames, self._frames) if margin == _MARGINS[0] else (frames,):
                found = self._solve(output, decay, coordinates, starts=starts, margin=margin)
                if found is None:
                    continue
                entry = _entry(output, decay, found, starts=starts)
                try:
                    prove_bound(self._loop, number(self._rates.rate), entry, arb(1), self._overshoot)
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

    def _best_decay(self, output: str, *, starts: bool) -> tuple[float, Found]:
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


def _chain(loop: Loop, rate: float) -> dict[str, object] | None:
    """Return the gain of the paper's chain with the witness of its tail; None: the model does not decay."""
    W = floats(loop.weight)
    G = W @ floats(loop.H) @ np.linalg.inv(W) + rate * np.eye(loop.n)
    if not G.any():
        return {"gain": 1.0, "tail": np.eye(loop.n).tolist()}
    if np.linalg.eigvals(G).real.max() >= 0:
        return None
    tail = solve_continuous_lyapunov(G.T, -np.eye(loop.n))
    gain = max(_sups(G)) * (1 + 3e-4) + 1e-9
    return {"gain": gain, "tail": ((tail + tail.T) / 2).tolist()}


def _sups(G: Matrix) -> Iterator[float]:
    """Yield the largest of ‖e^{Gτ}‖ on grids of 256 times until it has decayed."""
    slowest = -float(np.linalg.eigvals(G).real.max())
    step = 0.02 / max(float(np.linalg.norm(G, 2)), slowest)
    cells = np.array([expm(G * step * k) for k in range(256)])
    power, following = np.eye(len(G)), expm(G * step * 256)
    for _ in range(400):
        sizes = np.linalg.norm(cells @ power, 2, axis=(1, 2))
        yield float(sizes.max())
        if sizes[-1] < 1e-2:
            return
        power = following @ power


def _inter_event_s(loop: Loop, rate: float, drift: Mapping[str, object]) -> float:
    """Return a time that :mod:`noack_check.proof` accepts between two events; 0 without one."""
    numbers = drift["numbers"]
    assert isinstance(numbers, dict)
    D1, D2 = numbers.get("level 1", 0.0), numbers.get("level 2", 0.0)
    level, floor = float(loop.rule.level), float(loop.rule.floor)
    if rate != float(loop.rule.rate):
        level = 0.0
    if loop.rule.always or loop.rule.negative.nrows() or not (level or floor):
        return 0.0
    shares = [(max(level**2 * v, floor**2), D1 * v + D2) for v in _kinks(level, floor)]
    most = min((threshold / size) ** 0.5 for threshold, size in shares if size)
    W = floats(loop.weight)
    G = W @ floats(loop.H) @ np.linalg.inv(W) + rate * np.eye(loop.n)
    low, high = 0.0, most
    for _ in range(30):
        middle = (low + high) / 2
        total = float(growth(matrix(G.tolist()), number(middle))[1].mid())
        low, high = (middle, high) if total * (1 + 1e-9) < most else (low, middle)
    return low


def _first_event_s(loop: Loop, drift: Mapping[str, object], most: float) -> float:
    """Return a share of ``most`` before which no event follows the one at t = 0; 0 without one."""
    numbers = drift["numbers"]
    assert isinstance(numbers, dict)
    decaying, constant = (number(numbers.get(name, 0.0)).sqrt() for name in ("level 1", "level 2"))
    bound = Bound("drift", decaying, constant, True)
    for share in (1.0, 0.9, 0.75, 0.5, 0.25):
        with contextlib.suppress(RejectedError):
            prove_first_event(loop, bound, number(share * most), loop.times.start)
            return share * most
    return 0.0


def _kinks(level: float, floor: float) -> list[float]:
    if not level:
        return [0.0, 1.0]
    return [1.0, *([0.0, min((floor / level) ** 2, 1.0)] if floor else [])]
