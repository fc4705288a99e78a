"""Lateness of the processes of a live run, in wall time."""

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.summary_model import LatencyPart, LatenessPart
from cosim.record.packet_outcomes import packet_outcomes
from cosim.record.run_record import RunRecord
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    NO_SEQUENCE,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)


def lateness_us(record: RunRecord, role: str) -> NDArray[np.float64]:
    """Wall time between a process's actions and their nominal times, (k,).

    The nominal time is the deadline for plant and controller, the time of the measurement for the
    sensor, and the time of the event for the network.
    """
    if role == "netem":
        outcomes = packet_outcomes(record)
        late_ns = outcomes.rows["now_ns"] - outcomes.event_ns
    else:
        steps = {"plant": PLANT_STEP, "sensor": SENSOR_MEASUREMENT, "controller": CONTROLLER_STEP}
        late_ns = record[steps[role]]["now_ns"] - record[steps[role]]["t_ns"]
    return np.asarray(late_ns / (1e3 * record.scenario.speed))


def lateness(record: RunRecord, role: str) -> LatenessPart:
    """Return quantiles of a process's lateness, and its number of steps late by over a period."""
    timing = record.scenario.timing
    period_ns = {
        "plant": timing.plant_period_ns,
        "sensor": timing.measurement_period_ns,
        "controller": timing.controller_period_ns,
        "netem": timing.plant_period_ns,
    }[role]
    late_us = lateness_us(record, role)
    late_steps = int((late_us * 1e3 * record.scenario.speed > period_ns).sum())
    return LatenessPart(**_quantiles(late_us), steps=len(late_us), late_steps=late_steps)


def latency_us(record: RunRecord) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the wall time from the sensor's event to the controller's update, one way.

    Returns:
        Event times in ns (d,) and latencies in µs (d,), of the delivered updates.
    """
    sensor, deliveries = record[SENSOR_MEASUREMENT], record[CONTROLLER_DELIVERY]
    events = sensor[sensor["event"] != NO_SEQUENCE]
    _, at_sensor, at_controller = np.intersect1d(
        events["event"], deliveries["sequence"], return_indices=True
    )
    passed_ns = deliveries["now_ns"][at_controller] - events["now_ns"][at_sensor]
    return events["t_ns"][at_sensor], passed_ns / (1e3 * record.scenario.speed)


def latency(record: RunRecord) -> LatencyPart:
    """Quantiles of the latency."""
    _, passed_us = latency_us(record)
    return LatencyPart(**_quantiles(passed_us), updates=len(passed_us))


def _quantiles(times_us: NDArray[np.float64]) -> dict[str, float | None]:
    shares = {"p50": 0.5, "p99": 0.99, "p999": 0.999, "max": 1.0}
    known = len(times_us) > 0
    return {key: float(np.quantile(times_us, q)) if known else None for key, q in shares.items()}
