"""Computes runs one by one, from event to event; a run's row depends on its own draw only."""

import math
from typing import Any, NamedTuple

from cosim.simulation.batch.batch_rule import Rule, Span, phase_at, span_after
from cosim.simulation.batch.batch_status import DIVERGED, OK, TOO_MANY_EVENTS, UNDECIDED
from cosim.simulation.batch.integral_crossing import first_excess
from cosim.simulation.batch.norm_crossing import MOST_STEPS, NONE, UNRESOLVED, first_exit
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
from cosim.simulation.batch.taylor import Array, degree_for, driven, powers, reaches, value
from cosim.simulation.batch.vector_lanes import Lanes, Width, dot, filled, load, store, times
from netem.rules.link_rules import admit
from noack.impairments.link_records import DELIVERED, FORCED, NEVER_NS, LinkMemory, LinkProgram

_LARGEST = 1e100
"""A state above this norm counts as diverged, as in ``continuous_loop``."""
_MOST_PIECES = 1_000_000
"""Largest number of pieces of a run; computing them takes about 2 s."""
_AHEAD = 1.25
"""Length of the first search after an event, in units of the time that the error would need at its
initial speed."""


class BatchSystem(NamedTuple):
    """The data that all runs share; matrices in column-major order."""

    H: Array
    K: Array
    weight: Array
    """W; empty: the identity."""
    Q: Array
    """Empty: the identity."""
    R: Array
    """Empty: the identity."""
    inverse: Array
    """1/k at index k."""
    H_k: Array
    """Table of H^k/k!."""
    rule: Rule
    fading_per_s: float
    """α of the supremum of ‖W e_c‖ e^{αt}."""
    horizon_s: float
    known_start: bool
    first_delivered: bool
    settle: float
    most_events: int


class Draws(NamedTuple):
    """The data that differ between the runs; matrices in column-major order, run by run."""

    A: Array
    B: Array
    x0: Array
    keys: Any
    """Keys of the random streams, (runs, stages, 2)."""


class BatchMemory(NamedTuple):
    """Scratch, written before it is read."""

    E: Array
    A_k: Array
    X_k: Array
    reach_s: Array
    """Time over which a polynomial is accurate, by degree."""
    measured_s: Array
    """The same, at the accuracy of the measures."""
    x_c: Array
    """Coefficients, as in all arrays below."""
    e_c: Array
    d: Array
    x: Array
    u: Array
    error: Array
    """W e_s."""
    weighted: Array
    """W e_c."""
    x_scaled: Array
    u_scaled: Array
    squares: Array
    """Coefficients of ‖W e_c‖²."""
    sizes: Array


class LossTable(NamedTuple):
    """The compiled rules of the link, and their state."""

    program: LinkProgram
    state: LinkMemory
    verdicts: Any
    """One :class:`noack.impairments.link_records.PacketDecision`."""


class EventLog(NamedTuple):
    """The events of a run, up to the length of the arrays."""

    event_s: Array
    delivered: Any


class Batch(NamedTuple):
    """All data of a batch."""

    n: Width
    """Tuple of n entries, n the number of states."""
    m: Width
    """Tuple of m entries, m the number of inputs."""
    system: BatchSystem
    draws: Draws
    network: LossTable
    space: BatchMemory
    log: EventLog


class Models(NamedTuple):
    """The state of a run in the coordinates of :mod:`cosim.simulation.batch.taylor`."""

    x_c: Lanes
    e_c: Lanes
    d: Lanes


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
        follow(batch, squares, run, rows[run])


def renew(network: LossTable, keys: Any, run: int, first_delivered: bool) -> None:
    """Reset the link to its state before a run's first update, with the run's random streams."""
    flow = network.state.flows[0]
    flow.packets = 0
    flow.consecutive_losses = 0
    flow.forced_first = 1 if first_delivered else 0
    flow.first_release_ns = NEVER_NS
    flow.score = 0.0
    flow.newest = -1
    flow.since = 0
    flow.longest_loss_burst = 0
    for stage in range(len(network.program.stages)):
        network.program.stages[stage].key0 = keys[run, stage, 0]
        network.program.stages[stage].key1 = keys[run, stage, 1]
        network.state.memory[0][stage].phase = 0
        network.state.memory[0][stage].score = 0.0


def arrives(network: LossTable) -> bool:
    """Return whether the next update arrives."""
    admit(network.program, network.state, 0, 1, 0, network.verdicts[0])
    fate = network.verdicts[0].fate
    return fate in (DELIVERED, FORCED)


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
    n, system, space = batch.n, batch.system, batch.space
    rule = system.rule
    nothing = filled(0.0, n)
    x0 = load(batch.draws.x0, run * len(n), n)
    settled = system.settle * math.sqrt(dot(x0, x0))
    farthest_s = space.reach_s[len(space.reach_s) - 1]
    auxiliary, first_degree = 0.0, 1
    if squares is not None:
        auxiliary, first_degree = squares.initial_dynamic_variable, 2
        if squares.decay_per_s > 0.0:
            farthest_s = min(farthest_s, SLOWEST / squares.decay_per_s)
    event = not system.known_start
    state = Models(nothing, nothing - x0, nothing) if event else Models(x0, nothing, nothing)
    t_s, last_s, first_s, status = 0.0, -1.0, 0.0, OK
    above, fresh, looked, agree = math.sqrt(dot(x0, x0)) > settled, True, False, True
    span, point, scale, level = Span(0.0, 0.0, 0.0, 0.0, 0.0, 0), 0, 1.0, 0.0
    begin_row(row)
    for _ in range(_MOST_PIECES if farthest_s > 0.0 else 0):
        if event:
            if row.transmissions >= system.most_events or t_s <= last_s:
                status = TOO_MANY_EVENTS
                break
            agree = count_event(batch, row, t_s, last_s)
            if row.transmissions == 1:
                first_s = t_s
                if t_s == 0.0 and not agree:
                    row.sup_e_c_scaled = size_of(weighted(batch, state.e_c))
            last_s, fresh = t_s, True
            state = updated(state, agree, nothing)
        if t_s >= system.horizon_s:
            break
        if fresh:
            span = next_span(batch, squares, state, t_s)
            point, fresh, looked = span.point, False, False
            if rule.integrates:
                auxiliary = 0.0
        phase = phase_at(rule, span, t_s)
        until_s = min(phase.until_s, system.horizon_s)
        threshold, rate = phase.threshold, phase.rate_per_s
        # The degree, and the length of the first search after an event.
        window_s = farthest_s
        if squares is not None:
            scale = scale_of(size_of_state(state), threshold, auxiliary)
            level = (threshold / scale) * (threshold / scale)
        expand(batch, squares, state, 1.0 / scale, 0, first_degree)
        if phase.compares and not looked:
            if not is_within(state.x_c, state.e_c, state.d, _LARGEST, threshold):
                status = DIVERGED
                break
            if squares is None:
                window_s = min(window_s, first_window(batch, threshold, auxiliary))
            else:
                soon_s = first_look(squares, level, 2.0 * rate, auxiliary / (scale * scale))
                window_s = min(window_s, max(_AHEAD * soon_s, point * rule.grid_s - t_s))
            looked = True
        closes = window_s >= until_s - t_s
        if closes:
            window_s = until_s - t_s
        p = degree_for(space.reach_s, window_s)
        expand(batch, squares, state, 1.0 / scale, first_degree + 1, p)
        # The event.
        found_s = NONE
        if squares is not None:
            if phase.compares or len(squares.gain) > 0:
                degree = compare(squares, p, auxiliary / (scale * scale))
                if phase.compares:
                    found_s, point = first_event(
                        squares, rule, degree, level, 2.0 * rate, point, t_s, window_s
                    )
        elif rule.integrates:
            found_s, auxiliary = first_excess(
                space.error, p, auxiliary, threshold if phase.compares else math.inf, rate,
                window_s, n,
            )  # fmt: skip
        elif phase.compares:
            found_s = first_exit(space.error, p, threshold, rate, window_s, False, MOST_STEPS, n)
        if found_s == UNRESOLVED:
            status = UNDECIDED
            break
        event = found_s != NONE
        spent_s = found_s if event else window_s
        if squares is not None:
            auxiliary = dynamic_variable_at(squares, p, spent_s) * (scale * scale)
        p = degree_for(space.reach_s, spent_s)
        x_c, e_c = value(space.x_c, p, spent_s, n), value(space.e_c, p, spent_s, n)
        state = Models(x_c, e_c, value(space.d, p, spent_s, n))
        # The end of a run that diverges.
        decayed = threshold * math.exp(-rate * spent_s) if rate > 0.0 else threshold
        if not is_within(state.x_c, state.e_c, state.d, _LARGEST, decayed):
            status = DIVERGED
            t_s += passed_at(
                space.x_c, space.e_c, space.d, p, spent_s, _LARGEST, threshold, rate, n
            )
            break
        # While both models agree, e_c = e_s, and ‖W e_s‖ is at most the threshold between events.
        ceiling = math.inf
        if agree and phase.compares and squares is None and not rule.integrates:
            until = t_s + (spent_s if rate == 0.0 else 0.0)
            ceiling = threshold * math.exp(system.fading_per_s * until)
        within_s = measure_piece(batch, row, state, Piece(t_s, spent_s, settled, ceiling))
        if within_s == UNRESOLVED:
            status = UNDECIDED
            break
        above = within_s == spent_s
        t_s = until_s if closes and not event else t_s + spent_s
        event = event or t_s >= span.due_s
    else:
        status = UNDECIDED
    finish_row(row, status, t_s, last_s - first_s, above, size_of(state.x_c - state.e_c))


def begin_row(row: Any) -> None:
    """Initialise a row to the values before the first event."""
    row.transmissions = 0
    row.deliveries = 0
    row.inter_event_min_s = math.inf
    row.cost = 0.0
    row.sup_e_c_scaled = 0.0
    row.settling_s = 0.0


def finish_row(row: Any, status: int, t_s: float, span_s: float, above: bool, norm: float) -> None:
    """Complete a row.

    Args:
        row: the row, with its sums and extremes up to ``t_s``.
        status: how the run ended.
        t_s: end of the run.
        span_s: time from the first event to the last.
        above: whether ‖x‖ is above the settling level at the end.
        norm: ‖x‖ at the end.
    """
    gaps, finished = row.transmissions - 1, status == OK
    row.inter_event_min_s = row.inter_event_min_s if gaps > 0 else math.nan
    row.inter_event_mean_s = span_s / gaps if gaps > 0 else math.nan
    row.settling_s = row.settling_s if finished and not above else math.nan
    row.cost = row.cost if finished else math.nan
    row.sup_e_c_scaled = row.sup_e_c_scaled if finished else math.nan
    row.final_norm = norm if finished else math.nan
    row.diverged_at_s = t_s if status == DIVERGED else math.nan
    row.status = status


def count_event(batch: Batch, row: Any, t_s: float, last_s: float) -> bool:
    """Count an event; return whether its update arrives."""
    delivered, log = arrives(batch.network), batch.log
    if row.transmissions < len(log.event_s):
        log.event_s[row.transmissions] = t_s
        log.delivered[row.transmissions] = delivered
    if row.transmissions > 0:
        row.inter_event_min_s = min(row.inter_event_min_s, t_s - last_s)
    row.transmissions += 1
    if delivered:
        row.deliveries += 1
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


def first_window(batch: Batch, threshold: float, auxiliary: float) -> float:
    """Return the length of the first search after an event, from the error's initial speed."""
    speed = size_of(load(batch.space.error, len(batch.n), batch.n))
    if speed == 0.0:
        return math.inf
    if batch.system.rule.integrates:  # of an error that grows in proportion to time: ½ speed s²
        return _AHEAD * math.sqrt(2.0 * max(threshold - auxiliary, 0.0) / speed)
    return _AHEAD * threshold / speed


def measure_piece(batch: Batch, row: Any, end: Models, piece: Piece) -> float:
    """Add a piece's contribution to a row.

    Args:
        batch: the batch; its memory contains the coefficients of the piece.
        row: the row, with its sums and extremes up to the piece.
        end: the state at the end of the piece.
        piece: the piece.

    Returns:
        The last time on the piece at which ‖x‖ is above the settling level; NONE; or UNRESOLVED.
    """
    n, system, space = batch.n, batch.system, batch.space
    q = degree_for(space.measured_s, piece.length_s)
    row.cost += square_integrals(
        space.x, space.u, q, piece.length_s, system.Q, system.R, system.inverse,
        space.x_scaled, space.u_scaled, n, batch.m,
    )  # fmt: skip
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
