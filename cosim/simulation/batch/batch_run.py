"""One run after the other, from event to event; a run's row depends on its own draw only."""

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
    first_event,
    first_look,
    left_side,
    put,
    reserve_at,
    scale_of,
)
from cosim.simulation.batch.taylor import Array, degree_for, driven, powers, reaches, value
from cosim.simulation.batch.vector_lanes import Lanes, Width, dot, filled, load, store, times
from netem.rules.link_rules import admit
from noack.impairments.link_records import DELIVERED, FORCED, NEVER_NS, LinkMemory, LinkProgram

_LARGEST = 1e100
"""Beyond, a state is said to have diverged, as in ``continuous_loop``."""
_MOST_PIECES = 1_000_000
"""Of a run: some 2 s."""
_AHEAD = 1.25
"""A first look goes so many times as far as the error at its first speed needs."""


class BatchSystem(NamedTuple):
    """What all runs share; matrices by columns, one number after the other."""

    H: Array
    K: Array
    weight: Array
    """W; empty: the identity."""
    Q: Array
    """Empty: the identity."""
    R: Array
    """Empty: the identity."""
    inverse: Array
    """1/k at place k."""
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
    """What is each run's own; matrices by columns, one run after the other."""

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
    """How far polynomials carry, by degree."""
    measured_s: Array
    """The same for what is measured."""
    x_c: Array
    """Coefficients, as all that follow."""
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
    """The compiled rules of the link, and what they remember."""

    program: LinkProgram
    state: LinkMemory
    verdicts: Any
    """One, of :class:`noack.impairments.link_records.PacketDecision`."""


class EventLog(NamedTuple):
    """Where events go, as far as there is room."""

    event_s: Array
    delivered: Any


def run_many(
    n: Width, m: Width, system: BatchSystem, draws: Draws, network: LossTable, space: BatchMemory,
    squares: QuadraticCurves | None, rows: Any, log: EventLog,
) -> None:  # fmt: skip
    """Run k draws; each fills a row.

    Without ``squares`` the rule compares ‖W e_s‖ with its threshold, or nothing. The two are
    compiled apart, each when it is first wanted.
    """
    powers(system.H, 0, system.H_k, n)
    for run in range(len(rows)):
        renew(network, draws.keys, run, system.first_delivered)
        prepare(n, m, system, draws, space, run)
        follow(n, m, system, draws, network, space, squares, run, rows[run], log)


def renew(network: LossTable, keys: Any, run: int, first_delivered: bool) -> None:
    """Let the link be that of a run: before its first update, with the run's random streams."""
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
    """Whether the next update does."""
    admit(network.program, network.state, 0, 1, 0, network.verdicts[0])
    fate = network.verdicts[0].fate
    return fate in (DELIVERED, FORCED)


def prepare(
    n: Width, m: Width, system: BatchSystem, draws: Draws, space: BatchMemory, run: int
) -> None:
    """Make a plant's tables."""
    size, inputs = len(n), len(m)
    A, B = run * size * size, run * size * inputs
    for j in range(size):
        BK = times(draws.B, B, load(system.K, j * inputs, m), n)
        store(
            space.E,
            j * size,
            load(draws.A, A + j * size, n) + BK - load(system.H, j * size, n),
        )
    powers(draws.A, A, space.A_k, n)
    driven(draws.A, A, space.E, system.H_k, space.X_k, n)
    reaches(
        system.H_k, space.A_k, space.X_k, space.E, space.sizes, space.reach_s, space.measured_s, n
    )


def expand(
    n: Width, m: Width, system: BatchSystem, space: BatchMemory,
    squares: QuadraticCurves | None, factor: float,
    x_c: Lanes, e_c: Lanes, d: Lanes, begin: int, end: int,
) -> None:  # fmt: skip
    """Write the coefficients of degree ``begin`` to ``end``; ``squares``' are times a factor."""
    size, inputs = len(n), len(m)
    for k in range(begin, end + 1):
        table, place = k * size * size, k * size
        model = times(system.H_k, table, x_c, n)
        error = times(space.A_k, table, e_c, n) + times(space.X_k, table, x_c, n)
        apart = times(system.H_k, table, d, n)
        store(space.x_c, place, model)
        store(space.e_c, place, error)
        store(space.d, place, apart)
        store(space.x, place, model - error)
        store(space.u, k * inputs, times(system.K, 0, model, m))
        if len(system.weight) == 0:
            store(space.weighted, place, error)
        else:
            store(space.weighted, place, times(system.weight, 0, error, n))
        if squares is not None:
            put(squares, k, model - error, error + apart, factor)
        elif len(system.weight) == 0:
            store(space.error, place, error + apart)
        else:
            store(space.error, place, times(system.weight, 0, error + apart, n))


def follow(
    n: Width, m: Width, system: BatchSystem, draws: Draws, network: LossTable, space: BatchMemory,
    squares: QuadraticCurves | None, run: int, row: Any, log: EventLog,
) -> None:  # fmt: skip
    """Follow one run to its end."""
    size, rule = len(n), system.rule
    x_c = load(draws.x0, run * size, n)
    nothing = filled(0.0, n)
    e_c, d = nothing, nothing
    start = math.sqrt(dot(x_c, x_c))
    settled = system.settle * start
    farthest_s = space.reach_s[len(space.reach_s) - 1]
    t_s, last_s, above_s = 0.0, -1.0, 0.0
    shortest_s, first_s = math.inf, 0.0
    events, deliveries, status = 0, 0, OK
    cost, best, above = 0.0, 0.0, start > settled
    fresh, looked, agree = True, False, True
    span, point = Span(0.0, 0.0, 0.0, 0.0, 0.0, 0), 0
    auxiliary, scale, level, degree, first_degree = 0.0, 1.0, 0.0, 0, 1
    if squares is not None:
        auxiliary, first_degree = squares.initial_dynamic_variable, 2
        if squares.decay_per_s > 0.0:
            farthest_s = min(farthest_s, SLOWEST / squares.decay_per_s)
    if not system.known_start:
        e_c = nothing - x_c
        x_c = nothing
        event = True
    else:
        event = False
    for _ in range(_MOST_PIECES if farthest_s > 0.0 else 0):
        if event:
            if events >= system.most_events or t_s <= last_s:
                status = TOO_MANY_EVENTS
                break
            delivered = arrives(network)
            if events < len(log.event_s):
                log.event_s[events] = t_s
                log.delivered[events] = delivered
            if events == 0:
                first_s = t_s
            else:
                shortest_s = min(shortest_s, t_s - last_s)
            last_s = t_s
            events += 1
            if delivered:
                deliveries += 1
                x_c = x_c - e_c
                e_c, d, agree = nothing, nothing, True
            else:
                agree = False
                d = nothing - e_c
                if events == 1 and t_s == 0.0:
                    w = e_c if len(system.weight) == 0 else times(system.weight, 0, e_c, n)
                    best = max(best, math.sqrt(dot(w, w)))
            fresh = True
        if t_s >= system.horizon_s:
            break
        if fresh:
            x, left, length = x_c - e_c, 0.0, 0.0
            if squares is not None:
                left = left_side(squares, x)
            if rule.forecasts:
                w = x if len(system.weight) == 0 else times(system.weight, 0, x, n)
                length = math.sqrt(dot(w, w))
            span = span_after(rule, t_s, left, length)
            point, fresh, looked = span.point, False, False
            if rule.integrates:
                auxiliary = 0.0
        phase = phase_at(rule, span, t_s)
        until_s = min(phase.until_s, system.horizon_s)
        threshold, rate = phase.threshold, phase.rate_per_s
        # How far to look, and at which degree.
        window_s = farthest_s
        if squares is not None:
            size_now = dot(x_c, x_c) + dot(e_c, e_c) + dot(d, d)
            scale = scale_of(math.sqrt(size_now), threshold, auxiliary)
            level = (threshold / scale) * (threshold / scale)
        expand(n, m, system, space, squares, 1.0 / scale, x_c, e_c, d, 0, first_degree)
        if phase.compares and not looked:
            if not is_within(x_c, e_c, d, _LARGEST, threshold):
                status = DIVERGED
                break
            if squares is None:
                first = load(space.error, size, n)
                speed = math.sqrt(dot(first, first))
                if rule.integrates:  # an error of constant speed: its integral is ½ speed s²
                    left_s = math.sqrt(2.0 * max(threshold - auxiliary, 0.0) / max(speed, 1e-300))
                    window_s = min(window_s, _AHEAD * left_s)
                elif speed * window_s > _AHEAD * threshold:
                    window_s = _AHEAD * threshold / speed
            else:
                soon_s = first_look(squares, level, 2.0 * rate, auxiliary / (scale * scale))
                window_s = min(window_s, max(_AHEAD * soon_s, point * rule.grid_s - t_s))
            looked = True
        closes = window_s >= until_s - t_s
        if closes:
            window_s = until_s - t_s
        p = degree_for(space.reach_s, window_s)
        expand(n, m, system, space, squares, 1.0 / scale, x_c, e_c, d, first_degree + 1, p)
        found_s = NONE
        if squares is not None and (phase.compares or len(squares.gain) > 0):
            degree = compare(squares, p, auxiliary / (scale * scale))
        if rule.integrates:
            found_s, auxiliary = first_excess(
                space.error, p, auxiliary, threshold if phase.compares else math.inf, rate,
                window_s, n,
            )  # fmt: skip
        elif phase.compares:
            if squares is None:
                found_s = first_exit(
                    space.error, p, threshold, rate, window_s, False, MOST_STEPS, n
                )
            else:
                found_s, point = first_event(
                    squares, rule, degree, level, 2.0 * rate, point, t_s, window_s
                )
        if found_s == UNRESOLVED:
            status = UNDECIDED
            break
        event = found_s != NONE
        spent_s = found_s if event else window_s
        if squares is not None:
            auxiliary = reserve_at(squares, p, spent_s) * (scale * scale)
        p = degree_for(space.reach_s, spent_s)
        x_c, e_c = value(space.x_c, p, spent_s, n), value(space.e_c, p, spent_s, n)
        d = value(space.d, p, spent_s, n)
        growth, rise = math.exp(system.fading_per_s * t_s), math.exp(system.fading_per_s * spent_s)
        faded = threshold
        if rate > 0.0:
            # Where it fades as the supremum is scaled, an exponential is saved.
            faded *= 1.0 / rise if rate == system.fading_per_s else math.exp(-rate * spent_s)
        if not is_within(x_c, e_c, d, _LARGEST, faded):
            status = DIVERGED
            t_s += passed_at(
                space.x_c, space.e_c, space.d, p, spent_s, _LARGEST, threshold, rate, n
            )
            break
        # What the piece is worth.
        q = degree_for(space.measured_s, spent_s)
        cost += square_integrals(
            space.x, space.u, q, spent_s, system.Q, system.R, system.inverse,
            space.x_scaled, space.u_scaled, n, m,
        )  # fmt: skip
        weighted = e_c if len(system.weight) == 0 else times(system.weight, 0, e_c, n)
        grown = growth * rise
        best = max(best, math.sqrt(dot(weighted, weighted)) * grown)
        # While both models agree, e_c is e_s, which is below a threshold that meets it at an event.
        ceiling = math.inf
        if agree and phase.compares and squares is None and not rule.integrates:
            ceiling = threshold * (grown if rate == 0.0 else growth)
        if not ceiling <= best * (1.0 + CERTAINTY):
            best = raised(
                best, space.weighted, q, spent_s, system.fading_per_s, growth, space.squares, n
            )
        within_s = last_above(space.x, q, spent_s, settled, x_c - e_c, n)
        if best == UNRESOLVED or within_s == UNRESOLVED:
            status = UNDECIDED
            break
        if within_s != NONE:
            above_s = t_s + within_s
        above = within_s == spent_s
        t_s = until_s if closes and not event else t_s + spent_s
        event = event or t_s >= span.due_s
    else:
        status = UNDECIDED
    x = x_c - e_c
    row.transmissions = events
    row.deliveries = deliveries
    row.inter_event_min_s = shortest_s if events > 1 else math.nan
    row.inter_event_mean_s = (last_s - first_s) / (events - 1) if events > 1 else math.nan
    finished = status == OK
    row.settling_s = above_s if finished and not above else math.nan
    row.cost = cost if finished else math.nan
    row.sup_e_c_scaled = best if finished else math.nan
    row.final_norm = math.sqrt(dot(x, x)) if finished else math.nan
    row.diverged_at_s = t_s if status == DIVERGED else math.nan
    row.status = status
