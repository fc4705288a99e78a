"""The sensor: runs the model x_s in parallel to the plant and transmits at events (eq:ModSensor).

At a measurement: propagate x_s → test → send at most one state update. x_s is reset at *every*
event, whether or not the network delivers the update: nothing is acknowledged. In the
acknowledgement baseline, only an acknowledged update resets x_s.
"""

from collections.abc import Sequence

import numpy as np

from noack.config.parameter_changes import ChangeSchedule, ParameterChange
from noack.config.resolution import loop_of, policy_of, setpoint_of
from noack.config.scenario import Scenario
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, Vector, norm
from noack.core.model_flow import ModelFlow
from noack.core.ordered_arithmetic import product
from noack.protocol.machine_interface import BEGINNING, Notice, Output, Record, Start
from noack.protocol.record_tables import (
    NO_SEQUENCE,
    SENSOR_ACKNOWLEDGEMENT,
    SENSOR_MEASUREMENT,
    SENSOR_SETTING,
)
from noack.protocol.wire_format import Flow, Message
from noack.trigger.trigger_policy import Policy, TriggerDecision, new_trigger
from sensor_node.observing_sensor import ObservingSensor, observer_of


class Sensor:
    """The machine of the sensor node.

    Its time is the time of the measurements: its output depends on the measured values and their
    times, not on when a datagram was read.

    Args:
        H: the matrix that the model integrates between updates, shape (n, n), per second.
        policy: the event-triggering policy.
        x0: x(0), if sensor and controller start from it; else None, and the first measurement is an
            event.
        period_ns: expected time between measurements, for precomputed matrices; others are
            possible.
        first_number: number of its first event and first input.
        setpoint: x_r, shape (n,); None is 0.
        schedule: the announced changes of its settings; None if they cannot change.
    """

    def __init__(
        self,
        H: Matrix,
        policy: Policy,
        x0: Vector | None = None,
        *,
        period_ns: int | None = None,
        first_number: int = 0,
        setpoint: Vector | None = None,
        schedule: ChangeSchedule | None = None,
    ) -> None:
        self._flow = ModelFlow(H, () if period_ns is None else (period_ns,), setpoint)
        self._schedule = schedule
        self._reached_ns = -1
        self._trigger = new_trigger(policy)
        self._weight = policy.weight
        self._model_ns = 0
        self._inputs = first_number
        self._events = first_number
        self.x_s = x0
        if x0 is not None:
            self._trigger.start(0, x0)

    def next_deadline_ns(self) -> int | None:
        """None: the sensor only reacts to messages."""
        return None

    def on_timer(self, now_ns: int) -> Sequence[Output]:
        """Nothing is ever due."""
        return ()

    def announce(self, change: ParameterChange, now_ns: int) -> Sequence[Record | Notice]:
        """Schedule a change; it takes effect at the first measurement at or after its time T.

        x_s follows the new set point from T itself on.
        """
        if self._schedule is None:
            raise CallerError("this sensor's settings cannot be changed")
        outputs = self._schedule.announce(
            SENSOR_SETTING, change, self._inputs, now_ns, self._reached_ns
        )
        self._inputs += 1
        return outputs

    def _change(self, t_ns: int) -> None:
        """Apply the changes that are due at a time."""
        while self._schedule is not None and (due := self._schedule.take(t_ns)) is not None:
            setpoint, policy = due.prepared
            self._flow.change(due.since_ns, setpoint)
            self._trigger.change(policy)

    def handle(self, message: Message, now_ns: int) -> Sequence[Output]:
        """Process a measurement x(t); at an event, transmit it and reset x_s."""
        t_ns, x = message.t_ns, message.vector
        if self._schedule is not None and self._schedule.next_ns is not None:
            self._change(t_ns)
        first = self.x_s is None
        x_s = x if self.x_s is None else self._flow(self.x_s, self._model_ns, t_ns)
        if first:
            self._trigger.start(t_ns, x)
        e_s = x_s - x
        decision = self._trigger.test(t_ns, x, e_s)
        event = first or decision.event
        if event:
            self._trigger.start(t_ns, x)
        self.x_s = x if event else x_s
        self._model_ns = self._reached_ns = t_ns
        return self._outputs(message, now_ns, x_s, e_s, decision, event=event)

    def _outputs(
        self, message: Message, now_ns: int, x_s: Vector, e_s: Vector,
        decision: TriggerDecision, *, event: bool,
    ) -> Sequence[Output]:  # fmt: skip
        """Return the record of a measurement, and at an event the update before it."""
        t_ns, x = message.t_ns, message.vector
        row = (
            self._count(), message.sequence, t_ns, now_ns, x, x_s,
            norm(e_s if self._weight is None else product(self._weight, e_s)),
            decision.left, decision.right, self._events if event else NO_SEQUENCE,
        )  # fmt: skip
        record = Record(SENSOR_MEASUREMENT, row)
        if not event:
            return (record,)
        self._events += 1
        return (Message(Flow.UPDATE, self._events - 1, t_ns, x), record)

    def _count(self) -> int:
        self._inputs += 1
        return self._inputs - 1


class AcknowledgedSensor(Sensor):
    """The machine of the sensor node, if updates are acknowledged.

    At an acknowledgement of update k, x_s ← e^{H(t−t_k)} x(t_k) at the time t of the last
    measurement; this equals the controller's model then. After a transmission the sensor waits for
    the acknowledgement until a timeout. If the policy then still requires a transmission, it
    transmits the current measurement. Nothing is transmitted twice. The policy's state since the
    last event restarts when the event is acknowledged.

    Args:
        H, policy, period_ns, first_number: as for :class:`Sensor`.
        x0: likewise; with None, the first measurement is an event, and x_s is 0, as x_c is, until
            an update is acknowledged.
        timeout_ns: how long to wait for an acknowledgement.
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
        super().__init__(H, policy, x0, period_ns=period_ns, first_number=first_number)
        self._timeout_ns = timeout_ns
        self._sent: dict[int, Vector] = {}
        self._wait_until_ns: int | None = None
        self._first = x0 is None
        self.x_s: Vector = np.zeros(len(H)) if x0 is None else x0

    def handle(self, message: Message, now_ns: int) -> Sequence[Output]:
        """Process a measurement or an acknowledgement."""
        if message.flow is Flow.ACKNOWLEDGEMENT:
            return self._acknowledged(message, now_ns)
        t_ns, x = message.t_ns, message.vector
        first, self._first = self._first, False
        if first:
            self._model_ns = t_ns
            self._trigger.start(t_ns, x)
        self.x_s = x_s = self._flow(self.x_s, self._model_ns, t_ns)
        self._model_ns = t_ns
        e_s = x_s - x
        decision = self._trigger.test(t_ns, x, e_s)
        waits = self._wait_until_ns is not None and t_ns < self._wait_until_ns
        event = first or (decision.event and not waits)
        if event:
            self._sent[self._events] = x
            self._wait_until_ns = t_ns + self._timeout_ns
        return self._outputs(message, now_ns, x_s, e_s, decision, event=event)

    def _acknowledged(self, message: Message, now_ns: int) -> Sequence[Output]:
        """Reset x_s to the acknowledged update; an acknowledgement is newer than all before it."""
        event_ns, before = message.t_ns, self.x_s
        x = self._sent.get(message.sequence)
        if x is not None:
            self.x_s = self._flow(x, event_ns, self._model_ns)
            self._trigger.restart(event_ns, x)
            self._sent = {k: sent for k, sent in self._sent.items() if k > message.sequence}
            if not self._sent:
                self._wait_until_ns = None
        row = (
            self._count(), message.sequence, event_ns, now_ns, self._model_ns, before, self.x_s,
        )  # fmt: skip
        return (Record(SENSOR_ACKNOWLEDGEMENT, row),)


def sensor_of(resolved: Scenario, start: Start = BEGINNING) -> Sensor | ObservingSensor:
    """Return the sensor of a resolved scenario; of the plant's data it uses at most x(0).

    After a restart, the sensor transmits its first measurement.
    """
    observer = observer_of(resolved, restarted=start.is_restart)
    sensor = _sensor_without_observer(resolved, start)
    if observer is None:
        return sensor
    return ObservingSensor(observer, sensor, restarted=start.is_restart)


def _sensor_without_observer(resolved: Scenario, start: Start) -> Sensor:
    loop, policy = loop_of(resolved), policy_of(resolved)
    known = resolved.network.initial_sync == "known_state" and not start.is_restart
    x0 = loop.x0 if known else None
    period_ns, first = resolved.timing.measurement_period_ns, start.first_number
    if resolved.protocol.acknowledges:
        timeout_ns = resolved.timing.acknowledgement_timeout_ns
        return AcknowledgedSensor(
            loop.H, policy, x0, timeout_ns=timeout_ns, period_ns=period_ns, first_number=first
        )
    return Sensor(
        loop.H, policy, x0, period_ns=period_ns, first_number=first, setpoint=loop.setpoint,
        schedule=ChangeSchedule(resolved, _prepared),
    )  # fmt: skip


def _prepared(resolved: Scenario) -> tuple[Vector | None, Policy]:
    """Return the parts of another scenario that a sensor needs: its set point and its policy."""
    setpoint = setpoint_of(resolved)
    return None if setpoint is None else setpoint[0], policy_of(resolved)
