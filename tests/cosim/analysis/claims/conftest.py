"""Runs with known conditions, and functions that damage their records."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import UserNetwork, simulate
from noack.protocol.record_tables import OWNER, SENSOR_MEASUREMENT
from noack.protocol.wire_format import read_header
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from tests.cosim.record.changed_records import changed

MS = 1_000_000

Make = Callable[..., Scenario]


def network_of(decide: Callable[[int], int | None]) -> UserNetwork:
    """A network that maps an update's number to a delay in ms, or to None for a loss."""

    def network(data: bytes, now_ns: int) -> int | None:
        header = read_header(data)
        assert header is not None
        delay_ms = decide(header.sequence)
        return None if delay_ms is None else delay_ms * MS

    return network


def without(record: RunRecord, *processes: str) -> RunRecord:
    """The record without the rows of some processes."""
    without_rows = {table: record[table][:0] for table in record.tables if OWNER[table] in processes}
    return changed(record, without_rows)


def event_s(record: RunRecord, number: int) -> float:
    """The time of an event."""
    rows = record[SENSOR_MEASUREMENT]
    return float(rows["t_ns"][rows["event"] == number][0] * 1e-9)


@pytest.fixture(scope="session")
def make() -> Make:
    """A double integrator with a separate plant, 100 Hz; ``changes`` by section."""

    def scenario(**changes: Any) -> Scenario:
        content: dict[str, Any] = {
            "name": "claims", "horizon_s": 6.0,
            "model": {"A": [[0.0, 1.0], [0.0, 0.0]], "B": [[0.0], [1.0]], "gain": [[-1.0, -1.8]]},
            "plant": {
                "initial_state": [1.0, 0.0], "rate_hz": 100.0, "draw": "given",
                "A": [[0.0, 1.0], [0.2, 0.1]], "B": [[0.0], [1.1]],
            },
            "controller": {"rate_hz": 100.0},
            "trigger": {"beta": 0.02, "alpha_per_s": 0.25},
            "network": {"mansd": 2, "loss": {"model": "bernoulli", "probability": 0.5}},
            "certificate": {"late_periods": 0, "paper": True},
        }  # fmt: skip
        for section, values in changes.items():
            inner = isinstance(values, dict)
            content[section] = content.get(section, {}) | values if inner else values
        return resolve(validate(content, "test"))

    return scenario


@pytest.fixture(scope="session")
def run(make: Make) -> RunRecord:
    """A run that meets its timing conditions, with about 50 events; its rows are read-only."""
    record = simulate(make())
    assert np.isfinite(record["plant_step"]["x"]).all()
    for table in record.tables:
        record[table].setflags(write=False)
    return record
