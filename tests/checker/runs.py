"""Runs of a loop with exact steps, random or worst losses, delays, ages and disturbances, beside a proof.

Nothing of the checker's model is used: x, x_s and x_c are integrated, not the errors.
"""

import functools
from collections.abc import Iterable
from itertools import count
from typing import NamedTuple

import numpy as np
from flint import fmpq
from numpy.typing import NDArray
from scipy.linalg import expm

from noack.core.balls import number
from noack.proof.elaborate.loop import Loop
from noack.proof.search.results import Proof

Array = NDArray[np.float64]
_ROUNDING = 1e-9
_SECONDS, _LESS = 3.0, 0.9
"""Of runs within several proofs; and the share of a threshold of which its tests are."""
_PARTS = 5
"""Of the period of a periodic rule: ages and disturbances may change after each."""


def floats(M: object) -> Array:
    """Return a matrix of balls as floats."""
    return np.array([[float(v.mid()) for v in row] for row in M.tolist()]).reshape(M.nrows(), M.ncols())  # type: ignore[attr-defined]


class Exceeded(NamedTuple):
    """A bound that a run exceeded."""

    output: str
    time: float
    value: float
    bound: float


class _Sample(NamedTuple):
    """The states at a time of a run, the age of the input that acts, and the signs of the disturbances."""

    time: float
    z: Array
    """x, x_s, x_c, x̂ and 1."""
    age: float | None
    """None: no input acts yet."""
    signs: tuple[float, ...]


class _Plant:
    """One plant of the box; steps under an input K e^{−Hs} x_c of some age and a disturbance."""

    def __init__(self, loop: Loop, rng: np.random.Generator) -> None:
        self.n, self.H, self.gain = loop.n, floats(loop.H), floats(loop.gain)
        signs = [rng.choice([-1.0, 0.0, 1.0], floats(M).shape) for M in (loop.half_A, loop.half_B)]
        self.A = floats(loop.A) + signs[0] * floats(loop.half_A)
        self.B = floats(loop.B) + signs[1] * floats(loop.half_B)
        self.outputs = floats(loop.output_rows)
        self.pushes = floats(loop.pushes) * np.array([float(size.mid()) for size in loop.sizes])
        push = loop.push_before_input
        self.early = np.zeros(self.n) if push is None else floats(push)[:, 0]
        self.step = functools.lru_cache(4096)(self._step)
        self.predict = functools.lru_cache(4096)(lambda dt: np.asarray(expm(self.H * dt)))
        self.input_matrix = functools.lru_cache(16)(self._input_matrix)

    def _input_matrix(self, age: float | None) -> Array:
        return 0 * self.gain if age is None else self.gain @ expm(-self.H * age)

    def _step(self, age: float | None, signs: tuple[float, ...], dt: float) -> Array:
        """Return the exact step of (x, x_s, x_c, x̂, 1)."""
        n = self.n
        F = np.zeros((4 * n + 1, 4 * n + 1))
        F[3 * n : 4 * n, 3 * n : 4 * n] = self.A
        F[3 * n : 4 * n, 2 * n : 3 * n] = self.B @ self.input_matrix(age)
        F[:n, :n], F[:n, 2 * n : 3 * n] = self.A, self.B @ self.input_matrix(age)
        F[:n, -1] = self.pushes @ np.array(signs) + (self.early if age is None else 0.0)
        F[n : 2 * n, n : 2 * n] = F[2 * n : 3 * n, 2 * n : 3 * n] = self.H
        return np.asarray(expm(F * dt))


def exceeded(
    loop: Loop, proof: Proof, rng: np.random.Generator, until: float, *, by_forms: bool = True
) -> list[Exceeded]:
    """Return where a random run exceeds what is proven; by forms this is a root of a sum of squares."""
    plant, times, rule = _Plant(loop, rng), [float(t.p) / float(t.q) for t in loop.times], loop.rule
    sampling, least, delay, age, start, *periods, dwell, longest, due, lead = times
    next_event = float(rng.choice(periods)) if periods[1] else np.inf  # of a periodic rule
    if periods[1] and loop.observer is None:
        least = sampling = periods[1] / _PARTS
    W, n, positive, negative = floats(loop.weight), loop.n, floats(rule.positive), floats(rule.negative)
    level, rate, floor = (float(v.mid()) for v in (rule.level, rule.rate, rule.floor))
    x, noise = floats(loop.start)[:, 0], floats(loop.noise)
    kind_of_noise = rng.choice(["random", "hides", "provokes"])
    gains = [] if loop.observer is None else [floats(gain) for gain in loop.observer.gains]
    C, tests = np.eye(n) if loop.observer is None else floats(loop.observer.outputs), count()

    def measured(x: Array, x_s: Array, x_hat: Array) -> Array:
        """Return a measurement with the largest noise: in random directions, or against or for an event.

        An observer's estimate takes its place.
        """
        added = noise
        if gains:
            L = gains[min(next(tests), len(gains) - 1)]
            x, added = x + (np.eye(n) - L @ C) @ (x_hat - x), L @ noise
        signs = rng.choice([-1.0, 1.0], noise.shape[1])
        if kind_of_noise != "random":
            along = (W @ added).T @ (W @ (x_s - x))
            signs = np.where(along == 0, signs, np.sign(along)) * (1 if kind_of_noise == "hides" else -1)
        return np.asarray(x + added @ signs)

    remembered = _Memory(loop)
    y = measured(x, x, x if loop.observer is None else x + floats(loop.observer.start)[:, 0])
    z = np.concatenate([x, y, y, y, [1.0]])
    remembered.start(y)
    first_input = start * float(rng.choice([0.0, 1.0, rng.random()]))
    style = rng.integers(3)
    ages = [-lead, age, age / 2]
    t, lost, events = 0.0, 0, [0.0]
    area = last_size = last_test = 0.0  # of a rule that integrates
    arriving: list[tuple[float, float, Array]] = []
    """Of each update on its way: when it acts, when it was sent, and the prediction that starts with it."""
    next_test, found = sampling, list[Exceeded]()
    current = ages[rng.integers(3)]
    signs = tuple(rng.choice([-1.0, 1.0], len(loop.sizes)))
    samples: list[_Sample] = []
    while t < until:
        stop = min(v for v in (next_test, next_event, *(update[0] for update in arriving)) if v > t)
        if t < first_input < stop:
            stop = first_input
        acting = current if t >= first_input else None
        step = plant.step(acting, signs, round((stop - t) / 2, 12))
        for half in (1, 2):
            z = step @ z
            decay = plant.predict(round((stop - t) / 2, 12))
            arriving = [(acts, sent, decay @ state) for acts, sent, state in arriving]
            samples.append(_Sample(t + half * (stop - t) / 2, z.copy(), acting, signs))
        t = stop
        if acting_now := [update for update in arriving if update[0] <= t]:
            newest = max(acting_now, key=lambda update: update[1])
            z[2 * n : 3 * n] = newest[2]
            arriving = [update for update in arriving if update[1] > newest[1]]
        if t >= min(next_test, next_event):
            y = z[3 * n : 4 * n] = measured(z[:n], z[n : 2 * n], z[3 * n : 4 * n])
            pair = np.concatenate([y, z[n : 2 * n] - y])
            seen = np.concatenate([y, plant.gain @ pair[n:]]) if rule.of_input else pair
            eta = remembered.at_test(sampling)
            threshold = np.hypot(max(level * np.exp(-rate * t), floor), np.linalg.norm(negative @ seen))
            threshold = np.hypot(threshold, np.sqrt(max(eta, 0.0)))
            may_come = rule.always and t - events[-1] > due - 1e-9  # without the comparison
            fires = np.linalg.norm(positive @ seen) > threshold or (may_come and rng.random() < 0.2)
            if rule.integrates:
                now = float(np.linalg.norm(positive @ seen))
                area += (t - last_test) * (now + last_size) / 2
                fires, last_size, last_test = area > floor, now, t
                if fires:
                    area = last_size = 0.0
            fires = fires and t - events[-1] > dwell - 1e-9
            fires = fires or bool(longest and t + sampling - events[-1] > longest + 1e-9)
            if periods[1]:
                fires = t >= next_event
            remembered.test(seen if not fires else np.concatenate([y, 0 * seen[n:]]))
            if fires:
                if t < first_input and proof.is_quiet:
                    found.append(Exceeded("an event before the first input", t, 0.0, first_input))
                _apart(found, proof, events, t, first_input)
                z[n : 2 * n] = y
                loses = lost < loop.losses and (style == 0 or (style == 1 and rng.random() < 0.7))
                lost = lost + 1 if loses else 0
                if not loses and delay:
                    late = delay * float(rng.choice([1.0, 1.0, 0.5, 0.0]))
                    acts = max(t + max(round(late, 9), 1e-9), first_input)
                    arriving.append((acts, t, z[n : 2 * n].copy()))
                elif not loses:
                    z[2 * n : 3 * n] = z[n : 2 * n]
                next_event = t + float(rng.choice(periods)) if periods[1] else np.inf
            next_test = t + round(float(rng.choice([least, sampling])), 9)
            current = ages[rng.integers(3)] if rng.random() < 0.3 else current
            if rng.random() < 0.05:
                signs = tuple(rng.choice([-1.0, 1.0], len(loop.sizes)))
    return found + _compare(plant, W, proof, samples, by_forms=by_forms)


def longest(times: Iterable[fmpq | None]) -> fmpq | None:
    return max((time for time in times if time is not None), default=None)


def played(loop: Loop) -> Loop:
    """Return a loop as runs have it: tests at all times are often, for a little less than the threshold."""
    if loop.times.sampling > 0:
        return loop
    rule, step = loop.rule, fmpq(1, 500)
    less = rule._replace(level=number(_LESS) * rule.level, floor=number(_LESS) * rule.floor)
    return loop._replace(rule=less, times=loop.times._replace(sampling=step, least_sampling=step))


def require_true(loop: Loop, proofs: list[Proof], seed: int) -> None:
    """Require that runs stay within the least of some proofs of one loop."""
    kinds = {(float(proof.rate.mid()), proof.is_quiet) for proof in proofs}
    for rate, is_quiet in kinds:
        alike = [each for each in proofs if (float(each.rate.mid()), each.is_quiet) == (rate, is_quiet)]
        together = alike[0]._replace(
            bounds=tuple(bound for proof in alike for bound in proof.bounds),
            inter_event=longest(proof.inter_event for proof in alike),
            first_event=longest(proof.first_event for proof in alike),
        )
        for k in range(2):
            rng = np.random.default_rng((seed, k))
            assert exceeded(played(loop), together, rng, _SECONDS, by_forms=False) == []


class _Memory:
    """η of a rule, which it integrates as the core does: with its rate at the test before."""

    def __init__(self, loop: Loop) -> None:
        self._memory, self._eta, self._rate = loop.rule.memory, 0.0, 0.0
        if self._memory is not None:
            self._decay, self._gain = float(self._memory.decay.mid()), floats(self._memory.gain)
            self._n = loop.n

    def start(self, y: Array) -> None:
        if self._memory is not None:
            self._eta = float(self._memory.start.mid())
            self.test(np.concatenate([y, np.zeros(len(self._gain) - self._n)]))

    def at_test(self, step_s: float) -> float:
        if self._memory is not None:
            gained_s = -np.expm1(-self._decay * step_s) / self._decay if self._decay else step_s
            self._eta = self._eta * np.exp(-self._decay * step_s) + gained_s * self._rate
        return self._eta

    def test(self, seen: Array) -> None:
        if self._memory is not None:
            self._rate = float(seen @ self._gain @ seen)


def _apart(found: list[Exceeded], proof: Proof, events: list[float], t: float, first_input: float) -> None:
    least = proof.first_event if len(events) == 1 else proof.inter_event
    if not proof.is_quiet and events[-1] < first_input:
        least = None
    if least is not None and t - events[-1] < float(least) - 1e-9:
        found.append(Exceeded("inter-event time", t, t - events[-1], float(least)))
    events.append(t)


def _compare(
    plant: _Plant, W: Array, proof: Proof, samples: list[_Sample], *, by_forms: bool
) -> list[Exceeded]:
    """Return where the samples of a run exceed the bounds."""
    n = plant.n
    t, z = (np.array([sample[k] for sample in samples]) for k in (0, 1))
    x, xs, xc = z[:, :n], z[:, n : 2 * n], z[:, 2 * n : 3 * n]
    acts = np.array([sample.age is not None for sample in samples])
    u = np.array([plant.input_matrix(sample.age) @ state for sample, state in zip(samples, xc, strict=True)])
    pushes = np.array([sample.signs for sample in samples]).reshape(len(t), -1) @ plant.pushes.T
    drift = x @ plant.A.T + u @ plant.B.T + pushes - x @ plant.H.T
    values = {"x": x, "e_s": (xs - x) @ W.T, "e_c": (xc - x) @ W.T, "drift": drift @ W.T}
    entries = {"x": x, "u": u, "y": x @ plant.outputs.T}
    fading, found = np.exp(-float(proof.rate.mid()) * t), list[Exceeded]()
    for bound in proof.bounds:
        if not bound.from_start:
            continue
        output = bound.output
        value = values[output] if output in values else entries[output[0]][:, [int(output[2:-1])]]
        added = np.hypot if by_forms and output not in {"e_s", "e_c"} else np.add
        sizes = np.linalg.norm(value, axis=1)
        limits = added(float(bound.decaying.mid()) * fading, float(bound.constant.mid()))
        holds_early = output != "drift" and (proof.is_quiet or output != "e_c")  # before the first input
        over = (sizes > limits * (1 + _ROUNDING)) & (acts | holds_early)
        found += [Exceeded(output, *map(float, (t[k], sizes[k], limits[k]))) for k in np.flatnonzero(over)]
    return found
