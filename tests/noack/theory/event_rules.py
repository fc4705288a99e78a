"""Event rules for simulations of many runs; independent of ``noack.trigger``.

A rule is called at every test of the trigger, with the step, the steps since each run's last event,
x and e_s, and returns which runs have an event.
"""

from dataclasses import dataclass, field

import numpy as np

from noack.core.linear_systems import Matrix
from tests.noack.theory.loops import EventRule, Flags, Reals, Steps


@dataclass
class Compare:
    """‖W e_s‖² > (share ‖W x‖)² + threshold²; send-on-delta without a share."""

    weight: Matrix
    threshold: float
    share: float = 0.0

    def __call__(self, step: int, since: Steps, x: Reals, e_s: Reals) -> Flags:
        size, error = (np.linalg.norm(v @ self.weight.T, axis=1) for v in (x, e_s))
        return np.asarray(error > np.hypot(self.share * size, self.threshold))


@dataclass
class Quadratic:
    """zᵀQz > ε, every so many steps."""

    Q: Matrix
    epsilon: float
    every: int

    def __call__(self, step: int, since: Steps, x: Reals, e_s: Reals) -> Flags:
        z = np.hstack([x, e_s])
        above = np.einsum("ri,ij,rj->r", z, self.Q, z) > self.epsilon
        return np.asarray(above & (step % self.every == 0))


@dataclass
class Area:
    """The trapezoidal sum of ‖W e_s‖ since the last event exceeds δ."""

    weight: Matrix
    delta: float
    every: int
    """Steps between two tests."""
    step_s: float
    _area: Reals = field(default_factory=lambda: np.zeros(1))
    _before: Reals = field(default_factory=lambda: np.zeros(1))

    def __call__(self, step: int, since: Steps, x: Reals, e_s: Reals) -> Flags:
        error, is_fresh = np.linalg.norm(e_s @ self.weight.T, axis=1), since <= self.every
        before = np.where(is_fresh, 0.0, self._before if step else 0.0)
        added = self.every * self.step_s * (before + error) / 2
        self._area = np.where(is_fresh, 0.0, self._area if step else 0.0) + added * (step > 0)
        self._before = error
        return np.asarray(self._area > self.delta)


@dataclass
class AtLatest:
    """Any rule, and at the latest so many steps after the last event; without one, periodic."""

    steps: int
    rule: EventRule | None = None

    def __call__(self, step: int, since: Steps, x: Reals, e_s: Reals) -> Flags:
        due = since >= self.steps
        return due if self.rule is None else due | self.rule(step, since, x, e_s)


@dataclass
class NotBefore:
    """Any rule, but not earlier than so many steps after the last event."""

    steps: int
    rule: EventRule

    def __call__(self, step: int, since: Steps, x: Reals, e_s: Reals) -> Flags:
        return self.rule(step, since, x, e_s) & (since >= self.steps)


@dataclass
class Decaying:
    """The paper's rule."""

    weight: Matrix
    beta: float
    alpha_per_s: float
    step_s: float

    def __call__(self, step: int, since: Steps, x: Reals, e_s: Reals) -> Flags:
        threshold = self.beta * np.exp(-self.alpha_per_s * step * self.step_s)
        return np.asarray(np.linalg.norm(e_s @ self.weight.T, axis=1) > threshold)


@dataclass
class Growing:
    """‖x‖² has grown by a factor since the last event; it says nothing about e_s."""

    factor: float
    every: int
    _size: Reals = field(default_factory=lambda: np.zeros(1))

    def __call__(self, step: int, since: Steps, x: Reals, e_s: Reals) -> Flags:
        size = np.einsum("ri,ri->r", x, x)
        self._size = np.where(since <= self.every, size, self._size if step else size)
        return np.asarray(size > self.factor * self._size)


@dataclass
class Between:
    """After any number of steps between two; it stands for every forecast."""

    shortest: int
    longest: int
    seed: int

    def __call__(self, step: int, since: Steps, x: Reals, e_s: Reals) -> Flags:
        wanted = np.random.default_rng((self.seed, step)).uniform(size=len(x)) < 0.3
        return np.asarray((since >= self.longest) | (wanted & (since >= self.shortest)))
