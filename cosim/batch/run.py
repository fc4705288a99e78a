"""One run after the other, from event to event; a run's row depends on its own draw only."""

import math
from typing import Any, NamedTuple

from cosim.batch.crossing import NONE, first_exit
from cosim.batch.lanes import Lanes, Width, dot, filled, load, store, times
from cosim.batch.measures import CERTAINTY, last_above, raised, square_integrals
from cosim.batch.status import DIVERGED, OK, TOO_MANY_EVENTS
from cosim.batch.taylor import Array, degree_for, driven, powers, reaches, value
from netem.rules.link import DELIVERED, FORCED, Program, State, admit
from netem.rules.mansd import NEVER_NS

_LARGEST = 1e100
"""Beyond, a state is said to have diverged, as in :mod:`cosim.exact.loop`."""
_AHEAD = 1.25
"""A first look goes so many times as far as the error at its first speed needs."""


class System(NamedTuple):
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
    beta: float
    alpha_per_s: float
    floor: float
    floor_from_s: float
    """From when on the floor is the threshold."""
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


class Space(NamedTuple):
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
    sizes: Array


class Network(NamedTuple):
    """The compiled rules of the link, and what they remember."""

    program: Program
    state: State
    verdicts: Any
    """One, of :class:`netem.records.Verdict`."""


class Log(NamedTuple):
    """Where events go, as far as there is room."""

    event_s: Array
    delivered: Any


def run_many(
    n: Width, m: Width, system: System, draws: Draws, network: Network, space: Space,
    rows: Any, log: Log,
) -> None:  # fmt: skip
    """Run k draws; each fills a row."""
    powers(system.H, 0, system.H_k, n)
    for run in range(len(rows)):
        renew(network, draws.keys, run, system.first_delivered)
        prepare(n, m, system, draws, space, run)
        follow(n, m, system, draws, network, space, run, rows[run], log)


def renew(network: Network, keys: Any, run: int, first_delivered: bool) -> None:
    """Let the link be that of a run: before its first update, with the run's random streams."""
    flow = network.state.flows[0]
    flow.packets = 0
    flow.run = 0
    flow.forced_first = 1 if first_delivered else 0
    flow.first_release_ns = NEVER_NS
    flow.score = 0.0
    flow.newest = -1
    flow.since = 0
    flow.longest_run = 0
    for stage in range(len(network.program.stages)):
        network.program.stages[stage].key0 = keys[run, stage, 0]
        network.program.stages[stage].key1 = keys[run, stage, 1]
        network.state.memory[0][stage].phase = 0
        network.state.memory[0][stage].score = 0.0


def arrives(network: Network) -> bool:
    """Whether the next update does."""
    admit(network.program, network.state, 0, 1, 0, network.verdicts[0])
    fate = network.verdicts[0].fate
    return fate in (DELIVERED, FORCED)


def prepare(n: Width, m: Width, system: System, draws: Draws, space: Space, run: int) -> None:
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
    n: Width, m: Width, system: System, space: Space, x_c: Lanes, e_c: Lanes, d: Lanes,
    begin: int, end: int,
) -> None:  # fmt: skip
    """Write the coefficients of degree ``begin`` to ``end``."""
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
            store(space.error, place, error + apart)
            store(space.weighted, place, error)
        else:
            store(space.error, place, times(system.weight, 0, error + apart, n))
            store(space.weighted, place, times(system.weight, 0, error, n))


def follow(
    n: Width, m: Width, system: System, draws: Draws, network: Network, space: Space, run: int,
    row: Any, log: Log,
) -> None:  # fmt: skip
    """Follow one run to its end."""
    size = len(n)
    x_c = load(draws.x0, run * size, n)
    nothing = filled(0.0, n)
    e_c, d = nothing, nothing
    start = math.sqrt(dot(x_c, x_c))
    level = system.settle * start
    farthest_s = space.reach_s[len(space.reach_s) - 1]
    t_s, last_s, above_s = 0.0, -1.0, 0.0
    shortest_s, first_s = math.inf, 0.0
    events, deliveries, status = 0, 0, OK
    cost, best, above = 0.0, 0.0, start > level
    fresh, agree = True, True
    if not system.known_start:
        e_c = nothing - x_c
        x_c = nothing
        event = True
    else:
        event = False
    while True:
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
        # The threshold is c e^{−ρ(t − t_s)} until until_s.
        threshold, rate, until_s = system.floor, 0.0, system.horizon_s
        if t_s < system.floor_from_s:
            rate = system.alpha_per_s
            threshold = system.beta * math.exp(-rate * t_s)
            until_s = min(until_s, system.floor_from_s)
        largest = math.sqrt(dot(x_c, x_c) + dot(e_c, e_c) + dot(d, d))
        if not largest * max(1.0, 1.0 / threshold) < _LARGEST:
            status = DIVERGED
            break
        # How far to look, and at which degree.
        window_s = farthest_s
        expand(n, m, system, space, x_c, e_c, d, 0, 1)
        if fresh:
            first = load(space.error, size, n)
            speed = math.sqrt(dot(first, first))
            if speed * window_s > _AHEAD * threshold:
                window_s = _AHEAD * threshold / speed
        closes = window_s >= until_s - t_s
        if closes:
            window_s = until_s - t_s
        p = degree_for(space.reach_s, window_s)
        expand(n, m, system, space, x_c, e_c, d, 2, p)
        found_s = first_exit(space.error, p, threshold, rate, window_s, False, n)
        event = found_s != NONE
        spent_s = found_s if event else window_s
        p = degree_for(space.reach_s, spent_s)
        x_c, e_c = value(space.x_c, p, spent_s, n), value(space.e_c, p, spent_s, n)
        if not event:
            d = value(space.d, p, spent_s, n)
        # What the piece is worth.
        q = degree_for(space.measured_s, spent_s)
        cost += square_integrals(
            space.x, space.u, q, spent_s, system.Q, system.R, system.inverse,
            space.x_scaled, space.u_scaled, n, m,
        )  # fmt: skip
        weighted = e_c if len(system.weight) == 0 else times(system.weight, 0, e_c, n)
        growth = math.exp(system.alpha_per_s * t_s)
        grown = growth * math.exp(system.alpha_per_s * spent_s)
        best = max(best, math.sqrt(dot(weighted, weighted)) * grown)
        # While both models agree, e_c is e_s, which is below a threshold that meets it at an event.
        ceiling = math.inf
        if agree:
            ceiling = threshold * (grown if rate == 0.0 else growth)
        if not ceiling <= best * (1.0 + CERTAINTY):
            best = raised(best, space.weighted, q, spent_s, system.alpha_per_s, growth, n)
        within_s = last_above(space.x, q, spent_s, level, x_c - e_c, n)
        if within_s != NONE:
            above_s = t_s + within_s
        above = within_s == spent_s
        fresh = False
        t_s = until_s if closes and not event else t_s + spent_s
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
