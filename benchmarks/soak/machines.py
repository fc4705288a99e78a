"""Checks each machine's rows by independent computations from the scenario, batch by batch.

The replay at a run's end compares with the machines themselves. These are other implementations of
the same rules, for whole batches, equal up to rounding errors.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from cosim.record.run_record import Rows, updates_in
from noack.config.resolution import loop_of
from noack.config.scenario import Scenario
from noack.core.linear_systems import discretise, transition
from noack.protocol.record_tables import NO_SEQUENCE, effective

Reals = NDArray[np.float64]

_ROUNDING = 1e-12
"""Rounding error of one step, relative to the inputs of the computation."""


class PlantSteps:
    """x(t_k) = Ad x(t_{k−1}) + Bd u(t_{k−1}), on the grid."""

    def __init__(self, scenario: Scenario) -> None:
        loop = loop_of(scenario)
        self._period_ns = scenario.timing.plant_period_ns
        self._Ad, self._Bd = discretise(loop.A, loop.B, self._period_ns)
        self._last: Rows | None = None

    def take(self, rows: Rows) -> Iterator[str]:
        """Check rows of ``plant_step``; yield the faults."""
        if self._last is not None:
            rows = np.concatenate([self._last, rows])
        self._last = rows[-1:]
        yield from _on_grid("plant_step", rows, self._period_ns)
        before = rows[:-1]
        x = before["x"] @ self._Ad.T + before["u"] @ self._Bd.T
        size = np.abs(before["x"]) @ np.abs(self._Ad.T) + np.abs(before["u"]) @ np.abs(self._Bd.T)
        yield from _unlike("plant_step", rows[1:], "x", x, size)
        if (np.diff(rows["actuation"]) < 0).any():
            yield f"plant_step: an older input is latched near t = {rows['t_ns'][0]} ns"


class SensorSteps:
    """x_s follows its model between events; an event happens when the threshold is exceeded."""

    def __init__(self, scenario: Scenario) -> None:
        loop, trigger = loop_of(scenario), scenario.decaying
        self._period_ns = scenario.timing.measurement_period_ns
        self._step = transition(loop.H, self._period_ns)
        self._weight = np.eye(loop.n) if loop.weight is None else loop.weight
        self._trigger = trigger
        self._first_is_event = scenario.network.initial_sync == "first_packet"
        self._last: Rows | None = None
        self._events = 0

    def take(self, rows: Rows) -> Iterator[str]:
        """Check rows of ``sensor_measurement``; yield the faults."""
        events = rows["event"][rows["event"] != NO_SEQUENCE]
        if (events != self._events + np.arange(len(events))).any():
            yield f"sensor_measurement: events are not numbered in turn from {self._events} on"
        self._events += len(events)
        exceeds = rows["compared"] > rows["threshold"]
        if self._last is None and self._first_is_event:
            exceeds[0] = True
        wrong = np.flatnonzero(exceeds != (rows["event"] != NO_SEQUENCE))
        if len(wrong):
            at_ns = rows["t_ns"][wrong[0]]
            yield f"sensor_measurement: the trigger is not obeyed at t = {at_ns} ns"
        faded = self._trigger.beta * np.exp(-self._trigger.alpha_per_s * 1e-9 * rows["t_ns"])
        threshold = np.maximum(faded, self._trigger.floor)
        yield from _unlike("sensor_measurement", rows, "threshold", threshold, threshold)
        weighted = (rows["x_s"] - rows["x"]) @ self._weight.T
        norms = np.linalg.norm(weighted, axis=1)
        for column in ("e_s_norm", "compared"):
            yield from _unlike("sensor_measurement", rows, column, norms, norms)
        if self._last is not None:
            rows = np.concatenate([self._last, rows])
        self._last = rows[-1:]
        yield from _on_grid("sensor_measurement", rows, self._period_ns)
        before = rows[:-1]
        reset = (before["event"] != NO_SEQUENCE)[:, None]
        x_s = np.where(reset, before["x"], before["x_s"])
        size = np.abs(x_s) @ np.abs(self._step.T)
        yield from _unlike("sensor_measurement", rows[1:], "x_s", x_s @ self._step.T, size)


class ControllerTicks:
    """u = K x_c at every tick."""

    def __init__(self, scenario: Scenario) -> None:
        self._K = loop_of(scenario).K
        self._period_ns = scenario.timing.controller_period_ns
        self._phase_ns = scenario.timing.controller_phase_ns
        self._next = 0

    def take(self, rows: Rows) -> Iterator[str]:
        """Check rows of ``controller_step``; yield the faults."""
        if (rows["sequence"] != self._next + np.arange(len(rows))).any():
            yield f"controller_step: ticks are not numbered in turn from {self._next} on"
        self._next += len(rows)
        if (rows["t_ns"] != self._phase_ns + rows["sequence"] * self._period_ns).any():
            yield f"controller_step: a tick is off the grid near t = {rows['t_ns'][0]} ns"
        size = np.abs(rows["x_c"]) @ np.abs(self._K.T)
        yield from _unlike("controller_step", rows, "u", rows["x_c"] @ self._K.T, size)


class Network:
    """The network's fates and releases; at most M − 1 consecutive losses.

    Args:
        mansd: M − 1.
    """

    def __init__(self, mansd: int) -> None:
        self._mansd = mansd
        self._in_flight: dict[int, int] = {}
        self._packets = 0
        self.longest_loss_burst = 0
        self.delivered_out_of_order = 0
        """Updates that left after a newer one; the controller treats them as stale."""

    @property
    def waiting(self) -> int:
        """Number of updates that have not left yet."""
        return len(self._in_flight)

    def take(self, packets: Rows, releases: Rows) -> tuple[list[int], list[int], list[str]]:
        """Check rows of the network's tables; they must be consecutive in the order of inputs.

        Returns:
            Numbers of the updates that arrived, and that left, in order; and the faults.
        """
        updates, sequences, _ = updates_in(packets)
        wrong = [] if len(updates) == len(packets) else ["netem_packet: something is no update"]
        lost = ~effective(updates["fate"])
        longest = int(updates["consecutive_losses"][lost].max(initial=0))
        self.longest_loss_burst = max(self.longest_loss_burst, longest)
        if longest > self._mansd:
            wrong.append(f"netem_packet: {longest} dropouts in a row, at most {self._mansd} agreed")
        places = self._packets + np.arange(len(packets))
        self._packets += len(packets)
        if (packets["sequence"] != places).any():
            wrong.append(f"netem_packet: packets are not numbered in turn from {places[0]} on")
        left: list[tuple[int, int]] = []
        for row, sequence in zip(updates[~lost], sequences[~lost].tolist(), strict=True):
            if row["release_ns"] <= row["now_ns"]:
                left.append((int(row["input"]), sequence))
            else:
                self._in_flight[int(row["sequence"])] = sequence
        for row in releases:
            sequence = self._in_flight.pop(int(row["sequence"]), None)
            if sequence is None:
                wrong.append(f"netem_release: packet {row['sequence']} was not under way")
            elif row["stale"]:
                self.delivered_out_of_order += 1
            else:
                left.append((int(row["input"]), sequence))
        return sequences.tolist(), [sequence for _, sequence in sorted(left)], wrong


def _on_grid(table: str, rows: Rows, period_ns: int) -> Iterator[str]:
    grid_ns = rows["sequence"] * period_ns
    if (np.diff(rows["sequence"]) != 1).any() or (rows["t_ns"] != grid_ns).any():
        yield f"{table}: not one row for each point of the grid near t = {rows['t_ns'][0]} ns"


def _unlike(table: str, rows: Rows, column: str, expected: Reals, size: Reals) -> Iterator[str]:
    """Yield the rows in which a column differs from its computed value by more than rounding."""
    tiny = np.finfo(float).tiny
    wrong = ~(np.abs(rows[column] - expected) <= _ROUNDING * (size + tiny))
    if wrong.ndim == 2:
        wrong = wrong.any(axis=1)
    if wrong.any():
        at_ns = rows["t_ns"][np.argmax(wrong)]
        yield f"{table}: {column} is not as computed anew at t = {at_ns} ns"
