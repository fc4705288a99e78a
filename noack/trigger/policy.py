"""What an event-triggering policy is, and the machine that applies one to measurements."""

import math
from typing import NamedTuple, Protocol

import numpy as np

from noack.linear import Matrix, Vector
from noack.trigger.guard import Guard


class Policy(Protocol):
    """An event-triggering policy: after each event it says what the next one waits for."""

    @property
    def weight(self) -> Matrix | None:
        """W of the norm in which errors are shown, (n, n); None is the identity."""
        ...

    def guard(self, t_ns: float, x: Vector) -> Guard:
        """The rule after an event, or from the start on.

        Args:
            t_ns: time of the event.
            x: the plant's state there, shape (n,).
        """
        ...

    @property
    def first_reserve(self) -> float:
        """η at the start, of a dynamic policy; else 0."""
        ...


class Verdict(NamedTuple):
    """What a policy says of a measurement."""

    event: bool
    left: float
    right: float
    """The sides of the comparison: an event if ``left`` exceeds ``right``, or if it is time."""


class Trigger:
    """Applies a policy at measurements; it knows what was measured and nothing else.

    Between two measurements a dynamic policy's η takes the state as it was at the first of them.

    Args:
        policy: the policy.
    """

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        self._guard: Guard | None = None
        self._reserve = policy.first_reserve
        self._gain = 0.0
        self._seen_ns = 0

    def start(self, t_ns: int, x: Vector) -> None:
        """Begin, or begin anew after an event, at a state of shape (n,)."""
        self._guard = self._policy.guard(t_ns, x)
        self._see(t_ns, x, np.zeros_like(x))

    def renew(self, t_ns: int, x: Vector) -> None:
        """Take the rule that follows an event of the past, known now to have reset the model."""
        self._guard = self._policy.guard(t_ns, x)

    def test(self, t_ns: int, x: Vector, e_s: Vector) -> Verdict:
        """Say of a measurement whether it is an event; :meth:`start` comes first.

        Args:
            t_ns: its time, not before the last one's.
            x: the measured state, shape (n,).
            e_s: x_s − x, shape (n,).
        """
        if self._guard is None:
            raise RuntimeError("a trigger must be started")
        guard = self._guard
        if guard.reserve is not None:
            dt_s, decay = (t_ns - self._seen_ns) * 1e-9, guard.reserve.decay_per_s
            gained = -math.expm1(-decay * dt_s) / decay if decay else dt_s
            self._reserve = self._reserve * math.exp(-decay * dt_s) + gained * self._gain
        left, right = guard.sides(t_ns, x, e_s, self._reserve)
        due = t_ns >= guard.latest_ns
        self._see(t_ns, x, e_s)
        return Verdict(due or (left > right and guard.is_looked_at(t_ns)), left, right)

    def _see(self, t_ns: int, x: Vector, e_s: Vector) -> None:
        reserve = None if self._guard is None else self._guard.reserve
        self._seen_ns = t_ns
        self._gain = 0.0 if reserve is None else reserve.gain.value(np.concatenate([x, e_s]))
