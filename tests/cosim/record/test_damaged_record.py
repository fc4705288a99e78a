"""A damaged run directory: the readable part is read, the rest is reported in one line."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cosim.analysis.run_summary import summarise
from cosim.record.run_directory import RECORD, REPORTS_FILE
from cosim.record.run_record import load_record
from cosim.record.spool_conversion import finish_record
from noack.core.errors import CallerError
from noack.protocol.record_tables import PLANT_STEP
from noack.runtime.spool import SPOOL, SpoolWriter, notices_of
from tests.fuzz.parsers.record import NOTICE, files, spooled


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    for name, data in files(acknowledged=False, live=True).items():
        if not name.startswith(SPOOL):
            (tmp_path / name).parent.mkdir(exist_ok=True)
            (tmp_path / name).write_bytes(data)
    return tmp_path


COLUMNS: list[tuple[Callable[[int], Any], str]] = [
    (lambda n: pa.array(["0"] * n), "column t_ns is not one of int64"),
    (lambda n: pa.array([0.5] * n), "column t_ns is not one of int64"),
    (lambda n: pa.array([None] + [0] * (n - 1), pa.int64()), "column t_ns has holes"),
]


def test_a_damaged_column_or_report_is_refused_or_ignored(run_dir: Path) -> None:
    path, reports = run_dir / RECORD / f"{PLANT_STEP}.parquet", run_dir / REPORTS_FILE
    whole, given = pq.read_table(path), json.loads(reports.read_text())
    text = {"ended": "horizon", "channel": {}, "rows": {"plant_step": "1", "plant_actuation": 1}}
    for report in (None, [], {"rows": {}}, text):
        reports.write_text(json.dumps(given | {"plant": report}))
        record = load_record(run_dir)
        assert record.reports.keys() == {"sensor", "netem", "controller"}
        assert summarise(record, 0, "").to_json()["missing_samples"] == 0
    number = whole.column_names.index("t_ns")
    for values, expected in COLUMNS:
        pq.write_table(whole.set_column(number, "t_ns", values(len(whole))), path)
        with pytest.raises(CallerError, match=expected):
            load_record(run_dir)
    pq.write_table(whole.append_column("t_ns", whole["t_ns"]), path)
    with pytest.raises(CallerError, match=r"plant_step\.parquet: .*t_ns"):
        load_record(run_dir)


def test_the_readable_part_of_a_damaged_spool_is_read(run_dir: Path) -> None:
    record = load_record(run_dir)
    rows, steps = spooled(record, PLANT_STEP), len(record[PLANT_STEP])
    (run_dir / RECORD / f"{PLANT_STEP}.parquet").unlink()
    writer = SpoolWriter(run_dir / SPOOL, "recorder")
    writer.append(PLANT_STEP, 0, rows[:2].tobytes())
    writer.append(PLANT_STEP, 2, rows[2:4].tobytes()[:-1])
    writer.append(PLANT_STEP, 4, rows[4:].tobytes())
    for number, line in enumerate(["[]", "{", json.dumps(NOTICE | {"text": "last"})]):
        writer.append(notices_of("netem"), number, line.encode())
    writer.close()
    finished = finish_record(run_dir).loop()
    kept = [*rows["input"][:2].tolist(), *rows["input"][4:].tolist()]
    assert finished[PLANT_STEP]["input"].tolist() == kept
    assert [notice["text"] for notice in finished.notices] == ["MANSD violated", "last"]
    assert summarise(finished, 0, "").to_json()["missing_by_table"] == {PLANT_STEP: 2}
    assert steps == len(finished[PLANT_STEP]) + 2


def test_a_table_is_a_regular_file_in_parts_of_bounded_length(run_dir: Path) -> None:
    path = run_dir / RECORD / f"{PLANT_STEP}.parquet"
    table = pq.read_table(path)
    pq.write_table(pa.concat_tables([table] * (40_000 // len(table))), path, row_group_size=10**6)
    with pytest.raises(CallerError, match=r"rows in one part; at most 32,768 are read"):
        load_record(run_dir)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(CallerError, match="not a regular file"):
        load_record(run_dir)
