"""The sensor: runs the model x_s beside the plant and transmits when the two part (eq:ModSensor).

A measurement in → propagate x_s → test → maybe one state update out. x_s is reset at *every* event,
whether or not the update survives the network: nothing is acknowledged.
"""

from collections.abc import Sequence

from noack.linear import Matrix, Propagator, Vector
from noack.machine import Output, Record
from noack.records import NO_SEQUENCE, SENSOR_MEASUREMENT
from noack.resolve import loop_of
from noack.scenario import Scenario
from noack.trigger.decaying import DecayingTrigger, trigger_of
from noack.wire import Flow, Message


class Sensor:
    """The machine of the sensor node.

    Its time is the measurements' own: what it sends depends on what was measured and when, not on
    when the datagram was read.

    Args:
        H: what the model integrates between updates, shape (n, n), per second.
        trigger: the event-triggering policy.
        x0: the state that sensor and controller both know at t = 0; None if they do not, in which
            case the first measurement is an event.
        period_ns: expected time between measurements, to prepare for; others are taken as well.
    """

    def __init__(
        self,
        H: Matrix,
        trigger: DecayingTrigger,
        x0: Vector | None = None,
        *,
        period_ns: int | None = None,
    ) -> None:
        self._propagate = Propagator(H, () if period_ns is None else (period_ns,))
        self._trigger = trigger
        self._model_ns = 0
        self._inputs = 0
        self._events = 0
        self.x_s = x0

    def next_deadline_ns(self) -> int | None:
        """None: the sensor acts on measurements only."""
        return None

    def on_timer(self, now_ns: int) -> Sequence[Output]:
        """Nothing is ever due."""
        return ()

    def handle(self, message: Message, now_ns: int) -> Sequence[Output]:
        """Take a measurement x(t); transmit it and reset x_s if ‖x_s − x‖ exceeds the threshold."""
        t_ns, x = message.t_ns, message.vector
        first = self.x_s is None
        x_s = x if self.x_s is None else self._propagate(self.x_s, t_ns - self._model_ns)
        error = self._trigger.error_norm(x_s - x)
        threshold = self._trigger.threshold(t_ns)
        event = first or error > threshold
        self.x_s = x if event else x_s
        self._model_ns = t_ns
        row = (
            self._inputs, message.sequence, t_ns, now_ns, x, x_s,
            error, threshold, self._events if event else NO_SEQUENCE,
        )  # fmt: skip
        self._inputs += 1
        record = Record(SENSOR_MEASUREMENT, row)
        if not event:
            return (record,)
        update = Message(Flow.UPDATE, self._events, t_ns, x)
        self._events += 1
        return (update, record)


def sensor_of(resolved: Scenario) -> Sensor:
    """Return the sensor of a resolved scenario; of the plant it learns x(0) at the most."""
    loop = loop_of(resolved)
    known = resolved.network.initial_sync == "known_state"
    return Sensor(
        loop.H,
        trigger_of(resolved),
        loop.x0 if known else None,
        period_ns=resolved.plant_period_ns * resolved.plant.measure_every,
    )
