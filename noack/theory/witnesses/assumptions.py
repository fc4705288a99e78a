"""What a witness's model assumes: the size of the sensor's error, and events while an update is on its way.

Each guess leads to a bound of the drift or of the error, and this to the next guess, until one confirms
itself. Nothing here has to be right: :mod:`noack.proof.search.results` proves what is assumed.
"""

import math
import warnings
from collections.abc import Mapping, Sequence

import numpy as np
from flint import arb, fmpq
from scipy.linalg import expm, logm, schur

from noack.core.balls import matrix, number
from noack.proof.elaborate.hybrid_system import thresholds
from noack.proof.elaborate.loop import Loop
from noack.proof.elaborate.noise import noise_of
from noack.proof.elaborate.norms import growth
from noack.proof.loop_document import LoopDocument, Naming, NoDocumentError
from noack.proof.quiet_start import write_quiet_start
from noack.proof.search.results import MOST_LATER, Assumptions, compares_error, last_test_before, weighted
from noack.theory.witnesses.coordinates import floats
from noack.theory.witnesses.effort import NoWitnessError

_ROOM = 1.01
"""A guess is confirmed if what follows from it is smaller by this factor."""
_FURTHER = 1.3
"""The next guess exceeds what followed from the last one by this factor."""

_SPLITS = np.geomspace(1e-3, 1e3, 121)
"""Tried numbers s of (a + b)² ≤ (1 + s) a² + (1 + 1/s) b²."""
_AT_ONCE, _FASTEST, _MOST_TURN = 1e-3, 1e-6, 3.0
"""An error of an observer that decays, or turns, more between two tests has no smooth part."""
_NEARLY, _MOST_STEPS = 1 - 1e-4, 30
"""A time is accepted if e_s reaches nearly the threshold."""


def first_assumptions(loop: Loop, rate: float) -> dict[str, object]:
    """Return a document without bounds: its rate, and what is assumed at first.

    A rule that compares ‖W e_s‖ may have no event while an update is on its way; of others each test may
    be one. With a held input, and with events that need no comparison, forms need a bound of the errors.
    """
    document: dict[str, object] = {"rate": rate}
    if (smooth := smooth_part(loop)) is not None:
        document["observer"] = smooth
    later, at_start = 0, 0
    if not compares_error(loop) or not starts_quietly(loop, rate):
        later, at_start = (_most_between(loop, time) for time in (loop.times.delay, loop.times.start))
    document |= {"later": later, "later_at_start": at_start}
    is_still = loop.holds and rate == 0
    if (is_still or loop.rule.always) and compares_error(loop) and not loop.noise.ncols():
        share = 1.1 if loop.times.sampling > 0 else 1.0
        document = with_errors(document, [share * float(each) for each in thresholds(loop, number(rate))])
    return document


def without_drift(loop: Loop, document: Mapping[str, object]) -> dict[str, object]:
    """Return a document that assumes nothing that follows from a bound of the drift."""
    return {**document, "later": _most_between(loop, loop.times.delay)}


def require_few(document: Mapping[str, object]) -> None:
    """Raise NoWitnessError if more events are assumed than the checker accepts."""
    later, at_start = document["later"], document["later_at_start"]
    assert isinstance(later, int)
    assert isinstance(at_start, int)
    for events, when in ((later, "while an update is on its way"), (at_start, "before the first input acts")):
        if events > MOST_LATER:
            raise NoWitnessError(f"{events} events may happen {when}: at most {MOST_LATER} are covered")


def with_errors(document: Mapping[str, object], sizes: Sequence[float]) -> dict[str, object]:
    """Return a document that assumes other errors."""
    decaying, constant = sizes
    return {**document, "errors": {"decaying": decaying, "constant": constant}}


def starts_quietly(loop: Loop, rate: float) -> bool:
    """Return whether a lemma is found that no event follows the one at t = 0 before the first input acts."""
    none = Assumptions(None, 0, 0, noise=noise_of(loop, number(rate)))
    try:
        document = LoopDocument(loop, number(rate), none, (), Naming("loop"))
        document.require_counted()
    except NoDocumentError:
        return False
    edges = [edge for edge in document.dead_edges if edge["from"].startswith("start")]
    return all(write_quiet_start(document, edge) is not None for edge in edges)


def next_assumptions(
    loop: Loop, document: Mapping[str, object], drift: Sequence[float]
) -> dict[str, object] | None:
    """Return the next document, or None if a bound of the drift confirms what the present one assumes."""
    rate = document["rate"]
    assert isinstance(rate, float)
    later = _needed_later(loop, document, inter_event_s(loop, rate, drift) / _ROOM)
    following, errors = {**document, "later": later}, document.get("errors")
    if not isinstance(errors, Mapping):
        return None if later == document["later"] else following
    sizes = errors["decaying"], errors["constant"]
    share = _share_of(sizes, loop, rate, drift)
    is_exact = not loop.times.sampling > 0
    if later == document["later"] and (is_exact or _ROOM * share < 1):
        return None
    units = [float(each) for each in thresholds(loop, number(rate))]
    largest, total = _growth_between_tests(loop, rate)
    needed = [largest * unit + total * size for unit, size in zip(units, drift, strict=True)]
    grown = [unit + _FURTHER * (size - unit) for size, unit in zip(needed, units, strict=True)]
    factor = max(_ROOM**2 * _share_of(grown, loop, rate, drift), 1.0)
    return with_errors(following, [factor * size for size in grown])


def _growth_between_tests(loop: Loop, rate: float) -> tuple[float, float]:
    """Return the supremum and the integral of ‖e^{Gs}‖, G = W(H + r)W⁻¹, between two tests."""
    largest, total = growth(weighted(loop, number(rate)), arb(loop.times.sampling))
    return float(largest.abs_upper()), float(total.abs_upper())


def _share_of(sizes: Sequence[float], loop: Loop, rate: float, drift: Sequence[float]) -> float:
    """Return the share of errors of some sizes that the sensor's error reaches between two tests.

    It is the larger one of both units, with the best split of (a + b)² ≤ (1 + s) a² + (1 + 1/s) b².
    """
    largest, total = _growth_between_tests(loop, rate)
    units = [float(each) for each in thresholds(loop, number(rate))]
    triples = [triple for triple in zip(sizes, units, drift, strict=True) if any(triple)]
    return min(
        max(
            ((1 + s) * (largest * unit) ** 2 + (1 + 1 / s) * (total * push) ** 2) ** 0.5 / size
            if size
            else math.inf
            for size, unit, push in triples
        )
        for s in _SPLITS
    )


def _needed_later(loop: Loop, document: Mapping[str, object], apart_s: float) -> int:
    """Return the most events while an update is on its way: none, or one at each test.

    ``apart_s``: two events are so far apart.
    """
    later, times = document["later"], loop.times
    assert isinstance(later, int)
    most = _most_between(loop, times.delay)
    if later or not (most or times.sampling == 0 < times.delay):
        return later
    last_s = float(arb(last_test_before(times, times.delay)))
    is_due = loop.rule.always and times.due <= last_test_before(times, times.delay)
    return 0 if last_s < apart_s and not is_due else most


def _most_between(loop: Loop, time: fmpq) -> int:
    """Return the most events within a time after an event, if each test may be one."""
    least = loop.times.least_apart
    return max(int((time / least).ceil()) - 1, 0) if least > 0 else 0


def smooth_part(loop: Loop) -> dict[str, object] | None:
    """Return S, Λ and s(0) with S e^{ΛTk} s(0) as F^k n_0, F = (I − LC) e^{AT}; None: there are none.

    S spans what F does not bring to 0 at once, and Se^{ΛT} = FS.
    """
    observer, n = loop.observer, loop.n
    if observer is None or len(observer.gains) > 2 or not floats(observer.start).any():
        return None
    period_s = float(observer.period.p) / float(observer.period.q)
    F = floats(observer.last_correction) @ expm(floats(loop.A) * period_s)
    least = _AT_ONCE if loop.loads else 0.0
    triangle, basis, q = schur(F, sort=lambda re, im: np.hypot(re, im) > least)
    step, S = triangle[:q, :q], basis[:, :q]
    values = np.linalg.eigvals(step)
    if not q or (np.abs(values) < _FASTEST).any() or (np.abs(np.angle(values)) > _MOST_TURN).any():
        return None
    first = floats(observer.correction(0)) @ floats(observer.start)
    if q == n:
        S, step = np.eye(n), F
    else:  # after n steps nothing else is left
        first = np.linalg.matrix_power(np.linalg.inv(step), n) @ S.T @ np.linalg.matrix_power(F, n) @ first
    with warnings.catch_warnings(action="ignore"):  # of rounding: nothing of this part has to be right
        rates = logm(step).real / period_s
    return {"columns": S.tolist(), "rates": rates.tolist(), "start": first.tolist()}


def observer_decay(loop: Loop) -> float:
    """Return the rate at which the error of the observer decays; infinite without one."""
    if loop.observer is None:
        return np.inf
    period_s = float(loop.observer.period.p) / float(loop.observer.period.q)
    F = floats(loop.observer.last_correction) @ expm(floats(loop.A) * period_s)
    return float(-np.log(np.abs(np.linalg.eigvals(F)).max()) / period_s)


def inter_event_s(loop: Loop, rate: float, drift: Sequence[float]) -> float:
    """Return a time that :mod:`noack.proof.search.results` accepts between two events; 0 without one."""
    (D1, D2), (noise1, noise2) = drift, map(float, noise_of(loop, number(rate)).sizes)
    level, floor = float(loop.rule.level), float(loop.rule.floor)
    if rate != float(loop.rule.rate):
        level = 0.0
    if loop.rule.negative.nrows() or not (floor or (level and not D2 and not noise2)):
        return 0.0
    triples = [
        (max(level * v, floor), float(np.hypot(D1 * v, D2)), noise1 * v + noise2)
        for v in _kinks(level, floor)
    ]
    W = floats(loop.weight)
    G = W @ floats(loop.H) @ np.linalg.inv(W) + rate * np.eye(loop.n)

    def share(time: float) -> float:
        """Return the largest share of the threshold that e_s − n reaches within a time after an event."""
        largest, total = (float(each.mid()) for each in growth(matrix(G.tolist()), number(time)))
        reached = ((size * total + (largest + 1) * noise) / limit for limit, size, noise in triples)
        return (1 + 1e-9) * max(reached)

    at_once = share(0.0)
    if at_once >= _NEARLY:
        return 0.0
    time = min((limit / size for limit, size, _ in triples if size), default=0.0)
    if not time:  # nothing drives the errors, so no time is the least one
        return before_due(loop) if loop.rule.always else 0.0
    for _ in range(_MOST_STEPS):
        reached = share(time)
        if _NEARLY < reached < 1:
            break
        time *= ((1 + _NEARLY) / 2 - at_once) / (reached - at_once)
    return min(time, before_due(loop)) if reached < 1 else 0.0


def before_due(loop: Loop) -> float:
    """Return a time before which no event comes without the rule's comparison; infinite: each needs it."""
    return (1 - 1e-9) * float(arb(loop.times.due)) if loop.rule.always else math.inf


def _kinks(level: float, floor: float) -> list[float]:
    if not level:
        return [0.0, 1.0]
    return [1.0, *([0.0, min(floor / level, 1.0)] if floor else [])]
