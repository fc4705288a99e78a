r"""Bounds by gains: the paper's chain, and a loop of inequalities between suprema.

With p = u − Kx and E = A + BK − H the loop obeys, between events,

    ẋ = (A + BK)x + Bp + ω + Dd,    ė_s = H e_s − (Ex + Bp + ω + Dd),

where ω is what a plant of the box adds, |ω_i| ≤ Σ_j |half_A_ij x_j| + |half_B_ij u_j|. Before the first
input, which acts within t_a, u = 0 and p = −Kx. In coordinates T of the inputs, p stands for Tp, and B for
BT⁻¹. About a reference, −Bu_r is added to ẋ then: one more column, which acts up to t_a.

*Units.* A bound is D₁ f₁ + D₂ f₂, f₁ = e^{−rt} and f₂ = 1. The start and the level of the threshold are of
unit f₁, what is constant of f₂ (and all if f₁ = f₂). Each unit has inequalities of its own. In those of f₁
every signal is multiplied by e^{rt}, and H, A + BK, A stand for these matrices plus r. In a unit let θ be
the part of the threshold, and η that of ‖W n‖, where x + n is what the sensor takes for x.

*The comparison.* A witness names matrices Y, J and S with Q + SᵀS ⪰ (J, I)ᵀ YᵀY (J, I) on (x, e_s), where an
event needs zᵀQz > θ². So a silent test leaves c = ‖Y(e_s − n + J(x + n))‖ with c² ≤ θ² + ‖S(x + n)‖². For
‖W e_s‖² > θ² + ‖Nx‖² these are W, 0 and N. With ‖S(x + n)‖ ≤ s₁f₁ + s₂f₂ and θ ≤ max(θ₁f₁, θ₂f₂) this
bound is convex in f₁ from 0 to 1. So c ≤ c₁f₁ + c₂f₂ if it is so at both ends: c₂ ≥ √(θ₂² + s₂²) and
c₁ + c₂ ≥ √(max(θ₁, θ₂)² + (s₁ + s₂)²). In a single unit c ≤ √(θ² + s²).

*Other rules* are followed as if they were one of these. If events are at most some time apart, as with a
deadline, the rule may be taken for a periodic one of this period. A rule that needs ∫ ‖W(e_s − n)‖ dt > a
may be taken for ‖W(e_s − n)‖ > a/T, for any T, with T for h: in the last T there was an event, or a time at
which ‖W(e_s − n)‖ ≤ a/T, and no event after it. If tests are h' to h apart, the trapezoids of k of them give
a/(kh') for a/T, and (k + 1)h for h.

*After a test* e_s = Y⁻¹y − J(x + n) + n with ‖y‖ ≤ c, or e_s = n if it was an event. So |C e^{Hs} e_s| is
at most the sum b(s) of the bounds of these three parts. The next test is at most h later. With a dwell time
h is the time from an event on in which none is tested. For a periodic rule, which compares nothing, it is
that up to the next event, and e_s = n.

*The controller's error.* Let t_r be the last event whose update acts at t, and v(τ) = e_s(τ) +
Σ e^{H(τ−t_k)} (e_s(t_k⁻) − n_k) over the events in (t_r, τ]. An event does not change v. So v is continuous,
v̇ = Hv − (Ex + Bp + ω + Dd), however close the events are, and v(t) = e_c(t). Let σ = max(t − d, t_r). If it
is t_r, v(σ) = n. Else the events in (t_r, σ] are lost, since they would act in the place of t_r: at most
M − 1. Go back from σ to the test before it, and from each lost event to the test before it. Then

    |C e_c| ≤ g + Σ_q ∫₀^{h+d} |C e^{Hs} q| ds · |q̂|
              + (M − 1) (g' + k η + Σ_q min(h sup |C e^{Hs} q|, k ∫₀ʰ ‖W e^{Hs} q‖ ds) · |q̂|)

with g and g' the suprema of b(s) up to h + d, and for ever, and k that of ‖C e^{Hs} W⁻¹‖ for ever. The sums
are over the columns q of B, D, and of the identity for ω and Ex, with the suprema |q̂| of p, d, ω and Ex. The
integrals are over times that do not overlap. So what p exceeds |p̂| by before the first input adds at most
t_a sup |C e^{Hs} q| times this. Neither times between events nor numbers of updates on their way are assumed.
With a periodic rule t − t_r ≤ Mh + d: v is followed from t_r, and nothing is counted as lost.

*The input* is K e^{−Hs} x_c of an age s, |s| ≤ a: p = K e^{−Hs} e_c − sKHx + ∫₀ˢ (s − τ) K e^{−Hτ} H² x dτ.
With a ball C around K e^{−Hs} for all ages, |p_j| ≤ |C_j e_c| + a |K_j H x| + a²/2 |C_j H² x|.

*The state.* |Cx| ≤ sup |C e^{(A+BK)s} x(0)| + Σ_q ∫ |C e^{(A+BK)s} q| ds · |q̂|. By what p exceeds |p̂|
before the first input, it adds at most t_a sup |C e^{(A+BK)s} q| times this: there p = −Kx, of which
x = e^{At} x(0) + … gives a bound.

*Conclusion.* For each signal these are inequalities v_i(t) ≤ (T v)(t) + g_i(t) with a positive linear T of
the past, which maps y₁f₁ + y₂f₂ to at most F₁y₁ f₁ + F₂y₂ f₂. The solution has y > Fy + g in both units, and
c₁ and c₂ exceed their bounds. Up to a time there are finitely many events (tests are apart; with tests at all
times events are, too: see :mod:`.words`), and all signals are finite. Let λ be the least number with
v ≤ λ(y₁f₁ + y₂f₂) up to this time. If λ > 1, then v ≤ λ(Ty + g), as also √(θ² + λ²s²) ≤ λ√(θ² + s²), is at
most λ(1 − ε)(y₁f₁ + y₂f₂) for an ε > 0: a contradiction. So v ≤ y₁f₁ + y₂f₂, up to any time. Where the plant
is enclosed on a region, this holds up to the time at which x or u would leave it, and there it shows that
they do not: see :mod:`.statement`.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import NamedTuple

from flint import arb, arb_mat, fmpq, fmpq_mat

from noack_gains.balls import (
    beside,
    between,
    columns_of,
    identity,
    is_positive,
    is_zero,
    norm_of,
    rows_of,
    square,
    upper,
    zeros,
)
from noack_gains.document import Document, Loop, Output, Rule
from noack_gains.reading import (
    Matrix,
    RejectedError,
    Table,
    exact_matrix,
    fields,
    mapping,
    rational,
    read_matrix,
    truth,
    whole,
)
from noack_gains.responses import (
    Decay,
    EnclosedResponses,
    Question,
    Response,
    enclose,
    responses,
    responses_until,
)

Form = Mapping[str, arb]
"""Σ coefficient · signal, by the signals' names; "1" is the constant 1."""
_STEPS_OF_GAIN = 200
"""Products with F after which its spectral radius is read, for a message."""
_ROOM = 1e-9
"""By so much, relatively, y exceeds the solution of y = Fy + g."""
_MOST_TESTS = 1_000_000
"""Over which an integral is averaged."""
_MOST_AGES = 12
"""Most lost events whose ages are told apart."""
_REST = 1e-5
"""The share of an integral of an error for ever that is left to the tail: later parts are used, too."""
_CHORDS, _BETTER = 8, 0.999
"""Chords of √(θ² + s²) that are tried, while they are less steep by this factor."""


class Unit(NamedTuple):
    """One of f₁ and f₂, with what is of this unit."""

    rate: arb
    has_start: bool
    has_constants: bool
    threshold: arb
    noise: arb
    of_constant: arb = arb(1)
    """What a constant 1 is in this unit, if it has constants."""


class Comparison(NamedTuple):
    """After a silent test ‖Y(e_s − n + J(x + n))‖² ≤ θ² + ‖S(x + n)‖²."""

    errors: arb_mat  # Y, (n, n)
    shift: arb_mat  # J, (n, n)
    share: arb_mat  # S, (k, n)


class Witness(NamedTuple):
    """What a witness names: Lyapunov functions at the rate r, T, and what a silent test says."""

    plant: Decay  # of A + BK + r
    model: Decay | None  # of H + r; None: the models hold the last update, or nothing is lost
    inputs: arb_mat
    comparison: Comparison | None  # None: a periodic rule compares nothing


class Source(NamedTuple):
    """What acts through a column: the sup of its amplitude in the equation of x and of e_s."""

    of_state: Form
    of_error: Form
    early: Form  # in both, beside these, up to the first input
    is_outside: bool = False  # acts before the first input, too, beside p


def units_of(loop: Loop) -> list[Unit]:
    """Return the units of a loop's bounds."""
    level, floor = arb(loop.rule.level), arb(loop.rule.floor)
    decaying, constant = loop.noise
    if not loop.has_decaying_unit:  # the threshold is at most the constant max(c, f)
        return [Unit(arb(0), True, True, level.max(floor), decaying + constant)]
    found = [Unit(arb(loop.rate), True, False, level, decaying)]
    if loop.needs_constant:
        found.append(Unit(arb(0), False, True, floor, constant))
    return found


def single_unit(loop: Loop) -> Unit | None:
    """Return the unit max(f₁, f/c) of a threshold max(c f₁, f), or f₂ if c is 0, of all that acts.

    None: there is only one unit, or no constant threshold.
    """
    rule, (decaying, constant) = loop.rule, loop.noise
    if not (loop.has_decaying_unit and loop.needs_constant and rule.floor > 0):
        return None
    if rule.level > 0 and loop.rate == rule.rate:
        scale = arb(rule.level) / arb(rule.floor)
        return Unit(arb(loop.rate), True, True, arb(rule.level), decaying + scale * constant, scale)
    return Unit(arb(0), True, True, arb(max(rule.level, rule.floor)), decaying + constant)


def read_witness(document: Document, loop: Loop, table: Table) -> Witness:
    """Return what a proof names of a loop, which may be one with the rule that :func:`_followed` takes."""
    n, m = document.n, document.m
    decays = {}
    for name in ("plant", "model"):
        if table.get(name) is not None or name == "plant":
            entry = mapping(table.get(name), name)
            fields(entry, name, ("form", "decay"))
            form = exact_matrix(entry["form"], f"form of the {name}", n, n)
            if form.mid != form.mid.transpose():
                raise RejectedError(f"form of the {name}: not symmetric")
            decays[name] = Decay(form.balls, arb(rational(entry["decay"], name)))
    T = exact_matrix(table["inputs"], "inputs", m, m).balls
    return Witness(decays["plant"], decays.get("model"), T, _comparison(document, loop, table))


def _comparison(document: Document, loop: Loop, table: Table) -> Comparison | None:
    """Return what a silent test says, as proven: of some rules with what a proof names."""
    n, rule = loop.n, loop.rule
    if loop.times.period > 0:
        return None
    if loop.compares_error:
        share = columns_of(rule.negative.balls, range(n)) if rule.negative.shape[0] else zeros(0, n)
        return Comparison(loop.weight, zeros(n, n), share)
    if table.get("comparison") is None:
        raise RejectedError("comparison: the rule does not compare ‖W e_s‖, so one is needed")
    entry = mapping(table["comparison"], "comparison")
    fields(entry, "comparison", Comparison._fields)
    found = Comparison(
        exact_matrix(entry["errors"], "comparison: errors", n, n).balls,
        exact_matrix(entry["shift"], "comparison: shift", n, n).balls,
        read_matrix(entry["share"], "comparison: share", None, n).balls,
    )
    Q = square(rule.positive.balls)
    if rule.negative.shape[0]:
        Q -= square(rule.negative.balls)
    Q += square(beside(found.share, zeros(found.share.nrows(), n)))
    if not is_positive(Q - square(found.errors * beside(found.shift, identity(n)))):
        raise RejectedError("comparison: a silent test does not say as much")
    return found


def _followed(loop: Loop, table: Table) -> Loop:
    """Return the loop with the rule for which that of a loop is taken, as a proof says."""
    n, rule, times = loop.n, loop.rule, loop.times
    if truth(table.get("by_time", False), "by_time"):
        if not times.longest > 0:
            raise RejectedError("by_time: the rule has no largest time between events")
        none, zero = Matrix(fmpq_mat(0, 2 * n)), fmpq(0)
        least = max(times.least_apart, min(times.longest, fmpq(1, 10**9)))
        return loop._replace(
            rule=Rule(none, none, zero, zero, zero, False, False),
            times=times._replace(
                least_period=min(least, times.longest), period=times.longest, dwell=zero, longest=zero
            ),
        )
    if not rule.integrates:
        return loop
    if times.sampling > 0:
        tests = whole(table.get("tests"), "tests", _MOST_TESTS)
        least, window = tests * times.least_sampling, (tests + 1) * times.sampling
    else:
        least = window = rational(table.get("window_s"), "window_s")
    if not least > 0:
        raise RejectedError("tests or window_s: not above 0")
    return loop._replace(
        rule=rule._replace(floor=rule.floor / least, integrates=False),
        times=times._replace(sampling=window, least_sampling=fmpq(0)),
    )


class _Responses:
    """What follows of x and of errors from what acts, at a rate, which two units may share.

    Args:
        loop: the loop.
        rate: what is added to A + BK, H and A.
        witness: what the document names.
        outputs: rows C of the outputs to bound, by their names.

    Raises:
        RejectedError: a response is not enclosed.
    """

    def __init__(self, loop: Loop, rate: arb, witness: Witness, outputs: Mapping[str, arb_mat]) -> None:
        self.loop, self.witness = loop, witness
        n, m, times, one = loop.n, loop.B.ncols(), loop.times, identity(loop.n)
        self.compared = witness.comparison or Comparison(loop.weight, zeros(n, n), zeros(0, n))
        try:
            self.inputs, self.inverse, of_compared = (
                M.inv() for M in (witness.inputs, loop.weight, self.compared.errors)
            )
        except ZeroDivisionError:
            raise RejectedError("weight, inputs or errors: not proven to have an inverse") from None
        self.gain, H, closed = witness.inputs * loop.gain, loop.H, loop.A + loop.B * loop.gain
        K, is_periodic = self.gain, times.period > 0
        self.untested = arb(times.period if is_periodic else max(times.sampling, times.dwell))
        self.lost = 0 if is_periodic else loop.losses
        recent = self.untested * (1 + loop.losses if is_periodic else 1) + arb(times.delay)
        mismatch, self.boxed, self.mismatched = closed - H, loop.boxed, loop.mismatched
        self.driving, first = self._driving(), m + len(self.boxed)
        self.of_mismatch = range(first, first + len(self.mismatched))

        # The state.
        self.aged = K * (-1 * between(-arb(times.lead), arb(times.age)) * H).exp()
        share, shift = self.compared.share, loop.weight * self.compared.shift
        found_rows = {"share": share, "shift": shift, **outputs}
        found_rows |= {f"x[{i}]": rows_of(one, [i]) for i in range(n) if self.boxed}
        found_rows |= {f"Kx {j}": rows_of(loop.gain, [j]) for j in range(m)}
        found_rows |= {f"Ex {i}": rows_of(mismatch, [i]) for i in self.mismatched}
        found_rows |= {"WEx": loop.weight * mismatch} if self.mismatched else {}
        if times.from_tick > 0:
            found_rows |= {f"aged {j}": rows_of(K, [j]) * H for j in range(m)}
            found_rows |= {f"bent {j}": rows_of(self.aged, [j]) * H * H for j in range(m)}
        columns = [*self.driving, loop.start]
        found = responses(closed + rate * one, witness.plant, list(found_rows.values()), columns)
        self.states = dict(zip(found_rows, found, strict=True))
        self.before = responses_until(
            loop.A + rate * one, arb(times.start), [rows_of(K, [j]) for j in range(m)], columns
        )

        # Errors.
        self.scaled_H = H + rate * one
        errors = {"W": loop.weight} | {f"p {j}": rows_of(self.aged, [j]) for j in range(m)}
        self._errors = errors
        self.is_own = witness.comparison is None or loop.compares_error
        self.columns = [self.inverse]
        if witness.comparison is not None and not self.is_own:
            self.columns.append(of_compared)
        self.starts = len(self.columns)
        self.columns += self.driving
        found = responses_until(self.scaled_H, recent, list(errors.values()), self.columns)
        self.recent = dict(zip(errors, found, strict=True))
        self.untested_growth = self.growth(self.untested)
        self._ever: EnclosedResponses | None = None
        if self.lost and not is_zero(self.scaled_H):
            if witness.model is None:
                raise RejectedError("model: missing")
            question = Question(self.scaled_H, witness.model, list(errors.values()), self.columns)
            self._ever = enclose(question, _REST)
        self.ever = self._from(arb(0)) if self.lost else {}

    def _driving(self) -> list[arb_mat]:
        """Return the columns through which something acts, in the order of :meth:`UnitGains.sources`."""
        loop, one = self.loop, identity(self.loop.n)
        B = loop.B * self.inputs
        found = [columns_of(B, [j]) for j in range(B.ncols())]
        found += [columns_of(one, [i]) for i in (*self.boxed, *self.mismatched)]
        found += [columns_of(loop.pushes, [i]) for i in range(loop.pushes.ncols())]
        return found if loop.before_input is None else [*found, loop.before_input]

    def growth(self, until: arb) -> list[Response]:
        """Return the growth of W e_s within a time, from W⁻¹ and by each source."""
        return responses_until(self.scaled_H, until, [self.loop.weight], self.columns)[0]

    def ever_after(self, apart: arb) -> list[tuple[dict[str, list[Response]], int]]:
        """Return :attr:`ever` from 0, 1, … times a time on, each with the number of lost events."""
        if self._ever is None or not 1 < self.lost <= _MOST_AGES:
            return [(self.ever, self.lost)] if self.lost else []
        return [(self._from(k * apart), 1) for k in range(self.lost)]

    def _from(self, time: arb) -> dict[str, list[Response]]:
        """Return the growth of errors from a time on, for ever."""
        if self._ever is not None:
            return dict(zip(self._errors, self._ever.after(time), strict=True))
        return {
            name: [Response(norm_of(C * Y), arb(0)) for Y in self.columns] for name, C in self._errors.items()
        }


class UnitGains:
    """The inequalities in one unit, and their solution.

    Args:
        responses: what follows from what acts, at the rate of the unit.
        unit: the unit.
        constant: the inequalities in the unit f₂, for those in f₁, if there are both.

    Raises:
        RejectedError: a signal has no bound.
    """

    def __init__(self, responses: _Responses, unit: Unit, constant: "UnitGains | None" = None) -> None:
        self.loop, self.unit, self._constant, self.responses = responses.loop, unit, constant, responses
        self._early, self.sources = arb(self.loop.times.start), list(self._all_sources())
        self._tested: list[dict[str, arb]] = [{"1": unit.noise}]
        """The parts of e_s after a test: of W⁻¹, and perhaps of Y⁻¹."""
        compared = responses.compared
        if responses.witness.comparison is not None:
            self._tested[0] |= {"shift": arb(1)}
            if responses.is_own:
                self._tested[0] |= {"compared": arb(1)}
            else:
                self._tested.append({"compared": arb(1)})
        parts = (("share", compared.share), ("shift", self.loop.weight * compared.shift))
        self._of_noise = {name: norm_of(M * responses.inverse) * unit.noise for name, M in parts}
        self.sups = self._solution()

    def _all_sources(self) -> Iterator[Source]:
        loop, unit, one = self.loop, self.unit, arb(1)
        for j in range(loop.B.ncols()):
            amplitude = {f"p {j}": one}
            yield Source(amplitude, amplitude, {f"p more {j}": one})
        for i in self.responses.boxed:
            amplitude = {f"box {i}": one}
            yield Source(amplitude, amplitude, {}, is_outside=True)
        for i in self.responses.mismatched:
            yield Source({}, {f"Ex {i}": one}, {})
        for size in loop.sizes:
            amplitude = {"1": size * unit.of_constant} if unit.has_constants else {}
            yield Source(amplitude, amplitude, {}, is_outside=True)
        if loop.before_input is not None:  # it acts up to t_a, where f₁ has fallen
            early = {"1": (arb(loop.times.start) * unit.rate).exp()} if unit.has_start else {}
            yield Source({}, {}, early, is_outside=True)

    def state(self, name: str) -> Form:
        """Return the bound of an output |Cx|."""
        found = self.responses.states[name]
        terms: list[tuple[arb, Form]] = []
        if self.unit.has_start:
            terms.append((found[-1].most, {"1": arb(1)}))
        for response, source in zip(found, self.sources, strict=False):
            terms.append((response.total, source.of_state))
            terms.append((response.total.min(self._early * response.most), source.early))
        return _sum(*terms)

    def input(self, j: int) -> Form:
        """Return the bound of an input |u_j|; it is 0 before the first one."""
        terms = [
            (abs(self.responses.inputs[j, k]), {f"p {k}": arb(1)})
            for k in range(self.responses.inputs.ncols())
        ]
        return _sum((arb(1), self.state(f"Kx {j}")), *terms)

    def sensor_error(self) -> Form:
        """Return the bound of ‖W e_s‖."""
        grown = self.responses.untested_growth
        return _sum(*self._after_test(grown), *self.driven(self.of_sources(grown)))

    def error(self, name: str) -> Form:
        """Return the bound of an output |C e_c|: "W", or "p j" for the row j of K e^{−Hs}."""
        recent = self.responses.recent[name]
        terms, sources = self._after_test(recent), self.of_sources(recent)
        if self.responses.lost:
            of_lost, further = self._lost(self.responses.ever[name], self.responses.lost)
            terms += of_lost
            sources = [Response(b.most, a.total + b.total) for a, b in zip(sources, further, strict=True)]
        return _sum(*terms, *self.driven(sources))

    def lost(self, name: str, apart: arb) -> Form:
        """Return the bound of what lost events add to an output |C e_c|, if two are at least so far apart."""
        every = [self._lost(ever[name], events) for ever, events in self.responses.ever_after(apart)]
        return _sum(*(term for terms, sources in every for term in (*terms, *self.driven(sources))))

    def _lost(self, ever: Sequence[Response], lost: int) -> tuple[list[tuple[arb, Form]], list[Response]]:
        """Return terms of the bound of what so many lost events add, and the responses to the sources."""
        untested = self.responses.untested
        gain = ever[0].most
        terms = [(lost * most, form) for most, form in self._after_test(ever)]
        terms.append((lost * gain, {"1": self.unit.noise}))
        growths = zip(self.of_sources(ever), self.of_sources(self.responses.untested_growth), strict=True)
        return terms, [Response(a.most, lost * (untested * a.most).min(gain * b.total)) for a, b in growths]

    def _after_test(self, growths: Sequence[Response]) -> list[tuple[arb, Form]]:
        """Return terms of an error, by what a test leaves."""
        return [(growth.most, form) for growth, form in zip(growths, self._tested, strict=False)]

    def of_sources(self, growths: Sequence[Response]) -> Sequence[Response]:
        """Return the responses to the sources."""
        return growths[len(self._tested) :]

    def driven(self, growths: Sequence[Response]) -> Iterator[tuple[arb, Form]]:
        """Yield terms of an error, by what it is driven by each source."""
        for growth, source in zip(growths, self.sources, strict=True):
            yield growth.total, source.of_error
            yield growth.total.min(self._early * growth.most), source.early

    def by_age(self, j: int) -> Form:
        """Return the bound of what the age of the input adds to p_j, of x."""
        age = arb(self.loop.times.from_tick)
        if age == 0:
            return {}
        return _sum((age, self.state(f"aged {j}")), (age**2 / 2, self.state(f"bent {j}")))

    def value(self, form: Form) -> arb:
        """Return the value of a form of the solution, rounded up."""
        return value(form, self.sups)

    def _inequalities(self, slope: arb) -> Iterator[tuple[str, Form]]:
        """Yield signals and what they are at most; of a signal with several, the largest.

        ``slope`` is that of a chord of √(θ² + s²).
        """
        loop, one = self.loop, arb(1)
        for j in range(loop.B.ncols()):
            yield f"p {j}", _sum((one, self.error(f"p {j}")), (one, self.by_age(j)))
            before = self.responses.before[j]
            pairs = list(zip(before, self.sources, strict=False))
            outside = [(response.total, source) for response, source in pairs if source.is_outside]
            terms = [(total, form) for total, source in outside for form in (source.of_error, source.early)]
            terms += [(before[-1].most, {"1": one})] if self.unit.has_start else []
            yield f"p before {j}", _sum(*terms)
            yield f"p more {j}", {}
            yield f"p more {j}", {f"p before {j}": one, f"p {j}": -one}
        for i in self.responses.boxed:
            terms = [(loop.half_A[i, j], self.state(f"x[{j}]")) for j in range(loop.n)]
            terms += [(loop.half_B[i, j], self.input(j)) for j in range(loop.B.ncols())]
            yield f"box {i}", _sum(*terms)
        for i in self.responses.mismatched:
            yield f"Ex {i}", self.state(f"Ex {i}")
        for name, of_noise in self._of_noise.items():
            yield name, _sum((one, self.state(name)), (of_noise, {"1": one}))
        yield "compared", {"1": self._compared(arb(0)), "share": slope}

    def _compared(self, share: arb) -> arb:
        """Return a bound of c in this unit, if ‖S(x + n)‖ is at most a share in this unit."""
        if self._constant is None:
            return upper((self.unit.threshold**2 + share**2).sqrt())
        sups, threshold = self._constant.sups, self.unit.threshold.max(self._constant.unit.threshold)
        both = (threshold**2 + (share + sups["share"]) ** 2).sqrt()
        return upper((both - sups["compared"]).max(arb(0)))

    def _solution(self) -> dict[str, arb]:
        """Return y > Fy + g, by signals, with chords of the bound of c up to smaller and smaller shares."""
        slope, none = arb(1), self._compared(arb(0))
        y = self._solution_at(slope)
        for _ in range(_CHORDS):
            following = upper((self._compared(y["share"]) - none) / y["share"])
            if not following < _BETTER * slope:
                break
            smaller = self._solution_at(following)
            if not self._compared(smaller["share"]) < smaller["compared"]:
                break
            y, slope = smaller, following
        if not self._compared(y["share"]) < y["compared"]:
            raise _unbounded(dict(self._inequalities(slope)))
        return y

    def _solution_at(self, slope: arb) -> dict[str, arb]:
        """Return y > Fy + g, by signals. Which inequality counts of several is tried."""
        every = list(self._inequalities(slope))
        chosen = dict(reversed(every))
        for _ in range(len(chosen)):
            y = _solved(chosen)
            failing = [(name, form) for name, form in every if not value(form, y) < y[name]]
            if not failing:
                return y
            chosen |= dict(failing)
        raise _unbounded(chosen)


def _sum(*terms: tuple[arb, Form]) -> Form:
    """Return Σ factor · form."""
    found: dict[str, arb] = {}
    for factor, form in terms:
        for name, size in form.items():
            found[name] = found.get(name, arb(0)) + factor * size
    return found


def value(form: Form, sups: Mapping[str, arb]) -> arb:
    """Return the value of a form, rounded up."""
    return upper(sum((size * sups[name] for name, size in form.items()), arb(0)).max(arb(0)))


def _solved(rows: Mapping[str, Form]) -> dict[str, arb]:
    """Return y with y = Fy + g and some room, nearly.

    Raises:
        RejectedError: y is not above 0.
    """
    names, none = list(rows), arb(0)
    F = arb_mat(len(names), len(names), [rows[a].get(b, none).mid() for a in names for b in names])
    right = [rows[name].get("1", none) for name in names]
    room = _ROOM * (sum(right, none) if any(each > 0 for each in right) else arb(1))
    try:
        y = (identity(len(names)) - F).solve(
            arb_mat(len(names), 1, [((1 + _ROOM) * each + room).mid() for each in right])
        )
    except ZeroDivisionError:
        raise _unbounded(rows) from None
    found = {name: arb(y[i, 0].mid()) for i, name in enumerate(names)}
    if not all(size > 0 for size in found.values()):
        raise _unbounded(rows)
    return found | {"1": arb(1)}


def _unbounded(rows: Mapping[str, Form]) -> RejectedError:
    """Return that y > Fy + g is not solved, with the spectral radius of F, about, which has to be below 1."""
    y, radius = dict.fromkeys(rows, 1.0), 0.0
    for _ in range(_STEPS_OF_GAIN):
        following = {
            name: sum(float(size) * y[other] for other, size in form.items() if other in y)
            for name, form in rows.items()
        }
        radius = max(map(abs, following.values()))
        if not 0 < radius < math.inf:
            break
        y = {name: value / radius for name, value in following.items()}
    if not 1 <= radius < math.inf:
        return RejectedError("the inequalities between the suprema are not solved")
    return RejectedError(
        "what losses and delays add to an error comes back through the loop "
        f"{radius:.4g} times as large; a proof needs less than 1"
    )


class Gains:
    """What is proven by gains.

    Args:
        document: of the loop.
        table: a proof's numbers.

    Raises:
        RejectedError: it is not proven.
    """

    def __init__(self, document: Document, table: Table) -> None:
        self.document = document
        self.loop = loop = _followed(document.loop, table)
        self._witness = witness = read_witness(document, loop, table)
        shift = arb(loop.rate) * identity(loop.n)
        witness.plant.require(loop.A + loop.B * loop.gain + shift, "plant")
        if witness.model is not None:
            witness.model.require(loop.H + shift, "model")
        self._rows = {
            f"output {output.name}": output.rows.balls
            for output in document.outputs
            if output.rows is not None
        }
        self._responses: dict[bool, _Responses] = {}
        self.units: list[UnitGains] = []
        for unit in reversed(units_of(loop)):
            self.units.append(self._gains(unit, *self.units))
        self.bounds = {output.name: self._bound(output) for output in document.outputs}
        """D₁ and D₂ of each output of the document, of x about where the loop has it."""

    def _bound(self, output: Output) -> tuple[arb, arb]:
        found = {True: arb(0), False: arb(0)}
        for gains in self.units:
            if output.rows is not None:
                form = gains.state(f"output {output.name}")
            elif output.input is not None:
                form = gains.input(output.input)
            else:
                form = gains.sensor_error() if output.error == "sensor" else gains.error("W")
            found[gains.unit.has_constants] = value(form, gains.sups)
        return found[False], found[True]

    def _gains(self, unit: Unit, *constant: UnitGains) -> UnitGains:
        key = bool(unit.rate > 0)
        if key not in self._responses:
            self._responses[key] = _Responses(self.loop, unit.rate, self._witness, self._rows)
        return UnitGains(self._responses[key], unit, *constant)

    @cached_property
    def single(self) -> UnitGains | None:
        """The inequalities in one unit instead of two, as :mod:`.apart` needs them; None: there are none."""
        unit = single_unit(self.loop)
        try:
            return None if unit is None else self._gains(unit)
        except RejectedError:
            return None
