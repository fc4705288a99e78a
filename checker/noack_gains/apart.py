r"""How far apart events are, by gains: after an event, e_s needs time to reach the threshold.

At an event e_s becomes n, and a later one needs ‖W(e_s − n')‖ above the threshold, n and n' the noises of
both. In a unit with the rate r let η be the supremum of ‖W n‖ and, up to a time τ after an event, R that of
‖W e_s‖. There is no event within τ if R + η is below the threshold. Let g_M ≥ 1 be the supremum of ‖W e^{Ms}
W⁻¹‖ over the times in question; r is added to H and M.

*By p.* ė_s = H e_s − (Ex + Bp + ω + Dd) gives R ≤ g_H η + ∫₀^τ N(e^{Hs}; p̂, …) ds.

*By what is not e_s.* An update that was sent by the event acts within d, or never. So d later only lost
events are missing: p = K e^{−Hs} (e_s + w) + …, where w is what at most M − 1 of them add to e_c, which
:mod:`.gains` bounds, and "…" what the age s of the input adds, of x. With a matrix C in the middle of all K
e^{−Hs} it is p = C e_s + q, and |q_j| ≤ κ_j R + |(K e^{−Hs})_j w| + …, κ_j a bound of ‖(K e^{−Hs} − C)_j
W⁻¹‖. No two events up to this one were less than τ apart, by induction: so the lost ones are at least 0, τ,
2τ, … old, and the suprema in their parts of w are those from there on. From d on ė_s = (H − BC) e_s − (Ex +
Bq + ω + Dd), and with M = H − BC

    R ≤ g_M (g_H η + ∫₀^d N(e^{Hs}; p̂, …) ds) + ∫₀^{τ−d} N(e^{Ms}; q̂, …) ds + R ∫₀^{τ−d} N(e^{Ms}; κ) ds.

Before the first input p = −Kx: there |q_j| ≤ |K_j x| + ‖C_j W⁻¹‖ R, for at most t_a. What multiplies R on
the right is below 1, so R is bounded, in both units by the same argument as the signals in :mod:`.gains`.

*N* is what vectors c_k, the columns of W e^{Ms} times those of the sources, may add up to with amplitudes
a_k: at most (Σ |c_i · c_k| a_i a_k)^½. In it Ex may also stand for ‖W e^{Ms} W⁻¹‖ sup ‖W E x‖.

*Two units, or one.* In the units f₁ and f₂ the sum D₁ v + D₂, v = e^{−rt}, has to be below max(c v, f). It
is convex in v, so v = 0, v = 1 and the kink suffice. If both c and f are above 0, f₃ = max(f₁, f/c) is a
unit, too: f₃(s) ≤ e^{r(t−s)} f₃(t) for s ≤ t is all that the inequalities with the rate r need. The
threshold is c f₃, and a constant 1 is at most (c/f) f₃. So D₃ < c is enough, while D₁ f₁ + D₂ counts both
parts of the threshold at the kink. If c is 0, f₂ alone is such a unit, with all that is of unit f₁ in it.
"""

from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

from flint import arb, arb_mat

from noack_gains.balls import beside, norm_of, rows_of, square, upper, upto
from noack_gains.gains import Gains, UnitGains

_CELLS = 48


class _Source(NamedTuple):
    """The amplitudes of what acts through a column: a + κ R, and beside it up to the first input."""

    size: arb
    early: arb
    of_error: arb = arb(0)
    early_of_error: arb = arb(0)


class _Moved(NamedTuple):
    """By what e_s is moved within a time: the largest ‖W e^{Ms} W⁻¹‖, an integral, and one times R."""

    largest: arb
    total: arb
    of_error: arb


def share_of_threshold(gains: Gains, time: arb) -> arb:
    """Return the largest share of the threshold that ‖W(e_s − n')‖ reaches up to a time after an event.

    It is infinite if none is known. The rule compares ‖W e_s‖.
    """
    rule, rate = gains.loop.rule, gains.loop.rate
    level, floor = arb(rule.level if rate == rule.rate else 0), arb(rule.floor)
    share = arb("inf")
    if gains.single is not None:
        share = share.min(reached(gains.single, time) / (level if level > 0 else floor))
    decaying, constant = (
        sum((reached(unit, time) for unit in gains.units if unit.unit.has_constants == is_constant), arb(0))
        for is_constant in (False, True)
    )
    kinks = [arb(1)] + [arb(0)] * bool(rate > 0)
    if level > 0 and bool(floor > 0) and not floor > level:
        kinks.append(floor / level)
    largest = arb(0)
    for v in kinks:
        threshold, size = (level * v).max(floor), decaying * v + constant
        if not size == threshold == 0:
            largest = largest.max(size / threshold if threshold > 0 else arb("inf"))
    return upper(share.min(largest))


def reached(gains: UnitGains, time: arb) -> arb:
    """Return a bound of ‖W(e_s − n')‖ in a unit, up to a time after an event."""
    delay, found = arb(gains.loop.times.delay), _by_input_error(gains, time)
    if time > delay:
        found = found.min(_by_rest(gains, time, delay))
    return upper(found + gains.unit.noise)


def _by_input_error(gains: UnitGains, time: arb) -> arb:
    """Return R, by p."""
    sources = [_Source(gains.value(each.of_error), gains.value(each.early)) for each in gains.sources]
    moved = _moved(gains, gains.responses.scaled_H, time, sources)
    return moved.largest * gains.unit.noise + moved.total


def _by_rest(gains: UnitGains, time: arb, delay: arb) -> arb:
    """Return R, by what is not e_s from the largest delay of an update on."""
    of, inverse, times = gains.responses, gains.responses.inverse, gains.loop.times
    B = gains.loop.B * of.inputs
    middle = arb_mat(of.aged.nrows(), of.aged.ncols(), [entry.mid() for entry in of.aged.entries()])
    sources = [_Source(gains.value(each.of_error), gains.value(each.early)) for each in gains.sources]
    for j in range(B.ncols()):
        sources[j] = _Source(
            gains.value(gains.lost(f"p {j}", time)) + gains.value(gains.by_age(j)),
            gains.sups[f"p before {j}"] if times.start > 0 else arb(0),
            norm_of((rows_of(of.aged, [j]) - rows_of(middle, [j])) * inverse),
            norm_of(rows_of(middle, [j]) * inverse),
        )
    moved = _moved(gains, of.scaled_H - B * middle, time - delay, sources)
    before = _by_input_error(gains, delay) if times.delay > 0 else gains.unit.noise
    if not moved.of_error < 1:
        return arb("inf")
    return (moved.largest.max(arb(1)) * before + moved.total) / (1 - moved.of_error)


def _moved(gains: UnitGains, M: arb_mat, time: arb, sources: Sequence[_Source]) -> _Moved:
    """Return by what e_s is moved within a time, along ė_s = M e_s + Σ column · amplitude."""
    loop, of = gains.loop, gains.responses
    step, edge, start = time / _CELLS, loop.weight, arb(loop.times.start)
    within, forward = (upto(step) * M).exp(), (step * M).exp()
    sizes, own = [source.size for source in sources], [source.of_error for source in sources]
    others = [arb(0) if k in of.of_mismatch else size for k, size in enumerate(sizes)]
    mismatch = gains.value(gains.state("WEx")) if of.of_mismatch else arb(0)
    columns = reduce(beside, of.driving)
    largest, total, of_error = arb(0), arb(0), arb(0)
    most, totals = [arb(0)] * len(sources), [arb(0)] * len(sources)
    for _ in range(_CELLS):
        during = edge * within
        driven = during * columns
        norm, products = norm_of(during * of.inverse), square(driven)
        added = _sum_of_vectors(products, sizes)
        if of.of_mismatch:
            added = added.min(_sum_of_vectors(products, others) + norm * mismatch)
        largest, total = largest.max(norm), total + step * added
        of_error += step * _sum_of_vectors(products, own)
        if start > 0:
            lengths = [upper(products[k, k]).sqrt() for k in range(len(sources))]
            most = [a.max(length) for a, length in zip(most, lengths, strict=True)]
            totals = [a + step * length for a, length in zip(totals, lengths, strict=True)]
        edge = edge * forward
    for source, highest, area in zip(sources, most, totals, strict=True):
        acts = area.min(start * highest)
        total, of_error = total + acts * source.early, of_error + acts * source.early_of_error
    return _Moved(upper(largest), upper(total), upper(of_error))


def _sum_of_vectors(products: arb_mat, sizes: Sequence[arb]) -> arb:
    """Return a bound of ‖Σ a_k c_k‖ for |a_k| at most some sizes, from the products c_i · c_k."""
    acting = [k for k, size in enumerate(sizes) if size != 0]
    squared = arb(0)
    for place, i in enumerate(acting):
        squared += products[i, i] * sizes[i] ** 2
        squared += 2 * sizes[i] * sum((abs(products[i, k]) * sizes[k] for k in acting[:place]), arb(0))
    return upper(squared).sqrt()
