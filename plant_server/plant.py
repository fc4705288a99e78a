"""The plant: a system on a time grid, under held inputs.

At grid time t_k = k h the plant advances its system to t_k under the input held since t_{k−1}. Then
it measures, and latches the newest actuation received; the input that is due of it is held until
t_{k+1} (``input_buffer.py``). A late step has the same length h, and the plant catches up. The
watchdog chooses the input when no actuation has been received for too long (``watchdog.py``). The
scenario defines the system (``noack.plants``), its disturbance from t_k until t_{k+1}
(``disturbance_signal.py``) and its measurement (``measurement.py``). If the system fails, x is NaN
from then on, as in a plant that diverges, and a notice gives the reason.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from noack.config.resolution import loop_of
from noack.config.scenario import Scenario
from noack.core.linear_systems import Matrix, Vector
from noack.plants.plant_settings import PlantStart
from noack.plants.systems.plant_system import PlantSystem, SystemFailedError
from noack.protocol.machine_interface import FAILED, Notice, Output, Record
from noack.protocol.record_tables import PLANT_ACTUATION, PLANT_STEP
from noack.protocol.wire_format import Flow, Message
from plant_server.disturbance_signal import Disturbance, disturbance_of
from plant_server.input_buffer import InputBuffer
from plant_server.measurement import MeasurementModel, measurement_model_of
from plant_server.watchdog import FALLBACK_NAMES, Fallback, PredictedInput, Watchdog, hold, zero


class Plant:
    """The machine of the plant server.

    Args:
        system: the system to advance, at x(0).
        watchdog: checks the age of the newest actuation.
        period_ns: step h.
        horizon_ns: no step is due after this time.
        measure_every: number of steps per measurement.
        disturbance: is added to u and to ẋ; None if there is none.
        measuring: the measurement model; None if y = x.
        reports_inputs: whether a measurement also carries the inputs of the steps since the last
            measurement. These are the latched inputs, without the disturbance.
    """

    def __init__(
        self,
        system: PlantSystem,
        watchdog: Watchdog,
        *,
        period_ns: int,
        horizon_ns: int,
        measure_every: int = 1,
        disturbance: Disturbance | None = None,
        measuring: MeasurementModel | None = None,
        reports_inputs: bool = False,
    ) -> None:
        self._system = system
        self._disturbance = disturbance
        self._measuring = measuring
        self._reports_inputs = reports_inputs
        self._watchdog = watchdog
        self._period_ns = period_ns
        self._horizon_ns = horizon_ns
        self._measure_every = measure_every
        self._inputs = 0
        self._step = 0
        self._measurements = 0
        self._failed = False
        self._x, self._z = system.x, system.z
        self._predictive = len(watchdog.newest.inputs) > 1
        self.u = watchdog.newest.u
        self._applied_input = self.u
        """The input of the system: u with its disturbance."""
        self._held = [self.u] * measure_every
        """The inputs since the last measurement; 0 before the first step."""

    @property
    def x(self) -> Vector:
        """The state, shape (n,)."""
        return self._x

    def next_deadline_ns(self) -> int | None:
        """Grid time of the next step."""
        t_ns = self._step * self._period_ns
        return t_ns if t_ns <= self._horizon_ns else None

    def handle(self, message: Message, now_ns: int) -> Sequence[Output]:
        """Receive an actuation; it is applied from the next step on."""
        newest = self._watchdog.take(message.vector, message.t_ns, message.sequence)
        further = (newest.inputs[1:].ravel(), newest.x_c)
        row = (self._count(), message.sequence, message.t_ns, now_ns, newest.u)
        return (Record(PLANT_ACTUATION, (*row, *(part for part in further if len(part)))),)

    def on_timer(self, now_ns: int) -> Sequence[Output]:
        """Make one step under the held input; measure; choose the input from now on."""
        step, t_ns = self._step, self._step * self._period_ns
        failed = self._advance(t_ns) if step > 0 else ()
        self.u, entry, notices = self._watchdog.input(t_ns)
        disturbed = self._disturb(step)
        self._step += 1
        newest = self._watchdog.newest.sequence
        x, z = self._x, self._z
        row: tuple[Any, ...] = (self._count(), step, t_ns, now_ns, x, self.u, newest)
        if self._predictive:
            row = (*row, entry)
        if len(z) or disturbed:
            row = (*row, *(part for part in (z, *disturbed) if len(part)))
        record = Record(PLANT_STEP, row)
        if step % self._measure_every:
            return (record, *failed, *notices)
        y = x if self._measuring is None else self._measuring(x, self._measurements)
        if self._reports_inputs:
            y = np.concatenate([y, *self._held])
        measurement = Message(Flow.MEASUREMENT, self._measurements, t_ns, y)
        self._measurements += 1
        return (measurement, record, *failed, *notices)

    def _advance(self, t_ns: int) -> Sequence[Notice]:
        """Step the system to ``t_ns``."""
        self._held = [*self._held[1:], self.u]
        if self._failed:
            return ()
        try:
            self._system.advance(self._applied_input, t_ns - self._period_ns, self._period_ns)
            self._x, self._z = self._system.x, self._system.z
        except SystemFailedError as error:
            self._failed = True
            self._x, self._z = np.full_like(self._x, np.nan), np.full_like(self._z, np.nan)
            return (Notice(t_ns, FAILED, str(error)),)
        return ()

    def _disturb(self, step: int) -> tuple[Vector, ...]:
        """Set the disturbed input of a step; return the disturbances for the record."""
        if self._disturbance is None:
            self._applied_input = self.u
            return ()
        d, w = self._disturbance(step)
        pushed = self.u + d if len(d) else self.u
        self._applied_input = np.concatenate([pushed, w]) if len(w) else pushed
        return d, w

    def _count(self) -> int:
        self._inputs += 1
        return self._inputs - 1


def plant_of(resolved: Scenario) -> Plant:
    """Return the plant of a resolved scenario."""
    return Plant(
        system_of(resolved),
        _watchdog_of(resolved),
        period_ns=resolved.timing.plant_period_ns,
        horizon_ns=resolved.timing.horizon_ns,
        measure_every=resolved.plant.measure_every,
        disturbance=disturbance_of(resolved),
        measuring=measurement_model_of(resolved),
        reports_inputs=resolved.observer is not None,
    )


def system_of(resolved: Scenario) -> PlantSystem:
    """Return the system of a resolved scenario's plant, at x(0).

    If the state of a linear plant is disturbed, the disturbance is a further input: ẋ = Ax + [B
    I][u; w].

    Raises:
        CallerError: a file or module that the system needs is missing, or differs from the
            settings.
    """
    loop, plant = loop_of(resolved), resolved.plant
    B: Matrix = loop.B
    if any(one.at == "state" for one in plant.disturbances):
        B = np.hstack([B, np.eye(loop.n)])
    start = PlantStart(np.array(plant.initial_state), loop.A, B, resolved.timing.plant_period_ns)
    return plant.system.system(start)


def _watchdog_of(resolved: Scenario) -> Watchdog:
    loop = loop_of(resolved)
    fallbacks: dict[str, Fallback] = {
        "hold": hold,
        "zero": zero,
        "model": PredictedInput(loop.H, loop.K, resolved.timing.plant_period_ns),
    }
    policy = resolved.plant.watchdog.policy
    timing, predictions = resolved.timing, resolved.controller.predictions
    return Watchdog(
        InputBuffer(loop.m, predictions, timing.controller_period_ns),
        timing.actuation_timeout_ns,
        fallbacks[policy],
        FALLBACK_NAMES[policy],
        timing.missing_actuation_ns,
    )
