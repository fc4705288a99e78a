"""Random small loops under a schedule, of several kinds, for which there may be a witness."""

from collections.abc import Callable

import numpy as np
from flint import arb, fmpq
from scipy.linalg import solve_continuous_are

from noack.core.balls import beside, identity, matrix, number, zeros
from noack.proof.elaborate.loop import Loop, Rule, Times


def _periodic(rng: np.random.Generator) -> Loop:
    """Return a loop whose events come periodically, or nearly so; some under ideal conditions."""
    loop, zero = _with_a_threshold(rng), fmpq(0)
    times, rule, n = loop.times, loop.rule, loop.n
    least = times.sampling * int(rng.integers(1, 40))
    most = least + times.sampling * fmpq(int(rng.integers(0, 4)), 4) * int(rng.integers(0, 2))
    if rng.random() < 0.2:
        times, most = Times(zero, zero, zero, zero, zero), least
    return loop._replace(
        rule=rule._replace(positive=zeros(0, 2 * n), level=arb(0), rate=arb(0), floor=arb(0)),
        times=times._replace(least_period=least, period=most),
    )


def _noisy(rng: np.random.Generator) -> Loop:
    """Return a loop with noise, often below half the threshold, of some of the kinds above."""
    kinds = [_with_a_threshold, _with_a_threshold, _periodic, _with_long_delays]
    loop = kinds[rng.integers(len(kinds))](rng)
    n, k = loop.n, int(rng.integers(1, loop.n + 1))
    columns = matrix(np.round(rng.normal(size=(n, k)), 2).tolist())
    size = loop._replace(noise=columns).plain_noise.sizes[1]
    share = number(round(float(rng.uniform(0.02, 0.45)), 3)) if size > 0 else arb(0)
    floor = loop.rule.floor.max(number(0.02))
    return loop._replace(noise=columns * (share * floor / size).mid() if size > 0 else columns)


def _with_a_threshold(rng: np.random.Generator) -> Loop:
    n, m = int(rng.integers(1, 4)), 1
    A, B = np.round(rng.normal(size=(n, n)), 3), np.round(rng.normal(size=(n, m)) + 0.5, 3)
    gain = np.round(-B.T @ solve_continuous_are(A, B, np.eye(n), np.eye(m)), 3)
    speed = np.linalg.norm(A + B @ gain, 2)
    error = 0.02 * rng.integers(0, 2)
    sampling = fmpq(int(rng.integers(2, 20)), int(1000 * speed) + 1)
    parts = rng.integers(0, 5, 3)
    least = sampling * fmpq(int(rng.integers(1, 3)), 2)
    delay, age, start = (sampling * fmpq(int(k), 2) for k in parts)
    rate = 0.3 * -np.linalg.eigvals(A + B @ gain).real.max()
    W = identity(n) if rng.random() < 0.5 else matrix(np.round(np.diag(rng.uniform(0.3, 3, n)), 3).tolist())
    has_push = rng.random() < 0.4
    return Loop(
        A=matrix((A * (1 + error * rng.choice([-1, 0, 1], A.shape))).tolist()),
        B=matrix((B * (1 + error)).tolist()),
        half_A=matrix((0.01 * np.abs(A) * rng.integers(0, 2)).tolist()),
        half_B=matrix((0.01 * np.abs(B) * rng.integers(0, 2)).tolist()),
        model_A=matrix(A.tolist()),
        model_B=matrix(B.tolist()),
        gain=matrix(gain.tolist()),
        weight=W,
        holds=False,
        start=matrix(np.round(rng.normal(size=(n, 1)), 2).tolist()),
        rule=Rule(
            beside(zeros(n, n), W),
            zeros(0, 2 * n),
            number(rng.choice([0.0, 0.1, 0.3])),
            number(round(rate, 4)),
            number(rng.choice([0.02, 0.1])),
        ),
        pushes=matrix(np.round(rng.normal(size=(n, 1)), 2).tolist()) if has_push else zeros(n, 0),
        sizes=(arb(0.02),) if has_push else (),
        noise=zeros(n, 0),
        losses=int(rng.integers(0, 4)),
        times=Times(sampling, least, delay, age, start),
    )


def _with_long_delays(rng: np.random.Generator) -> Loop:
    """Return a loop of one state: delays up to four tests, events before the first input, several rules."""
    while (loop := _with_a_threshold(rng)).n > 1:
        pass
    sampling, least = loop.times.sampling, loop.times.least_sampling
    delay, start = (sampling * fmpq(int(rng.integers(low, 9)), 2) for low in (1, 0))
    rule, loop = loop.rule, loop._replace(losses=int(rng.integers(0, 3)), holds=bool(rng.random() < 0.2))
    kind = rng.choice(["threshold", "relative", "quadratic", "deadline"], p=[0.4, 0.3, 0.2, 0.1])
    if kind in {"relative", "quadratic"}:
        size = number(round(float(rng.uniform(0.02, 0.2)), 3))
        rule = rule._replace(level=arb(0), negative=beside(size * loop.weight, zeros(1, 1)))
    if kind == "quadratic":
        rule = rule._replace(positive=rule.positive * number(round(float(rng.uniform(0.5, 5)), 2)))
    rule = rule._replace(always=bool(kind == "deadline"))
    times = loop.times._replace(sampling=sampling, least_sampling=least, delay=delay, start=min(start, delay))
    if rule.always:
        times = times._replace(due=least * int(rng.integers(0, 10)))
    return loop._replace(rule=rule, times=times)


def _quadratic(rng: np.random.Generator) -> Loop:
    """Return a loop whose rule is a quadratic form with mixed terms, sometimes with noise."""
    loop = _with_a_threshold(rng)
    n = loop.n
    of_errors, mixed = rng.normal(size=(n, n)), 0.02 * rng.normal(size=(n, n))
    positive = np.hstack([mixed, of_errors @ of_errors.T + 0.3 * np.eye(n)]).round(3)
    negative = np.hstack([0.02 * rng.normal(size=(n, n)), 0.1 * rng.normal(size=(n, n))]).round(3)
    rule = loop.rule._replace(positive=matrix(positive.tolist()), negative=matrix(negative.tolist()))
    noise = number(0.003) * identity(n) if rng.random() < 0.3 else loop.noise
    return loop._replace(rule=rule, noise=noise)


def _due(rng: np.random.Generator) -> Loop:
    """Return a loop with a deadline, of a threshold that alone would bound little."""
    loop = _with_a_threshold(rng)
    rule = loop.rule._replace(always=True, level=arb(0), floor=number(2.0))
    longest = loop.times.sampling * int(rng.integers(2, 12))
    due = min(loop.times.least_sampling * int(rng.integers(0, 12)), longest)
    return loop._replace(rule=rule, times=loop.times._replace(due=due, longest=longest))


def _area(rng: np.random.Generator) -> Loop:
    """Return a loop whose rule integrates the error, sometimes with noise."""
    loop = _with_a_threshold(rng)
    area = 0.05 * float(rng.integers(1, 10)) * float(loop.times.sampling.p) / float(loop.times.sampling.q)
    rule = loop.rule._replace(integrates=True, level=arb(0), floor=number(round(area, 6)))
    noise = number(0.003) * identity(loop.n) if rng.random() < 0.3 else loop.noise
    return loop._replace(rule=rule, noise=noise)


KINDS: dict[str, Callable[[np.random.Generator], Loop]] = {
    "threshold": _with_a_threshold,
    "periodic": _periodic,
    "noisy": _noisy,
    "long delays": _with_long_delays,
    "quadratic": _quadratic,
    "deadline": _due,
    "area": _area,
}


def random_loop(rng: np.random.Generator, kind: str = "threshold") -> Loop:
    """Return a loop of a kind, with at most three states and three consecutive losses."""
    return KINDS[kind](rng)


def long_run_s(loop: Loop) -> float:
    """Return the time of 600 tests, or of 40 events of a periodic rule."""
    times = loop.times
    return float(arb(40 * times.period if times.period > 0 else 600 * times.sampling))
