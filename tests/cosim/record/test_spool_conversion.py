"""The records of a live run of several loops, from a spool with the rows of a simulated one."""

import json
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.record.run_directory import REPORTS_FILE, write_environment
from cosim.record.run_record import RecordedRun, Rows, load_run
from cosim.record.run_scenario import write_scenario
from cosim.record.spool_conversion import Segment, finish_record, merge_segments
from cosim.record.table_files import TableFile, write_table
from cosim.simulation.virtual_time import simulate_loops
from netem.core.errors import MachineError
from netem.core.packet_rows import NETEM_PACKET
from noack.protocol.record_tables import LOOP, PLANT_STEP, network_tables
from noack.protocol.roles import Notice
from noack.runtime.spool import SPOOL, SpoolWriter, notices_of
from noack.scenario.resolution import resolve_run
from noack.scenario.scenario_file import validate
from tests.helpers.rows_of_loops import mixed_rows

LOOPS = 3


@pytest.fixture
def shared(content: dict[str, Any]) -> RecordedRun:
    content["horizon_s"] = 2.0
    content["plant"] |= {"rate_hz": 100.0, "initial_state_halfwidth": [0.5, 0.5]}
    content["controller"] = {"rate_hz": 100.0}
    content["trigger"]["beta"] = 0.01
    content["network"]["impairments"] = [{"kind": "delay", "delay_s": 0.012, "jitter_s": 0.009}]
    content["loops"] = [{"name": "a", "count": 2}, {"name": "b"}]
    return simulate_loops(resolve_run(validate(content, "here")))


def spool(run_dir: Path, table: str, rows: Rows, *, writer: str = "recorder") -> None:
    """Spool rows in batches of which every third comes late, and every fifth comes twice."""
    spool_writer = SpoolWriter(run_dir / SPOOL, writer)
    late_batches = []
    for number, first in enumerate(range(0, len(rows), 7)):
        batch = rows[first : first + 7].tobytes()
        late_batches += [(first, batch)] * (number % 3 == 0) + [(first, batch)] * (number % 5 == 0)
        if number % 3:
            spool_writer.append(table, first, batch)
    for first, batch in late_batches:
        spool_writer.append(table, first, batch)
    spool_writer.close()


def same_rows(run_dir: Path, shared: RecordedRun) -> None:
    """Finish a record and compare its rows."""
    finished = finish_record(run_dir)
    for record, expected in zip(
        (finished.network, *load_run(run_dir).loops), (shared.network, *shared.loops), strict=True
    ):
        for table in expected.tables:
            assert record[table].tobytes() == expected[table].tobytes(), table


def opened(shared: RecordedRun, run_dir: Path) -> Path:
    run_dir.mkdir()
    write_scenario(shared.resolved, run_dir)
    write_environment(run_dir, "live")
    return run_dir


def test_every_row_and_line_reaches_the_record_of_its_loop(shared: RecordedRun, tmp_path: Path) -> None:
    run_dir = opened(shared, tmp_path / "run")
    for table, rows in mixed_rows(shared).items():
        spool(run_dir, table, rows)
    out = SpoolWriter(run_dir / SPOOL, "recorder")
    for number, notice in enumerate((Notice(5, "info", "mine", 1), Notice(7, "info", "all"))):
        out.append(notices_of("sensor"), number, json.dumps(notice.line()).encode())
    for number, loop in enumerate((-1, LOOPS, True, 1.0, "1", 2**70, [1])):  # loops of no run
        line = {"t_ns": number, "level": "info", "text": "damaged", "loop": loop}
        out.append(notices_of("plant"), number, json.dumps(line).encode())
    out.append(notices_of("plant"), 10, b"[" * 100_000)
    out.append(PLANT_STEP, 10**6, b"damaged")
    out.close()
    same_rows(run_dir, shared)
    run = load_run(run_dir)
    for record, expected in zip(run.loops, shared.loops, strict=True):
        assert (record.kind, record.number) == ("live", expected.number)
        assert record.scenario == expected.scenario
    lines = [[line["text"] for line in loop.notices] for loop in run.loops]
    assert lines == [["all"], ["mine", "all"], ["all"]]
    assert [line["text"] for line in run.network.notices] == ["all"]
    assert not (run_dir / SPOOL).exists()


def test_an_interrupted_attempt_is_repeated_and_later_rows_are_added(
    shared: RecordedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_dir = opened(shared, tmp_path / "run")
    rows = mixed_rows(shared)
    later = {table: batch[len(batch) // 2 :] for table, batch in rows.items()}
    for table, batch in rows.items():
        spool(run_dir, table, batch[: len(batch) // 2])
    with monkeypatch.context() as patch:
        patch.setattr("cosim.record.table_files.write_table", _fail)
        with pytest.raises(MachineError, match="is kept in"):
            finish_record(run_dir)
    finish_record(run_dir)
    counts = [loop.count(PLANT_STEP) for loop in load_run(run_dir).loops]
    assert sum(counts) == len(rows[PLANT_STEP]) // 2
    for table, batch in later.items():  # a process that was frozen spools its rows after the end
        spool(run_dir, table, batch, writer="frozen")
    same_rows(run_dir, shared)


def _fail(*_: object) -> None:
    raise OSError(28, "No space left on device")


def test_a_loops_reports_count_its_own_rows_and_datagrams(shared: RecordedRun, tmp_path: Path) -> None:
    """A row of the network that is missing is missing in every loop."""
    run_dir = opened(shared, tmp_path / "run")
    rows = dict(mixed_rows(shared))
    rows[NETEM_PACKET] = rows[NETEM_PACKET][:-1]
    for table, batch in rows.items():
        spool(run_dir, table, batch)
    steps = [loop.count(PLANT_STEP) for loop in shared.loops]
    own = [{"accepted": number, "rejected": {"stale": number}} for number in range(LOOPS)]
    plant = {
        "ended": "horizon",
        "rows": {PLANT_STEP: sum(steps), "plant_actuation": 0},
        "rows_by_loop": {PLANT_STEP: steps, "plant_actuation": []},
        "channel": {"accepted": 3, "rejected": {"stale": 3}, "loops": own},
    }
    netem = {
        "ended": "horizon",
        "rows": {table: shared.network.count(table) for table in network_tables()},
        "channel": {"rejected": {"loop": 2}},
    }
    content = {"plant": plant, "netem": netem, "earlier": [plant | {"process": "plant"}]}
    (run_dir / REPORTS_FILE).write_text(json.dumps(content))
    finish_record(run_dir)
    for number, record in enumerate(load_run(run_dir).loops):
        report = record.reports["plant"]
        assert report["rows"] == {PLANT_STEP: steps[number], "plant_actuation": 0}
        assert report["channel"] == own[number]
        missing = record.reports["netem"]["rows"][NETEM_PACKET] - record.count(NETEM_PACKET)
        assert missing == 1


def test_a_loop_without_rows_between_long_ones_is_empty(tmp_path: Path) -> None:
    """Its rows do not begin a part of the file."""
    dtype = np.dtype([(LOOP, "<u2"), ("input", "<i8")])
    counts = (5000, 0, 5000, 10, 0, 40_000, 0)
    batches = [np.zeros(count, dtype) for count in counts]
    for number, rows in enumerate(batches):
        rows[LOOP], rows["input"] = number, range(len(rows))
    write_table(tmp_path / f"{PLANT_STEP}.parquet", batches, dtype, {})
    file = TableFile(tmp_path / f"{PLANT_STEP}.parquet", dtype)
    assert np.concatenate([*file.batches()]).tobytes() == np.concatenate(batches).tobytes()
    for number, count in enumerate(counts):
        parts = [*file.of_loops(range(number, number + 1), dtype)]
        assert sum(len(rows) for _, rows in parts) == count
        assert {loop for loop, _ in parts} <= {number}


@given(st.lists(st.tuples(st.integers(0, 40), st.integers(0, 12)), max_size=12), st.integers(1, 30))
def test_merged_rows_are_unique_and_ordered(ranges: list[tuple[int, int]], at_once: int) -> None:
    """Batches in any order, overlapping, repeated, empty; gaps stay gaps."""
    dtype, segments = np.dtype([("input", "<i8"), ("value", "<f8")]), []
    for first, count in ranges:
        rows = np.zeros(count, dtype)
        rows["input"] = rows["value"] = np.arange(first, first + count)
        if count:
            segments.append(Segment(first, first + count - 1, lambda rows=rows: rows))
    with patch("cosim.record.spool_conversion.BATCH_ROWS", at_once):
        rows = np.concatenate([np.zeros(0, dtype), *merge_segments(segments, dtype)])
    present = sorted({k for first, n in ranges for k in range(first, first + n)})
    assert rows["input"].tolist() == rows["value"].tolist() == present
