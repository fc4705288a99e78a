"""What an event-triggering policy is, and the machine that applies one to measurements."""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, Vector
from noack.trigger.trigger_condition import TriggerCondition
from noack.trigger.trigger_rule import TriggerRule


class Policy(Protocol):
    """An event-triggering policy: what each event makes the next one wait for."""

    @property
    def weight(self) -> Matrix | None:
        """W of the norm in which errors are shown, (n, n); None is the identity."""
        ...

    def trigger_rule(self, n: int) -> TriggerRule:
        """The rules after events, for n states."""
        ...

    @property
    def initial_dynamic_variable(self) -> float:
        """η at the start, of a dynamic policy; else 0."""
        ...


class TriggerDecision(NamedTuple):
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
        self._condition: TriggerCondition | None = None
        self._reserve = policy.initial_dynamic_variable
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
        self._condition = self._policy.trigger_rule(len(x)).after(t_ns, x)

    def change(self, policy: Policy) -> None:
        """Go on with another policy, as if it had been this one at the last event, too."""
        self._policy = policy
        if self._began is not None:
            self.renew(*self._began)

    def test(self, t_ns: int, x: Vector, e_s: Vector) -> TriggerDecision:
        """Say of a measurement whether it is an event; :meth:`start` comes first.

        Args:
            t_ns: its time, not before the last one's.
            x: the measured state, shape (n,).
            e_s: x_s − x, shape (n,).
        """
        if self._condition is None:
            raise RuntimeError("a trigger must be started")
        condition = self._condition
        if condition.dynamic_variable is not None:
            dt_s = (t_ns - self._seen_ns) * 1e-9
            self._reserve = condition.dynamic_variable.after(dt_s, self._reserve, self._gain)
        left, right = condition.sides(t_ns, x, e_s, self._reserve)
        due = t_ns >= condition.latest_ns
        self._see(t_ns, x, e_s)
        return TriggerDecision(due or (left > right and condition.is_looked_at(t_ns)), left, right)

    def first_event(self, t_ns: NDArray[np.int64], x: Matrix, e_s: Matrix) -> int | None:
        """Test measurements that follow one another, up to the first event; say which it is.

        Args:
            t_ns: their times, shape (k,).
            x: the measured states, shape (k, n).
            e_s: x_s − x without an event among them, shape (k, n).
        """
        if self._condition is None:
            raise RuntimeError("a trigger must be started")
        if not len(t_ns):
            return None
        condition, z = self._condition, np.hstack([x, e_s])
        gains, reserves = np.zeros(len(z)), np.zeros(len(z))
        if condition.dynamic_variable is not None:
            gains = condition.dynamic_variable.gain.values(z)
            dt_s = np.diff(t_ns, prepend=self._seen_ns) * 1e-9
            held = [self._gain, *gains[:-1].tolist()]
            dynamic_variable = self._reserve
            for i, (elapsed_s, gain) in enumerate(zip(dt_s.tolist(), held, strict=True)):
                reserves[i] = dynamic_variable = condition.dynamic_variable.after(
                    elapsed_s, dynamic_variable, gain
                )
        looked_at = t_ns >= condition.earliest_ns
        if condition.grid_ns:
            looked_at &= t_ns % condition.grid_ns == 0
        due = (t_ns >= condition.latest_ns) | (looked_at & condition.exceeds(t_ns, z, reserves))
        events = np.flatnonzero(due)
        last = int(events[0]) if len(events) else len(z) - 1
        self._seen_ns, self._gain = int(t_ns[last]), float(gains[last])
        if condition.dynamic_variable is not None:
            self._reserve = float(reserves[last])
        return last if len(events) else None

    def _see(self, t_ns: int, x: Vector, e_s: Vector) -> None:
        dynamic_variable = None if self._condition is None else self._condition.dynamic_variable
        self._seen_ns = t_ns
        self._gain = (
            0.0
            if dynamic_variable is None
            else dynamic_variable.gain.value(np.concatenate([x, e_s]))
        )
