"""The store of a run's telemetry: what it has, in whichever order batches arrive."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.live.recording.telemetry_store import TelemetryStore
from netem.core.errors import MachineError, PeerError
from noack.protocol.record_tables import PLANT_STEP
from noack.runtime.control_messages import ChannelCounters, ProcessReport
from noack.runtime.spool import NOTICES, SPOOL, batch_of, read_batches
from noack.scenario.resolution import ResolvedRun, resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate

BATCH = 10


@pytest.fixture
def scenario(content: dict[str, Any]) -> Scenario:
    return resolve(validate(content, "here"))


@pytest.fixture
def store(scenario: Scenario, tmp_path: Path) -> Iterator[TelemetryStore]:
    telemetry_store = TelemetryStore(ResolvedRun(scenario).tables, tmp_path)
    yield telemetry_store
    telemetry_store.writer.close()


def batch(store: TelemetryStore, first: int, count: int = BATCH) -> bytes:
    rows = np.zeros(count, store.types[PLANT_STEP])
    rows["input"] = first + np.arange(count)
    return rows.tobytes()


def add(store: TelemetryStore, first: int) -> bool:
    """Add a batch of the plant's steps; return whether it follows the rows before."""
    payload = batch(store, first)
    rows, follows = store.add_rows("plant", PLANT_STEP, first, payload)
    assert rows.tobytes() == payload
    return follows


def report_of(steps: int, **stored: tuple[tuple[int, int], ...]) -> ProcessReport:
    channel = ChannelCounters(rejected={})
    return ProcessReport(ended="horizon", channel=channel, rows={PLANT_STEP: steps}, stored=stored)


def missing(store: TelemetryStore, steps: int) -> list[tuple[int, int]]:
    return store.missing("plant", report_of(steps)).get(PLANT_STEP, [])


def acknowledged(store: TelemetryStore) -> dict[str, Any]:
    return dict(store.acknowledgements())


@pytest.mark.parametrize("seed", range(5))
def test_batches_may_arrive_in_any_order_and_twice(store: TelemetryStore, seed: int) -> None:
    batches, stored_batches, end = 12, set[int](), 0
    rng = np.random.default_rng(seed)
    for number in [*rng.permutation(batches), *rng.integers(batches, size=3)]:
        first = BATCH * int(number)
        assert add(store, first) is (first == end)
        stored_batches |= set(range(first, first + BATCH))
        end = max(end, first + BATCH)
        absent = {row for begin, until in missing(store, BATCH * batches) for row in range(begin, until)}
        assert absent == set(range(BATCH * batches)) - stored_batches
    assert acknowledged(store)["plant"] == {"rows": {PLANT_STEP: [(0, BATCH * batches)]}}


def test_a_batch_of_another_process_is_refused_and_not_stored(store: TelemetryStore, tmp_path: Path) -> None:
    payload = batch(store, 0)
    refused = [
        ("sensor", PLANT_STEP, payload),  # the table of another role
        ("plant", "plant_steps", payload),  # no table
        ("plant", PLANT_STEP, b""),
    ]
    for role, table, rows in refused:
        with pytest.raises(PeerError):
            store.add_rows(role, table, 0, rows)
    with pytest.raises(ValueError, match="buffer size"):
        store.add_rows("plant", PLANT_STEP, 0, payload[:-1])
    with pytest.raises(PeerError):
        store.add_notices("plant", 0, b"no JSON")
    assert acknowledged(store) == {}
    assert list(read_batches(tmp_path / SPOOL, PLANT_STEP)) == []


def test_rows_and_lines_of_the_log_are_acknowledged(store: TelemetryStore) -> None:
    line = json.dumps({"t_ns": 0, "level": "info", "text": "here"}).encode()
    add(store, 0)
    assert len(store.add_notices("plant", 0, batch_of([line] * 3))) == 3
    rows: dict[str, Any] = {PLANT_STEP: [(0, BATCH)], NOTICES: [(0, 3)]}
    assert acknowledged(store) == {"plant": {"rows": rows}}
    assert missing(store, 2 * BATCH) == [(BATCH, 2 * BATCH)]


def test_of_the_rows_that_a_process_stored_itself_the_new_ones_are_counted(store: TelemetryStore) -> None:
    add(store, 0)
    report = report_of(3 * BATCH, plant_step=((BATCH // 2, 3 * BATCH),))
    assert store.add_stored("plant", report) == 2 * BATCH
    assert store.add_stored("plant", report) == 0
    assert missing(store, 3 * BATCH) == []


def test_a_spool_that_was_moved_is_reported(store: TelemetryStore, tmp_path: Path) -> None:
    add(store, 0)
    (tmp_path / SPOOL).rename(tmp_path / "elsewhere")
    with pytest.raises(MachineError):
        acknowledged(store)
