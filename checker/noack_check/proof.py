"""What a witness of a loop proves, from its document: bounds over time, and times between events.

A document names the plants ("own" or "box") and the conditions ("schedule" or "ideal"), and has for
each output the numbers that :mod:`.check` verifies. From the bound of the drift W(ẋ − Hx) follow

* the sensor's error between two tests: e^{Hs} times its value at the test, plus what the drift adds;
* the least time between events, since e_s begins at 0 and has to reach the threshold;
* that no event happens while an update is on its way, which the model assumes: by induction over the
  events, since all bounds hold up to the next one;
* the controller's error, e_c = e_s + Σ e^{H(t−t_i)} e_s(t_i⁻) over the missing updates: the paper's chain.

Rules that do not compare ‖W e_s‖ with a threshold have no such bound of the drift. Without it, events
are as far apart as tests: no update may be on its way for longer.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from flint import arb, arb_mat, fmpq

from noack_check.balls import around_zero, frobenius, identity, is_zero, number, upto
from noack_check.check import RejectedError, verify
from noack_check.loop import Loop, Times
from noack_check.model import Model, thresholds
from noack_check.norms import decays_below, growth

_MOST_TESTS = 1_000_000
_CELLS = 32
"""Parts of the time before the first input."""


class Bound(NamedTuple):
    """|output| ≤ (D₁² e^{−2rt} + D₂²)^½, for all t ≥ 0, or only in the limit t → ∞."""

    output: str
    decaying: arb  # D₁
    constant: arb  # D₂
    from_start: bool


class Proof(NamedTuple):
    """What was proven of a loop."""

    rate: arb  # r, 1/s
    bounds: tuple[Bound, ...]
    inter_event: arb | None
    """Two events after the one at t = 0 are at least this far apart, s; None: nothing is known."""
    first_event: arb | None
    """No event follows the one at t = 0 before this time, s."""


def prove(loop: Loop, document: Mapping[str, object]) -> Proof:
    """Return what a witness's document proves of a loop.

    Raises:
        RejectedError: the first inequality that fails, or what is wrong with the document.
    """
    if not isinstance(document, Mapping):
        raise RejectedError("not a table")
    if fault := loop.fault():
        raise RejectedError(f"loop: {fault}")
    rate = _number(document, "rate")
    if not rate >= 0 or not (loop.rule.level == 0 or rate <= loop.rule.rate):
        raise RejectedError("rate: not between 0 and that of the threshold")
    chain_gain = _chain_gain(loop, rate, document)
    overshoot = _number(document, "overshoot") if "overshoot" in document else None
    entries = _entries(document, "bounds")
    if not entries:
        raise RejectedError("bounds: there is none")
    if len({(str(e.get("output")), bool(e.get("from_start", True))) for e in entries}) < len(entries):
        raise RejectedError("bounds: an output occurs twice")
    bounds = [prove_bound(loop, rate, entry, chain_gain, overshoot) for entry in entries]
    drift = next((b for b in bounds if b.output == "drift" and b.from_start), None)
    if drift is None:
        if overshoot is not None or loop.times.least_sampling < max(loop.times.delay, loop.times.start):
            raise RejectedError("bounds: that of the drift from the start on is missing")
        return Proof(rate, tuple(bounds), None, None)
    apart = first = _number(document, "inter_event_s")
    _prove_inter_event(loop, rate, drift, apart)
    if not _is_quiet(loop, apart, loop.times.delay):
        raise RejectedError("inter_event_s: an event may happen while an update is on its way")
    if loop.times.start > 0:
        _prove_quiet_start(loop)
        first = _number(document, "first_event_s") if "first_event_s" in document else arb(0)
        prove_first_event(loop, drift, first, loop.times.start)
    sensor = _sensor_error(loop, rate, drift)
    if overshoot is not None:
        _prove_overshoot(loop, rate, sensor, overshoot)
    bounds.append(sensor)
    if chain_gain is not None:
        missing = loop.losses + (1 if loop.times.delay > 0 else 0)
        factor = 1 + missing * chain_gain
        bounds.append(Bound("e_c", factor * sensor.decaying, factor * sensor.constant, True))
    if not all(size.is_finite() for bound in bounds for size in (bound.decaying, bound.constant)):
        raise RejectedError("bounds: not finite")
    return Proof(rate, tuple(bounds), apart, first)


def _is_quiet(loop: Loop, apart: arb, time: fmpq) -> bool:
    """Return whether no event comes sooner than ``time`` after another, if e_s needs longer than ``apart``.

    Tests are the only times of events, and the k-th comes between k times the least and the largest
    time between two tests. An event at the time at which an input begins to act may come before or
    after it: w is the same.
    """
    times, quiet = loop.times, 0
    if time == 0 or apart >= arb(time):
        return True
    while times.sampling > 0 and quiet < _MOST_TESTS and arb((quiet + 1) * times.sampling) <= apart:
        quiet += 1
    return (quiet + 1) * times.least_sampling >= time


def _prove_quiet_start(loop: Loop) -> None:
    """Prove that no event happens after the one at t = 0 until the first input acts."""
    times, rule = loop.times, loop.rule
    last = times.start if not times.sampling > 0 else _last_test_before(times, times.start)
    if last == 0:
        return
    if rule.always or not rule.positive.nrows():
        raise RejectedError("times: an event without a comparison may happen before the first input acts")
    if not error_without_input(loop, last) < (rule.level * (-rule.rate * last).exp()).max(rule.floor):
        raise RejectedError("times: an event may happen before the first input acts")


def error_without_input(loop: Loop, until: fmpq) -> arb:
    """Return a bound of ‖W e_s‖ until a time, if no input acts and no event happens after t = 0.

    Without an input x(t) = e^{At} x(0), and the disturbances add at most t · sup‖e^{As}‖ · ‖D d‖.
    """
    A = loop.A + arb_mat(loop.n, loop.n, [around_zero(h) for h in loop.half_A.entries()])
    pushes = arb_mat(loop.n, 1)
    if loop.sizes:
        pushes = loop.pushes * arb_mat(len(loop.sizes), 1, [around_zero(size) for size in loop.sizes])
    largest, _ = growth(_weighted(loop, arb(0)), arb(until))
    step, x, reached = arb(until) / _CELLS, loop.start, arb(0)
    within, forward = (upto(step) * A).exp(), (step * A).exp()
    for _ in range(_CELLS):
        during = within * x + upto(step) * (within * pushes)
        drift = loop.weight * ((A - loop.H) * during + pushes)
        reached += step * largest * frobenius(drift)
        x = forward * x + step * (within * pushes)
    return reached


def prove_first_event(loop: Loop, drift: Bound, first: arb, until: fmpq) -> None:
    """Prove that no event follows the one at t = 0 for a time, where inputs may act from 0 to ``until`` on.

    Until the first input e_s grows as without one, and after it as the bound of the drift says.
    """
    rule = loop.rule
    if first == 0:
        return
    if rule.always or not compares_error(loop) or not first > 0:
        raise RejectedError("first_event_s: not proven for this rule; 0 is")
    largest, total = growth(_weighted(loop, arb(0)), first)
    added = total * (drift.decaying**2 + drift.constant**2).sqrt()
    threshold = (rule.level * (-rule.rate * first).exp()).max(rule.floor)
    if not largest * error_without_input(loop, until) + added < threshold:
        raise RejectedError("first_event_s: an event may come earlier")


def _last_test_before(times: Times, until: fmpq) -> fmpq:
    """Return the time of the last test before a time; one at this time comes after it."""
    if times.least_sampling == 0:
        return until
    tests = (until / times.least_sampling).ceil() - 1
    return min(tests * times.sampling, until)


def _chain_gain(loop: Loop, rate: arb, document: Mapping[str, object]) -> arb | None:
    """Return g ≥ sup ‖W e^{(H+r)τ} W⁻¹‖ over τ ≥ 0, as proven; None: the document has none."""
    if "chain" not in document:
        return None
    chain = document["chain"]
    if not isinstance(chain, Mapping):
        raise RejectedError("chain: not a table")
    gain, G = _number(chain, "gain"), _weighted(loop, rate)
    tail = _matrix(chain, "tail", loop.n)
    proven = gain >= 1 if is_zero(G) else decays_below(G, gain, tail)
    if not proven:
        raise RejectedError("chain: the growth of the model's error is not below its gain")
    return gain


def _weighted(loop: Loop, rate: arb) -> arb_mat:
    """Return W (H + r) W⁻¹."""
    try:
        H = loop.weight * loop.H * loop.weight.inv()
    except ZeroDivisionError:
        raise RejectedError("weight: not proven to have an inverse") from None
    return H if is_zero(H) and rate == 0 else H + rate * identity(loop.n)


def prove_bound(
    loop: Loop, rate: arb, entry: Mapping[str, object], chain_gain: arb | None, overshoot: arb | None
) -> Bound:
    """Return the bound of one output, after verifying its inequalities."""
    uses_chain = overshoot is not None
    if uses_chain and chain_gain is None:
        raise RejectedError("overshoot: needs the chain")
    kappa = chain_gain * overshoot if uses_chain else None  # type: ignore[operator]
    model = Model(loop, rate, _number(entry, "decay"), kappa)
    output, starts = str(entry.get("output")), bool(entry.get("from_start", True))
    if output not in {"x", "e_s", "e_c", "drift", *(f"x[{i}]" for i in range(loop.n))}:
        raise RejectedError(f"output: {output[:50]!r} is none of the loop's")
    matrices, numbers = entry.get("matrices"), entry.get("numbers")
    if not isinstance(matrices, Mapping) or not isinstance(numbers, Mapping):
        raise RejectedError(f"{output}: matrices or numbers are missing")
    try:
        verify(
            model,
            output,
            {name: _matrix(matrices, name, most=3 * loop.n) for name in matrices},
            {name: _number(numbers, name) for name in numbers},
            starts=starts,
        )
    except RejectedError as error:
        raise RejectedError(f"{output}: {error}") from None
    levels = (_number(numbers, name) if name in numbers else arb(0) for name in ("level 1", "level 2"))
    decaying, constant = (level.sqrt() for level in levels)
    return Bound(output, decaying, constant, starts)


def _prove_inter_event(loop: Loop, rate: arb, drift: Bound, apart: arb) -> None:
    """Prove that e_s stays below the threshold for ``apart`` after an event, or that this is 0.

    ‖W e_s‖ ≤ (D₁² v + D₂²)^½ I, v = e^{−2rt} and I = ∫ ‖W e^{(H+r)s} W⁻¹‖ ds. Its square is affine in
    v, and that of the threshold max(c² v, f²) convex and piecewise affine: its ends and its kink suffice.
    """
    if apart == 0:
        return
    rule = loop.rule
    if rule.always or not compares_error(loop) or not apart > 0:
        raise RejectedError("inter_event_s: not proven for this rule; 0 is")
    _, total = growth(_weighted(loop, rate), apart)
    level = rule.level if bool(rate == rule.rate) else arb(0)
    kinks = [arb(0), arb(1)]
    if level > 0 and rule.floor > 0:
        kinks.append((rule.floor / level) ** 2)
    for v in kinks:
        if v > 1:
            continue
        threshold = (level**2 * v).max(rule.floor**2)
        reached = (drift.decaying**2 * v + drift.constant**2) * total**2
        if not (reached < threshold or (v == 0 and rule.floor == 0 and drift.constant == 0)):
            raise RejectedError("inter_event_s: an event may come earlier")


def compares_error(loop: Loop) -> bool:
    """Return whether the rule compares ‖W e_s‖ with a threshold."""
    n, positive = loop.n, loop.rule.positive
    if positive.nrows() != n or loop.rule.negative.nrows():
        return False
    entries = (
        (positive[i, j], loop.weight[i, j - n] if j >= n else 0) for i in range(n) for j in range(2 * n)
    )
    return all(entry == expected for entry, expected in entries)


def _sensor_error(loop: Loop, rate: arb, drift: Bound) -> Bound:
    """Return the bound of W e_s: the threshold at the last test, grown, plus what the drift adds."""
    if not compares_error(loop):
        raise RejectedError("drift: bounds e_s only for a rule that compares ‖W e_s‖")
    level, floor = thresholds(loop, rate)
    if loop.times.sampling == 0:
        return Bound("e_s", level, floor, True)
    largest, total = growth(_weighted(loop, rate), arb(loop.times.sampling))
    most = largest * _at_first_input(loop, rate)
    parts = zip((level, floor), (drift.decaying, drift.constant), strict=True)
    decaying, constant = (most * at_test + total * added for at_test, added in parts)
    return Bound("e_s", decaying, constant, True)


def _at_first_input(loop: Loop, rate: arb) -> arb:
    """Return the largest ‖W e_s‖ up to the first input in multiples of the threshold, or 1.

    No test is needed between the first input and the last one before it: the drift has no bound there.
    """
    until, (level, floor) = loop.times.start, thresholds(loop, rate)
    if until == 0:
        return arb(1)
    threshold = ((level * (-rate * until).exp()) ** 2 + floor**2).sqrt()
    return arb((error_without_input(loop, until) / threshold).max(arb(1)).abs_upper())


def _prove_overshoot(loop: Loop, rate: arb, sensor: Bound, overshoot: arb) -> None:
    """Prove ‖W e_s‖ ≤ overshoot · (c² f₁² + f² f₂²)^½, strictly: then the facts that used it hold on.

    Up to some time they hold; so do all bounds, and ‖W e_s‖ is below what the facts allow, also a
    little later, since e_s is continuous but for its jumps to 0.
    """
    if loop.times.sampling == 0:
        if not overshoot >= 1:
            raise RejectedError("overshoot: below 1")
        return
    for proven, unit in zip((sensor.decaying, sensor.constant), thresholds(loop, rate), strict=True):
        if not (proven < overshoot * unit or (proven == 0 and unit == 0)):
            raise RejectedError("overshoot: the sensor's error may exceed it")


# Reading a document.


def _entries(document: Mapping[str, object], key: str) -> list[Mapping[str, object]]:
    entries = document.get(key)
    if not isinstance(entries, list) or not all(isinstance(entry, Mapping) for entry in entries):
        raise RejectedError(f"{key}: not a list of tables")
    return entries


def _number(table: Mapping[str, object], key: str) -> arb:
    value = table.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise RejectedError(f"{key}: not a number")
    if isinstance(value, int) and abs(value) > 2**63:
        raise RejectedError(f"{key}: too large")
    found = number(value)
    if not found.is_finite():
        raise RejectedError(f"{key}: not finite")
    return found


def _matrix(
    table: Mapping[str, object], key: str, size: int | None = None, *, most: int | None = None
) -> arb_mat:
    rows = table.get(key)
    if not isinstance(rows, list) or not rows or not all(isinstance(row, Sequence) for row in rows):
        raise RejectedError(f"{key}: not a matrix")
    n = len(rows)
    wrong = (size is not None and n != size) or (most is not None and n > most)
    if wrong or any(len(row) != n for row in rows):
        raise RejectedError(f"{key}: not a square matrix of the right size")
    found = arb_mat([[_number({key: value}, key) for value in row] for row in rows])
    if any(found[i, j] != found[j, i] for i in range(n) for j in range(i)):
        raise RejectedError(f"{key}: not symmetric")
    return found
