"""A loop about a reference: what is moved to 0, and what disturbs the loop in these coordinates.

x_r and u_r are polynomials and waves on segments, and solve the model up to rounding. Sensor and
controller have d(x_s − x_r)/dt = H(x_s − x_r), and u = K(x_c − x_r) + u_r of a time t − s, where s is the
age of the input. With x̃ = x − x_r the plant has

    dx̃/dt = Ax̃ + B(K(x_c − x_r)(t − s) + u_r(t − s) − u_r(t)) + (A x_r + B u_r − ẋ_r),

and errors are as without a reference. So the loop is that of the reference 0 with bounded disturbances.

Where segments join, x_r jumps by rounding, −δ_j at t_j. So what is moved to 0 is x_r + η, with
η(t) = Σ e^{H(t − t_j)} δ_j over the joints up to t: it has no jumps, and both models follow H about it, too.
It adds (A − H)η + BKη(t − s) to the disturbances. A larger jump ends the statement.
"""

from collections.abc import Sequence
from itertools import pairwise
from math import comb
from typing import NamedTuple

from flint import arb, arb_mat, fmpq

from noack.core.balls import beside, columns_of, frobenius, rows_of, upto, zeros

_ROUNDING = arb(10) ** -9
"""A jump of x_r is rounding up to this share of what is the largest entry of x_r and u_r up to then."""
_PARTS = 8
"""Parts of a segment on which a polynomial is enclosed; of many segments there are fewer."""
_FEW_SEGMENTS = 200


class EnclosedSegment(NamedTuple):
    """Σ_k polynomial_k τ^k + Σ_l sines_l sin 2πf_l τ + cosines_l cos 2πf_l τ; τ is the time since its begin.

    The n states of x_r come first, then the m inputs of u_r.
    """

    begin: fmpq  # s
    polynomial: arb_mat  # (n + m, powers)
    hz: Sequence[arb]  # f
    sines: arb_mat  # (n + m, waves)
    cosines: arb_mat  # (n + m, waves)

    def at(self, time: arb) -> arb_mat:
        """Return the values at a time since its begin, (n + m, 1)."""
        powers = arb_mat(self.polynomial.ncols(), 1, [time**k for k in range(self.polynomial.ncols())])
        value = self.polynomial * powers
        for place, hz in enumerate(self.hz):
            angle = 2 * arb.pi() * hz * time
            value += (
                columns_of(self.sines, [place]) * angle.sin()
                + columns_of(self.cosines, [place]) * angle.cos()
            )
        return value

    def image(self, M: arb_mat) -> "EnclosedSegment":
        """Return M times the values."""
        return EnclosedSegment(self.begin, M * self.polynomial, self.hz, M * self.sines, M * self.cosines)

    def minus(self, other: "EnclosedSegment", rows: Sequence[int]) -> "EnclosedSegment":
        """Return the difference to some rows of a segment of the same powers and waves."""
        P, S, C = (rows_of(M, rows) for M in (other.polynomial, other.sines, other.cosines))
        return EnclosedSegment(self.begin, self.polynomial - P, self.hz, self.sines - S, self.cosines - C)

    @property
    def is_constant(self) -> bool:
        """Whether x_r and u_r are a set-point."""
        return self.polynomial.ncols() == 1 and not self.hz

    @property
    def derivative(self) -> "EnclosedSegment":
        """The derivative, of as many powers."""
        P, width = self.polynomial, self.polynomial.nrows()
        powers = [k * columns_of(P, [k]) for k in range(1, P.ncols())] + [zeros(width, 1)]
        whole = powers[0]
        for column in powers[1:]:
            whole = beside(whole, column)
        omega = [2 * arb.pi() * hz for hz in self.hz]
        waves = range(len(omega))
        sines = arb_mat(
            width, len(omega), [-omega[k] * self.cosines[i, k] for i in range(width) for k in waves]
        )
        cosines = arb_mat(
            width, len(omega), [omega[k] * self.sines[i, k] for i in range(width) for k in waves]
        )
        return EnclosedSegment(self.begin, whole, self.hz, sines, cosines)

    def largest(self, length: arb, parts: int) -> list[arb]:
        """Return upper bounds of the absolute values up to a time since its begin."""
        found = [arb(0)] * self.polynomial.nrows()
        for part in range(parts):
            for row in range(len(found)):
                found[row] = found[row].max(self._hull(row, length * part / parts, length / parts))
        waves = range(len(self.hz))
        for row in range(len(found)):
            found[row] += sum(
                ((self.sines[row, k] ** 2 + self.cosines[row, k] ** 2).sqrt() for k in waves), arb(0)
            )
        return [arb(size.abs_upper()) for size in found]

    def _hull(self, row: int, begin: arb, length: arb) -> arb:
        """Return the largest Bézier point of a polynomial on a part, in absolute value."""
        c, degree = (
            [self.polynomial[row, k] for k in range(self.polynomial.ncols())],
            self.polynomial.ncols() - 1,
        )
        own = [
            sum((comb(j, k) * begin ** (j - k) * c[j] for j in range(k, degree + 1)), arb(0)) * length**k
            for k in range(degree + 1)
        ]
        points = (
            sum((own[k] * comb(i, k) / comb(degree, k) for k in range(i + 1)), arb(0))
            for i in range(degree + 1)
        )
        largest = arb(0)
        for point in points:
            largest = largest.max(arb(point.abs_upper()))
        return largest


class About(NamedTuple):
    """The loop about a point that moves, in whose coordinates this point is 0."""

    start: arb_mat
    """x_r(0), (n, 1)."""
    state: Sequence[arb]
    """At most this is added to each entry of ẋ."""
    input: Sequence[arb]
    """At most this is added to each input."""
    before_input: arb_mat
    """What is added to ẋ in addition while no input acts, (n, 1), as balls over this time."""
    until: fmpq
    """The statement holds up to this time, s."""
    offset: arb
    """The point is at most this far from x_r."""


class Matrices(NamedTuple):
    """Those of a loop that its coordinates about a reference depend on."""

    A: arb_mat
    B: arb_mat
    half_A: arb_mat
    half_B: arb_mat
    H: arb_mat
    gain: arb_mat


class Moments(NamedTuple):
    """The times that the coordinates depend on, in s."""

    from_tick: fmpq
    """Largest difference between the time and the time for which an input was computed."""
    start: fmpq
    """The first input acts within this time."""
    end: fmpq
    """Of the run."""


def first_jump(segments: Sequence[EnclosedSegment], n: int, end: fmpq) -> fmpq:
    """Return when x_r first jumps by more than rounding, or the end of the run."""
    largest = _largest_entry(segments[0].at(arb(0)))
    for before, after in pairwise(segments):
        if after.begin >= end:
            break
        left, right = before.at(arb(after.begin - before.begin)), after.at(arb(0))
        largest = largest.max(_largest_entry(left)).max(_largest_entry(right))
        if not _largest_entry(rows_of(right - left, range(n))) <= _ROUNDING * largest:
            return after.begin
    return end


def about_reference(
    segments: Sequence[EnclosedSegment], loop: Matrices, times: Moments, error_gain: arb | None
) -> About:
    """Return the loop about a reference, until it first jumps.

    ``error_gain`` is at least sup‖e^{Hτ}‖ over all τ ≥ 0; None: it is not known, and may be infinite.
    """
    n, m = loop.A.nrows(), loop.B.ncols()
    until = first_jump(segments, n, times.end)
    used = [segment for segment in segments if segment.begin < until] or [segments[0]]
    ends = [*(segment.begin for segment in used[1:]), until]
    lengths = [arb(end - segment.begin) for segment, end in zip(used, ends, strict=True)]
    parts = _PARTS if len(used) <= _FEW_SEGMENTS else 1

    def largest(of: Sequence[EnclosedSegment]) -> list[arb]:
        return _most([each.largest(length, parts) for each, length in zip(of, lengths, strict=True)])

    slopes = [segment.derivative for segment in used]
    AB = beside(loop.A, loop.B)
    residuals = [each.image(AB).minus(slope, range(n)) for each, slope in zip(used, slopes, strict=True)]
    entries, rates = largest(used), largest(slopes)
    jumps = [
        after.at(arb(0)) - before.at(length)
        for (before, after), length in zip(pairwise(used), lengths, strict=False)
    ]
    offset = arb(0)
    if any(entry != 0 or entry.rad() != 0 for jump in jumps for entry in rows_of(jump, range(n)).entries()):
        total = sum((frobenius(rows_of(jump, range(n))) for jump in jumps), arb(0))
        offset = total * (arb.pos_inf() if error_gain is None else error_gain)
    held = [arb(times.from_tick) * rate for rate in rates[n:]]
    held = [
        size + step
        for size, step in zip(held, _steps_together(used, jumps, n, m, times.from_tick), strict=True)
    ]
    input_sizes = [
        size + _row_norm(loop.gain, j) * offset if times.from_tick > 0 or offset != 0 else size
        for j, size in enumerate(held)
    ]
    state = [
        size
        + _product(loop.half_A, i, [entry + offset for entry in entries[:n]])
        + _product(loop.half_B, i, [e + s for e, s in zip(entries[n:], input_sizes, strict=True)])
        + _row_norm(loop.A - loop.H, i) * offset
        for i, size in enumerate(largest(residuals))
    ]
    first = rows_of(_over(used, lengths, times.start), range(n, n + m))
    radii = arb_mat(
        n, m, [arb(0, half.abs_upper()) if half != 0 else arb(0) for half in loop.half_B.entries()]
    )
    return About(
        start=rows_of(used[0].at(arb(0)), range(n)),
        state=[arb(size.abs_upper()) for size in state],
        input=[arb(size.abs_upper()) for size in input_sizes],
        before_input=-1 * ((loop.B + radii) * first),
        until=until,
        offset=arb(offset.abs_upper()),
    )


def _steps_together(
    used: Sequence[EnclosedSegment], jumps: Sequence[arb_mat], n: int, m: int, within: fmpq
) -> list[arb]:
    """Return the largest sum of |jumps| of each entry of u_r within a time."""
    if not within > 0:
        return [arb(0)] * m
    begins, largest = [segment.begin for segment in used[1:]], [arb(0)] * m
    for first, begin in enumerate(begins):
        total, last = [arb(0)] * m, first
        while last < len(begins) and begins[last] <= begin + within:
            total = [size + abs(jumps[last][n + j, 0]) for j, size in enumerate(total)]
            last += 1
        largest = _most([largest, total])
    return largest


def _over(used: Sequence[EnclosedSegment], lengths: Sequence[arb], end: fmpq) -> arb_mat:
    """Return balls that contain the values up to a time, or to the end of what is used."""
    whole: arb_mat | None = None
    for segment, length in zip(used, lengths, strict=True):
        if whole is not None and segment.begin >= end:
            break
        found = segment.at(upto(arb(end - segment.begin).min(length)))
        whole = found if whole is None else _union(whole, found)
    assert whole is not None
    return whole


def _union(first: arb_mat, second: arb_mat) -> arb_mat:
    pairs = zip(first.entries(), second.entries(), strict=True)
    return arb_mat(first.nrows(), 1, [one.union(other) for one, other in pairs])


def _most(rows: Sequence[Sequence[arb]]) -> list[arb]:
    """Return the largest entry of each column of balls without negative entries."""
    found = list(rows[0])
    for row in rows[1:]:
        found = [one.max(other) for one, other in zip(found, row, strict=True)]
    return found


def _largest_entry(values: arb_mat) -> arb:
    found = arb(0)
    for value in values.entries():
        found = found.max(arb(value.abs_upper()))
    return found


def _product(half: arb_mat, row: int, sizes: Sequence[arb]) -> arb:
    return sum((half[row, k] * size for k, size in enumerate(sizes)), arb(0))


def _row_norm(M: arb_mat, row: int) -> arb:
    return frobenius(rows_of(M, [row]))


def padded(segment: EnclosedSegment, n: int, zero_states: int) -> EnclosedSegment:
    """Return a segment with further states that are 0 after its n own ones."""
    P, S, C = (_with_zeros(M, n, zero_states) for M in (segment.polynomial, segment.sines, segment.cosines))
    return EnclosedSegment(segment.begin, P, segment.hz, S, C)


def _with_zeros(M: arb_mat, n: int, zero_states: int) -> arb_mat:
    columns, height = range(M.ncols()), M.nrows()
    rows = [[M[i, k] for k in columns] for i in range(height)]
    rows[n:n] = [[arb(0) for _ in columns] for _ in range(zero_states)]
    return arb_mat(height + zero_states, M.ncols(), [entry for row in rows for entry in row])
