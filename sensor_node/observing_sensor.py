"""A sensor with an observer: it estimates x from the measurements, and the trigger tests x̂.

The observer needs the input that the plant applied. The sensor does not receive the actuations, and
nothing is acknowledged. So the input is measured at the actuator, and a measurement carries [y; u
of every step since the last measurement]. Sensor and actuator are at the plant, the controller is
on the other side of the network. Montestruque and Antsaklis (2003) place their observer likewise.
Disturbances that enter after the actuator are not part of the measured input.

At a measurement, x̂ is predicted over the plant's steps and corrected by y. The sensor behind the
observer then uses x̂ in place of x. The observer's time is the time of its measurements. If
measurements are missing, the inputs of their steps are unknown, and the first known input is used.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from noack.config.parameter_changes import ParameterChange, ReconfigurableMachine
from noack.config.resolution import loop_of
from noack.config.scenario import Scenario
from noack.config.state_estimation import assumed_model
from noack.core.linear_systems import Vector
from noack.observers.observer_settings import StateObserver
from noack.protocol.machine_interface import Notice, Output, Record
from noack.protocol.record_tables import SENSOR_MEASUREMENT
from noack.protocol.wire_format import Flow, Message


@dataclass
class AppliedInputTracker:
    """Advances an observer from measurement to measurement, under the applied inputs."""

    observer: StateObserver
    inputs: int
    """m."""
    outputs: int
    """p."""
    period_ns: int
    """The plant's step."""
    t_ns: int | None
    """Time of the estimate; at first None: the time of the first measurement."""

    def split(self, vector: Vector) -> tuple[Vector, Vector]:
        """Split the vector of a measurement into y and the inputs since the last measurement."""
        # Slices are copied: a slice may have another memory layout than the vectors of a replay.
        return vector[: self.outputs].copy(), vector[self.outputs :].copy()

    def take(self, t_ns: int, y: Vector, inputs: Vector) -> Vector:
        """Return x̂ at the time of a measurement, shape (n,)."""
        since_ns = t_ns if self.t_ns is None else self.t_ns
        for u in self._applied_inputs((t_ns - since_ns) // self.period_ns, inputs):
            self.observer.predict(u)
        self.observer.correct(y)
        self.t_ns = t_ns
        return self.observer.x

    def _applied_inputs(self, steps: int, inputs: Vector) -> Iterable[Vector]:
        known = inputs.reshape(-1, self.inputs)
        for before in range(steps, 0, -1):
            yield known[max(len(known) - before, 0)].copy()


class ObservingSensor:
    """The machine of a sensor with an observer: ``sensor`` receives x̂ in place of x.

    A restarted sensor does not know the estimate of the sensor that it replaces.
    """

    def __init__(
        self,
        tracker: AppliedInputTracker,
        sensor: ReconfigurableMachine[Message],
        *,
        restarted: bool = False,
    ) -> None:
        self._tracker = tracker
        self._sensor = sensor
        self._restarted = restarted

    def next_deadline_ns(self) -> int | None:
        """The deadline of the sensor behind the observer."""
        return self._sensor.next_deadline_ns()

    def on_timer(self, now_ns: int) -> Sequence[Output]:
        """Forward the timer to the sensor behind the observer."""
        return self._sensor.on_timer(now_ns)

    def announce(self, change: ParameterChange, now_ns: int) -> Sequence[Record | Notice]:
        """Forward a change to the sensor behind the observer, which has no runtime parameters."""
        return self._sensor.announce(change, now_ns)

    def handle(self, message: Message, now_ns: int) -> Sequence[Output]:
        """Process a measurement [y; u …], or an acknowledgement."""
        if message.flow is not Flow.MEASUREMENT:
            return self._sensor.handle(message, now_ns)
        y, inputs = self._tracker.split(message.vector)
        x = self._tracker.take(message.t_ns, y, inputs)
        outputs: list[Output] = [
            Record(output.table, (*output.row, y, inputs))
            if isinstance(output, Record) and output.table == SENSOR_MEASUREMENT
            else output
            for output in self._sensor.handle(message._replace(vector=x), now_ns)
        ]
        if self._restarted:
            self._restarted = False
            text = "the observer restarts from its initial estimate"
            outputs.append(Notice(message.t_ns, "info", text))
        return outputs


def observer_of(resolved: Scenario, *, restarted: bool) -> AppliedInputTracker | None:
    """Return the observer of a resolved scenario; None if it has none.

    If the sensor restarts during the run, x(0) is not used.
    """
    settings, loop = resolved.observer, loop_of(resolved)
    if settings is None:
        return None
    knows_start = resolved.network.initial_sync == "known_state" and not restarted
    x = loop.x0 if knows_start else np.zeros(loop.n)
    if settings.initial_estimate is not None:
        x = np.array(settings.initial_estimate)
    observer = settings.estimator(assumed_model(resolved), x)
    since_ns = 0 if knows_start else None
    return AppliedInputTracker(
        observer, loop.m, resolved.message_sizes.outputs, resolved.timing.plant_period_ns, since_ns
    )
