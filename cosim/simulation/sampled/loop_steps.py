"""The loop as the processes run it, step by step; compiled, many runs from event to event.

At step k of the plant, in this order: x advances under the input held since step k − 1, and the
newest actuation is latched. At every ``every``-th step y is measured (with an observer y = x̂), and
the trigger tests it. After an event x_s = y. Delivered updates take effect once they have arrived.
The last tick of the controller before step k + 1 computes the next actuation. Nothing is late.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.trigger.self_triggered_interval import Forecast, interval_ns
from noack.trigger.trigger_arrays import (
    auxiliary_after,
    auxiliary_rate,
    is_event,
    start_condition,
    weighted_norm,
)

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

LARGEST = 1e100
"""A state above this norm counts as diverged."""
NO_TICK = -1


class Loop(NamedTuple):
    """The matrices and the times of a loop; K steps follow step 0."""

    period_ns: int
    """The plant's period h."""
    every: int
    """Steps from one measurement to the next."""
    known_from: int
    """Step from whose end on the controller knows a state; −1: from the start."""
    A: Array
    """(n, n), over a step"""
    B: Array
    """(n, m), over a step"""
    push: Array
    """Change of x by the disturbance of each step, (K, n); (0, n) without one."""
    A_observer: Array
    """Â over a step, (n, n)."""
    B_observer: Array
    """B̂ over a step, (n, m)."""
    C: Array
    """y = C x + v, (p, n)."""
    gains: Array
    """The observer's gain at each measurement, (measurements, n, p); (0, n, p) without one."""
    noise: Array
    """v of each measurement, (measurements, p); (0, p) without noise."""
    model: Array
    """e^{Hh}, (n, n)."""
    tick: Numbers
    """Index of ``input_of`` for the last tick in [t_k, t_{k+1}); ``NO_TICK`` if none, (K + 1,)."""
    input_of: Array
    """K e^{Hs} for each time s from a step to its last tick, (ticks, m, n)."""
    wait: Numbers
    """Steps from an event at each step until its update takes effect, (K + 1,)."""
    age: Numbers
    """Index of ``aged`` for that time, (K + 1,)."""
    aged: Array
    """e^{H wait h}, (ages, n, n)."""
    safe_input: Array
    """The controller's input before it knows a state, (m,)."""


class Scales(NamedTuple):
    """What the values of a run are multiplied with, by the step, (K + 1,)."""

    weight: Array
    """W, (n, n)."""
    error: Array
    state: Array


class Rule(NamedTuple):
    """A trigger rule, with the condition since the last event."""

    trigger: Any
    """(1,) :data:`noack.trigger.trigger_arrays.TRIGGER`."""
    matrices: Array
    """Its matrices."""
    forecasts: bool
    forecast: Forecast
    shortest_ns: float
    longest_ns: float


class Runs(NamedTuple):
    """N runs, changed in place; r is the number of updates that may be in flight."""

    step: Numbers
    """The step of the event before, which is decided; −1 at a start that is no event, (N,)."""
    x: Array
    """(N, n), and the same for the next ones."""
    y: Array
    x_s: Array
    x_c: Array
    u: Array
    """The held input, (N, m)."""
    u_next: Array
    """The newest actuation, (N, m)."""
    sent: Array
    """The step of each update in flight, the oldest first; −1 for none, (N, r)."""
    updates: Array
    """Their states, (N, r, n)."""
    auxiliary: Array
    """η, or the integral, (N,)."""
    is_event: Any
    """Whether the run reached an event, not the last step, (N,)."""
    error: Array
    """The largest scaled ‖W e_c‖ since the event before; infinite if the run diverged, (N,)."""
    state: Array
    """The largest scaled ‖x‖, (N,)."""
    cost: Array
    """∫‖x‖² dt, as a sum over the steps, (N,)."""
    error_at: Numbers
    """Step of the largest ‖W e_c‖, (N,)."""
    state_at: Numbers


class Scratch(NamedTuple):
    """Memory that is written before it is read."""

    a: Array
    b: Array
    z: Array
    """(x, e_s), (2n,)."""
    sides: Array
    """Both sides of the trigger's comparison, (2,)."""
    products: Array
    """Products with the trigger's matrices."""


def follow(
    loop: Loop, rule: Rule, scales: Scales, runs: Runs, last: Numbers, tests: bool, own: Scratch
) -> None:
    """Advance each run to its next event or its ``last`` step; without ``tests``, to the latter."""
    for i in range(len(runs.step)):
        follow_one(loop, rule, scales, runs, i, last[i], tests, own)


def follow_one(
    loop: Loop, rule: Rule, scales: Scales, runs: Runs, i: int, last: int, tests: bool, own: Scratch
) -> None:
    """Advance one run."""
    k, h_s = runs.step[i], loop.period_ns * 1e-9
    runs.is_event[i] = False
    runs.error[i] = runs.state[i] = runs.cost[i] = 0.0
    if k >= 0:
        finish(loop, runs, i, k, own)
    trigger, n, measured = rule.trigger[0], len(own.a), max(k, 0)
    rate = start(rule, measured * loop.period_ns, runs.x_s[i], own)
    if trigger.integrates != 0:
        runs.auxiliary[i] = 0.0
    while k < last:
        k += 1
        if k > 0:
            advance(loop, runs, i, k, own)
        size = length(runs.x[i])
        if not size < LARGEST:
            runs.error[i] = runs.state[i] = runs.cost[i] = math.inf
            break
        if size * scales.state[k] > runs.state[i]:
            runs.state[i], runs.state_at[i] = size * scales.state[k], k
        runs.cost[i] += size * size * h_s if k > 0 else 0.0
        if k % loop.every == 0:
            measure(loop, runs, i, k // loop.every, own)
            if k > loop.known_from:
                note_error(scales, runs, i, k, own)
            place(own.z, runs.y[i], runs.x_s[i])
            following = auxiliary_rate(trigger, rule.matrices, n, own.z, own.products)
            dt_s = (k - measured) * h_s
            auxiliary = auxiliary_after(trigger, dt_s, runs.auxiliary[i], rate, following)
            runs.auxiliary[i], rate, measured = auxiliary, following, k
            if tests and is_event(
                trigger, rule.matrices, k * loop.period_ns, n, own.z, auxiliary, own.sides,
                own.products,
            ):  # fmt: skip
                runs.is_event[i] = True
                break
        finish(loop, runs, i, k, own)
    runs.step[i] = k


def note_error(scales: Scales, runs: Runs, i: int, k: int, own: Scratch) -> None:
    """Keep the largest ‖W e_c‖."""
    subtract(runs.x_c[i], runs.y[i], own.a)
    error = math.sqrt(square(scales.weight, own.a)) * scales.error[k]
    if error > runs.error[i]:
        runs.error[i], runs.error_at[i] = error, k


def advance(loop: Loop, runs: Runs, i: int, k: int, own: Scratch) -> None:
    """Make the plant's step to k, and that of the models; latch the newest actuation."""
    add_product(loop.A, runs.x[i], loop.B, runs.u[i], own.a)
    copy(own.a, runs.x[i])
    if len(loop.push):
        for j in range(len(own.a)):
            runs.x[i, j] += loop.push[k - 1, j]
    if len(loop.gains):
        add_product(loop.A_observer, runs.y[i], loop.B_observer, runs.u[i], own.a)
        copy(own.a, runs.y[i])
    multiply(loop.model, runs.x_s[i], own.a)
    copy(own.a, runs.x_s[i])
    multiply(loop.model, runs.x_c[i], own.a)
    copy(own.a, runs.x_c[i])
    copy(runs.u_next[i], runs.u[i])


def measure(loop: Loop, runs: Runs, i: int, number: int, own: Scratch) -> None:
    """Set y to the measurement of x, or to the corrected estimate."""
    n, x, y = len(own.a), runs.x[i], runs.y[i]
    if len(loop.gains) == 0:
        for j in range(n):
            y[j] = x[j] + (loop.noise[number, j] if len(loop.noise) else 0.0)
        return
    for j in range(len(loop.C)):
        innovation = loop.noise[number, j] if len(loop.noise) else 0.0
        for col in range(n):
            innovation += loop.C[j, col] * (x[col] - y[col])
        own.b[j] = innovation
    for row in range(n):
        for j in range(len(loop.C)):
            y[row] += loop.gains[number, row, j] * own.b[j]


def finish(loop: Loop, runs: Runs, i: int, k: int, own: Scratch) -> None:
    """Apply the updates that arrive during step k, and make the step's last tick."""
    sent = runs.sent[i]
    while sent[0] >= 0 and sent[0] + loop.wait[int(sent[0])] <= k:
        multiply(loop.aged[loop.age[int(sent[0])]], runs.updates[i, 0], runs.x_c[i])
        for j in range(1, len(sent)):
            sent[j - 1] = sent[j]
            copy(runs.updates[i, j], runs.updates[i, j - 1])
        sent[len(sent) - 1] = -1.0
    if loop.tick[k] == NO_TICK:
        return
    if k < loop.known_from:
        copy(loop.safe_input, runs.u_next[i])
    else:
        multiply(loop.input_of[loop.tick[k]], runs.x_c[i], runs.u_next[i])


def start(rule: Rule, t_ns: int, x: Array, own: Scratch) -> float:
    """Apply the rule after an event, or the start, at x; return the rate of η or the integral."""
    trigger, n = rule.trigger[0], len(x)
    start_condition(trigger, rule.matrices, t_ns, x, 0, n, own.z, own.products)
    if rule.forecasts:
        size = weighted_norm(trigger, rule.matrices, x, 0, n, own.products)
        due_ns = interval_ns(rule.forecast, size, t_ns * 1e-9, rule.shortest_ns, rule.longest_ns)
        trigger.latest_ns = t_ns + int(due_ns)
    place(own.z, x, x)
    return auxiliary_rate(trigger, rule.matrices, n, own.z, own.products)


def place(z: Array, y: Array, x_s: Array) -> None:
    """Set z to (y, x_s − y)."""
    n = len(y)
    for j in range(n):
        z[j], z[n + j] = y[j], x_s[j] - y[j]


def square(M: Array, v: Array) -> float:
    """Return ‖M v‖²."""
    total = 0.0
    for row in range(len(M)):
        entry = 0.0
        for j in range(len(v)):
            entry += M[row, j] * v[j]
        total += entry * entry
    return total


def multiply(M: Array, v: Array, out: Array) -> None:
    """Set ``out`` to M v."""
    for row in range(len(M)):
        entry = 0.0
        for j in range(len(v)):
            entry += M[row, j] * v[j]
        out[row] = entry


def add_product(M: Array, v: Array, N: Array, w: Array, out: Array) -> None:
    """Set ``out`` to M v + N w."""
    multiply(M, v, out)
    for row in range(len(N)):
        for j in range(len(w)):
            out[row] += N[row, j] * w[j]


def subtract(v: Array, w: Array, out: Array) -> None:
    """Set ``out`` to v − w."""
    for j in range(len(v)):
        out[j] = v[j] - w[j]


def copy(v: Array, out: Array) -> None:
    """Set ``out`` to v."""
    for j in range(len(v)):
        out[j] = v[j]


def length(v: Array) -> float:
    """Return ‖v‖."""
    total = 0.0
    for j in range(len(v)):
        total += v[j] * v[j]
    return math.sqrt(total)
