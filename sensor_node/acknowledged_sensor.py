"""The sensor of the acknowledgement baseline: only an acknowledged update resets x_s.

At a measurement: propagate x_s → test → send at most one state update, and remember it. At an
acknowledgement of update k: x_s ← e^{H(t−t_k)} x(t_k), which equals the controller's model then.
After a transmission the sensor waits for the acknowledgement until a timeout. If the policy then
still requires a transmission, it transmits the current measurement. Nothing is transmitted twice.
"""

from collections.abc import Sequence

import numpy as np

from noack.config.parameter_changes import FixedMachine
from noack.core.linear_systems import Matrix, Propagator, Vector, norm
from noack.protocol.machine_interface import Output, Record
from noack.protocol.record_tables import NO_SEQUENCE, SENSOR_ACKNOWLEDGEMENT, SENSOR_MEASUREMENT
from noack.protocol.wire_format import Flow, Message
from noack.trigger.trigger_policy import Policy, new_trigger


class AcknowledgedSensor(FixedMachine):
    """The machine of the sensor node, if updates are acknowledged.

    Its time is the time of the measurements. An acknowledgement resets the model at the time of the
    last measurement; the next measurement advances it from there.

    Args:
        H: the matrix that the model integrates between updates, shape (n, n), per second.
        policy: the event-triggering policy; its state since the last event restarts when the event
            is acknowledged.
        x0: x(0), if sensor and controller start from it; else None. With None, the first
            measurement is an event, and x_s is 0, as x_c is, until an update is acknowledged.
        timeout_ns: how long to wait for an acknowledgement.
        period_ns: expected time between measurements, for precomputed matrices; others are
            possible.
        first_number: number of its first event and first input.
    """

    def __init__(
        self,
        H: Matrix,
        policy: Policy,
        x0: Vector | None = None,
        *,
        timeout_ns: int,
        period_ns: int | None = None,
        first_number: int = 0,
    ) -> None:
        self._propagate = Propagator(H, () if period_ns is None else (period_ns,))
        self._trigger = new_trigger(policy)
        self._weight = policy.weight
        self._timeout_ns = timeout_ns
        self._model_ns = 0
        self._inputs = first_number
        self._events = first_number
        self._sent: dict[int, Vector] = {}
        self._wait_until_ns: int | None = None
        self._first = x0 is None
        self.x_s = np.zeros(H.shape[0]) if x0 is None else x0
        if x0 is not None:
            self._trigger.start(0, x0)

    def next_deadline_ns(self) -> int | None:
        """None: the sensor only reacts to messages."""
        return None

    def on_timer(self, now_ns: int) -> Sequence[Output]:
        """Nothing is ever due."""
        return ()

    def handle(self, message: Message, now_ns: int) -> Sequence[Output]:
        """Process a measurement or an acknowledgement."""
        if message.flow is Flow.ACKNOWLEDGEMENT:
            return self._acknowledged(message, now_ns)
        return self._measured(message, now_ns)

    def _measured(self, message: Message, now_ns: int) -> Sequence[Output]:
        t_ns, x = message.t_ns, message.vector
        first, self._first = self._first, False
        if first:
            self._model_ns = t_ns
            self._trigger.start(t_ns, x)
        self.x_s = x_s = self._propagate(self.x_s, t_ns - self._model_ns)
        self._model_ns = t_ns
        e_s = x_s - x
        verdict = self._trigger.test(t_ns, x, e_s)
        waits = self._wait_until_ns is not None and t_ns < self._wait_until_ns
        event = first or (verdict.event and not waits)
        row = (
            self._count(), message.sequence, t_ns, now_ns, x, x_s,
            norm(e_s if self._weight is None else self._weight @ e_s), verdict.left, verdict.right,
            self._events if event else NO_SEQUENCE,
        )  # fmt: skip
        record = Record(SENSOR_MEASUREMENT, row)
        if not event:
            return (record,)
        update = Message(Flow.UPDATE, self._events, t_ns, x)
        self._sent[self._events] = x
        self._wait_until_ns = t_ns + self._timeout_ns
        self._events += 1
        return (update, record)

    def _acknowledged(self, message: Message, now_ns: int) -> Sequence[Output]:
        """Reset x_s to the acknowledged update; an acknowledgement is newer than all before it."""
        event_ns, before = message.t_ns, self.x_s
        x = self._sent.get(message.sequence)
        if x is not None:
            self.x_s = self._propagate(x, self._model_ns - event_ns)
            self._trigger.restart(event_ns, x)
            self._sent = {k: sent for k, sent in self._sent.items() if k > message.sequence}
            if not self._sent:
                self._wait_until_ns = None
        row = (
            self._count(), message.sequence, event_ns, now_ns, self._model_ns, before, self.x_s,
        )  # fmt: skip
        return (Record(SENSOR_ACKNOWLEDGEMENT, row),)

    def _count(self) -> int:
        self._inputs += 1
        return self._inputs - 1
