"""The loop as a hybrid system: locations with flows, and edges between them.

The state is z = (x, e, w, f₁, f₂): the plant's state x; e = x_s − x, the sensor's error; w = x_c − x_s,
where x_c is what the acting input was computed from; f₁ = e^{−rt} and f₂ = 1, the units of decaying and
of constant bounds. With the input u = K e^{−Hs} x_c of age s,

    ẋ = Ax + Bu + Dd,   ė = H(x + e) − ẋ,   ẇ = Hw,   ḟ₁ = −r f₁,   ḟ₂ = 0.

At a test the sensor takes x + n for x, with n = Ss + Σ column p: see :mod:`.noise`. Here s is a state, and
the p with |p| ≤ f₁ or f₂ are others at each test. An event sets x_s := x + n, so e := n at once, since the
sensor's model is reset whether or not the update arrives, and w grows by e − n. The rule compares x + n and
e − n. The entries of z for e are those of e − Ss. Those for p are used at tests only; with tests at all times
also in flows, where some p at each time makes the rule silent.

A location says what becomes of the updates that were sent since the one that the acting input
was computed from:

* "j lost": j updates, which never act. At an event the next one is lost, too, or is on its way.
* "k later": one is on its way that will act, k events happened after its own, and a clock shows the time
  since that. It acts before the clock shows d. Of the k later updates one acts next, or all are lost.

In "k later" z has k vectors more: v₁, …, v_k with v̇ᵢ = Hvᵢ, what w will be when the updates act that
have k, …, 1 later ones. An event adds e − n to all of them, since it changes x_s by n − e and no prediction.

A periodic rule (``times.period`` > 0) compares nothing, so its events depend on the time only. In each
location a clock shows the time since the last event, at which the next one happens. Nothing depends on
the error of the newest update if this one is lost; so in "j lost" x_s is x_c: w = 0, and the event of
an update that is lost changes no error.

If tests are T apart, exactly, V may depend on where each update is at each test: see
:mod:`.tests_apart`. Rules with a dwell time, and those with a memory η, need this. Then z has a number y
more with y² = max(η, 0), as it will be at the next test. It is the same until then; at a test η becomes
e^{−λT} η + (1 − e^{−λT})/λ zᵀΨz. So y² becomes 0, or at most this with y² for η: V does not grow in either
case, with coefficients of y² that are at least 0.

At most ``losses`` consecutive updates are lost, and at most ``later`` events are assumed to happen within d
after an event. :mod:`.proof` shows both assumptions from bounds of the same loop, by induction over the
events.

An *inequality* of :meth:`Model.inequalities` is a symmetric matrix that depends linearly on the
numbers of a witness (matrices, multipliers, levels) and has to be positive semidefinite. Together they
prove the statement:

* V(z) = zᵀPz, with P of the location and the time θ since the last test, or that of the location's clock
  (affine between nodes of θ).
  V ≤ 0 is invariant: along flows dV/dt ≤ −νV, over edges V does not grow, and V ≤ 0 at the start.
* Where V ≤ 0, each output obeys |Cz|² ≤ D₁² f₁² + D₂² f₂².
* Quadratic facts q(z) ≤ 0 that hold where an inequality is used (the rule's comparison, bounds of p and
  of w) enter with multipliers m ≥ 0, and unknown signals p with |p|² ≤ |Rz|² with multipliers, too.

Flows are affine in the input's matrix K e^{−Hs}, so its hull's corners suffice; inequalities are affine
in θ between two nodes, so both ends suffice.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import comb
from typing import NamedTuple

from flint import arb, arb_mat, fmpq

from noack.core.balls import (
    around_zero,
    beside,
    columns_of,
    identity,
    is_zero,
    rows_of,
    square,
    stack,
    transpose,
    upto,
    zeros,
)
from noack.proof.elaborate.loop import Along, Loop, Memory, Noise
from noack.proof.elaborate.tests_apart import Move, PlaceAtTest, Places

_CLOSE = 1000
"""Nodes of a periodic rule's clock are at least such a share of the period apart."""
DEGREE, SMALL = 8, 1e-12
"""The degree of Taylor polynomials in the age of inputs, and a remainder that needs no smaller parts."""


class UnknownSignal(NamedTuple):
    """An unknown signal p in ż = Fz + ``column`` p with |p| ≤ |``rows`` z|."""

    column: arb_mat
    rows: arb_mat
    along: Along | None = None
    """A row C and k ≥ 0 with p·Cz ≥ k p², as of friction."""


class Signal(NamedTuple):
    """An unknown signal p in ż = Fz + ``column`` p with |p| ≤ ``size`` |``row`` z|."""

    column: arb_mat
    row: arb_mat
    size: arb
    along: Along | None

    @property
    def plain(self) -> UnknownSignal:
        """The signal itself."""
        return UnknownSignal(self.column, self.size * self.row, self.along)

    @property
    def scaled(self) -> UnknownSignal:
        """The signal over the root of its size: then a search has numbers of similar size."""
        root = self.size.sqrt()
        along = None if self.along is None else Along(self.along.row, root * self.along.least)
        return UnknownSignal(root * self.column, root * self.row, along)


class ContinuousFlow(NamedTuple):
    """ż = ``matrix`` z + Σ column p, with the input u = ``input`` z."""

    matrix: arb_mat
    unknowns: tuple[UnknownSignal, ...]
    input: arb_mat


class Location(NamedTuple):
    """Where z flows until an edge is taken."""

    name: str
    coordinates: tuple[int, ...]
    """The entries of z that may differ from 0."""
    nodes: tuple[arb, ...]
    """Times θ since it was entered, since the last test or, with a periodic rule, since the last event."""
    flows: tuple[ContinuousFlow, ...]
    facts: tuple[arb_mat, ...]
    """Symmetric Q with zᵀQz ≤ 0."""
    silent: tuple[arb_mat, ...]
    """Those that say that a rule which is tested at all times is silent."""
    is_tested: bool


class Edge(NamedTuple):
    """A jump z := ``jump`` z, possible where ``facts`` are ≤ 0."""

    name: str
    source: int
    target: int
    pairs: tuple[tuple[int, int], ...]
    """Nodes of the source and of the target; between two pairs both times are affine."""
    jump: arb_mat
    facts: tuple[arb_mat, ...]
    is_test: bool
    """z has the noise of a measurement."""
    memory: arb_mat | None = None
    """Symmetric Q: y² becomes zᵀQz; None: it stays."""


class Errors(NamedTuple):
    """What is assumed at all times: ‖W e_s‖² ≤ ``decaying``² f₁² + ``constant``² f₂²."""

    decaying: arb
    constant: arb


class MatrixPart(NamedTuple):
    """LᵀVR + RᵀVL of a symmetric matrix V of the witness."""

    name: str
    left: arb_mat
    right: arb_mat


class Inequality(NamedTuple):
    """Σ parts + Σ number · matrix + constant ⪰ 0."""

    name: str
    location: int
    signals: int
    """The last rows and columns are those of so many unknown signals, the others those of a location."""
    parts: tuple[MatrixPart, ...]
    scalars: tuple[tuple[str, arb_mat], ...]
    constant: arb_mat


class Form(NamedTuple):
    """P of a location at a node: Σ SᵀVS + Σ number · matrix, with named V and numbers."""

    parts: tuple[tuple[str, arb_mat], ...]
    scalars: tuple[tuple[str, arb_mat], ...]


def thresholds(loop: Loop, rate: arb) -> tuple[arb, arb]:
    """Return c and f with c² f₁² + f² f₂² at least the square of the threshold.

    Without f₁ the threshold is at most the constant max(c, f).
    """
    rule = loop.rule
    return (rule.level, rule.floor) if loop.has_decaying_unit(rate) else (arb(0), rule.level.max(rule.floor))


class Model:
    """The hybrid system of a loop.

    Args:
        loop: the loop.
        rate: r ≥ 0 in f₁ = e^{−rt}, in 1/s.
        decay: ν in dV/dt ≤ −νV, in 1/s.
        errors: what is assumed of e_s, if it is used. With a held input H = 0, so w does not move and is then
            bounded, too: by as many times as much as updates are missing.
        noise: bounds of n; by default those without an observer.
        later: most events within d after an event.
        later_at_start: most events after the one at t = 0 before the first input acts.
        pieces: of the period of a periodic rule, or of the time between tests, on which P is affine.
        by_tests: V depends on where each update is at each test, which is at an exact time.
        counted: V depends on the number of silent tests since the last event, up to so many.
        blocks: V has no products of an update on its way with other states. Then flows split into blocks.
        is_exact: with False a coarse approximation of K e^{−Hs} replaces its hull, for a search.
    """

    def __init__(
        self,
        loop: Loop,
        rate: arb,
        decay: arb,
        errors: Errors | None = None,
        noise: Noise | None = None,
        *,
        later: int = 0,
        later_at_start: int = 0,
        pieces: int = 1,
        by_tests: bool = False,
        counted: int = 0,
        blocks: bool = False,
        is_exact: bool = True,
    ) -> None:
        self.loop, self.rate, self.decay, self.errors = loop, rate, decay, errors
        self.later, self.is_exact = later, is_exact
        self.counted = counted
        self._blocks = blocks and not loop.rule.negative.nrows()
        self.later_at_start = later_at_start
        self.is_periodic = loop.times.period > 0
        self._pieces, self.memory = pieces, loop.rule.memory
        self._places = None
        if loop.rule.integrates:
            raise ValueError("a rule that integrates has no forms")
        if loop.needs_tests_apart and not loop.times.sampling == loop.times.least_sampling > 0:
            raise ValueError("forms for a dwell time need tests that are a known time apart")
        if by_tests or loop.needs_tests_apart:
            self._places = Places(loop.losses, loop.times, later, later_at_start, counted)
        self._clock = self._clock_nodes(pieces) if self.is_periodic else []
        n, copies = loop.n, max(later, later_at_start)
        seen = loop.seen if self._places is not None else None
        self.sees_all = seen is None
        self._seen = identity(n) if seen is None else seen
        q, lift = self._seen.nrows(), self._right_inverse()
        if noise is None and loop.observer is not None:
            raise ValueError("noise: that of the observer is missing")
        self.bounds = noise = noise or loop.plain_noise
        smooth = range(n + (2 + copies) * q, n + (2 + copies) * q + noise.smooth.rates.nrows())
        self.sources = range(smooth.stop, smooth.stop + noise.columns.ncols())
        memories = range(self.sources.stop, self.sources.stop + 2 * (self.memory is not None))
        self.size = memories.stop + 2
        every = identity(self.size)
        self.x = rows_of(every, range(n))
        self.error_rows = [rows_of(every, range(i, i + q)) for i in range(n, smooth.start, q)]
        self._error, self.w, *self.v = (
            self.error_rows if seen is None else [lift * e for e in self.error_rows]
        )
        self.s, self.p = rows_of(every, smooth), rows_of(every, self.sources)
        self.moving = rows_of(self.x, range(n - loop.loads))
        self._decaying = noise.smooth.columns * self.s if smooth else 0 * self.x
        self.y, self.next_y = rows_of(every, memories[:1]), rows_of(every, memories[1:])
        self.e = self._error + self._decaying if smooth else self._error
        self.f1, self.f2 = (rows_of(every, [self.size - 2 + i]) for i in range(2))
        self.noise = 1 * self._decaying
        if self.sources:
            self.noise += noise.columns * self.p
        units = [self.f1] * noise.decaying + [self.f2] * len(self.sources)
        bounds = zip(self.sources, units, strict=False)
        self.noise_bounds = tuple(square(rows_of(every, [i])) - square(unit) for i, unit in bounds)
        self._has_f1 = loop.has_decaying_unit(rate)
        self.level, self.floor = thresholds(loop, rate)
        self.silent = self._comparison(self.level, self.floor)
        self.guards = self._event_guards()
        self._forms: dict[tuple[int, int], Form] = {}
        self.locations = self._locations() if self._places is None else self._locations_by_tests(self._places)
        self.edges = self._edges() if self._places is None else self._edges_by_tests(self._places)

    # The system.

    def _right_inverse(self) -> arb_mat:
        """Return R with GR = 1: e may be taken for R G e."""
        G = self._seen
        return transpose(G) * (G * transpose(G)).inv() if not self.sees_all else G

    def _reduced(self, errors: arb_mat) -> arb_mat:
        return errors if self.sees_all else self._seen * errors

    def _event_guards(self) -> Mapping[str, arb_mat]:
        """Return by unit what is ≤ 0 at events: that the rule's comparison exceeds the unit's threshold.

        Only with the guard of a unit does an edge leave room for a constant c of this unit that differs
        between locations. Where it is missing, all locations have the same c, and edges use no facts.
        """
        return {} if self.loop.rule.always else self.exceeded()

    def exceeded(self) -> Mapping[str, arb_mat]:
        """Return by unit what is ≤ 0 where the rule's comparison exceeds the unit's threshold."""
        rule, found = self.loop.rule, {}
        if rule.positive.nrows():
            if bool(self.rate == rule.rate) and rule.level > 0 and self._has_f1:
                found["c1"] = -1 * self._comparison(rule.level, arb(0))
            if rule.floor > 0 and bool(self.floor == rule.floor):
                found["c2"] = -1 * self._comparison(arb(0), rule.floor)
            if not found:
                found[""] = -1 * self._comparison(arb(0), rule.floor)
        return found

    def _comparison(self, level: arb, floor: arb) -> arb_mat:
        """Return ‖P z‖² − ‖N z‖² − c² f₁² − f² f₂² of what is measured."""
        rule = self.loop.rule
        form = self._measured(rule.positive) - self._measured(rule.negative) - square(self.y)
        return form - level**2 * square(self.f1) - floor**2 * square(self.f2)

    def _measured(self, rows: arb_mat) -> arb_mat:
        """Return the square of some rows of a measurement and its error."""
        return square(rows * self.pair) if rows.nrows() else zeros(self.size, self.size)

    @property
    def pair(self) -> arb_mat:
        """A measurement, and its error."""
        error = self.e - self.noise
        return stack([self.x + self.noise, self.loop.gain * error if self.loop.rule.of_input else error])

    def threshold_squared(self) -> arb_mat:
        """Return c² f₁² + f² f₂², at least the square of the threshold."""
        return self.level**2 * square(self.f1) + self.floor**2 * square(self.f2)

    def _locations(self) -> list[Location]:
        losses, times = self.loop.losses, self.loop.times
        flows = self._flows(self._gains())
        tested: tuple[arb, ...] = (arb(0), arb(times.sampling)) if times.sampling > 0 else (arb(0),)
        silent = () if times.sampling > 0 or self.is_periodic else (self.silent, *self.noise_bounds)
        if self.is_periodic:
            tested = self._nodes_until(times.period)
        assumed = self._assumed() if times.sampling > 0 else ()
        if assumed and not self.is_guarded:
            tested = (arb(0),)  # an input may act at any time after a test, and leaves all c as they are
        found = []
        for lost in range(losses + 1):
            facts = assumed + (self._missing(lost) if lost else ())
            coordinates = self._coordinates(lost > 0 and not self.is_periodic, 0)
            found.append(Location(f"{lost} lost", coordinates, tested, flows, facts, silent, True))
        for later in range(self._waiting):
            facts, nodes = self._missing(losses + later + 1), self._time_to(times.delay, later)
            facts += self._assumed()
            name, coordinates = f"{later} later", self._coordinates(True, later)
            found.append(Location(name, coordinates, nodes, flows, facts, (), False))
        if times.start > 0:
            no_input = self._flows([0 * self.loop.gain], self._before_input())
            for later in range(self.later_at_start + 1):
                name, coordinates = f"start, {later} later", self._coordinates(False, later)
                nodes = self._time_to(times.start, later)
                found.append(Location(name, coordinates, nodes, no_input, (), (), False))
        return found

    def _clock_nodes(self, pieces: int) -> list[fmpq]:
        """Return the nodes of a periodic rule's clock, from 0 to its largest period.

        Between the times at which a location may begin or end to have an edge each node is at most a
        piece after the one before. Of two such times that are close to each other one is left out.
        """
        times, (zero, last) = self.loop.times, (fmpq(0), self.loop.times.period)
        ends = {times.least_period}
        ends |= {times.delay - later * times.least_period for later in range(self.later + 1)}
        ends |= {times.start - later * times.least_period for later in range(self.later_at_start + 1)}
        marks = [zero]
        for end in sorted(ends):
            if min(end - marks[-1], last - end) > last / _CLOSE:
                marks.append(end)
        nodes = [zero]
        for begin, end in zip(marks, [*marks[1:], last], strict=True):
            count = max(int(((end - begin) * pieces / last).ceil()), 1)
            nodes += [begin + (end - begin) * k / count for k in range(1, count + 1)]
        return nodes

    def _nodes_until(self, end: fmpq) -> tuple[arb, ...]:
        """Return the clock's nodes up to the first one that is not before a time, at least two."""
        count = sum(node < end for node in self._clock[:-1]) + 1
        return tuple(arb(node) for node in self._clock[: max(count, 2)])

    def _time_to(self, end: fmpq, later: int) -> tuple[arb, ...]:
        """Return the nodes of a location in which an update with so many later ones acts before a time.

        The time counts from its event, a periodic rule's clock from the last one.
        """
        if self.is_periodic:
            return self._nodes_until(end - later * self.loop.times.least_period)
        return arb(0), arb(end)

    def _event_pairs(self, nodes: tuple[arb, ...]) -> tuple[tuple[int, int], ...]:
        """Return an event's pairs of nodes: it sets the clock since the last test, or event, to 0."""
        first = 0
        if self.is_periodic:
            first = sum(node <= self.loop.times.least_period for node in self._clock) - 1
        return tuple((node, 0) for node in range(first, len(nodes)))

    def _coordinates(self, has_w: bool, copies: int) -> tuple[int, ...]:
        """Return those of x, e, w, some v and the units."""
        n, first = self.loop.n, self.size - 2
        units = ([first] if self._has_f1 else []) + ([first + 1] if self.loop.needs_constant else [])
        q, s = self._seen.nrows(), self.sources.start - self.s.nrows()
        w, v = range(n + q, n + 2 * q) if has_w else range(0), range(n + 2 * q, n + (2 + copies) * q)
        known = (*range(n - self.loop.loads), *range(n, n + q), *w, *v, *range(s, self.sources.start))
        return (*known, *range(self.sources.stop, first)[:1], *units)

    @property
    def is_guarded(self) -> bool:
        """Whether events have a guard in each unit, so that locations have a c of their own."""
        return self._units() <= set(self.guards)

    def _units(self) -> set[str]:
        """Return the names of c of all units."""
        return ({"c1"} if self._has_f1 else set()) | ({"c2"} if self.loop.needs_constant else set())

    def _assumed(self) -> tuple[arb_mat, ...]:
        """Return ‖W e_s‖² minus its bound, if one is assumed."""
        return self.at_most(self.e, arb(1))

    def _missing(self, updates: int) -> tuple[arb_mat, ...]:
        """Return ‖W w‖² minus its bound with some missing updates, if the input is held: w does not move."""
        return self.at_most(self.w, arb(updates)) if self.loop.holds else ()

    def at_most(self, error: arb_mat, factor: arb) -> tuple[arb_mat, ...]:
        """Return ‖W error‖² minus a multiple of what is assumed of ‖W e_s‖², if that is."""
        if self.errors is None:
            return ()
        assumed = self.errors.decaying**2 * square(self.f1) + self.errors.constant**2 * square(self.f2)
        return (square(self.loop.weight * error) - factor**2 * assumed,)

    def _gains(self) -> list[arb_mat]:
        """Return matrices in whose hull K e^{−Hs} is, for all ages s, which are −lead at least.

        On each part [a, a + q] it is a Taylor polynomial of degree d, up to q^{d+1}/(d+1)! ·
        sup|K H^{d+1} e^{−Hs}|, and the polynomial is in the hull of its Bézier points
        b_i = Σ_{k ≤ i} C(i, k)/C(d, k) q^k t_k, with t_k its coefficients.
        """
        K, H, lead = self.loop.gain, self.loop.H, arb(self.loop.times.lead)
        span = lead + arb(self.loop.times.age)
        if self.loop.holds or not span > 0:
            return [K]
        first = K * (lead * H).exp() if lead > 0 else K
        if not self.is_exact:  # a parabola through three points
            middle, end = first * (-span / 2 * H).exp(), first * (-span * H).exp()
            return [first, 2 * middle - (first + end) / 2, end]
        for parts in (1, 2, 4, 8):
            q = span / parts
            found = [_corners(first * (-part * q * H).exp(), H, q, DEGREE) for part in range(parts)]
            if max(float(rest.abs_upper()) for _, rests in found for rest in rests.entries()) < SMALL:
                break
        return [point + rests for points, rests in found for point in points]

    def _before_input(self) -> tuple[UnknownSignal, ...]:
        """Return what pushes x until an input acts: e^{r·start} f₁ or f₂ times it is at least it."""
        loop = self.loop
        if loop.push_before_input is None or is_zero(loop.push_before_input):
            return ()
        unit = self.f2 if loop.needs_constant else (self.rate * loop.times.start).exp() * self.f1
        return (UnknownSignal(self._push(loop.push_before_input), unit),)

    def _flows(
        self, gains: list[arb_mat], further: tuple[UnknownSignal, ...] = ()
    ) -> tuple[ContinuousFlow, ...]:
        loop, H = self.loop, self.loop.H
        found = []
        for gain in gains:
            u = gain * (self.x + self.e + self.w)
            velocity = loop.A * self.x + loop.B * u
            error, smooth = H * (self.x + self.e) - velocity, self.s
            copies = (H * v for v in self.v)
            if self.s.nrows():
                smooth = self.bounds.smooth.rates * self.s
                error -= self.bounds.smooth.columns * smooth
            units = 0 * self.p, 0 * self.y, 0 * self.next_y, -self.rate * self.f1, 0 * self.f2
            moved = [self._reduced(each) for each in (error, H * self.w, *copies)]
            matrix = stack([velocity, *moved, smooth, *units])
            found.append(
                ContinuousFlow(matrix, (*(signal.scaled for signal in self.signals(u)), *further), u)
            )
        return tuple(found)

    def signals(self, u: arb_mat) -> Iterator[Signal]:
        """Yield what moves x in an unknown way: entries of A and B, and disturbances."""
        loop, n = self.loop, self.loop.n
        for half, signal in ((loop.half_A, self.x), (loop.half_B, u)):
            for i in range(half.nrows()):
                for k in range(half.ncols()):
                    if half[i, k] == 0:  # false for a ball around 0
                        continue
                    column = self._push(columns_of(identity(n), [i]))
                    yield Signal(column, rows_of(signal, [k]), half[i, k], None)
        for index, size in enumerate(loop.sizes):
            column, along = self._push(columns_of(loop.pushes, [index])), None
            if loop.along and not is_zero((known := loop.along[index]).row):
                along = Along(known.row * stack([self.x, u]), known.least)
            yield Signal(column, self.f2, size, along)

    def _push(self, column: arb_mat) -> arb_mat:
        """Return the column of ż for one of ẋ."""
        return transpose(self.x) * column - transpose(self.error_rows[0]) * self._reduced(column)

    @property
    def _waiting(self) -> int:
        """The number of locations with an update on its way."""
        return self.later + 1 if self.loop.times.delay > 0 else 0

    def _edges(self) -> list[Edge]:
        losses = self.loop.losses
        event = (*self.guards.values(), *self.noise_bounds)
        delivered = self.jump(self.noise, 0 * self.w, ())
        sent = self.jump(self.noise, self.w + self.e - self.noise, ())
        lost = self.jump(self.e, self.w, ()) if self.is_periodic else sent
        tests = self._event_pairs(self.locations[0].nodes)
        found = []
        for j in range(losses + 1):
            if self._waiting:
                found.append(Edge(f"{j} lost, sent", j, losses + 1, tests, sent, event, True))
            else:
                found.append(Edge(f"{j} lost, delivered", j, 0, tests, delivered, event, True))
            if j < losses:
                found.append(Edge(f"{j} lost, lost", j, j + 1, tests, lost, event, True))
            if self.has_silent_edges:
                silent, stays = (self.silent, *self.noise_bounds), identity(self.size)
                found.append(Edge(f"{j} lost, silent", j, j, ((1, 0),), stays, silent, True))
        for later in range(self._waiting):
            found += self._on_its_way(losses + 1 + later, later, self.later)
        if self.loop.times.start > 0:
            first = losses + 1 + self._waiting
            for later in range(self.later_at_start + 1):
                found += self._on_its_way(first + later, later, self.later_at_start)
            for later in range(self.later_at_start):
                name = f"start, {later} later, event"
                pairs = self._events_while_waiting(first + later)
                found.append(Edge(name, first + later, first, pairs, delivered, event, True))
        return found

    def _on_its_way(self, source: int, later: int, most: int) -> Iterator[Edge]:
        """Yield the edges of a location in which an update is on its way that has so many later ones."""
        losses, name = self.loop.losses, self.locations[source].name
        if later < most:
            event, added = (*self.guards.values(), *self.noise_bounds), self.e - self.noise
            jump = self.jump(self.noise, self.w + added, [v + added for v in self.v[:later]] + [added])
            pairs = self._events_while_waiting(source)
            yield Edge(f"{name}, event", source, source + 1, pairs, jump, event, True)
        w, others = (self.v[0], self.v[1:later]) if later else (0 * self.w, [])
        if later <= losses:
            jump = self.jump(self.e + w, 0 * w, ()) if self.is_periodic else self.jump(self.e, w, ())
            yield self._arrival(f"{name}, all lost", source, later, jump)
        for following in range(min(later, self._waiting)):
            jump = self.jump(self.e, w, others[len(others) - following :])
            yield self._arrival(f"{name}, {following} later", source, losses + 1 + following, jump)

    def _events_while_waiting(self, location: int) -> tuple[tuple[int, int], ...]:
        """Return the pairs of nodes of an event: its clock goes on, or is one since the last event."""
        return self._event_pairs(self.locations[location].nodes) if self.is_periodic else ((0, 0), (1, 1))

    def _arrival(self, name: str, source: int, target: int, jump: arb_mat) -> Edge:
        """Return the edge of the first input with an update: a periodic rule's clock is as it was."""
        nodes, target_nodes = (range(len(self.locations[index].nodes)) for index in (source, target))
        pairs = tuple((node, target_node) for node in nodes for target_node in target_nodes)
        if self.is_periodic:
            pairs = tuple(zip(nodes, target_nodes, strict=False))
        return Edge(name, source, target, pairs, jump, (), False)

    def jump(self, e: arb_mat, w: arb_mat, v: Sequence[arb_mat]) -> arb_mat:
        """Return z after a jump; other vectors than these become 0."""
        rest = [0 * self.w] * (len(self.v) - len(v))
        error = e - self._decaying if self.s.nrows() else e
        errors = [self._reduced(each) for each in (error, w, *v, *rest)]
        return stack([self.x, *errors, self.s, self.p, self.y, self.next_y, self.f1, self.f2])

    # Tests at exact times.

    @property
    def is_by_tests(self) -> bool:
        """Whether V depends on where each update is at each test."""
        return self._places is not None

    def silent_tests(self, location: int) -> int:
        """Return how many silent tests were counted since the last event."""
        return 0 if self._places is None else self._places.places[location].silent

    def _locations_by_tests(self, places: Places) -> list[Location]:
        flows = self._flows(self._gains())
        no_input = self._flows([0 * self.loop.gain], self._before_input())
        found = []
        for place in places.places:
            nodes = tuple(arb(node) for node in places.nodes(place, self._pieces))
            coordinates = self._coordinates(
                place.has_input and (place.lost > 0 or bool(place.ages)), place.later
            )
            moves = flows if place.has_input else no_input
            found.append(Location(self._place_name(place), coordinates, nodes, moves, (), (), False))
        return found

    def _place_name(self, place: PlaceAtTest) -> str:
        """Return "1 lost", or "1 later, 2 0 tests ago": the times since the events on their way."""
        parts = [f"{place.later} later" if place.ages else f"{place.lost} lost"]
        if not place.has_input:
            parts.insert(0, "start")
        if place.ages:
            ages = (float(arb(age / self.loop.times.sampling)) for age in place.ages)
            parts.append(f"{' '.join(f'{age:g}' for age in ages)} tests ago")
        if place.silent:
            parts.append(f"an event {place.silent} tests ago")
        return ", ".join([*parts, "dwells"] if place.dwells else parts)

    def _edges_by_tests(self, places: Places) -> list[Edge]:
        found = []
        indices = {place: index for index, place in enumerate(places.places)}
        for move in places.moves:
            source, target = indices[move.source], indices[move.target]
            name = f"{self.locations[source].name}, {move.kind}, {self.locations[target].name}"
            nodes, others = self.locations[source].nodes, self.locations[target].nodes
            pairs: tuple[tuple[int, int], ...] = ((len(nodes) - 1, 0),)
            if move.kind == "arrival":
                pairs = tuple((node, node) for node in range(min(len(nodes), len(others))))
            facts = self._facts_of_test(move)
            jump, is_test = self._jump_of(move), move.kind != "arrival"
            if self.memory is None or not is_test:
                found.append(Edge(name, source, target, pairs, jump, facts, is_test))
                continue
            until = places.clock_end(move.target)
            following = self._next_memory(self.memory, until, resets=move.is_event)
            grown, none = (*facts, -1 * following), (*facts, following)
            found.append(Edge(name, source, target, pairs, jump, grown, is_test, following))
            nothing = zeros(self.size, self.size)
            found.append(Edge(f"{name}, none", source, target, pairs, jump, none, is_test, nothing))
        return found

    def _facts_of_test(self, move: Move) -> tuple[arb_mat, ...]:
        if move.kind == "arrival":
            return ()
        if move.is_event:
            return (*self.guards.values(), *self.noise_bounds)
        return (self.silent, *self.noise_bounds)

    def _jump_of(self, move: Move) -> arb_mat:
        """Return what becomes of z; see the edges of loops whose tests may be at any time."""
        place, added = move.source, self.e - self.noise
        if move.kind == "silent":
            return identity(self.size)
        if move.kind == "arrival":
            w = self.v[0] if place.later else 0 * self.w
            return self.jump(self.e, w, self.v[place.later - move.target.later : place.later])
        if move.kind in ("delivered", "first"):
            return self.jump(self.noise, 0 * self.w, ())
        copies = [*(v + added for v in self.v[: place.later]), added] if move.kind == "later" else []
        return self.jump(self.noise, self.w + added, copies)

    def _next_memory(self, memory: Memory, until: fmpq, *, resets: bool) -> arb_mat:
        """Return η at the next test, with y² for η, as a form of z at this one, before an event.

        ``resets``: the test is an event, after which the measurement has no error.
        """
        eta, decay = square(self.y), (-1 * memory.decay * until).exp()
        gained = arb(until) if memory.decay == 0 else (1 - decay) / memory.decay
        n, pair = self.loop.n, self.pair
        if resets:
            pair = stack([rows_of(pair, range(n)), zeros(pair.nrows() - n, self.size)])
        return decay * eta + gained * (transpose(pair) * memory.gain * pair)

    def memory_after_test(self, *, resets: bool) -> arb_mat:
        """Return the form of η after a test, which may be an event; 0 for a rule without a memory."""
        if self.memory is None:
            return zeros(self.size, self.size)
        return self._next_memory(self.memory, self.loop.times.sampling, resets=resets)

    @property
    def memory_at_start(self) -> float:
        """The root of η(0), before the first test."""
        return 0.0 if self.memory is None else float(self.memory.start.sqrt().mid())

    @property
    def has_silent_edges(self) -> bool:
        """Whether V has to be shown not to grow at a silent test."""
        changes = len(self.locations[0].nodes) > 1 and not self.is_periodic
        return bool(self.sources) and changes and self.loop.rule.positive.nrows() > 0

    # The quadratic forms.

    def form(self, location: int, node: int) -> Form:
        """Return P of a location at a node, in the location's coordinates.

        P is that of xᵀXx + (e, w)ᵀQ(e, w) − c₁ f₁² − c₂ f₂² − a θ·(comparison), with X common to all
        locations: then x drops out of the edges, and a silent test at θ leaves V as it is where the
        comparison is ≤ 0, since a ≥ 0. With s it is (x, s)ᵀX(x, s), and e − Ss for e. With noise each of the
        comparison's four terms has an a of its own, and there is an inequality for silent tests.
        Waiting locations have Q, c₁ and c₂ for each node. Where an event's guard contains x, each location
        has a form of x, e and w of its own, and with a periodic rule each node of each location.
        """
        if (location, node) not in self._forms:
            new = self._new_form if self._places is None else self._form_by_tests
            self._forms[location, node] = new(location, node)
        return self._forms[location, node]

    def _new_form(self, location: int, node: int) -> Form:
        place = self.locations[location]
        rule, E = self.loop.rule, columns_of(identity(self.size), place.coordinates)
        errors = stack([f for f in self.error_rows if not is_zero(f * E)])
        by_node = self.is_periodic or not place.is_tested
        own = f"{place.name}, {node}" if by_node else place.name
        starts = place.name.startswith("start")
        X = f"X/start, {node}" if starts else "X"
        later = self.later_of(location) if self._blocks else 0
        present = [f for f in self.error_rows if not is_zero(f * E)]
        kept = len(present) - later
        parts: tuple[tuple[str, arb_mat], ...] = (
            (X, stack([self.moving, self.s]) * E),
            (f"Q/{own}", stack(present[:kept]) * E),
            *((f"V{k}/{own}", f * E) for k, f in enumerate(present[kept:], 1)),
        )
        if rule.negative.nrows() or self.is_periodic:
            parts = ((f"P/{own}", stack([self.moving, self.s, errors]) * E),)
        units = [(name, f) for name, f in (("c1", self.f1), ("c2", self.f2)) if not is_zero(f * E)]
        scalars = []
        for name, f in units:
            common = f"{name}/start, {node}" if starts else name
            is_own = name in self.guards or self.is_periodic
            scalars.append((f"{name}/{own}" if is_own else common, -1 * square(f * E)))
        if place.is_tested and node and rule.positive.nrows():
            compared = {"": self.silent}
            if self.has_silent_edges:
                compared = {"": self._measured(rule.positive), "/N": -1 * self._measured(rule.negative)}
                sizes = ("c1", self.f1, self.level), ("c2", self.f2, self.floor)
                compared |= {f"/{name}": -1 * square(f) for name, f, size in sizes if size > 0}
            for name, M in compared.items():
                if not is_zero(transpose(E) * M * E):
                    scalars.append((f"a/{own}{name}", -1 * place.nodes[node] * transpose(E) * M * E))
        return Form(parts, tuple(scalars))

    def _form_by_tests(self, location: int, node: int) -> Form:
        """Return P + T P' of (x, s, e, w, …) with P common to all places with as many lost or later updates.

        T is the time to the next test, and P' belongs to the node. So all matrices of a witness are about
        as large, however small T is. The same holds for the coefficients of f₁², f₂² and y².
        """
        place, names = self.locations[location], self.names_by_tests(location, node)
        E = columns_of(identity(self.size), place.coordinates)
        rows = stack([self.x, self.s, *(f for f in self.error_rows if not is_zero(f * E))]) * E
        squares = [("c1", -1 * square(self.f1 * E)), ("c2", -1 * square(self.f2 * E))]
        squares = [(letter, M) for letter, M in squares if not is_zero(M)]
        if self.memory is not None:
            squares.append(("eta", square(self.y * E)))
        parts = tuple((f"P/{name}", size.sqrt() * rows) for name, size in names)
        scalars = [(f"{letter}/{name}", size * M) for letter, M in squares for name, size in names]
        if self.counted:  # without a threshold one c₁ is as good as others
            scalars = [s for s in scalars if not s[0].startswith("c1")] + [("c1", -1 * square(self.f1 * E))]
        return Form(parts, tuple(scalars))

    def names_by_tests(self, location: int, node: int) -> list[tuple[str, arb]]:
        """Return the names of P and P', with their factors; of P alone where it is first used.

        Where no update is on its way, P' is affine in the number of silent tests, between :func:`_knots`.
        """
        place, kinds = self.locations[location], [_kind(each.name) for each in self.locations[: location + 1]]
        common = (kinds[-1], arb(1))
        if node == 0 and kinds.count(kinds[-1]) == 1:
            return [common]
        if not (silent := self.silent_tests(location)) or " ago, " in place.name:
            return [common, (f"{place.name}, {node}", place.nodes[-1])]
        low, high = _knots(silent, self.counted)
        share = arb(silent - low) / max(high - low, 1)
        around = ((low, 1 - share), (high, share))
        names = ((f"{kinds[-1]}, {knot} silent, {node}", s * place.nodes[-1]) for knot, s in around if s > 0)
        return [common, *names]

    def block_sizes(self, location: int) -> list[int]:
        """Return the sizes of the forms of updates on their way that have no products with other states."""
        return [self._seen.nrows()] * self.later_of(location) if self._blocks else []

    def later_of(self, location: int) -> int:
        """Return how many updates were sent after the one on its way; 0 in other locations."""
        name = self.locations[location].name.removeprefix("start, ")
        return int(name.split(" ")[0]) if name.endswith(" later") else 0

    # The inequalities.

    def inequalities(self, output: str, *, starts: bool) -> Iterator[Inequality]:
        """Yield the inequalities that prove a bound of an output: see :meth:`output`.

        ``starts``: from the loop's start on; else in the limit t → ∞.
        """
        yield from self.common_inequalities()
        yield from self.output_inequalities(output)
        if starts:
            yield self.start_inequality()

    def common_inequalities(self) -> Iterator[Inequality]:
        """Yield those of flows and edges, which are the same for all outputs, and affine in ν."""
        for index in range(len(self.locations)):
            yield from self._by_blocks(self._flow_inequalities(index))
        for edge in self.edges:
            yield from self._edge_inequalities(edge)
        if self.memory is not None:
            yield from (self._memory_inequality(index) for index in range(len(self.locations)))

    @staticmethod
    def _by_blocks(items: Iterable[Inequality]) -> Iterator[Inequality]:
        """Yield inequalities without the forms of updates on their way, and one for each of these forms.

        Nothing else has the states of such an update, which move on their own: the matrix is block diagonal.
        It is the same one for all corners.
        """
        for item in items:
            blocks = {part.name for part in item.parts if part.name.startswith("V")}
            yield item._replace(parts=tuple(part for part in item.parts if part.name not in blocks))
            kinds = sorted({name.split("/")[0] for name in blocks})
            for kind in kinds if item.name.endswith("/0") else []:
                parts = tuple(part for part in item.parts if part.name.split("/")[0] == kind)
                yield item._replace(
                    name=f"{item.name}, {kind}", parts=parts, scalars=(), constant=0 * item.constant
                )

    def _memory_inequality(self, index: int) -> Inequality:
        """The coefficient of y² after a test is at least 0."""
        terms = _Terms(1)
        self._add_memory(terms, index, 0, identity(1))
        return terms.inequality(f"memory/{self.locations[index].name}", index, -1)

    def _add_memory(self, terms: "_Terms", location: int, node: int, M: arb_mat) -> None:
        """Add the coefficient of y² times M."""
        for name, size in self.names_by_tests(location, node):
            terms.scalar(f"eta/{name}", size * M)

    def output_inequalities(self, output: str) -> Iterator[Inequality]:
        """Yield those of an output; the drift has none before the first input."""
        for index, place in enumerate(self.locations):
            if not place.name.startswith("start") or output != "drift":
                yield from self._by_blocks(self._output_inequalities(index, output))

    def _flow_inequalities(self, index: int) -> Iterator[Inequality]:
        """dV/dt + νV ≤ Σ m q + Σ τ (|p|² − |Rz|²), at both ends of each piece of θ."""
        place = self.locations[index]
        E0 = self._columns(place, with_noise=bool(place.silent))
        last = len(place.nodes) - 1
        for piece in range(max(last, 1)):
            for end in (piece, piece + 1) if last else (0,):
                for corner, flow in enumerate(place.flows):
                    k = len(flow.unknowns)
                    E = beside(identity(E0.ncols()), zeros(E0.ncols(), k))
                    motion = flow.matrix * E0
                    for unknown in flow.unknowns:
                        motion = beside(motion, unknown.column)
                    F, z = rows_of(motion, place.coordinates), rows_of(E0 * E, place.coordinates)
                    terms = _Terms(E.ncols())
                    terms.add(self.form(index, end), z, F, arb(-1))
                    terms.add(self.form(index, end), z, z, -self.decay / 2)
                    if last:
                        length = place.nodes[piece + 1] - place.nodes[piece]
                        terms.add(self.form(index, piece + 1), z, z, -1 / length / 2)
                        terms.add(self.form(index, piece), z, z, 1 / length / 2)
                    name = f"flow/{place.name}/{end}"
                    terms.facts(f"m/{name}", place.silent + place.facts, E0 * E)
                    self._add_signals(terms, f"m/{name}", flow.unknowns, E0 * E)
                    yield terms.inequality(f"{name}/{corner}", index, k)

    def output(self, name: str, place: Location) -> list[tuple[arb_mat, ContinuousFlow | None]]:
        """Return C of an output in a location, for each flow if the output depends on the flow.

        "x" is x, "x[i]" one of its entries, "u[j]" one of the input, "y[j]" the j-th output, "e_s" and
        "e_c" are W e_s and W e_c, and
        "drift" is W (ẋ − H x), by which the sensor's error grows: ė = He − (ẋ − Hx). With an error Ss of an
        observer it is that of e − Ss: s is left out of it. The bound of the drift is one from the first
        input on.
        """
        loop = self.loop
        if name == "x":
            return [(self.x, None)]
        if name == "e_s":
            return [(loop.weight * self.e, None)]
        if name == "e_c":
            return [(loop.weight * (self.e + self.w), None)]
        if name == "drift":
            known = loop.H * self.x
            if self.s.nrows():
                known += (
                    loop.H * self.bounds.smooth.columns
                    - self.bounds.smooth.columns * self.bounds.smooth.rates
                ) * self.s
            return [(self._drift(flow.matrix) - loop.weight * known, flow) for flow in place.flows]
        index = int(name[2:].removesuffix("]"))
        if name.startswith("u["):
            return [(rows_of(flow.input, [index]), None) for flow in place.flows]
        row = rows_of(loop.output_rows if name.startswith("y[") else identity(loop.n), [index])
        return [(row * self.x, None)]

    def _drift(self, motion: arb_mat) -> arb_mat:
        return self.loop.weight * rows_of(motion, range(self.loop.n))

    def _output_inequalities(self, index: int, output: str) -> Iterator[Inequality]:
        """|Cz + Σ C p|² ≤ D₁² f₁² + D₂² f₂² + V + Σ m q + Σ τ (|p|² − |Rz|²)."""
        place = self.locations[index]
        E0 = self._columns(place, with_noise=bool(place.silent))
        for node in range(len(place.nodes)):
            for corner, (C, flow) in enumerate(self.output(output, place)):
                unknowns = flow.unknowns if flow is not None else ()
                E = beside(identity(E0.ncols()), zeros(E0.ncols(), len(unknowns)))
                terms, z = _Terms(E.ncols()), rows_of(E0 * E, place.coordinates)
                terms.add(self.form(index, node), z, z, arb(1) / 2)
                for level, f in (("level 1", self.f1), ("level 2", self.f2)):
                    if not is_zero(f * E0):
                        terms.scalar(level, square(f * E0 * E))
                name = f"output/{place.name}/{node}"
                terms.facts(f"m/{name}", place.silent + place.facts, E0 * E)
                whole = C * E0
                for unknown in unknowns:
                    whole = beside(whole, self._drift(unknown.column))
                self._add_signals(terms, f"m/{name}", unknowns, E0 * E)
                terms.constant = -1 * square(whole)
                yield terms.inequality(f"{name}/{corner}", index, len(unknowns))

    def _add_signals(
        self, terms: "_Terms", name: str, unknowns: tuple[UnknownSignal, ...], E: arb_mat
    ) -> None:
        """Add Σ τ (|p|² − |Rz|²) + m (k p² − p·Cz) of the last coordinates, p."""
        size = E.ncols()
        for signal, unknown in enumerate(unknowns):
            one = zeros(1, size)
            one[0, size - len(unknowns) + signal] = 1
            terms.scalar(f"{name}/signal {signal}", square(one) - square(unknown.rows * E))
            if unknown.along is not None:
                product = transpose(one) * (unknown.along.row * E)
                known = 2 * unknown.along.least * square(one) - product - transpose(product)
                terms.scalar(f"{name}/along {signal}", known)

    def _edge_inequalities(self, edge: Edge) -> Iterator[Inequality]:
        """V_target(jump z) ≤ V_source(z) + Σ m q.

        That the rule is silent before a test says nothing with another noise at the test.
        """
        source, target = self.locations[edge.source], self.locations[edge.target]
        E = self._columns(source, with_noise=edge.is_test)
        z, motion = rows_of(E, source.coordinates), edge.jump * E
        if edge.memory is not None:
            motion -= transpose(self.y) * self.y * motion
        jump = rows_of(motion, target.coordinates)
        facts = edge.facts
        if self.is_guarded:
            facts += source.facts + (() if self.sources else source.silent)
        for node, target_node in edge.pairs:
            terms = _Terms(E.ncols())
            terms.add(self.form(edge.source, node), z, z, arb(1) / 2)
            terms.add(self.form(edge.target, target_node), jump, jump, arb(-1) / 2)
            if edge.memory is not None:
                after = -1 * (transpose(E) * edge.memory * E)
                self._add_memory(terms, edge.target, target_node, after)
            name = f"edge/{edge.name}/{node} {target_node}"
            terms.facts(f"m/{name}", facts, E)
            yield terms.inequality(name, edge.source, 0)

    def _columns(self, place: Location, *, with_noise: bool) -> arb_mat:
        """Return the columns of a location's coordinates, and of the noise."""
        return columns_of(identity(self.size), (*place.coordinates, *(self.sources if with_noise else ())))

    @property
    def start_location(self) -> int:
        """The location at t = 0."""
        if self._places is not None:
            return self._places.places.index(self._places.start)
        return self.loop.losses + 1 + self._waiting if self.loop.times.start > 0 else 0

    @property
    def start_columns(self) -> arb_mat:
        """z(0) = Z (1, p): e = n at the start."""
        z = transpose(self.x) * self.loop.start + transpose(self.f1) + transpose(self.f2)
        if self.s.nrows():
            z += transpose(self.s) * self.bounds.smooth.start
        if self.sources:
            error = transpose(self.error_rows[0]) * self._reduced(self.bounds.columns)
            z = beside(z, error + transpose(self.p))
        return z

    def clock_of_place(self, location: int) -> fmpq:
        """Return the time from a test to the next one, or until an update on its way has surely acted."""
        if self._places is None:
            raise ValueError("no forms of each test")
        return self._places.clock_limit(self._places.places[location])

    def start_inequality(self) -> Inequality:
        """V(z(0)) ≤ Σ m q: e = n at the start, for all p; η ≥ 0. The columns of z are a constant, and p."""
        index, z = self.start_location, self.start_columns
        at_start = rows_of(z, self.locations[index].coordinates)
        terms = _Terms(z.ncols())
        terms.add(self.form(index, 0), at_start, at_start, arb(-1) / 2)
        if self.memory is not None:
            self._add_memory(terms, index, 0, -1 * self.first_memory())
        terms.facts("m/start", self.noise_bounds, z)
        return terms.inequality("start", index, -1)

    def first_memory(self) -> arb_mat:
        """Return η after the test at t = 0, as a form of the columns of the start."""
        if self.memory is None or self._places is None:
            raise ValueError("a rule without a memory")
        z, root = self.start_columns, self.memory.start.sqrt()
        until = self._places.clock_end(self._places.places[self.start_location])
        Q = self._next_memory(self.memory, until, resets=True)
        z += transpose(self.y) * arb_mat(1, z.ncols(), [root] + [0] * (z.ncols() - 1))
        return transpose(z) * Q * z


def _corners(K: arb_mat, H: arb_mat, q: arb, degree: int) -> tuple[list[arb_mat], arb_mat]:
    """Return the Bézier points of the Taylor polynomial of K e^{−Hs} on [0, q], and balls of the rest."""
    terms = [K]
    for k in range(degree + 1):
        terms.append(terms[-1] * H * (-q / (k + 1)))
    last = terms.pop() * (-1 * upto(q) * H).exp()
    rest = arb_mat(K.nrows(), K.ncols(), [around_zero(v) for v in last.entries()])
    points = []
    for i in range(degree + 1):
        shares = [arb(comb(i, k)) / comb(degree, k) for k in range(i + 1)]
        points.append(sum((share * term for share, term in zip(shares, terms, strict=False)), 0 * K))
    return points, rest


def _knots(count: int, most: int) -> tuple[int, int]:
    """Return the knots around a number of silent tests, from 1 to the most that are counted."""
    low = high = 1
    while high < count:
        low, high = high, min(max(high + 1, high * 4 // 3), most)
    return low, high


def _kind(name: str) -> str:
    """Return "1 lost", "2 later" or "start, 2 later", with ", dwells" after an event with a dwell time."""
    return ", ".join(part for part in name.split(", ") if not part.endswith(" ago"))


def is_same(part: MatrixPart, other: MatrixPart) -> bool:
    """Return whether two parts are exactly equal."""
    return part.name == other.name and part.left == other.left and part.right == other.right


class _Terms:
    """Collects an inequality of some size."""

    def __init__(self, size: int) -> None:
        self.parts: list[MatrixPart] = []
        self.scalars: dict[str, arb_mat] = {}
        self.constant = zeros(size, size)

    def add(self, form: Form, left: arb_mat, right: arb_mat, factor: arb) -> None:
        """Add factor · (leftᵀ P right + rightᵀ P left)."""
        for name, S in form.parts:
            part = MatrixPart(name, factor * (S * left), S * right)
            opposite = MatrixPart(name, -1 * part.left, part.right)
            if any(is_same(opposite, other) for other in self.parts):  # they cancel
                self.parts = [other for other in self.parts if not is_same(opposite, other)]
            else:
                self.parts.append(part)
        for name, M in form.scalars:
            product = factor * (transpose(left) * M * right)
            self.scalar(name, product + transpose(product))

    def scalar(self, name: str, M: arb_mat) -> None:
        """Add number · M."""
        self.scalars[name] = self.scalars[name] + M if name in self.scalars else M

    def facts(self, name: str, facts: Iterable[arb_mat], z: arb_mat) -> None:
        """Add Σ m zᵀQz of facts zᵀQz ≤ 0."""
        for index, fact in enumerate(facts):
            self.scalar(f"{name}/{index}", transpose(z) * fact * z)

    def inequality(self, name: str, location: int, signals: int) -> Inequality:
        """Return what was collected."""
        return Inequality(
            name, location, signals, tuple(self.parts), tuple(self.scalars.items()), self.constant
        )
