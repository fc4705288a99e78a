"""The sensor: runs the model x_s beside the plant and transmits when the two part (eq:ModSensor).

A measurement in → propagate x_s → test → maybe one state update out. x_s is reset at *every* event,
whether or not the update survives the network: nothing is acknowledged.
"""

from collections.abc import Sequence

from noack.linear import Matrix, Propagator, Vector, norm
from noack.machine import Output, Record
from noack.records import NO_SEQUENCE, SENSOR_MEASUREMENT
from noack.resolve import loop_of
from noack.scenario import Scenario
from noack.trigger.choose import policy_of
from noack.trigger.policy import Policy, Trigger
from noack.wire import Flow, Message
from sensor_node.acknowledged import AcknowledgedSensor


class Sensor:
    """The machine of the sensor node.

    Its time is the measurements' own: what it sends depends on what was measured and when, not on
    when the datagram was read.

    Args:
        H: what the model integrates between updates, shape (n, n), per second.
        policy: the event-triggering policy.
        x0: the state that sensor and controller both know at t = 0; None if they do not, in which
            case the first measurement is an event.
        period_ns: expected time between measurements, to prepare for; others are taken as well.
    """

    def __init__(
        self,
        H: Matrix,
        policy: Policy,
        x0: Vector | None = None,
        *,
        period_ns: int | None = None,
    ) -> None:
        self._propagate = Propagator(H, () if period_ns is None else (period_ns,))
        self._trigger = Trigger(policy)
        self._weight = policy.weight
        self._model_ns = 0
        self._inputs = 0
        self._events = 0
        self.x_s = x0
        if x0 is not None:
            self._trigger.start(0, x0)

    def next_deadline_ns(self) -> int | None:
        """None: the sensor acts on measurements only."""
        return None

    def on_timer(self, now_ns: int) -> Sequence[Output]:
        """Nothing is ever due."""
        return ()

    def handle(self, message: Message, now_ns: int) -> Sequence[Output]:
        """Take a measurement x(t); transmit it and reset x_s if the policy says so."""
        t_ns, x = message.t_ns, message.vector
        first = self.x_s is None
        x_s = x if self.x_s is None else self._propagate(self.x_s, t_ns - self._model_ns)
        if first:
            self._trigger.start(t_ns, x)
        e_s = x_s - x
        verdict = self._trigger.test(t_ns, x, e_s)
        event = first or verdict.event
        if event:
            self._trigger.start(t_ns, x)
        self.x_s = x if event else x_s
        self._model_ns = t_ns
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


def sensor_of(resolved: Scenario) -> Sensor | AcknowledgedSensor:
    """Return the sensor of a resolved scenario; of the plant it learns x(0) at the most."""
    loop, policy = loop_of(resolved), policy_of(resolved)
    x0 = loop.x0 if resolved.network.initial_sync == "known_state" else None
    period_ns = resolved.measurement_period_ns
    if resolved.is_acknowledged:
        timeout_ns = resolved.acknowledgement_timeout_ns
        return AcknowledgedSensor(loop.H, policy, x0, timeout_ns=timeout_ns, period_ns=period_ns)
    return Sensor(loop.H, policy, x0, period_ns=period_ns)
