"""The growth of a loop with a time-triggered sensor under every pattern of losses, or under one of them.

The sensor transmits x, which it knows, every T; nothing is late, and nothing disturbs the loop. From one
transmission to the next the state z = (x, x_c, u, w, older x) is multiplied by a matrix D, if an update
arrives before the next transmission, and else by L: u is the input that the plant applies, w the newest one
of the controller, and the older x are those of transmissions whose updates are on their way. Both depend on
the place of T relative to the controller's ticks, which repeats after some transmissions, the slots.

A *word* is what is known of the outcomes so far: it is how they end. A witness has words, each with a
positive definite matrix P for every slot. From a word w, outcome o leads to the longest word that w·o ends
with. If for all slots and words, and all outcomes that the guarantee allows there,

    Mᵀ P_to M ⪯ ρ² P_from,    M = D or L,

then no pattern grows faster than by ρ per period, in the long run: with √(zᵀPz) as its measure. "D" has to
be a word, since each pattern has a delivery, from which on there is a word.

An outcome belongs to the update that arrives, or would, between two transmissions.

A pattern that is repeated has the product Π of its matrices over all slots. |tr Π^k| ≤ N · (spectral radius
of Π)^k, N its size: so some z grows at least by (|tr Π^k| / N)^(1/k) over that time.
"""

from collections.abc import Mapping
from itertools import pairwise, product
from math import lcm
from typing import NamedTuple

from flint import arb, arb_mat, fmpq

from noack_check.balls import identity, is_positive, rows_of, stack, transpose, zeros
from noack_check.check import RejectedError
from noack_check.document import read_count, read_matrix, read_number, read_table
from noack_check.keys import RefusedError, Table
from noack_check.loop import Loop
from noack_check.scenario import constant_delay_ns, loss_windows, read_loop, read_schedule
from noack_check.times import NS_PER_S, Schedule

_MOST_STEPS, _MOST_SLOTS, _MOST_SIZE = 20_000, 64, 80
_MOST_WORDS, _LONGEST = 300, 1000
_MOST_SQUARINGS = 40
_DEFINITE = arb(2) ** -100
"""A form is definite if it is positive with so much less."""
_STEP, _ARRIVAL, _TICK = range(3)
"""What happens at one time, in this order; a transmission comes after a step."""


class PeriodicLoop(NamedTuple):
    """What happens between two transmissions, by slot, and which losses the guarantee allows."""

    delivered: tuple[arb_mat, ...]  # D
    lost: tuple[arb_mat, ...]  # L
    losses: int  # most consecutive losses
    windows: tuple[tuple[int, int], ...]  # at most the first number of losses in the second number of updates
    period: fmpq  # s

    def allows_loss(self, word: str) -> bool:
        """Return whether a loss may follow outcomes that end with a word."""
        in_a_row = len(word) - len(word.rstrip("L"))
        recent = (word[max(len(word) - window + 1, 0) :].count("L") < most for most, window in self.windows)
        return in_a_row < self.losses and all(recent)


class Growth(NamedTuple):
    """What is proven: bounds of the factor per period."""

    period: fmpq  # s
    losses: int
    """Most consecutive losses of the patterns."""
    upper: arb | None
    """No pattern grows faster; None: this is not proven."""
    lower: arb | None
    """``pattern`` grows at least so fast; None: there is none."""
    pattern: str


def read_periodic_loop(resolved: Table) -> PeriodicLoop:
    """Return the loop of a resolved scenario whose sensor is time-triggered.

    Raises:
        RefusedError: a key is not covered, is missing or has a wrong value.
    """
    loop, schedule = read_loop(resolved, box=False, ideal=False), read_schedule(resolved)
    if loop.observer is not None or loop.noise.ncols() or loop.sizes:
        raise RefusedError("the growth is of a loop without observer, noise and disturbances")
    if not loop.times.period > 0 or loop.times.least_period != loop.times.period:
        raise RefusedError("trigger.policy: the sensor is not time-triggered")
    if not schedule.is_whole:
        raise RefusedError("plant.rate_hz, controller.rate_hz: their periods are no whole nanoseconds")
    period_ns = int((loop.times.period * NS_PER_S).p)
    step_ns, tick_ns = int(schedule.step), int(schedule.tick)
    cycle_ns = lcm(step_ns, tick_ns)
    slots = lcm(cycle_ns, period_ns) // period_ns
    behind, _ = divmod(constant_delay_ns(resolved), period_ns)
    if slots > _MOST_SLOTS or period_ns // min(step_ns, tick_ns) > _MOST_STEPS:
        raise RefusedError("the times of the loop repeat only after too many steps")
    if 2 * (loop.n + loop.B.ncols()) + behind * loop.n > _MOST_SIZE:
        raise RefusedError("too many updates are on their way at once")
    maps = _PeriodMaps(loop, schedule, period_ns, constant_delay_ns(resolved))
    return PeriodicLoop(
        tuple(maps.of(slot, delivered=True) for slot in range(slots)),
        tuple(maps.of(slot, delivered=False) for slot in range(slots)),
        loop.losses,
        tuple(loss_windows(resolved)),
        loop.times.period,
    )


class _PeriodMaps:
    """The matrices of periods, with z = (x, x_c, u, w, older x)."""

    def __init__(self, loop: Loop, schedule: Schedule, period_ns: int, delay_ns: int) -> None:
        self._period_ns, (behind, self._rest_ns) = period_ns, divmod(delay_ns, period_ns)
        self._schedule, n, m = schedule, loop.n, loop.B.ncols()
        self._size = 2 * (n + m) + behind * n
        at = [0, n, 2 * n, 2 * n + m, *(2 * (n + m) + i * n for i in range(behind + 1))]
        whole = identity(self._size)
        x, x_c, u, w, *older = (rows_of(whole, range(begin, end)) for begin, end in pairwise(at))
        nothing = zeros(self._size - 2 * n, self._size)
        self._generator = stack([loop.A * x + loop.B * u, loop.H * x_c, nothing])
        sent = [x, *older]
        self._changes = {
            _STEP: stack([x, x_c, w, w, *older]),
            _TICK: stack([x, x_c, u, loop.gain * x_c, *older]),
        }
        self._arrived = (arb(fmpq(delay_ns, NS_PER_S)) * loop.H).exp() * sent[-1]
        self._x_c, self._older = range(n, 2 * n), sent[:-1]
        self._flows: dict[int, arb_mat] = {}

    def of(self, slot: int, *, delivered: bool) -> arb_mat:
        """Return the matrix from one transmission to the next; ``delivered``: an update arrives between."""
        begin = slot * self._period_ns
        end, now, state = begin + self._period_ns, begin, identity(self._size)
        for time, what in self._events(begin, end, delivered=delivered):
            state = self._flow(time - now) * state
            now = time
            if what == _ARRIVAL:
                rows = [rows_of(state, range(self._x_c.start)), self._arrived]
                state = stack([*rows, rows_of(state, range(self._x_c.stop, self._size))])
            else:
                state = self._changes[what] * state
        state = self._flow(end - now) * state
        kept = rows_of(state, range(self._size - sum(part.nrows() for part in self._older)))
        return stack([kept, *self._older])

    def _events(self, begin: int, end: int, *, delivered: bool) -> list[tuple[int, int]]:
        """Return what happens after a transmission and until the next one, in order of time."""
        schedule = self._schedule
        step, tick, phase = int(schedule.step), int(schedule.tick), int(schedule.phase)
        steps = range((begin // step + 1) * step, end + 1, step)
        ticks = range(-(-(begin - phase) // tick) * tick + phase, end, tick)
        arrivals = [begin + self._rest_ns] if delivered else []
        return sorted(
            [*((t, _STEP) for t in steps), *((t, _ARRIVAL) for t in arrivals), *((t, _TICK) for t in ticks)]
        )

    def _flow(self, duration_ns: int) -> arb_mat:
        if duration_ns not in self._flows:
            self._flows[duration_ns] = (arb(fmpq(duration_ns, NS_PER_S)) * self._generator).exp()
        return self._flows[duration_ns]


def prove_growth(loop: PeriodicLoop, document: Mapping[str, object]) -> Growth:
    """Return what a document proves of the growth of a loop, for as many losses as it says.

    Raises:
        RejectedError: the first inequality that fails, or what is wrong with the document.
    """
    upper = lower = None
    pattern = ""
    loop = loop._replace(losses=read_count(document, "losses", _LONGEST))
    if "stable" in document:
        upper = _prove_upper(loop, read_table(document, "stable"))
    if "unstable" in document:
        table = read_table(document, "unstable")
        pattern = _pattern(loop, table)
        lower = _lower(loop, pattern, table)
    if upper is None and lower is None:
        raise RejectedError("growth: neither stable nor unstable")
    return Growth(loop.period, loop.losses, upper, lower, pattern)


def _prove_upper(loop: PeriodicLoop, table: Mapping[str, object]) -> arb:
    """Prove that no pattern grows faster than by the table's factor."""
    factor, words = read_number(table, "factor"), read_table(table, "words")
    if not factor > 0:
        raise RejectedError("stable: factor: not above 0")
    if "D" not in words or len(words) > _MOST_WORDS or any(set(word) - set("DL") for word in words):
        raise RejectedError('stable: words: of letters D and L, "D" among them, and not too many')
    size, slots = loop.lost[0].nrows(), len(loop.lost)
    forms: dict[tuple[str, int], arb_mat] = {}
    for word, stack_of in words.items():
        if not isinstance(stack_of, list) or len(stack_of) != slots:
            raise RejectedError(f"stable: {word[:_LONGEST]}: not one matrix for each slot")
        for slot, rows in enumerate(stack_of):
            forms[word, slot] = P = read_matrix({word: rows}, word, size)
            if not is_positive(P - _DEFINITE * identity(size)):
                raise RejectedError(f"stable: {word}: not positive definite")
    for (word, slot), outcome in product(forms, "DL"):
        if outcome == "L" and not loop.allows_loss(word):
            continue
        M = (loop.delivered if outcome == "D" else loop.lost)[slot]
        following = forms[_following(words, word + outcome), (slot + 1) % slots]
        if not is_positive(factor**2 * forms[word, slot] - transpose(M) * following * M):
            raise RejectedError(f"stable: the inequality from {word} by {outcome} fails")
    return factor


def _following(words: Mapping[str, object], outcomes: str) -> str:
    """Return the longest word that outcomes end with."""
    for begin in range(len(outcomes)):
        if outcomes[begin:] in words:
            return outcomes[begin:]
    raise RejectedError(f"stable: no word is at the end of {outcomes[:_LONGEST]}")


def _pattern(loop: PeriodicLoop, table: Mapping[str, object]) -> str:
    """Return the pattern of a table, which the guarantee allows if it is repeated."""
    pattern = table.get("pattern")
    if not isinstance(pattern, str) or not 0 < len(pattern) <= _LONGEST or set(pattern) - set("DL"):
        raise RejectedError("unstable: pattern: not of letters D and L")
    longest = max(loop.losses, *(window for _, window in loop.windows), 1)
    repeated = pattern * (2 + longest // len(pattern))
    for end in range(len(repeated)):
        if repeated[end] == "L" and not loop.allows_loss(repeated[:end]):
            raise RejectedError("unstable: pattern: the guarantee does not allow it")
    return pattern


def _lower(loop: PeriodicLoop, pattern: str, table: Mapping[str, object]) -> arb:
    """Return a proven factor per period by which a pattern grows at least."""
    squarings = table.get("squarings")
    if isinstance(squarings, bool) or not isinstance(squarings, int) or not 0 <= squarings <= _MOST_SQUARINGS:
        raise RejectedError(f"unstable: squarings: not a whole number from 0 to {_MOST_SQUARINGS}")
    slots = len(loop.lost)
    periods = lcm(len(pattern), slots)
    Π = identity(loop.lost[0].nrows())
    for k in range(periods):
        Π = (loop.delivered if pattern[k % len(pattern)] == "D" else loop.lost)[k % slots] * Π
    for _ in range(squarings):
        Π = Π * Π
    trace = sum((Π[i, i] for i in range(Π.nrows())), arb(0))
    least = arb(trace.abs_lower()) / Π.nrows()
    if not (least > 0 and least.is_finite()):
        raise RejectedError("unstable: the trace of the product is not above 0")
    return arb((least.log() / (periods * 2**squarings)).exp())
