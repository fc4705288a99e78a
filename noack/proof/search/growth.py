"""The growth of a loop that transmits at least at some times, under every pattern of losses, or under one.

The sensor transmits x, which it knows, some units of time after the transmission before, whatever it
measures: the unit is its period, or the time between two measurements. Nothing is late, and nothing
disturbs the loop; with a set-point or a safe input the state is the difference of two runs. Periods
that are no whole nanoseconds are exact. With z = (x, x_c, u, older x) at a transmission whose update arrives,
u the input that the plant applies, and the older x those of transmissions whose updates are on their way:

* a *burst* leads from this transmission to the next one whose update arrives, some units later. Whatever
  was lost between, it multiplies z by one matrix. This depends on the number of units, on the place of the
  first transmission relative to the controller's ticks, the *slot*, and, if updates expire, on how much
  longer the update before it is used. An update that arrives within the latency of a live tick, before or
  after it, acts at this tick or at the next one, whatever the updates before it did: each is a burst.
* A *node* is all that bursts depend on after it: the state of the guarantee, the slot, and that time.
  Nodes with the same futures are one.

A witness has a positive definite P for every node; a node may also remember the last bursts, for which
the graph is replaced by that of its bursts. If every path from a node v has a beginning with the product Π,
of d units, and the end w, so that

    Πᵀ P_w Π ⪯ ρ²ᵈ P_v,

then no pattern grows faster than by ρ per unit in the long run, with √(zᵀPz) as its measure. The beginnings
are found here: bursts are added to a product until the inequality holds, up to some number.

A pattern that is repeated has the product Π of its matrices. |tr Π^k| ≤ N · (spectral radius of Π)^k, N its
size: so some z grows at least by (|tr Π^k| / N)^(1/k) over that time. In coordinates in which Π is nearly
diagonal, balls grow less from power to power.
"""

from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from functools import cached_property
from itertools import pairwise
from math import gcd, lcm
from typing import NamedTuple

from flint import arb, arb_mat

from netem.guarantee.loss_guarantee import GuaranteeState, LossGuarantee
from noack.core.balls import identity, is_positive, number, rows_of, stack, transpose, zeros
from noack.proof.elaborate.errors import RefusedError, RejectedError
from noack.proof.elaborate.tables import read_count, read_matrix, read_number, read_rows, read_table
from noack.proof.period_times import LoopTimes

_MOST_SLOTS, _MOST_SIZE, _MOST_UNITS = 64, 80, 100_000
MOST_BURSTS = 5000
_MOST_MEMORY, _LONGEST = 8, 1000
_MOST_PRODUCTS = 5000
"""Of two bursts and more, for all nodes: some seconds."""
_LONGEST_PRODUCT = 40
"""Bursts of a product: balls become larger with each."""
_MOST_SQUARINGS = 40
_DEFINITE = arb(2) ** -100
"""A form is definite if it is positive with so much less."""


class Burst(NamedTuple):
    """What may happen from one transmission whose update arrives to the next one."""

    source: int
    target: int
    slot: int
    usable: int
    """How long the update before is used after the first transmission."""
    losses: int
    units: int
    arrival: int | None = None
    """How long after the first transmission an update arrives; None: nominally."""


def list_bursts(guarantee: LossGuarantee, times: LoopTimes, between: range) -> list[Burst]:
    """Return all bursts; node 0 is that of the first transmission.

    Of several with the same nodes and units, the one with the fewest losses stands for all.

    Args:
        guarantee: the outcomes that are allowed.
        times: of the loop.
        between: numbers of units that may be between two transmissions.

    Raises:
        RefusedError: there are more than 5,000.
    """
    if between[-1] > _MOST_UNITS:
        raise RefusedError("trigger: too many measurements between two events")
    first, latest = guarantee.after(guarantee.start, lost=False), times.latest
    begin = first, 0, times.usable(1, latest)
    numbers, pending = {begin: 0}, [begin]
    bursts: dict[tuple[int, int, int, int], Burst] = {}
    arrivals = [times.arrivals(slot) for slot in range(times.slots)]
    while pending:
        node = state, slot, usable = pending.pop()
        source, sent = numbers[node], 0
        while state is not None:
            sent += 1
            after = guarantee.after(state, lost=False)
            for units in range(sent * between[0], sent * between[-1] + 1):
                target = after, (slot + units) % times.slots, times.usable(units, latest)
                if target not in numbers:
                    numbers[target] = len(numbers)
                    pending.append(target)
                for arrival in arrivals[slot]:
                    burst = Burst(source, numbers[target], slot, usable, sent - 1, units, arrival)
                    bursts.setdefault((source, numbers[target], units, arrival), burst)
            if len(bursts) > MOST_BURSTS:
                raise RefusedError(f"more than {MOST_BURSTS:,} transitions")
            state = guarantee.after(state, lost=True)
    return _merged(list(bursts.values()))


def _merged(bursts: Sequence[Burst]) -> list[Burst]:
    """Return the graph with one node for all that have the same futures, numbered anew.

    Nodes are divided as long as bursts of one class differ in their losses, times or targets' class.
    """
    leaving: dict[int, list[Burst]] = {}
    for burst in bursts:
        leaving.setdefault(burst.source, []).append(burst)
    classes, count = dict.fromkeys(sorted(leaving), 0), 0
    while len(set(classes.values())) > count:
        count = len(set(classes.values()))
        merged = {
            node: frozenset((*burst[2:], classes[burst.target]) for burst in leaving[node])
            for node in classes
        }
        numbers = {future: number for number, future in enumerate(dict.fromkeys(merged.values()))}
        classes = {node: numbers[future] for node, future in merged.items()}
    first = {number: node for node, number in reversed(classes.items())}
    return [
        burst._replace(source=number, target=classes[burst.target])
        for number, node in sorted(first.items())
        for burst in leaving[node]
    ]


def remembering(bursts: Sequence[Burst], memory: int) -> list[Burst]:
    """Return the graph in which a node also remembers the last bursts, so many of them."""
    for _ in range(memory):
        following: dict[int, list[int]] = {}
        for edge, burst in enumerate(bursts):
            following.setdefault(burst.source, []).append(edge)
        ends = [following[burst.target] for burst in bursts]
        if sum(map(len, ends)) > MOST_BURSTS:
            raise RejectedError(f"memory: more than {MOST_BURSTS:,} transitions")
        bursts = [
            bursts[edge]._replace(source=source, target=edge)
            for source, numbers in enumerate(ends)
            for edge in numbers
        ]
    return list(bursts)


class PeriodicLoop:
    """A loop that transmits at least at some times.

    Args:
        matrices: A, B, K and H.
        times: its times.
        between: numbers of units that may be between two transmissions.
        guarantee: the outcomes that are allowed.
    """

    def __init__(
        self,
        matrices: tuple[arb_mat, arb_mat, arb_mat, arb_mat],
        times: LoopTimes,
        between: range,
        guarantee: LossGuarantee,
    ) -> None:
        self.matrices, self.times = matrices, times
        self.between, self.guarantee = between, guarantee
        A, B, K, H = matrices
        n, m, behind = A.nrows(), B.ncols(), times.behind
        at = [0, n, 2 * n, 2 * n + m, *(2 * (n + m) + i * n for i in range(behind + 1))]
        self._whole = identity(at[-1])
        x, x_c, u, w, *older = (rows_of(self._whole, range(begin, end)) for begin, end in pairwise(at))
        still = zeros(at[-1] - 2 * n, at[-1])
        self._generator = stack([A * x + B * u, H * x_c, still])
        self._step = stack([x, x_c, w, w, *older])
        self._ticks = (
            stack([x, x_c, u, K * x_c, *older]),
            stack([x, x_c, u, w if times.holds_input else 0 * w, *older]),
        )
        sent = [x, *older]
        self._newest = sent[-1]
        arrives_at_once = behind * times.period + times.latest == 0
        self._loop = stack([x, x_c, u, w])
        self._sent = stack(sent[:-1]) if behind else None
        # A step comes before a transmission, so that u = w there. What arrives at once replaces x_c.
        kept = [*range(n), *(() if arrives_at_once else range(n, 2 * n)), *range(2 * n, 2 * n + m)]
        kept += range(2 * (n + m), at[-1])
        self._kept, self.size = kept, len(kept)
        if at[-1] > _MOST_SIZE:
            raise RefusedError("too many updates are on their way at once")
        inputs = {2 * n + i: 2 * n + m + i for i in range(m)}
        self._from_kept = arb_mat(
            at[-1], len(kept), [int(i in (j, inputs.get(j))) for i in range(at[-1]) for j in kept]
        )
        self._flows: dict[int, arb_mat] = {}
        self._advances: dict[tuple[int, int, bool], arb_mat] = {}
        self._after: dict[tuple[int, int, int], list[arb_mat]] = {}
        self._matrices: dict[tuple[int, int, int, int], arb_mat] = {}

    def under(self, guarantee: LossGuarantee) -> "PeriodicLoop":
        """Return the same loop with another guarantee."""
        other = PeriodicLoop.__new__(type(self))
        other.__dict__.update(self.__dict__)
        other.__dict__.pop("bursts", None)
        other.guarantee = guarantee
        return other

    @cached_property
    def bursts(self) -> list[Burst]:
        """The graph of what may happen; see :func:`list_bursts`."""
        return list_bursts(self.guarantee, self.times, self.between)

    def seconds(self, units: int) -> Fraction:
        """Return a time in s."""
        return self.times.exact_seconds(units * self.times.period)

    def matrix(self, burst: Burst) -> arb_mat:
        """Return the matrix of z over a burst."""
        arrival = self.times.delay if burst.arrival is None else burst.arrival
        key = burst.slot, burst.usable, burst.units, arrival
        if key not in self._matrices:
            self._matrices[key] = self._over(*key)
        return self._matrices[key]

    def _over(self, slot: int, usable: int, units: int, arrival: int) -> arb_mat:
        states, T = self._after.setdefault((slot, usable, arrival), []), self.times
        begin = slot * T.period
        expires = begin + T.timeout
        while len(states) < units:
            now = begin + len(states) * T.period
            if states:
                state, step = states[-1], self._advance(now, now + T.period, expires)
            else:
                state, arrives = self._from_kept, now + arrival
                before = self._advance(now, arrives, now + usable)
                # What arrives was sent before, and what is under way does not change until the end.
                step = self._advance(arrives, now + T.period, expires) * self._arrived(before, arrival)
            states.append(self._moved(step, state))
        return rows_of(states[units - 1], self._kept)

    def _arrived(self, before: arb_mat, arrival: int) -> arb_mat:
        """Return the matrix until after an arrival, of what was sent at the start or before it."""
        n = self.matrices[0].nrows()
        x, rest = (rows_of(before, rows) for rows in (range(n), range(2 * n, before.nrows())))
        delay_s = self.times.exact_seconds(self.times.behind * self.times.period + arrival)
        return stack([x, (number(delay_s) * self.matrices[3]).exp() * self._newest, rest])

    def _moved(self, step: arb_mat, state: arb_mat) -> arb_mat:
        """Return the state after a unit, in which the newest x is under way, too."""
        after = step * state
        if self._sent is None:
            return after
        return stack([self._loop * after, self._sent * state])

    def _advance(self, begin: int, end: int, expires: int) -> arb_mat:
        """Return the matrix between two times; a tick at the end is excluded, and a step at the start.

        From ``expires`` on the controller's update is too old.
        """
        if expires >= end:
            return self._without_arrival(begin, end, False)
        split = max(expires, begin)
        late = self._without_arrival(split, end, True)
        return late * self._without_arrival(begin, split, False) if split > begin else late

    def _without_arrival(self, begin: int, end: int, is_late: bool) -> arb_mat:
        cycle = lcm(self.times.step, self.times.tick)
        begin, duration = begin % cycle, end - begin
        key = begin, duration, is_late
        if key not in self._advances:
            cycles, rest = divmod(duration, cycle)
            product = self._events(begin, begin + rest, is_late)
            if cycles:
                product = product * self._events(begin, begin + cycle, is_late) ** cycles
            self._advances[key] = product
        return self._advances[key]

    def _events(self, begin: int, end: int, is_late: bool) -> arb_mat:
        state, now = self._whole, begin
        for t, is_tick in self.times.occurrences(begin, end):
            change = self._ticks[is_late] if is_tick else self._step
            state, now = change * (self._flow(t - now) * state), t
        return self._flow(end - now) * state

    def _flow(self, duration: int) -> arb_mat:
        if duration not in self._flows:
            self._flows[duration] = (number(self.times.exact_seconds(duration)) * self._generator).exp()
        return self._flows[duration]


class Growth(NamedTuple):
    """What is proven: bounds of the factor over the longest time between two transmissions."""

    period: Fraction  # s, the longest time
    shortest: Fraction  # s
    losses: int
    """Most consecutive losses of the patterns."""
    upper: arb | None
    """No pattern grows faster; None: this is not proven."""
    lower: arb | None
    """``pattern`` grows at least so fast; None: there is none."""
    pattern: str
    has_ties: bool = False
    """Whether an update may act at one of two ticks, anew each time."""


def prove_growth(loop: PeriodicLoop, document: Mapping[str, object]) -> Growth:
    """Return what a document proves of the growth of a loop, for as many losses as it says.

    Raises:
        RejectedError: the first inequality that fails, or what is wrong with the document.
        RefusedError: the guarantee allows too many patterns.
    """
    upper = lower = None
    pattern, losses = "", read_count(document, "losses", _LONGEST)
    loop = loop.under(loop.guarantee.capped(losses))
    longest = loop.between[-1]
    if "stable" in document:
        upper = _prove_upper(loop, read_table(document, "stable")) ** longest
    if "unstable" in document:
        lower, pattern = _prove_lower(loop, read_table(document, "unstable"))
        lower = lower**longest
    if upper is None and lower is None:
        raise RejectedError("growth: neither stable nor unstable")
    shortest, has_ties = loop.seconds(loop.between[0]), loop.times.has_ties
    return Growth(loop.seconds(longest), shortest, losses, upper, lower, pattern, has_ties)


def _prove_upper(loop: PeriodicLoop, table: Mapping[str, object]) -> arb:
    """Prove that no pattern grows faster than by the table's factor per unit."""
    factor, memory = read_number(table, "factor"), read_count(table, "memory", _MOST_MEMORY)
    if not factor > 0:
        raise RejectedError("stable: factor: not above 0")
    bursts = remembering(loop.bursts, memory)
    leaving: dict[int, list[Burst]] = {}
    for burst in bursts:
        leaving.setdefault(burst.source, []).append(burst)
    rows = table.get("forms")
    if not isinstance(rows, list) or len(rows) != len(leaving):
        raise RejectedError(f"stable: forms: not one matrix for each of {len(leaving)} nodes")
    forms = [read_matrix({"forms": form}, "forms", loop.size) for form in rows]
    if not all(is_positive(P - _DEFINITE * identity(loop.size)) for P in forms):
        raise RejectedError("stable: forms: not positive definite")
    products = 0
    for node, P in enumerate(forms):
        pending = [(node, identity(loop.size), 0, 1)]
        while pending:
            end, before, units, length = pending.pop()
            for burst in leaving[end]:
                Π, d = loop.matrix(burst) * before, units + burst.units
                products += length > 1
                if is_positive(factor ** (2 * d) * P - transpose(Π) * forms[burst.target] * Π):
                    continue
                if length == _LONGEST_PRODUCT or products > _MOST_PRODUCTS:
                    raise RejectedError(f"stable: the inequality fails after {d} units from node {node}")
                pending.append((burst.target, Π, d, length + 1))
    return factor


def _prove_lower(loop: PeriodicLoop, table: Mapping[str, object]) -> tuple[arb, str]:
    """Return a proven factor per unit by which a pattern grows at least, and the pattern."""
    squarings = table.get("squarings")
    if isinstance(squarings, bool) or not isinstance(squarings, int) or not 0 <= squarings <= _MOST_SQUARINGS:
        raise RejectedError(f"unstable: squarings: not a whole number from 0 to {_MOST_SQUARINGS}")
    pattern, intervals = _pattern(loop, table)
    slots, slot, total = loop.times.slots, read_count(table, "slot", _MOST_SLOTS), sum(intervals)
    bursts = [*_bursts_of(pattern, intervals)]
    places = table.get("arrivals", [0] * len(bursts))
    if not isinstance(places, list) or len(places) != len(bursts):
        raise RejectedError("unstable: arrivals: not one for each delivery")
    Π, units, latest = identity(loop.size), 0, loop.times.latest
    for _ in range(slots // gcd(slots, total)):
        usable = loop.times.usable(bursts[-1], latest)
        for burst, place in zip(bursts, places, strict=True):
            now = (slot + units) % slots
            arrivals = loop.times.arrivals(now)
            if type(place) is not int or not 0 <= place < len(arrivals):
                raise RejectedError("unstable: arrivals: an update does not arrive then")
            Π = loop.matrix(Burst(0, 0, now, usable, 0, burst, arrivals[place])) * Π
            usable, units = loop.times.usable(burst, latest), units + burst
    if "coordinates" in table:
        T = read_rows(table, "coordinates")
        if (T.nrows(), T.ncols()) != (loop.size, loop.size):
            raise RejectedError("unstable: coordinates: not a square matrix of the right size")
        try:
            Π = T.inv() * Π * T
        except ZeroDivisionError:
            raise RejectedError("unstable: coordinates: singular") from None
    for _ in range(squarings):
        Π = Π * Π
    trace = sum((Π[i, i] for i in range(Π.nrows())), arb(0))
    least = arb(trace.abs_lower()) / Π.nrows()
    if not (least > 0 and least.is_finite()):
        raise RejectedError("unstable: the trace of the product is not above 0")
    text = pattern
    if len(loop.between) > 1:
        seconds = (float(loop.seconds(k)) for k in intervals)
        text = " ".join(f"{letter} ({s:.6g} s)" for letter, s in zip(pattern, seconds, strict=True))
    return arb((least.log() / (units * 2**squarings)).exp()), text


def _pattern(loop: PeriodicLoop, table: Mapping[str, object]) -> tuple[str, list[int]]:
    """Return the pattern of a table, which the guarantee allows if it is repeated, and its intervals."""
    pattern = table.get("pattern")
    if not isinstance(pattern, str) or not 0 < len(pattern) <= _LONGEST or set(pattern) - set("DL"):
        raise RejectedError("unstable: pattern: not of letters D and L")
    intervals = table.get("intervals", [loop.between[0]] * len(pattern))
    if not isinstance(intervals, list) or len(intervals) != len(pattern):
        raise RejectedError("unstable: intervals: not one for each letter")
    if not all(type(k) is int and k in loop.between for k in intervals):
        raise RejectedError("unstable: intervals: not of the units that may be between two transmissions")
    state: GuaranteeState | None = loop.guarantee.start
    followed = set[GuaranteeState]()
    while state is not None and state not in followed:
        followed.add(state)
        for letter in pattern:
            state = None if state is None else loop.guarantee.after(state, lost=letter == "L")
    if state is None or "D" not in pattern:
        raise RejectedError("unstable: pattern: the guarantee does not allow it")
    if pattern[0] != "D":
        raise RejectedError("unstable: pattern: does not begin with a delivery")
    return pattern, intervals


def _bursts_of(pattern: str, intervals: Sequence[int]) -> Iterator[int]:
    """Yield the units from each delivery of a pattern to the next one."""
    starts = [*(k for k, letter in enumerate(pattern) if letter == "D"), len(pattern)]
    yield from (sum(intervals[begin:end]) for begin, end in pairwise(starts))
