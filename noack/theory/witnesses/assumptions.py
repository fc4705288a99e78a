"""What a witness's model assumes: the size of the sensor's error, and events while an update is on its way.

Each guess leads to a bound of the drift or of the error, and this to the next guess, until one confirms
itself. Nothing here has to be right: :mod:`noack_check.proof` proves what is assumed.
"""

import contextlib
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from flint import arb, fmpq
from scipy.linalg import expm, logm, schur, solve_continuous_lyapunov

from noack.core.linear_systems import Matrix
from noack.theory.witnesses.coordinates import floats
from noack.theory.witnesses.effort import NoWitnessError
from noack_check.balls import matrix, number
from noack_check.check import RejectedError
from noack_check.loop import Loop
from noack_check.model import Chain, Errors, thresholds
from noack_check.noise import noise_of
from noack_check.norms import growth
from noack_check.proof import (
    MOST_LATER,
    Assumptions,
    Bound,
    compares_error,
    prove_first_event,
    require_few_at_start,
    require_few_later,
    sensor_error,
    share_of_errors,
)

_ROOM = 1.01
"""A guess is confirmed if what follows from it is smaller by this factor."""
_FURTHER = 1.3
"""The next guess exceeds what followed from the last one by this factor."""

_AT_ONCE, _FASTEST, _MOST_TURN = 1e-3, 1e-6, 3.0
"""An error of an observer that decays, or turns, more between two tests has no smooth part."""
_NEARLY, _MOST_STEPS = 1 - 1e-4, 30
"""A time is accepted if e_s reaches nearly the threshold."""


def first_assumptions(loop: Loop, rate: float) -> dict[str, object]:
    """Return a document without bounds: its rate, its chain if it is used, and what is assumed at first.

    A rule that compares ‖W e_s‖ may have no event while an update is on its way; of others each test may
    be one.
    """
    document: dict[str, object] = {"rate": rate}
    if not loop.times.period > 0 and (chain := _chain(loop, rate)) is not None:
        document["chain"] = chain
    if (smooth := smooth_part(loop)) is not None:
        document["observer"] = smooth
    later, at_start = 0, 0
    try:
        require_few_at_start(loop, Assumptions(None, 0, 0, None))
    except RejectedError:
        at_start = _most_between(loop, loop.times.start)
    if at_start or not compares_error(loop):
        later = _most_between(loop, loop.times.delay)
    document |= {"later": later, "later_at_start": at_start}
    if (loop.holds or loop.rule.always) and compares_error(loop) and "chain" in document:
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


def _share_of(sizes: Sequence[float], loop: Loop, rate: float, drift: Sequence[float]) -> float:
    """Return the share of errors of some sizes that the sensor's error reaches."""
    decaying, constant = (number(size) for size in sizes)
    errors = Errors(decaying, constant, Chain(number(1.0), number(1.0)))
    return float(share_of_errors(loop, number(rate), _bound(drift), errors).mid())


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
    share = _share_of((errors["decaying"], errors["constant"]), loop, rate, drift)
    is_exact = not loop.times.sampling > 0
    if later == document["later"] and (is_exact or _ROOM * share < 1):
        return None
    units = [float(each) for each in thresholds(loop, number(rate))]
    sensor = sensor_error(loop, number(rate), _bound(drift))
    needed = [float(sensor.decaying), float(sensor.constant)]
    grown = [unit + _FURTHER * (size - unit) for size, unit in zip(needed, units, strict=True)]
    factor = max(_ROOM**2 * _share_of(grown, loop, rate, drift), 1.0)
    return with_errors(following, [factor * size for size in grown])


def _needed_later(loop: Loop, document: Mapping[str, object], apart_s: float) -> int:
    """Return the most events while an update is on its way, if two are so far apart."""
    later, at_start = document["later"], document["later_at_start"]
    assert isinstance(later, int)
    while later < _most_between(loop, loop.times.delay):
        with contextlib.suppress(RejectedError):
            require_few_later(
                loop, Assumptions(None, later, 0, None), None if at_start else number(apart_s).fmpq()
            )
            break
        later += 1
    return later


def _most_between(loop: Loop, time: fmpq) -> int:
    """Return the most events within a time after an event, if each test may be one."""
    least = loop.times.least_apart
    return max(int((time / least).ceil()) - 1, 0) if least > 0 else 0


def _bound(drift: Sequence[float]) -> Bound:
    decaying, constant = (number(level) for level in drift)
    return Bound("drift", decaying, constant, True)


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
    cells = np.eye(len(G))[None]
    for doubling in range(8):
        cells = np.concatenate([cells, cells @ expm(G * step * 2**doubling)])
    power, following = np.eye(len(G)), expm(G * step * 256)
    for _ in range(400):
        sizes = np.linalg.norm(cells @ power, 2, axis=(1, 2))
        yield float(sizes.max())
        if sizes[-1] < 1e-2:
            return
        power = following @ power


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
    """Return a time that :mod:`noack_check.proof` accepts between two events; 0 without one."""
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


def first_event_s(loop: Loop, drift: Sequence[float], most: float) -> float:
    """Return a share of ``most`` before which no event follows the one at t = 0; 0 without one."""
    for share in (1.0, 0.9, 0.75, 0.5, 0.25):
        with contextlib.suppress(RejectedError):
            prove_first_event(loop, _bound(drift), number(share * most), loop.times.start)
            return share * most
    return 0.0


def _kinks(level: float, floor: float) -> list[float]:
    if not level:
        return [0.0, 1.0]
    return [1.0, *([0.0, min(floor / level, 1.0)] if floor else [])]
