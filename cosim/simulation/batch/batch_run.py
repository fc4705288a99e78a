"""Computes runs one by one, from event to event; a run's row depends on its own draw only."""

import math
from typing import Any, NamedTuple

from cosim.simulation.batch.batch_data import Batch, LossTable
from cosim.simulation.batch.batch_rule import (
    Phase,
    Span,
    phase_at,
    span_after,
    threshold_after,
)
from cosim.simulation.batch.batch_status import DIVERGED, OK, TOO_MANY_EVENTS, UNDECIDED
from cosim.simulation.batch.integral_crossing import first_excess
from cosim.simulation.batch.norm_crossing import MOST_STEPS, NONE, UNRESOLVED, Search, first_exit
from cosim.simulation.batch.piece_measures import (
    CERTAINTY,
    is_within,
    last_above,
    passed_at,
    raised,
    square_integrals,
)
from cosim.simulation.batch.quadratic_crossing import (
    SLOWEST,
    QuadraticCurves,
    compare,
    dynamic_variable_at,
    first_event,
    first_look,
    left_side,
    put,
    scale_of,
)
from cosim.simulation.batch.taylor import Models, degree_for, driven, powers, reaches, state_at
from cosim.simulation.batch.vector_lanes import Lanes, dot, filled, load, store, times
from noack.core.core_library import core
from noack.runtime.native.libc_calls import address_of, link_decide, link_renew

_LARGEST = 1e100
"""A state above this norm counts as diverged, as in ``continuous_loop``."""
_MOST_PIECES = 1_000_000
"""Largest number of pieces of a run; computing them takes about 2 s."""
_AHEAD = 1.25
"""Length of the first search after an event, in units of the time that the error would need at its
initial speed."""


class Comparison(NamedTuple):
    """The comparison from the start of a piece on."""

    phase: Phase
    scale: float
    """The values of a quadratic comparison are divided by its square; otherwise 1."""
    level: float
    """Squared threshold, divided by the square of the scale."""
    auxiliary: float
    """η or the integral, at the start."""


DELIVERED: int = core.NOACK_DELIVERED
FORCED: int = core.NOACK_FORCED


class Piece(NamedTuple):
    """A piece of a run: an interval on which one polynomial is accurate."""

    t_s: float
    """Its start."""
    length_s: float
    settled: float
    """The run has settled when ‖x‖ is at or below this level."""
    ceiling: float
    """A bound on ‖W e_c‖ e^{αt}, or infinity."""


def run_many(batch: Batch, squares: QuadraticCurves | None, rows: Any) -> None:
    """Run k draws; each fills a row.

    Without ``squares`` the rule compares ‖W e_s‖ with its threshold, or has no comparison. The two
    cases are compiled separately, each at its first use. The compiler omits a branch only for an
    argument that is None, so ``squares`` is an argument and not a part of the batch.
    """
    powers(batch.system.H, 0, batch.system.H_k, batch.n)
    for run in range(len(rows)):
        renew(batch.network, batch.draws.keys, run, batch.system.first_delivered)
        prepare(batch, run)
        begin_row(rows[run])
        follow(batch, squares, run, rows[run])


def renew(network: LossTable, keys: Any, run: int, first_delivered: bool) -> None:
    """Reset the link to its state before a run's first update, with the run's random streams."""
    row_bytes = keys.shape[1] * keys.shape[2] * keys.itemsize
    link_renew(network.link, address_of(keys) + run * row_bytes, first_delivered)


def arrives(network: LossTable) -> bool:
    """Return whether the next update arrives."""
    link_decide(network.link, 0, 1, 0, address_of(network.decisions))
    return network.decisions[0].fate in (DELIVERED, FORCED)


def prepare(batch: Batch, run: int) -> None:
    """Compute a plant's tables."""
    n, m, system, draws, space = batch.n, batch.m, batch.system, batch.draws, batch.space
    size, inputs = len(n), len(m)
    A, B = run * size * size, run * size * inputs
    for j in range(size):
        BK = times(draws.B, B, load(system.K, j * inputs, m), n)
        column = load(draws.A, A + j * size, n) + BK - load(system.H, j * size, n)
        store(space.E, j * size, column)
    powers(draws.A, A, space.A_k, n)
    driven(draws.A, A, space.E, system.H_k, space.X_k, n)
    reaches(
        system.H_k, space.A_k, space.X_k, space.E, space.sizes, space.reach_s, space.measured_s, n
    )


def expand(
    batch: Batch, squares: QuadraticCurves | None, state: Models, factor: float, begin: int,
    end: int,
) -> None:  # fmt: skip
    """Write the coefficients of degree ``begin`` to ``end``; scale those of ``squares``."""
    n, m, system, space = batch.n, batch.m, batch.system, batch.space
    size, inputs = len(n), len(m)
    for k in range(begin, end + 1):
        table, place = k * size * size, k * size
        model = times(system.H_k, table, state.x_c, n)
        error = times(space.A_k, table, state.e_c, n) + times(space.X_k, table, state.x_c, n)
        apart = times(system.H_k, table, state.d, n)
        store(space.x_c, place, model)
        store(space.e_c, place, error)
        store(space.d, place, apart)
        store(space.x, place, model - error)
        store(space.u, k * inputs, times(system.K, 0, model, m))
        store(space.weighted, place, weighted(batch, error))
        if squares is not None:
            put(squares, k, model - error, error + apart, factor)
        else:
            store(space.error, place, weighted(batch, error + apart))


def weighted(batch: Batch, v: Lanes) -> Lanes:
    """Return W v."""
    if len(batch.system.weight) == 0:
        return v
    return times(batch.system.weight, 0, v, batch.n)


def follow(batch: Batch, squares: QuadraticCurves | None, run: int, row: Any) -> None:
    """Follow one run to its end."""
    system, space, n = batch.system, batch.space, batch.n
    x0, nothing = load(batch.draws.x0, run * len(n), n), filled(0.0, n)
    settled, farthest_s = system.settle * size_of(x0), farthest(batch, squares)
    auxiliary, first_degree = start_of(squares)
    event = not system.known_start
    state = Models(nothing, nothing - x0, nothing) if event else Models(x0, nothing, nothing)
    t_s, last_s, first_s, status = 0.0, -1.0, 0.0, UNDECIDED
    above, fresh, looked, agree = size_of(x0) > settled, True, False, True
    span, point = Span(0.0, 0.0, 0.0, 0.0, 0.0, 0), 0
    for _ in range(_MOST_PIECES if farthest_s > 0.0 else 0):
        if event:
            if row.transmissions >= system.most_events or t_s <= last_s:
                status = TOO_MANY_EVENTS
                break
            agree = count_event(batch, run, row, state, t_s, last_s)
            first_s = t_s if row.transmissions == 1 else first_s
            last_s, fresh, state = t_s, True, updated(state, agree, nothing)
        if t_s >= system.horizon_s:
            status = OK
            break
        if fresh:
            span, fresh, looked = next_span(batch, squares, state, t_s), False, False
            point, auxiliary = span.point, 0.0 if system.rule.integrates else auxiliary
        phase = phase_at(system.rule, span, t_s)
        left_s = min(phase.until_s, system.horizon_s) - t_s
        now = comparison_at(squares, phase, state, auxiliary)
        expand(batch, squares, state, 1.0 / now.scale, 0, first_degree)
        window_s = farthest_s
        if phase.compares and not looked:
            if not is_within(state, _LARGEST, phase.threshold):
                status = DIVERGED
                break
            window_s = min(window_s, first_window(batch, squares, now, point, t_s))
            looked = True
        window_s = min(window_s, left_s)
        p = degree_for(space.reach_s, window_s)
        expand(batch, squares, state, 1.0 / now.scale, first_degree + 1, p)
        found_s, auxiliary, point = find_event(batch, squares, now, p, point, t_s, window_s)
        if found_s == UNRESOLVED:
            break
        event = found_s != NONE
        spent_s = found_s if event else window_s
        if squares is not None:
            auxiliary = dynamic_variable_at(squares, p, spent_s) * (now.scale * now.scale)
        state = state_at(space, degree_for(space.reach_s, spent_s), spent_s, n)
        if not is_within(state, _LARGEST, threshold_after(phase, spent_s)):
            status = DIVERGED
            t_s += passed_at(space, spent_s, _LARGEST, phase, n)
            break
        bounded = agree and squares is None and phase.compares and not system.rule.integrates
        ceiling = ceiling_of(batch, phase, t_s, spent_s) if bounded else math.inf
        within_s = measure_piece(batch, row, state, Piece(t_s, spent_s, settled, ceiling))
        if within_s == UNRESOLVED:
            break
        above = within_s == spent_s
        t_s = t_s + spent_s if event or window_s < left_s else min(phase.until_s, system.horizon_s)
        event = event or t_s >= span.due_s
    finish_row(row, status, t_s, last_s - first_s, above, size_of(state.x_c - state.e_c))


def comparison_at(
    squares: QuadraticCurves | None, phase: Phase, state: Models, auxiliary: float
) -> Comparison:
    """Return the comparison of a phase, scaled to the state."""
    if squares is None:
        return Comparison(phase, 1.0, 0.0, auxiliary)
    scale = scale_of(size_of_state(state), phase.threshold, auxiliary)
    level = (phase.threshold / scale) * (phase.threshold / scale)
    return Comparison(phase, scale, level, auxiliary)


def find_event(
    batch: Batch, squares: QuadraticCurves | None, now: Comparison, p: int, point: int,
    t_s: float, window_s: float,
) -> tuple[float, float, int]:  # fmt: skip
    """Return the time of the next event on a piece, or NONE; the integral; the next grid point."""
    phase, rule, space = now.phase, batch.system.rule, batch.space
    if squares is not None:
        if phase.compares or len(squares.gain) > 0:
            degree = compare(squares, p, now.auxiliary / (now.scale * now.scale))
            if phase.compares:
                search = Search(now.level, 2.0 * phase.rate_per_s, window_s, False)
                found_s, point = first_event(squares, rule, degree, search, point, t_s)
                return found_s, now.auxiliary, point
    elif rule.integrates:
        level = phase.threshold if phase.compares else math.inf
        search = Search(level, phase.rate_per_s, window_s, False)
        found_s, integral = first_excess(space.error, p, search, now.auxiliary, batch.n)
        return found_s, integral, point
    elif phase.compares:
        search = Search(phase.threshold, phase.rate_per_s, window_s, False)
        found_s = first_exit(space.error, p, search, MOST_STEPS, batch.n)
        return found_s, now.auxiliary, point
    return NONE, now.auxiliary, point


def ceiling_of(batch: Batch, phase: Phase, t_s: float, spent_s: float) -> float:
    """Return a bound on ‖W e_c‖ e^{αt} on a piece on which both models agree: then e_c = e_s."""
    until_s = t_s + (spent_s if phase.rate_per_s == 0.0 else 0.0)
    return phase.threshold * math.exp(batch.system.fading_per_s * until_s)


def begin_row(row: Any) -> None:
    """Initialise a row to the values before the first event."""
    row.transmissions = 0
    row.deliveries = 0
    row.longest_loss_burst = 0
    row.inter_event_min_s = math.inf
    row.cost = 0.0
    row.sup_e_c_scaled = 0.0
    row.settling_s = 0.0


def finish_row(row: Any, status: int, t_s: float, span_s: float, above: bool, norm: float) -> None:
    """Complete a row."""
    gaps, finished = row.transmissions - 1, status == OK
    row.inter_event_min_s = row.inter_event_min_s if gaps > 0 else math.nan
    row.inter_event_mean_s = span_s / gaps if gaps > 0 else math.nan
    row.settling_s = row.settling_s if finished and not above else math.nan
    row.cost = row.cost if finished else math.nan
    row.sup_e_c_scaled = row.sup_e_c_scaled if finished else math.nan
    row.final_norm = norm if finished else math.nan
    row.diverged_at_s = t_s if status == DIVERGED else math.nan
    row.status = status


def count_event(batch: Batch, run: int, row: Any, state: Models, t_s: float, last_s: float) -> bool:
    """Count an event; return whether its update arrives."""
    delivered, log = arrives(batch.network), batch.log
    if row.transmissions < log.event_s.shape[1]:
        log.event_s[run, row.transmissions] = t_s
        log.delivered[run, row.transmissions] = delivered
    if row.transmissions > 0:
        row.inter_event_min_s = min(row.inter_event_min_s, t_s - last_s)
    elif t_s == 0.0 and not delivered:
        row.sup_e_c_scaled = size_of(weighted(batch, state.e_c))
    row.transmissions += 1
    if delivered:
        row.deliveries += 1
    losses = batch.network.decisions[0].consecutive_losses
    row.longest_loss_burst = max(row.longest_loss_burst, losses)
    return delivered


def updated(state: Models, delivered: bool, nothing: Lanes) -> Models:
    """Return the models after an event: x_s = x, and x_c = x if the update arrives."""
    if delivered:
        return Models(state.x_c - state.e_c, nothing, nothing)
    return Models(state.x_c, state.e_c, nothing - state.e_c)


def next_span(
    batch: Batch, squares: QuadraticCurves | None, state: Models, t_s: float
) -> Span:  # fmt: skip
    """Return the rule's span after an event or after the start."""
    x, left, length = state.x_c - state.e_c, 0.0, 0.0
    if squares is not None:
        left = left_side(squares, x)
    if batch.system.rule.forecasts:
        length = size_of(weighted(batch, x))
    return span_after(batch.system.rule, t_s, left, length)


def start_of(squares: QuadraticCurves | None) -> tuple[float, int]:
    """Return the auxiliary variable at the start, and the degree of the first estimate."""
    if squares is not None:
        return squares.initial_dynamic_variable, 2
    return 0.0, 1


def farthest(batch: Batch, squares: QuadraticCurves | None) -> float:
    """Return the length of the longest piece; 0 if no polynomial is accurate."""
    farthest_s = batch.space.reach_s[len(batch.space.reach_s) - 1]
    if squares is not None and squares.decay_per_s > 0.0:
        return min(farthest_s, SLOWEST / squares.decay_per_s)
    return farthest_s


def first_window(
    batch: Batch, squares: QuadraticCurves | None, now: Comparison, point: int, t_s: float
) -> float:
    """Return the length of the first search after an event, from the first coefficients."""
    threshold = now.phase.threshold
    if squares is not None:
        rate, scaled = 2.0 * now.phase.rate_per_s, now.auxiliary / (now.scale * now.scale)
        soon_s = first_look(squares, now.level, rate, scaled)
        return max(_AHEAD * soon_s, point * batch.system.rule.grid_s - t_s)
    speed = size_of(load(batch.space.error, len(batch.n), batch.n))
    if speed == 0.0:
        return math.inf
    if batch.system.rule.integrates:  # of an error that grows in proportion to time: ½ speed s²
        return _AHEAD * math.sqrt(2.0 * max(threshold - now.auxiliary, 0.0) / speed)
    return _AHEAD * threshold / speed


def measure_piece(batch: Batch, row: Any, end: Models, piece: Piece) -> float:
    """Add a piece's contribution to a row.

    Returns:
        The last time on the piece at which ‖x‖ is above the settling level; NONE; or UNRESOLVED.
    """
    n, system, space = batch.n, batch.system, batch.space
    q = degree_for(space.measured_s, piece.length_s)
    row.cost += square_integrals(system, space, q, piece.length_s, n, batch.m)
    growth = math.exp(system.fading_per_s * piece.t_s)
    rise = math.exp(system.fading_per_s * piece.length_s)
    best = max(row.sup_e_c_scaled, size_of(weighted(batch, end.e_c)) * growth * rise)
    if not piece.ceiling <= best * (1.0 + CERTAINTY):
        best = raised(
            best, space.weighted, q, piece.length_s, system.fading_per_s, growth, space.squares, n
        )
    if best == UNRESOLVED:
        return UNRESOLVED
    row.sup_e_c_scaled = best
    within_s = last_above(space.x, q, piece.length_s, piece.settled, end.x_c - end.e_c, n)
    if within_s >= 0.0:
        row.settling_s = piece.t_s + within_s
    return within_s


def size_of(v: Lanes) -> float:
    """Return ‖v‖."""
    return math.sqrt(dot(v, v))


def size_of_state(state: Models) -> float:
    """Return the norm of (x_c, e_c, d)."""
    x_c, e_c, d = state.x_c, state.e_c, state.d
    return math.sqrt(dot(x_c, x_c) + dot(e_c, e_c) + dot(d, d))
