"""The interface of an event-triggering policy, and the trigger that applies one to measurements."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, Vector
from noack.trigger.trigger_condition import TriggerCondition
from noack.trigger.trigger_rule import TriggerRule


class Policy(Protocol):
    """An event-triggering policy: a trigger rule, W and η at the start."""

    @property
    def weight(self) -> Matrix | None:
        """W of the norm in which errors are shown, (n, n); None is the identity."""
        ...

    def trigger_rule(self, n: int) -> TriggerRule:
        """The trigger rule, for n states."""
        ...

    @property
    def initial_dynamic_variable(self) -> float:
        """η at the start; 0 for a policy without η."""
        ...


@dataclass(frozen=True)
class CodedPolicy:
    """A policy that decides by code of its own, and so has no trigger rule."""

    weight: Matrix | None
    new_trigger: Callable[[], "EventTrigger"]
    """Returns a trigger that has not started."""
    why_no_rule: str
    """What a user is told where a trigger rule is needed."""
    initial_dynamic_variable = 0.0

    def trigger_rule(self, n: int) -> TriggerRule:
        """Raise a CallerError."""
        raise CallerError(self.why_no_rule)


class EventTrigger(Protocol):
    """Decides at measurements; the methods are those of :class:`Trigger`."""

    def start(self, t_ns: int, x: Vector) -> None:
        """Begin, or begin again after an event."""
        ...

    def restart(self, t_ns: int, x: Vector) -> object:
        """Begin after a past event that, as is known only now, has reset the model."""
        ...

    def change(self, policy: Policy) -> None:
        """Continue with another policy."""
        ...

    def test(self, t_ns: int, x: Vector, e_s: Vector) -> "TriggerDecision":
        """Decide whether a measurement is an event."""
        ...


class TriggerDecision(NamedTuple):
    """A policy's decision on a measurement."""

    event: bool
    left: float
    right: float
    """The sides of the comparison; an event if ``left`` exceeds ``right``, or if one is due."""


class Trigger:
    """Applies a policy at measurements."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        self._rule: TriggerRule | None = None
        self._condition: TriggerCondition | None = None
        self._auxiliary = policy.initial_dynamic_variable
        self._rate = 0.0
        self._measured_ns = 0
        self._event: tuple[int, Vector] | None = None

    def start(self, t_ns: int, x: Vector) -> None:
        """Begin, or begin again after an event, at a state of shape (n,)."""
        condition = self.restart(t_ns, x)
        self._measured_ns = t_ns
        if condition.has_auxiliary:
            z = np.concatenate([x, np.zeros_like(x)])
            self._rate = float(condition.auxiliary_rates(z[None])[0])

    def restart(self, t_ns: int, x: Vector) -> TriggerCondition:
        """Apply the condition after a past event that, as is known only now, has reset the model.

        An integral begins at 0 now.
        """
        self._event = (t_ns, x)
        self._condition = condition = self._condition_after(t_ns, x)
        if condition.integrates:
            self._auxiliary = self._rate = 0.0
        return condition

    def change(self, policy: Policy) -> None:
        """Continue with another policy, as if it had been in force at the last event."""
        self._policy, self._rule = policy, None
        if self._event is not None:
            self._condition = self._condition_after(*self._event)

    def test(self, t_ns: int, x: Vector, e_s: Vector) -> TriggerDecision:
        """Decide whether a measurement is an event; call :meth:`start` first."""
        condition = self._started()
        if condition.has_auxiliary:
            (rate,) = condition.auxiliary_rates(np.concatenate([x, e_s])[None]).tolist()
            dt_s = (t_ns - self._measured_ns) * 1e-9
            self._auxiliary = condition.auxiliary_after(dt_s, self._auxiliary, self._rate, rate)
            self._rate = rate
        self._measured_ns = t_ns
        left, right = condition.sides(t_ns, x, e_s, self._auxiliary)
        due = t_ns >= condition.latest_ns
        return TriggerDecision(due or (left > right and condition.counts_at(t_ns)), left, right)

    def first_event(self, t_ns: NDArray[np.int64], x: Matrix, e_s: Matrix) -> int | None:
        """Test k successive measurements up to the first event, and return its index.

        x and ``e_s`` = x_s − x without an event among them have the shape (k, n).
        """
        condition = self._started()
        if not len(t_ns):
            return None
        z = np.hstack([x, e_s])
        auxiliary, rates = np.zeros(len(z)), np.zeros(len(z))
        if condition.has_auxiliary:
            rates = condition.auxiliary_rates(z)
            dt_s = (np.diff(t_ns, prepend=self._measured_ns) * 1e-9).tolist()
            value, first = self._auxiliary, self._rate
            for i, last in enumerate(rates.tolist()):
                auxiliary[i] = value = condition.auxiliary_after(dt_s[i], value, first, last)
                first = last
        counts = t_ns >= condition.earliest_ns
        if condition.grid_ns:
            counts &= t_ns % condition.grid_ns == 0
        due = (t_ns >= condition.latest_ns) | (counts & condition.exceeds(t_ns, z, auxiliary))
        events = np.flatnonzero(due)
        last_index = int(events[0]) if len(events) else len(z) - 1
        self._measured_ns = int(t_ns[last_index])
        if condition.has_auxiliary:
            self._auxiliary = float(auxiliary[last_index])
            self._rate = float(rates[last_index])
        return last_index if len(events) else None

    def _condition_after(self, t_ns: int, x: Vector) -> TriggerCondition:
        if self._rule is None:
            self._rule = self._policy.trigger_rule(len(x))
        return self._rule.after(t_ns, x)

    def _started(self) -> TriggerCondition:
        if self._condition is None:
            raise RuntimeError("a trigger must be started")
        return self._condition
