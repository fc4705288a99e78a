"""What an event-triggering policy is, and the machine that applies one to measurements."""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, Vector
from noack.trigger.trigger_condition import Guard
from noack.trigger.trigger_rule import Guards


class Policy(Protocol):
    """An event-triggering policy: what each event makes the next one wait for."""

    @property
    def weight(self) -> Matrix | None:
        """W of the norm in which errors are shown, (n, n); None is the identity."""
        ...

    def guards(self, n: int) -> Guards:
        """The rules after events, for n states."""
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
        self._began: tuple[int, Vector] | None = None

    def start(self, t_ns: int, x: Vector) -> None:
        """Begin, or begin anew after an event, at a state of shape (n,)."""
        self.renew(t_ns, x)
        self._see(t_ns, x, np.zeros_like(x))

    def renew(self, t_ns: int, x: Vector) -> None:
        """Take the rule that follows an event of the past, known now to have reset the model."""
        self._began = (t_ns, x)
        self._guard = self._policy.guards(len(x)).after(t_ns, x)

    def change(self, policy: Policy) -> None:
        """Go on with another policy, as if it had been this one at the last event, too."""
        self._policy = policy
        if self._began is not None:
            self.renew(*self._began)

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
            dt_s = (t_ns - self._seen_ns) * 1e-9
            self._reserve = guard.reserve.after(dt_s, self._reserve, self._gain)
        left, right = guard.sides(t_ns, x, e_s, self._reserve)
        due = t_ns >= guard.latest_ns
        self._see(t_ns, x, e_s)
        return Verdict(due or (left > right and guard.is_looked_at(t_ns)), left, right)

    def first_event(self, t_ns: NDArray[np.int64], x: Matrix, e_s: Matrix) -> int | None:
        """Test measurements that follow one another, up to the first event; say which it is.

        Args:
            t_ns: their times, shape (k,).
            x: the measured states, shape (k, n).
            e_s: x_s − x without an event among them, shape (k, n).
        """
        if self._guard is None:
            raise RuntimeError("a trigger must be started")
        if not len(t_ns):
            return None
        guard, z = self._guard, np.hstack([x, e_s])
        gains, reserves = np.zeros(len(z)), np.zeros(len(z))
        if guard.reserve is not None:
            gains = guard.reserve.gain.values(z)
            dt_s = np.diff(t_ns, prepend=self._seen_ns) * 1e-9
            held = [self._gain, *gains[:-1].tolist()]
            reserve = self._reserve
            for i, (elapsed_s, gain) in enumerate(zip(dt_s.tolist(), held, strict=True)):
                reserves[i] = reserve = guard.reserve.after(elapsed_s, reserve, gain)
        looked_at = t_ns >= guard.earliest_ns
        if guard.grid_ns:
            looked_at &= t_ns % guard.grid_ns == 0
        due = (t_ns >= guard.latest_ns) | (looked_at & guard.exceeds(t_ns, z, reserves))
        events = np.flatnonzero(due)
        last = int(events[0]) if len(events) else len(z) - 1
        self._seen_ns, self._gain = int(t_ns[last]), float(gains[last])
        if guard.reserve is not None:
            self._reserve = float(reserves[last])
        return last if len(events) else None

    def _see(self, t_ns: int, x: Vector, e_s: Vector) -> None:
        reserve = None if self._guard is None else self._guard.reserve
        self._seen_ns = t_ns
        self._gain = 0.0 if reserve is None else reserve.gain.value(np.concatenate([x, e_s]))
