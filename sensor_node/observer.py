"""A sensor's observer: it estimates x from the measurements, and the trigger tests x̂.

The observer needs the input that the plant applied. The sensor does not receive the actuations, and
nothing is acknowledged. So the input is measured at the actuator, and a measurement carries [y; u
of every step since the last measurement]. Sensor and actuator are at the plant, the controller is
on the other side of the network. Montestruque and Antsaklis (2003) place their observer likewise.
Disturbances that enter after the actuator are not part of the measured input.

At a measurement, x̂ is predicted over the plant's steps and corrected by y (native/loop/observer.c).
The observer's time is the time of its measurements. If measurements are missing, the inputs of
their steps are unknown, and the first known input is used.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from noack.config.resolution import loop_of
from noack.config.scenario import Scenario
from noack.config.state_estimation import assumed_model
from noack.core.core_memory import CoreMemory
from noack.core.linear_systems import Vector
from noack.observers.observer_settings import EstimationModel, ObserverSettings
from noack.protocol.machine_interface import Notice


@dataclass
class Observer:
    """The observer of one loop's sensor.

    Args:
        settings: the kind of observer.
        model: the model with the covariances that it assumes.
        x: x̂ before the first measurement, (n,).
        reported: entries of a measurement that are inputs.
        period_ns: the plant's step.
        knows_start: whether x̂ is the estimate at time 0; else at the first measurement.
        restarted: a restarted sensor does not know the estimate of the sensor that it replaces.
    """

    settings: ObserverSettings
    model: EstimationModel
    x: Vector
    reported: int
    period_ns: int
    knows_start: bool
    restarted: bool = False

    @property
    def p(self) -> int:
        """Number of measured outputs."""
        return len(self.model.C)

    def fill(self, sensor: Any, memory: CoreMemory) -> None:
        """Fill the ``noack_observer`` of a sensor."""
        self.settings.fill(sensor.observer, self.model, self.x, memory)
        sensor.observer.t_ns = 0 if self.knows_start else -1
        sensor.plant_period_ns = self.period_ns

    def first_notice(self, t_ns: int) -> Sequence[Notice]:
        """Return the line of a restarted observer at its first measurement."""
        if not self.restarted:
            return ()
        self.restarted = False
        return (Notice(t_ns, "info", "the observer restarts from its initial estimate"),)


def observer_of(resolved: Scenario, *, restarted: bool) -> Observer | None:
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
    return Observer(
        settings, assumed_model(resolved), x, resolved.message_sizes.inputs_reported,
        resolved.timing.plant_period_ns, knows_start, restarted,
    )  # fmt: skip
