"""The sensor: runs the model x_s in parallel to the plant and transmits at events (eq:ModSensor).

At a measurement: propagate x_s → test → send at most one state update. x_s is reset at *every*
event, whether or not the network delivers the update: nothing is acknowledged.
"""

from collections.abc import Sequence

from noack.config.parameter_changes import ChangeSchedule, ParameterChange
from noack.config.resolution import loop_of, policy_of, setpoint_of
from noack.config.scenario import Scenario
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, Vector, norm
from noack.core.model_flow import ModelFlow
from noack.protocol.machine_interface import BEGINNING, Notice, Output, Record, Start
from noack.protocol.record_tables import NO_SEQUENCE, SENSOR_MEASUREMENT, SENSOR_SETTING
from noack.protocol.wire_format import Flow, Message
from noack.trigger.trigger_policy import Policy, new_trigger
from sensor_node.acknowledged_sensor import AcknowledgedSensor
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
        """None: the sensor only reacts to measurements."""
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
        said = self._schedule.announce(
            SENSOR_SETTING, change, self._inputs, now_ns, self._reached_ns
        )
        self._inputs += 1
        return said

    def _change(self, t_ns: int) -> None:
        """Apply the changes that are due at a time."""
        while self._schedule is not None and (found := self._schedule.take(t_ns)) is not None:
            setpoint, policy = found.prepared
            self._flow.change(found.since_ns, setpoint)
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
        verdict = self._trigger.test(t_ns, x, e_s)
        event = first or verdict.event
        if event:
            self._trigger.start(t_ns, x)
        self.x_s = x if event else x_s
        self._model_ns = self._reached_ns = t_ns
        row = (
            self._inputs, message.sequence, t_ns, now_ns, x, x_s,
            norm(e_s if self._weight is None else self._weight @ e_s), verdict.left, verdict.right,
            self._events if event else NO_SEQUENCE,
        )  # fmt: skip
        self._inputs += 1
        record = Record(SENSOR_MEASUREMENT, row)
        if not event:
            return (record,)
        update = Message(Flow.UPDATE, self._events, t_ns, x)
        self._events += 1
        return (update, record)


def sensor_of(
    resolved: Scenario, start: Start = BEGINNING
) -> Sensor | AcknowledgedSensor | ObservingSensor:
    """Return the sensor of a resolved scenario; of the plant's data it uses at most x(0).

    After a restart, the sensor transmits its first measurement.
    """
    observer = observer_of(resolved, restarted=start.is_restart)
    sensor = _triggering(resolved, start)
    if observer is None:
        return sensor
    return ObservingSensor(observer, sensor, restarted=start.is_restart)


def _triggering(resolved: Scenario, start: Start) -> Sensor | AcknowledgedSensor:
    """Return the models and the trigger: the sensor, or the part of it behind the observer."""
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
