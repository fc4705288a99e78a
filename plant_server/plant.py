"""The plant: exact zero-order-hold propagation of the true state on a time grid.

At grid time t_k = k h the plant advances x to t_k under the input that was held since t_{k−1},
measures, and latches the newest actuation received, which it then holds until t_{k+1}. A step is
always one h long: a late step is a late step of the same length, and is caught up.
"""

from collections.abc import Sequence

import numpy as np

from noack.linear import HeldInputPropagator, Matrix, Vector
from noack.machine import Output, Record
from noack.records import NO_SEQUENCE, PLANT_ACTUATION, PLANT_STEP
from noack.resolve import loop_of
from noack.scenario import Scenario
from noack.wire import Flow, Message


class Plant:
    """The machine of the plant server.

    Args:
        A, B: the true plant, shapes (n, n) and (n, m), per second.
        x0: x(0), shape (n,).
        period_ns: step h.
        horizon_ns: no step is due after this time.
        measure_every: a measurement is sent every so many steps.
    """

    def __init__(
        self,
        A: Matrix,
        B: Matrix,
        x0: Vector,
        *,
        period_ns: int,
        horizon_ns: int,
        measure_every: int = 1,
    ) -> None:
        self._advance = HeldInputPropagator(A, B)
        self._period_ns = period_ns
        self._horizon_ns = horizon_ns
        self._measure_every = measure_every
        self._inputs = 0
        self._step = 0
        self._measurements = 0
        self._newest = np.zeros(B.shape[1])
        self._newest_sequence = NO_SEQUENCE
        self.x = np.array(x0, dtype=np.float64)
        self.u = self._newest
        self._advance.step(period_ns)  # computed before the first deadline, not after it

    def next_deadline_ns(self) -> int | None:
        """Grid time of the next step."""
        t_ns = self._step * self._period_ns
        return t_ns if t_ns <= self._horizon_ns else None

    def handle(self, message: Message, now_ns: int) -> Sequence[Output]:
        """Take an actuation; it is applied from the next step on."""
        self._newest = message.vector
        self._newest_sequence = message.sequence
        row = (self._count(), message.sequence, message.t_ns, now_ns, message.vector)
        return (Record(PLANT_ACTUATION, row),)

    def on_timer(self, now_ns: int) -> Sequence[Output]:
        """Make one step: x(t_k) = Ad x(t_{k−1}) + Bd u; measure; latch the newest actuation."""
        step, t_ns = self._step, self._step * self._period_ns
        if step > 0:
            self.x = self._advance(self.x, self.u, self._period_ns)
        self.u = self._newest
        self._step += 1
        row = (self._count(), step, t_ns, now_ns, self.x, self.u, self._newest_sequence)
        record = Record(PLANT_STEP, row)
        if step % self._measure_every:
            return (record,)
        measurement = Message(Flow.MEASUREMENT, self._measurements, t_ns, self.x)
        self._measurements += 1
        return (measurement, record)

    def _count(self) -> int:
        self._inputs += 1
        return self._inputs - 1


def plant_of(resolved: Scenario) -> Plant:
    """Return the plant of a resolved scenario."""
    loop = loop_of(resolved)
    return Plant(
        loop.A,
        loop.B,
        loop.x0,
        period_ns=resolved.plant_period_ns,
        horizon_ns=resolved.horizon_ns,
        measure_every=resolved.plant.measure_every,
    )
