"""The interfaces of an event-triggering policy, and of a trigger that is code."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, Vector
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
    """Decides at measurements by code of its own."""

    def start(self, t_ns: int, x: Vector) -> None:
        """Begin, or begin again after an event."""
        ...

    def restart(self, t_ns: int, x: Vector) -> None:
        """Begin after a past event that, as is known only now, has reset the model."""
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
