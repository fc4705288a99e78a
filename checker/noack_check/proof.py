"""What a witness of a loop proves, from its document: bounds over time, and times between events.

A document names the plants ("own" or "box") and the conditions ("schedule" or "ideal"), and has for
each output the numbers that :mod:`.check` verifies. From the bound of the drift W(ẋ − Hx) follow

* the sensor's error between two tests: e^{Hs} times its value at the test, plus what the drift adds;
* the least time between events, since e_s begins at the noise n of the event's measurement and has to
  reach the threshold, to within the noise of another one. It comes at a test: with k tests that are silent
  it is the next one, k + 1 least times between two tests later.

Rules that do not compare ‖W e_s‖ with a threshold have a bound of e_s by quadratic forms, and their
events are as far apart as tests. From a bound of e_s follows

* the controller's error, e_c = e_s + Σ e^{H(t−t_i)} (e_s(t_i⁻) − n_i) over the missing updates: the paper's
  chain.

The model assumes a bound of e_s − n ("errors"), and how many events happen while an update is on its way
("later").
Both are proven from bounds of this model, by induction over the events: all bounds hold up to the next one.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from typing import Any, NamedTuple

from flint import arb, arb_mat, fmpq

from noack_check.balls import around_zero, frobenius, identity, is_zero, rows_of, upto
from noack_check.check import RejectedError, verify
from noack_check.document import read_count, read_matrix, read_number, read_rows, read_table
from noack_check.loop import Loop, Noise, Region, Smooth, Times
from noack_check.model import Chain, Errors, Model, thresholds
from noack_check.noise import noise_of
from noack_check.norms import decays_below, growth, spectral_norm
from noack_check.tests_apart import MOST_PLACES

MOST_PIECES = 64
MOST_LATER = 8
"""Most events within the time that an update may be on its way."""
_CELLS = 32
"""Parts of the time before the first input."""
_MOST_TRIES, _WIDER = 20, arb(1.1)
"""To enclose x in such a part."""


class Bound(NamedTuple):
    """|output| ≤ D₁ e^{−rt} + D₂, for all t ≥ 0, or only in the limit t → ∞.

    A bound by quadratic forms, as that of the drift, is even (D₁² e^{−2rt} + D₂²)^½.
    """

    output: str
    decaying: arb  # D₁
    constant: arb  # D₂
    from_start: bool


class Proof(NamedTuple):
    """What was proven of a loop."""

    rate: arb  # r, 1/s
    bounds: tuple[Bound, ...]
    inter_event: fmpq | None
    """Two events after the one at t = 0 are at least this far apart, s; None: nothing is known."""
    first_event: fmpq | None
    """No event follows the one at t = 0 before this time, s."""
    is_quiet: bool
    """No event follows the one at t = 0 before the first input acts; else the other times hold from it on."""


def prove(loop: Loop, document: Mapping[str, object]) -> Proof:
    """Return what a witness's document proves of a loop.

    Raises:
        RejectedError: the first inequality that fails, or what is wrong with the document.
    """
    if not isinstance(document, Mapping):
        raise RejectedError("not a table")
    rate = read_number(document, "rate")
    assumed = read_assumptions(loop, rate, document)
    entries = _entries(document, "bounds")
    if not entries:
        raise RejectedError("bounds: there is none")
    if len({(str(e.get("output")), bool(e.get("from_start", True))) for e in entries}) < len(entries):
        raise RejectedError("bounds: an output occurs twice")
    return conclude(loop, document, assumed, [prove_bound(loop, rate, entry, assumed) for entry in entries])


def conclude(
    loop: Loop, document: Mapping[str, object], assumed: "Assumptions", of_forms: Sequence[Bound]
) -> Proof:
    """Return what the bounds of a document's entries prove together, as :func:`prove_bound` returns them.

    Raises:
        RejectedError: they do not prove what it assumes, or a time that it states.
    """
    rate = read_number(document, "rate")
    bounds = [_joined(bound) for bound in of_forms] if rate == 0 else list(of_forms)
    proven = {bound.output: bound for bound in of_forms if bound.from_start}
    apart = first = None
    if "drift" in proven:
        apart, first = _times_between_events(loop, rate, proven["drift"], assumed, document)
        bounds.append(sensor_error(loop, rate, proven["drift"]))
    sensor = bounds[-1] if "drift" in proven else proven.get("e_s")
    is_quiet = require_few_at_start(loop, assumed)
    require_few_later(loop, assumed, apart if is_quiet else None)
    if assumed.errors is not None:
        _require_errors(loop, rate, proven, assumed.errors)
    if loop.region is not None:
        _require_region(loop.region, proven)
    if assumed.chain is not None and sensor is not None:
        jumps = assumed.chain.factor(loop.losses, 1 + assumed.later if loop.times.delay > 0 else 0)
        noise = noise_of(loop, rate).sizes
        decaying = sensor.decaying + jumps * (sensor.decaying + noise[0])
        constant = sensor.constant + jumps * (sensor.constant + noise[1])
        bounds.append(Bound("e_c", decaying, constant, True))
    if not all(size.is_finite() for bound in bounds for size in (bound.decaying, bound.constant)):
        raise RejectedError("bounds: not finite")
    is_moved = loop.loads > 0 or loop.until is not None or loop.push_before_input is not None
    if is_moved and any(bound.output.startswith("u[") for bound in bounds):
        raise RejectedError("u: about a reference, or where the loop rests, the input is not an output")
    apart, first = (_at_tests(loop.times, time) for time in (apart, first))
    return Proof(rate, tuple(_about(loop, bound) for bound in bounds), apart, first, is_quiet)


def _joined(bound: Bound) -> Bound:
    """Return a bound by forms whose units do not decay: f₁ = f₂ = 1, and |Cz|² ≤ D₁² + D₂²."""
    return bound._replace(decaying=arb(0), constant=(bound.decaying**2 + bound.constant**2).sqrt())


def _about(loop: Loop, bound: Bound) -> Bound:
    """Return the bound of an output itself, x being at most ``loop.offset`` from where the loop has it."""
    output, n = bound.output, loop.n
    if loop.offset == 0 or output[0] not in "xy":
        return bound
    row = identity(n) if output == "x" else loop.output_rows if output[0] == "y" else identity(n)
    if "[" in output:
        row = rows_of(row, [int(output[2:-1])])
    return bound._replace(constant=bound.constant + loop.offset * spectral_norm(row))


class Assumptions(NamedTuple):
    """What the model assumes, and the growth of the model's error, which is proven."""

    errors: Errors | None
    later: int
    later_at_start: int
    chain: Chain | None
    pieces: int = 1
    """Parts of the period of a periodic rule: the nodes of its clock."""
    noise: Noise | None = None
    """Of an observer."""
    by_tests: bool = False
    """V depends on where each update is at each test."""
    counted: int = 0
    """It depends on the number of silent tests since the last event, too, up to so many."""
    blocks: bool = False
    """It has no products of an update on its way with other states."""

    @property
    def of_model(self) -> dict[str, Any]:
        """Further arguments of the model."""
        names = ("later", "later_at_start", "pieces", "by_tests", "counted", "blocks")
        return {name: getattr(self, name) for name in names}


def read_assumptions(loop: Loop, rate: arb, document: Mapping[str, object]) -> Assumptions:
    """Return what a document with a rate r assumes of a loop.

    Raises:
        RejectedError: loop, rate or document have no meaning, or the chain's gain is not proven.
    """
    if fault := loop.fault():
        raise RejectedError(f"loop: {fault}")
    if not rate >= 0 or not (loop.rule.level == 0 or rate <= loop.rule.rate):
        raise RejectedError("rate: not between 0 and that of the threshold")
    chain = _chain(loop, rate, document)
    later, at_start = (read_count(document, key, MOST_LATER) for key in ("later", "later_at_start"))
    pieces = read_count(document, "pieces", MOST_PIECES) if "pieces" in document else 1
    if pieces < 1:
        raise RejectedError("pieces: below 1")
    smooth = _read_smooth(loop, document) if "observer" in document else None
    noise, by_tests = noise_of(loop, rate, smooth), document.get("by_tests", False)
    if by_tests and (loop.times.period > 0 or not loop.times.sampling == loop.times.least_sampling > 0):
        raise RejectedError("by_tests: the tests are not an exact time apart")
    if (by_tests or loop.needs_tests_apart) and loop.loads:
        raise RejectedError("by_tests: not with unknown loads")
    by_tests = bool(by_tests) or loop.needs_tests_apart
    counted = read_count(document, "counted", MOST_PLACES) if "counted" in document else 0
    if counted and not by_tests:
        raise RejectedError("counted: only forms of each test count tests")
    blocks = document.get("blocks", False) is True
    if blocks and (by_tests or loop.times.period > 0):
        raise RejectedError("blocks: not with a periodic rule, or with forms of each test")
    if "errors" not in document:
        return Assumptions(None, later, at_start, chain, pieces, noise, by_tests, counted, blocks)
    if loop.times.period > 0 or by_tests:
        raise RejectedError("errors: of no use with a periodic rule, or with forms of each test")
    table = document["errors"]
    if not isinstance(table, Mapping):
        raise RejectedError("errors: not a table")
    if chain is None:
        raise RejectedError("errors: need the chain")
    sizes = read_number(table, "decaying"), read_number(table, "constant")
    units = loop.has_decaying_unit(rate), loop.needs_constant
    if not all(size == 0 or (size > 0 and is_unit) for size, is_unit in zip(sizes, units, strict=True)):
        raise RejectedError("errors: below 0, or in a unit that the loop does not have")
    return Assumptions(Errors(*sizes, chain), later, at_start, chain, pieces, noise, blocks=blocks)


def _read_smooth(loop: Loop, document: Mapping[str, object]) -> Smooth:
    """Return the part of the observer's error that decays smoothly; nothing of it has to be right."""
    table = read_table(document, "observer")
    columns, rates, start = (read_rows(table, key) for key in ("columns", "rates", "start"))
    q = rates.nrows()
    shapes = [(M.nrows(), M.ncols()) for M in (columns, rates, start)]
    if shapes != [(loop.n, q), (q, q), (q, 1)]:
        raise RejectedError("observer: columns, rates and start do not fit")
    return Smooth(columns, rates, start)


def require_few_at_start(loop: Loop, assumed: Assumptions) -> bool:
    """Prove that no more events than assumed precede the first input; return whether there is none."""
    if (assumed.later_at_start + 1) * loop.times.least_apart < loop.times.start:
        if assumed.later_at_start:
            raise RejectedError("later_at_start: more events may happen before the first input acts")
        _prove_quiet_start(loop)
    return assumed.later_at_start == 0


def require_few_later(loop: Loop, assumed: Assumptions, apart: fmpq | None) -> None:
    """Prove that no more events than assumed happen while an update is on its way.

    Tests are the only times of events. If e_s needs longer than ``apart`` to reach the threshold, as
    many tests as surely happen within it are silent. An event at the time at which an input begins to
    act may come before or after it: w is the same.
    """
    times, silent = loop.times, 0
    if apart is not None:
        if apart * (assumed.later + 1) >= times.delay:
            return
        silent = _silent_tests(times, apart)
    if not (silent + 1) * times.least_apart * (assumed.later + 1) >= times.delay:
        raise RejectedError("later: more events may happen while an update is on its way")


def _silent_tests(times: Times, apart: fmpq) -> int:
    """Return how many tests after an event come within a time in which none is an event."""
    return int((apart / times.sampling).floor()) if times.sampling > 0 else 0


def _at_tests(times: Times, apart: fmpq | None) -> fmpq | None:
    """Return how far events are apart at least, if none comes within a time after another: it is a test's.

    None: nothing is known.
    """
    if not times.least_apart > 0:
        return apart
    apart = apart or fmpq(0)
    return max(apart, times.least_apart, (_silent_tests(times, apart) + 1) * times.least_sampling)


def _times_between_events(
    loop: Loop, rate: arb, drift: Bound, assumed: Assumptions, document: Mapping[str, object]
) -> tuple[fmpq, fmpq]:
    """Return least times between two events, and of the first event after t = 0, as proven."""
    apart = first = _time(document, "inter_event_s")
    _prove_inter_event(loop, rate, drift, apart)
    if loop.times.start > 0:
        first = _time(document, "first_event_s") if "first_event_s" in document else fmpq(0)
        prove_first_event(loop, drift, arb(first), loop.times.start)
    return apart, first


def _prove_quiet_start(loop: Loop) -> None:
    """Prove that no event happens after the one at t = 0 until the first input acts."""
    times, rule = loop.times, loop.rule
    last = times.start if not times.sampling > 0 else last_test_before(times, times.start)
    if last == 0:
        return
    if (rule.always and not times.due > last) or not rule.positive.nrows():
        raise RejectedError("times: an event without a comparison may happen before the first input acts")
    if not _exceeds_by_error(loop):
        raise RejectedError("times: an event of this rule may happen before the first input acts")
    if not error_without_input(loop, last) + _most_noise(loop) < (rule.level * (-rule.rate * last).exp()).max(
        rule.floor
    ):
        raise RejectedError("times: an event may happen before the first input acts")


def error_without_input(loop: Loop, until: fmpq) -> arb:
    """Return a bound of ‖W e_s‖ until a time, if no input acts.

    It begins at a noise, at t = 0 or at an event. Without an input x follows A, pushed by disturbances and,
    if the plant's entries are not known, by Δx: entries that depend on x, as of equations, vary in time.

    Raises:
        RejectedError: no bound of x is found.
    """
    half = arb_mat(loop.n, loop.n, [around_zero(h) for h in loop.half_A.entries()])
    pushes = arb_mat(loop.n, 1)
    if loop.sizes:
        pushes = loop.pushes * arb_mat(len(loop.sizes), 1, [around_zero(size) for size in loop.sizes])
    if loop.push_before_input is not None:
        pushes += loop.push_before_input
    largest, _ = growth(weighted(loop, arb(0)), arb(until))
    step, x, reached = arb(until) / _CELLS, loop.start, largest * _most_noise(loop)
    within, forward = (upto(step) * loop.A).exp(), (step * loop.A).exp()
    for _ in range(_CELLS):
        during = _during(x, within, upto(step) * within, pushes, half)
        added = pushes + half * during
        drift = loop.weight * ((loop.A - loop.H) * during + added)
        reached += step * largest * frobenius(drift)
        x = forward * x + step * (within * added)
    return reached


def _during(x: arb_mat, within: arb_mat, gained: arb_mat, pushes: arb_mat, half: arb_mat) -> arb_mat:
    """Enclose x on a cell: what x leads to if it is in an enclosure that contains this is in it (Picard)."""
    found = within * x + gained * pushes
    for _ in range(_MOST_TRIES):
        image = within * x + gained * (pushes + half * found)
        if all(outer.contains(inner) for outer, inner in zip(found.entries(), image.entries(), strict=True)):
            return image
        wider = [arb(entry.mid(), entry.rad() * _WIDER) for entry in image.entries()]
        found = arb_mat(len(wider), 1, wider)
    raise RejectedError("times: without an input no bound of x is found")


def prove_first_event(loop: Loop, drift: Bound, first: arb, until: fmpq) -> None:
    """Prove that no event follows the one at t = 0 for a time, where inputs may act from 0 to ``until`` on.

    Until the first input e_s grows as without one, and after it as the bound of the drift says.
    """
    rule = loop.rule
    if first == 0:
        return
    if not compares_error(loop) or not first > 0:
        raise RejectedError("first_event_s: not proven for this rule; 0 is")
    if rule.always and not first < arb(loop.times.due):
        raise RejectedError("first_event_s: an event without a comparison may come earlier")
    largest, total = growth(weighted(loop, arb(0)), first)
    added = total * (drift.decaying**2 + drift.constant**2).sqrt()
    threshold = (rule.level * (-rule.rate * first).exp()).max(rule.floor)
    if not largest * error_without_input(loop, until) + added + _most_noise(loop) < threshold:
        raise RejectedError("first_event_s: an event may come earlier")


def last_test_before(times: Times, until: fmpq) -> fmpq:
    """Return the time of the last test before a time; one at this time comes after it."""
    if times.least_sampling == 0:
        return until
    tests = (until / times.least_sampling).ceil() - 1
    return min(tests * times.sampling, until)


def _chain(loop: Loop, rate: arb, document: Mapping[str, object]) -> Chain | None:
    """Return the chain, its gain as proven; None: the document has none."""
    if "chain" not in document:
        return None
    table = document["chain"]
    if not isinstance(table, Mapping):
        raise RejectedError("chain: not a table")
    gain, G = read_number(table, "gain"), weighted(loop, rate)
    tail = read_matrix(table, "tail", loop.n)
    proven = gain >= 1 if is_zero(G) else decays_below(G, gain, tail)
    if not proven:
        raise RejectedError("chain: the growth of the model's error is not below its gain")
    recent, _ = growth(G, arb(loop.times.delay))
    return Chain(gain, arb(min(gain, recent)))


def weighted(loop: Loop, rate: arb) -> arb_mat:
    """Return W (H + r) W⁻¹."""
    try:
        H = loop.weight * loop.H * loop.weight.inv()
    except ZeroDivisionError:
        raise RejectedError("weight: not proven to have an inverse") from None
    return H if is_zero(H) and rate == 0 else H + rate * identity(loop.n)


def prove_bound(loop: Loop, rate: arb, entry: Mapping[str, object], assumed: Assumptions) -> Bound:
    """Return the bound of one output, after verifying its inequalities."""
    decay = read_number(entry, "decay")
    try:
        model = Model(loop, rate, decay, assumed.errors, assumed.noise, **assumed.of_model)
    except ValueError as error:
        raise RejectedError(str(error)) from None
    output, starts = str(entry.get("output")), bool(entry.get("from_start", True))
    if not starts and loop.until is not None:
        raise RejectedError(f"{output[:50]}: no bound in the limit: the loop is known up to a time only")
    counts = {"x": loop.n, "u": loop.B.ncols(), "y": loop.output_rows.nrows()}
    entries = {f"{kind}[{i}]" for kind, count in counts.items() for i in range(count)}
    if output not in {"x", "e_s", "e_c", "drift"} | entries:
        raise RejectedError(f"output: {output[:50]!r} is none of the loop's")
    if output.startswith("e_") and not model.sees_all:
        raise RejectedError(
            f"{output}: the model has no more of errors than the input and the rule depend on"
        )
    if output == "e_s" and model.is_periodic:
        raise RejectedError("e_s: the model of a periodic rule has no error of an update that is lost")
    matrices, numbers = entry.get("matrices"), entry.get("numbers")
    if not isinstance(matrices, Mapping) or not isinstance(numbers, Mapping):
        raise RejectedError(f"{output}: matrices or numbers are missing")
    try:
        verify(
            model,
            output,
            {name: read_matrix(matrices, name, most=model.size - 2) for name in matrices},
            {name: read_number(numbers, name) for name in numbers},
            starts=starts,
        )
    except RejectedError as error:
        raise RejectedError(f"{output}: {error}") from None
    levels = (read_number(numbers, name) if name in numbers else arb(0) for name in ("level 1", "level 2"))
    decaying, constant = (level.sqrt() for level in levels)
    return Bound(output, decaying, constant, starts)


def _prove_inter_event(loop: Loop, rate: arb, drift: Bound, apart: fmpq) -> None:
    """Prove that e_s − n stays below the threshold for ``apart`` after an event, or that this is 0.

    With v = e^{−rt}, ‖W (e_s − n)‖ ≤ (D₁² v² + D₂²)^½ I + (g + 1) (n₁ v + n₂), where g and I are the supremum
    and the integral of ‖W e^{(H+r)s} W⁻¹‖. This is convex in v, and the threshold max(c v, f) piecewise
    affine: its ends and its kink suffice.
    """
    _require_silent(loop, apart)
    if apart == 0:
        return
    largest, total = growth(weighted(loop, rate), arb(apart))
    noise = [(largest + 1) * size for size in noise_of(loop, rate).sizes]

    def reached(v: arb) -> arb:
        by_drift = (drift.decaying**2 * v**2 + drift.constant**2).sqrt() * total
        return by_drift + noise[0] * v + noise[1]

    _require_below(loop, rate, reached, is_decaying=drift.constant == 0 and noise[1] == 0)


def _require_silent(loop: Loop, apart: fmpq) -> None:
    """Require that events need the comparison of ‖W e_s‖, if a time between them is stated.

    Those that come without it, as at a deadline, may come at ``times.due``: what is stated is less.
    """
    if apart != 0 and (not compares_error(loop) or not apart > 0):
        raise RejectedError("inter_event_s: not proven for this rule; 0 is")
    if apart != 0 and loop.rule.always and not apart < loop.times.due:
        raise RejectedError("inter_event_s: an event without a comparison may come earlier")


def _require_below(loop: Loop, rate: arb, reached: Callable[[arb], arb], *, is_decaying: bool) -> None:
    """Require that what e_s reaches, a convex function of v = e^{−rt}, is below the threshold max(c v, f).

    ``is_decaying``: it is a multiple of v.
    """
    rule = loop.rule
    level = rule.level if bool(rate == rule.rate) else arb(0)
    kinks = [arb(0), arb(1)]
    if level > 0 and rule.floor > 0:
        kinks.append(rule.floor / level)
    for v in kinks:
        is_nothing = v == 0 and rule.floor == 0 and is_decaying
        if not v > 1 and not (reached(v) < (level * v).max(rule.floor) or is_nothing):
            raise RejectedError("inter_event_s: an event may come earlier")


def compares_error(loop: Loop) -> bool:
    """Return whether the rule compares ‖W e_s‖ with a threshold at all tests."""
    return _exceeds_by_error(loop) and not loop.rule.negative.nrows() and not loop.needs_tests_apart


def _exceeds_by_error(loop: Loop) -> bool:
    """Return whether the rule compares ‖W e_s‖ with at least its threshold."""
    n, positive = loop.n, loop.rule.positive
    if positive.nrows() != n or loop.rule.of_input or loop.rule.integrates:
        return False
    entries = (
        (positive[i, j], loop.weight[i, j - n] if j >= n else 0) for i in range(n) for j in range(2 * n)
    )
    return all(entry == expected for entry, expected in entries)


def sensor_error(loop: Loop, rate: arb, drift: Bound) -> Bound:
    """Return the bound of W e_s: the threshold at the last test, grown, plus what the drift adds."""
    decaying, constant = (sum(sizes, arb(0)) for sizes in zip(*_sensor_parts(loop, rate, drift), strict=True))
    return Bound("e_s", decaying, constant, True)


def _sensor_parts(loop: Loop, rate: arb, drift: Bound) -> list[tuple[arb, arb]]:
    """Return pairs (a, b): ‖W e_s‖ is at most the sum of their (a² f₁² + b² f₂²)^½.

    After a test it is at most the sum of threshold and noise, by an event or without one.
    """
    if not compares_error(loop):
        raise RejectedError("drift: bounds e_s only for a rule that compares ‖W e_s‖")
    (level, floor), noise = thresholds(loop, rate), _noise_parts(loop, rate)
    if loop.times.sampling == 0:
        return [(level, floor), *noise]
    largest, total = growth(weighted(loop, rate), arb(loop.times.sampling))
    most = largest * _at_first_input(loop, rate)
    added = total * drift.decaying, total * drift.constant
    return [(most * level, most * floor), *((largest * a, largest * b) for a, b in noise), added]


def _noise_parts(loop: Loop, rate: arb) -> list[tuple[arb, arb]]:
    """Return pairs as :func:`_sensor_parts` of ‖W n‖."""
    decaying, constant = noise_of(loop, rate).sizes
    return [(decaying, arb(0)), (arb(0), constant)]


def _most_noise(loop: Loop) -> arb:
    """Return a bound of ‖W n‖ at all times."""
    return sum(noise_of(loop, arb(0)).sizes, arb(0))


def _at_first_input(loop: Loop, rate: arb) -> arb:
    """Return the largest ‖W e_s‖ up to the first input in multiples of the threshold, or 1.

    No test is needed between the first input and the last one before it: the drift has no bound there.
    """
    until, (level, floor) = loop.times.start, thresholds(loop, rate)
    if until == 0:
        return arb(1)
    threshold = ((level * (-rate * until).exp()) ** 2 + floor**2).sqrt()
    return arb((error_without_input(loop, until) / threshold).max(arb(1)).abs_upper())


def _require_errors(loop: Loop, rate: arb, proven: Mapping[str, Bound], errors: Errors) -> None:
    """Prove that ‖W (e_s − n)‖ is below what is assumed of it, strictly: then what used it holds on.

    Up to some time the assumption holds; so do all bounds, and ‖W (e_s − n)‖ is below what is assumed, also
    a little later, since e_s is continuous but for its jumps to a noise. A rule that is tested at all times
    keeps ‖W e_s‖ at its threshold plus the noise, or below: there nothing is assumed.
    """
    if "drift" in proven:
        share = share_of_errors(loop, rate, proven["drift"], errors)
    elif "e_s" in proven:
        sensor = proven["e_s"].decaying, proven["e_s"].constant
        share = _share([sensor, *_noise_parts(loop, rate)], errors)
    else:
        raise RejectedError("errors: no bound of e_s, or of the drift, from the start on")
    exact = loop.times.sampling == 0 and compares_error(loop)
    if not (share < 1 or (exact and share <= 1)):
        raise RejectedError("errors: the sensor's error may exceed them")


def _require_region(region: Region, proven: Mapping[str, Bound]) -> None:
    """Prove that x and u stay in the region: their bounds are below its limits, strictly.

    Up to some time they are in it; so all bounds hold, also at this time, since x is continuous and no
    edge assumes anything of the plant. So x and the input that acts next are in it a little later, too.
    """
    for kind, limits in zip("xu", region, strict=True):
        for index, limit in enumerate(limits):
            if limit is None:
                continue
            name = f"{kind}[{index}]"
            if name not in proven:
                raise RejectedError(f"region: {name} has no bound from the start on")
            if not (proven[name].decaying ** 2 + proven[name].constant ** 2).sqrt() < limit:
                raise RejectedError(f"region: {name} may leave it")


def share_of_errors(loop: Loop, rate: arb, drift: Bound, errors: Errors) -> arb:
    """Return the largest share of what is assumed of ‖W (e_s − n)‖ that it reaches, by the drift."""
    return _share([*_sensor_parts(loop, rate, drift), *_noise_parts(loop, rate)], errors)


def _share(parts: Sequence[tuple[arb, arb]], errors: Errors) -> arb:
    """Return the sum of the shares of parts, (a² f₁² + b² f₂²)^½: each is the larger one of both units."""
    assumed = errors.decaying, errors.constant
    shares = [
        [size / limit for size, limit in zip(part, assumed, strict=True) if not size == limit == 0]
        for part in parts
    ]
    return sum((reduce(arb.max, each, arb(0)) for each in shares), arb(0))


# Reading a document.


def _time(table: Mapping[str, object], key: str) -> fmpq:
    """Return a time in s, exactly."""
    return read_number(table, key).fmpq()


def _entries(document: Mapping[str, object], key: str) -> list[Mapping[str, object]]:
    entries = document.get(key)
    if not isinstance(entries, list) or not all(isinstance(entry, Mapping) for entry in entries):
        raise RejectedError(f"{key}: not a list of tables")
    return entries
