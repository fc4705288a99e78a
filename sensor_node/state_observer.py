"""The sensor's observer: estimates x from what is measured, in front of the trigger.

It needs the input that the plant felt, which nothing in the loop tells the sensor: what the
controller puts out goes another way, and nothing is acknowledged. So the input is measured where it
acts, as y is, and a measurement carries [y; u of every step since the one before]: sensor and
actuator are at the plant, the controller is behind the network (Montestruque and Antsaklis 2003,
whose state observer beside the sensor has the plant's input as well). What disturbs the input
behind the actuator is not in it.

A measurement in → x̂ predicted over the plant's steps, corrected by y → the sensor behind it takes
x̂ for x. The observer's time is the measurements' own. Where measurements are missing, the inputs of
their steps are not known: the first that is known stands for them.
"""

from collections.abc import Iterable, Sequence
from typing import Protocol

import numpy as np

from noack.config.observers import KalmanSettings, LuenbergerSettings
from noack.config.parameter_changes import ParameterChange, ReconfigurableMachine
from noack.config.resolution import loop_of
from noack.config.scenario import Scenario
from noack.config.state_estimation import EstimationModel, believed_model
from noack.core.linear_systems import Matrix, Vector
from noack.protocol.machine_interface import Notice, Output, Record
from noack.protocol.record_tables import SENSOR_MEASUREMENT
from noack.protocol.wire_format import Flow, Message


class StateObserver(Protocol):
    """Estimates a state, measurement by measurement."""

    x: Vector
    """x̂, shape (n,)."""

    def predict(self, u: Vector) -> None:
        """Go on by a step of the plant under an input, shape (m,)."""
        ...

    def correct(self, y: Vector) -> None:
        """Take what was measured, shape (p,)."""
        ...


class LuenbergerObserver:
    """x̂(t_k) = x̂⁻ + L (y − C x̂⁻), with x̂⁻ ← Âd x̂ + B̂d u at every step of the plant.

    The error of a plant that is the model follows e(t_k) = (I − L C) Â^(T) e(t_(k−1)).

    Args:
        model: what the observer knows of the plant.
        gain: L, shape (n, p).
        x: x̂ before the first measurement, shape (n,).
    """

    def __init__(self, model: EstimationModel, gain: Matrix, x: Vector) -> None:
        self._model = model
        self._gain = gain
        self.x = x

    def predict(self, u: Vector) -> None:
        """Go on by a step of the plant."""
        self.x = self._model.Ad @ self.x + self._model.Bd @ u

    def correct(self, y: Vector) -> None:
        """Take what was measured."""
        self.x = self.x + self._gain @ (y - self._model.C @ self.x)


class KalmanObserver:
    """The Kalman filter (Kalman 1960), its covariance corrected in the form of Bucy and Joseph.

    At every step x̂ ← Âd x̂ + B̂d u, P ← Âd P Âdᵀ + Q; at a measurement S = C P Cᵀ + R,
    L = P Cᵀ S⁻¹, x̂ ← x̂ + L (y − C x̂), P ← (I − L C) P (I − L C)ᵀ + L R Lᵀ, which stays symmetric
    and positive whatever rounding makes of L.

    Args:
        model: what the filter knows of the plant, Q and R included.
        x: x̂ before the first measurement, shape (n,).
        covariance: P before it, shape (n, n).
    """

    def __init__(self, model: EstimationModel, x: Vector, covariance: Matrix) -> None:
        self._model = model
        self.x = x
        self.covariance = covariance

    def predict(self, u: Vector) -> None:
        """Go on by a step of the plant."""
        Ad, Bd, _, Q, _, _ = self._model
        self.x = Ad @ self.x + Bd @ u
        self.covariance = Ad @ self.covariance @ Ad.T + Q

    def correct(self, y: Vector) -> None:
        """Take what was measured."""
        C, R, P = self._model.C, self._model.R, self.covariance
        L = np.linalg.solve(C @ P @ C.T + R, C @ P).T
        rest = np.eye(len(P)) - L @ C
        self.x = self.x + L @ (y - C @ self.x)
        P = rest @ P @ rest.T + L @ R @ L.T
        self.covariance = 0.5 * (P + P.T)


class AppliedInputTracker:
    """An observer that follows the measurements through their times.

    Args:
        observer: at its first estimate.
        inputs: m.
        outputs: p.
        period_ns: the plant's step.
        since_ns: the time of that estimate; None: that of the first measurement that comes.
    """

    def __init__(
        self,
        observer: StateObserver,
        inputs: int,
        outputs: int,
        period_ns: int,
        since_ns: int | None,
    ) -> None:
        self._observer = observer
        self._inputs = inputs
        self._outputs = outputs
        self._period_ns = period_ns
        self._t_ns = since_ns

    def split(self, vector: Vector) -> tuple[Vector, Vector]:
        """Part what a measurement carries: y, and the inputs since the one before."""
        # A part of an array may lie in memory otherwise than a copy, and replay has copies.
        return vector[: self._outputs].copy(), vector[self._outputs :].copy()

    def take(self, t_ns: int, y: Vector, inputs: Vector) -> Vector:
        """Return x̂ at the time of a measurement, shape (n,)."""
        since_ns = t_ns if self._t_ns is None else self._t_ns
        for u in self._applied_input((t_ns - since_ns) // self._period_ns, inputs):
            self._observer.predict(u)
        self._observer.correct(y)
        self._t_ns = t_ns
        return self._observer.x

    def _applied_input(self, steps: int, inputs: Vector) -> Iterable[Vector]:
        """The inputs of the last steps, so far as known."""
        known = inputs.reshape(-1, self._inputs)
        for before in range(steps, 0, -1):
            yield known[max(len(known) - before, 0)].copy()


class ObservingSensor:
    """The machine of a sensor with an observer.

    Args:
        following: estimates.
        sensor: the sensor that takes x̂ for x: models and trigger.
        again: whether it takes the place of another, whose estimate is lost.
    """

    def __init__(
        self,
        following: AppliedInputTracker,
        sensor: ReconfigurableMachine[Message],
        *,
        again: bool = False,
    ) -> None:
        self._following = following
        self._sensor = sensor
        self._again = again

    def next_deadline_ns(self) -> int | None:
        """None: the sensor acts on what it receives only."""
        return self._sensor.next_deadline_ns()

    def on_timer(self, now_ns: int) -> Sequence[Output]:
        """Nothing is ever due."""
        return self._sensor.on_timer(now_ns)

    def announce(self, change: ParameterChange, now_ns: int) -> Sequence[Record | Notice]:
        """Tell the sensor behind it; nothing that an observer knows can be changed."""
        return self._sensor.announce(change, now_ns)

    def handle(self, message: Message, now_ns: int) -> Sequence[Output]:
        """Take a measurement [y; u …], or an acknowledgement."""
        if message.flow is not Flow.MEASUREMENT:
            return self._sensor.handle(message, now_ns)
        y, inputs = self._following.split(message.vector)
        x = self._following.take(message.t_ns, y, inputs)
        outputs: list[Output] = [
            Record(output.table, (*output.row, y, inputs))
            if isinstance(output, Record) and output.table == SENSOR_MEASUREMENT
            else output
            for output in self._sensor.handle(message._replace(vector=x), now_ns)
        ]
        if self._again:
            self._again = False
            text = "the observer begins anew, from its initial estimate"
            outputs.append(Notice(message.t_ns, "info", text))
        return outputs


def observer_of(resolved: Scenario, *, known: bool) -> AppliedInputTracker | None:
    """Return the observer of a resolved scenario; None if it has none.

    Args:
        resolved: the scenario.
        known: whether the sensor is there from the start, so that it may know x(0).
    """
    settings, loop = resolved.observer, loop_of(resolved)
    if settings is None:
        return None
    model = believed_model(resolved)
    told = known and resolved.network.initial_sync == "known_state"
    x = loop.x0 if told else np.zeros(loop.n)
    if settings.initial_estimate is not None:
        x = np.array(settings.initial_estimate)
    observer: StateObserver
    match settings:
        case LuenbergerSettings():
            observer = LuenbergerObserver(model, np.array(settings.gain), x)
        case KalmanSettings():
            observer = KalmanObserver(model, x, np.diag(np.square(settings.initial_std)))
    period_ns, since_ns = resolved.timing.plant_period_ns, 0 if told else None
    return AppliedInputTracker(
        observer, loop.m, resolved.message_sizes.outputs, period_ns, since_ns
    )
