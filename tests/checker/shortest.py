"""Runs of loops with one state in which events are as near each other as losses, pushes and noise make them.

Nothing of the checker's model is used: x, x_s and x_c are integrated, not the errors.
"""

import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from noack.proof.elaborate.loop import Loop
from tests.checker.runs import floats

STEP_S = 1e-3
"""Of a run whose rule is tested at all times: its events are up to a step late."""
_UNTIL_S = 40.0
_ROUNDING_S = 1e-9


class Shortest(NamedTuple):
    """The least times of some runs, in s; infinite if there are no such events."""

    first: float
    """From the event at t = 0 to the next one."""
    quiet: float
    """The same of those that come before the first input acts."""
    later: float
    """Between two events, of which the earlier one comes after t = 0, and after the first input."""
    any: float
    """Between two events, of which the earlier one comes after t = 0."""


class _Choice(NamedTuple):
    """What a run does, all along."""

    push: float
    """The sign of all disturbances."""
    is_late: bool
    """Whether updates, the first input, and the inputs that act are as late as they may be."""
    loses: bool
    """Whether updates are lost, as many after each other as may be; else none."""


def shortest_times(loop: Loop, until_s: float = _UNTIL_S) -> Shortest:
    """Return the least times between events of runs that try to have short ones, of a loop with n = m = 1."""
    pushes = (1.0, -1.0) if loop.sizes else (0.0,)
    late = (True, False) if max(loop.times.delay, loop.times.age, loop.times.start) > 0 else (False,)
    loses = (True, False) if loop.losses > 0 else (False,)
    choices = itertools.starmap(_Choice, itertools.product(pushes, late, loses))
    found = [_of_events([*_events(loop, choice, until_s)], _start(loop, choice)) for choice in choices]
    return Shortest(*map(min, zip(*found, strict=True)))


def _of_events(events: list[float], first_input: float) -> Shortest:
    apart = [(a, b - a) for a, b in itertools.pairwise(events)]
    first = apart[0][1] if apart else math.inf
    after = apart[1:]
    return Shortest(
        first,
        first if first < first_input else math.inf,
        min((time for t, time in after if t >= first_input), default=math.inf),
        min((time for _, time in after), default=math.inf),
    )


def _start(loop: Loop, choice: _Choice) -> float:
    """Return when the first input acts."""
    return float(loop.times.start) if choice.is_late else 0.0


def _events(loop: Loop, choice: _Choice, until_s: float) -> Iterator[float]:
    """Yield the times of the events of one run.

    Every other event is late by the noise of its measurement, and each one after it early: e_s begins at the
    one noise, and has to reach the threshold to within the other one.
    """
    times, rule = loop.times, loop.rule
    sampling, delay, age = float(times.sampling), float(times.delay), float(times.age)
    parts = math.ceil(sampling / STEP_S) if sampling else 1
    step = sampling / parts if sampling else STEP_S
    A, B, K, H = (float(floats(M).item()) for M in (loop.A, loop.B, loop.gain, loop.H))
    weight = float(floats(rule.positive)[0, 1])
    level, rate, floor = (float(v.mid()) for v in (rule.level, rule.rate, rule.floor))
    push = choice.push * float(np.abs(floats(loop.pushes)[0]) @ [float(size.mid()) for size in loop.sizes])
    noise = float(np.abs(floats(loop.noise)).sum())
    acting = B * K * math.exp(-H * age) if choice.is_late else B * K
    flow, by_input, by_push = expm(step * np.array([[A, acting, push], [0.0, H, 0.0], [0.0, 0.0, 0.0]]))[
        0
    ].tolist()
    decay, first_input = math.exp(H * step), _start(loop, choice)
    x = float(floats(loop.start).item())
    x_s = x_c = x + noise
    arriving: list[tuple[float, float]] = []
    """Of each update on its way: when it acts, and the prediction that starts with it."""
    lost, is_hidden = 0, True
    yield 0.0
    for k in range(1, round(until_s / step) + 1):
        t = k * step
        x = flow * x + by_push + (by_input * x_c if t - step >= first_input - _ROUNDING_S else 0.0)
        x_s, x_c = decay * x_s, decay * x_c
        arriving = [(acts, decay * state) for acts, state in arriving]
        while arriving and arriving[0][0] <= t + _ROUNDING_S:
            x_c = arriving.pop(0)[1]
        if k % parts:
            continue
        y = x + (1 if is_hidden else -1) * math.copysign(noise, x_s - x)
        if weight * abs(x_s - y) > max(level * math.exp(-rate * t), floor):
            yield t
            x_s, is_hidden = y, not is_hidden
            is_lost = choice.loses and lost < loop.losses
            lost = lost + 1 if is_lost else 0
            if not is_lost and choice.is_late and delay:
                arriving.append((max(t + delay, first_input), x_s))
            elif not is_lost:
                x_c = x_s
