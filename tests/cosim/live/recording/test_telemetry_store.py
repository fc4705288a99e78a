"""The store of a run's telemetry: what it has, in whichever order batches arrive."""

import json
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.live.recording.telemetry_store import TelemetryStore
from noack.core.errors import MachineError, PeerError
from noack.protocol.record_tables import PLANT_STEP
from noack.protocol.roles import BEGINNING, GENERATION, Start
from noack.runtime.control_messages import ChannelCounters, ProcessReport
from noack.runtime.spool import NOTICES, SPOOL, batch_of, read_batches
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate

BATCH = 10


@pytest.fixture
def scenario(content: dict[str, Any]) -> Scenario:
    return resolve(validate(content, "here"))


@pytest.fixture
def store(scenario: Scenario, tmp_path: Path) -> Iterator[TelemetryStore]:
    telemetry_store = TelemetryStore(scenario, tmp_path, "first", BEGINNING)
    yield telemetry_store
    telemetry_store.writer.close()


def batch(store: TelemetryStore, first: int, generation: int = 0, count: int = BATCH) -> bytes:
    rows = np.zeros(count, store.types[PLANT_STEP])
    rows["input"] = generation * GENERATION + first + np.arange(count)
    return rows.tobytes()


def add(store: TelemetryStore, first: int, generation: int = 0) -> bool:
    """Add a batch of the plant's steps; return whether it follows the rows before."""
    payload = batch(store, first, generation)
    rows, follows = store.add_rows("plant", PLANT_STEP, generation, first, payload)
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
    assert acknowledged(store)["plant"] == {"generation": 0, "rows": {PLANT_STEP: [(0, BATCH * batches)]}}


def test_a_batch_of_another_process_is_refused_and_not_stored(store: TelemetryStore, tmp_path: Path) -> None:
    payload = batch(store, 0)
    refused: list[tuple[str, str, int, bytes]] = [
        ("sensor", PLANT_STEP, 0, payload),  # the table of another role
        ("plant", "plant_steps", 0, payload),  # no table
        ("plant", PLANT_STEP, 1, payload),  # another generation than its rows
        ("plant", PLANT_STEP, 0, b""),
    ]
    for role, table, generation, rows in refused:
        with pytest.raises(PeerError):
            store.add_rows(role, table, generation, 0, rows)
    with pytest.raises(ValueError, match="buffer size"):
        store.add_rows("plant", PLANT_STEP, 0, 0, payload[:-1])
    with pytest.raises(PeerError):
        store.add_notices("plant", 0, 0, b"no JSON")
    assert acknowledged(store) == {}
    assert list(read_batches(tmp_path / SPOOL, PLANT_STEP)) == []


def test_rows_are_acknowledged_for_the_newest_process_of_a_role(store: TelemetryStore) -> None:
    line = json.dumps({"t_ns": 0, "level": "info", "text": "here"}).encode()
    add(store, 0)
    assert len(store.add_notices("plant", 0, 0, batch_of([line] * 3))) == 3
    rows: dict[str, Any] = {PLANT_STEP: [(0, BATCH)], NOTICES: [(0, 3)]}
    assert acknowledged(store) == {"plant": {"generation": 0, "rows": rows}}
    add(store, 5 * BATCH, generation=1)
    rows = {PLANT_STEP: [(5 * BATCH, 6 * BATCH)]}
    assert acknowledged(store) == {"plant": {"generation": 1, "rows": rows}}
    assert missing(store, 2 * BATCH) == [(BATCH, 2 * BATCH)]


def test_of_the_rows_that_a_process_stored_itself_the_new_ones_are_counted(store: TelemetryStore) -> None:
    add(store, 0)
    report = report_of(3 * BATCH, plant_step=((BATCH // 2, 3 * BATCH),))
    assert store.add_stored("plant", report) == 2 * BATCH
    assert store.add_stored("plant", report) == 0
    assert missing(store, 3 * BATCH) == []


def test_a_restarted_recorder_has_the_rows_of_the_one_before(
    store: TelemetryStore, scenario: Scenario, tmp_path: Path
) -> None:
    for first in (0, 3 * BATCH):
        add(store, first)
    store.writer.close()
    restarted = TelemetryStore(scenario, tmp_path, "second", Start(generation=1))
    with closing(restarted.writer):
        loaded: list[tuple[str, int]] = []
        restarted.load(lambda table, rows: loaded.append((table, int(rows["input"][0]))))
        assert loaded == [(PLANT_STEP, 0), (PLANT_STEP, 3 * BATCH)]
        assert missing(restarted, 4 * BATCH) == missing(store, 4 * BATCH) == [(BATCH, 3 * BATCH)]


def test_a_spool_that_was_moved_is_reported(store: TelemetryStore, tmp_path: Path) -> None:
    add(store, 0)
    (tmp_path / SPOOL).rename(tmp_path / "elsewhere")
    with pytest.raises(MachineError):
        acknowledged(store)
