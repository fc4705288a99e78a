"""Lateness of the processes of a live run, in wall time."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.quantile_sketch import QuantileSketch
from cosim.analysis.summary_model import LatencyPart, LatenessPart
from cosim.record.run_record import RunRecord
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    NETEM_PACKET,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)

_STEPS = {
    "plant": PLANT_STEP,
    "sensor": SENSOR_MEASUREMENT,
    "netem": NETEM_PACKET,
    "controller": CONTROLLER_STEP,
}


def lateness_parts(record: RunRecord, role: str) -> Iterator[NDArray[np.float64]]:
    """Yield the wall time between a process's actions and their nominal times in µs, in order.

    The nominal time is the deadline for plant and controller, the time of the measurement for the
    sensor, and the arrival of the datagram at its socket for the network. The plain engine of the
    network does not know the arrival; its rows have ``now_ns`` there, and are left out.
    """
    for rows in record.source.batches(_STEPS[role], ("now_ns", "t_ns")):
        late_ns = rows["now_ns"] - rows["t_ns"]
        known = late_ns[late_ns != 0] if role == "netem" else late_ns
        yield np.asarray(known / (1e3 * record.scenario.speed))


def lateness_us(record: RunRecord, role: str) -> NDArray[np.float64]:
    """Return the lateness of all actions of a process, (k,)."""
    return np.concatenate([np.zeros(0), *lateness_parts(record, role)])


def lateness(record: RunRecord, role: str) -> LatenessPart:
    """Return quantiles of a process's lateness, and its number of steps late by over a period."""
    timing = record.scenario.timing
    period_ns = {
        "plant": timing.plant_period_ns,
        "sensor": timing.measurement_period_ns,
        "controller": timing.controller_period_ns,
        "netem": timing.plant_period_ns,
    }[role]
    sketch, late_steps = QuantileSketch(), 0
    for late_us in lateness_parts(record, role):
        sketch.add(late_us)
        late_steps += int((late_us * 1e3 * record.scenario.speed > period_ns).sum())
    return LatenessPart(**_quantiles(sketch), steps=sketch.count, late_steps=late_steps)


def latency_us(record: RunRecord) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the wall time from the sensor's event to the controller's update, one way.

    Returns:
        Event times in ns (d,) and latencies in µs (d,), of the delivered updates.
    """
    events = record.events()
    deliveries = record.columns(CONTROLLER_DELIVERY, "sequence", "now_ns")
    _, at_sensor, at_controller = np.intersect1d(
        events["event"], deliveries["sequence"], return_indices=True
    )
    passed_ns = deliveries["now_ns"][at_controller] - events["now_ns"][at_sensor]
    return events["t_ns"][at_sensor], passed_ns / (1e3 * record.scenario.speed)


def latency(record: RunRecord) -> LatencyPart:
    """Quantiles of the latency."""
    _, passed_us = latency_us(record)
    sketch = QuantileSketch()
    sketch.add(passed_us)
    return LatencyPart(**_quantiles(sketch), updates=len(passed_us))


def _quantiles(sketch: QuantileSketch) -> dict[str, float | None]:
    shares = {"p50": 0.5, "p99": 0.99, "p999": 0.999, "max": 1.0}
    return {key: sketch.quantile(share) for key, share in shares.items()}
