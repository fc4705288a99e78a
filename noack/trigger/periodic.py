"""Time-triggered control: transmit every period, whatever is measured."""

from dataclasses import dataclass

from noack.linear import Matrix, Vector
from noack.trigger.guard import Form, Guard, nothing


@dataclass(frozen=True)
class PeriodicTrigger:
    """The periodic rule."""

    period_ns: int
    weight: Matrix | None = None
    first_reserve = 0.0

    def guard(self, t_ns: float, x: Vector) -> Guard:
        """A period after the event."""
        return Guard(Form(nothing(len(x)), nothing(len(x))), latest_ns=t_ns + self.period_ns)
