"""Damaged run directories, those of other users, and the tables in docs/record.md."""

import json
import multiprocessing
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cosim.analysis.summary.loop_summary import summarise_loop
from cosim.analysis.summary.summary_model import read_summary
from cosim.api.runs import open_run
from cosim.output.export.export_formats import export_run
from cosim.output.export.mat_export import save_mat
from cosim.output.table_files import save_tables
from cosim.record.run_directory import (
    CAMPAIGN_FILE,
    ENVIRONMENT_FILE,
    LATEST,
    RECORD,
    REPORTS_FILE,
    SCENARIO_FILE,
    SUMMARY_FILE,
    chosen_run,
    file_of_loop,
    latest_run,
    loop_of_file,
    new_run_dir,
    point_to_latest,
    read_object,
    require_output,
    write_output,
)
from cosim.record.run_record import load_record
from cosim.record.spool_conversion import finish_record
from cosim.record.table_files import TableFile, write_table
from netem.core.errors import CallerError
from netem.output.result_tables import ResultTable
from noack.protocol.record_tables import COMMON, LOOP, PLANT_STEP, TABLES, Column, Table
from noack.runtime.spool import SPOOL, SpoolWriter, notices_of
from tests.fuzz.parsers.record import NOTICE, files, spooled
from tests.noack.machines.stepped_channel import flipped


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
    table, old_reports = pq.read_table(path), json.loads(reports.read_text())
    text = {"ended": "horizon", "channel": {}, "rows": {"plant_step": "1", "plant_actuation": 1}}
    for report in (None, [], text, text | {"rows": {"plant_step": 1}}):
        reports.write_text(json.dumps(old_reports | {"plant": report}))
        record = load_record(run_dir)
        assert record.reports.keys() == {"sensor", "netem", "controller"}
        assert summarise_loop(record, 0, "").to_json()["missing_samples"] == 0
    number = table.column_names.index("t_ns")
    for values, expected in COLUMNS:
        pq.write_table(table.set_column(number, "t_ns", values(len(table))), path)
        with pytest.raises(CallerError, match=expected):
            _ = load_record(run_dir)[PLANT_STEP]
    pq.write_table(table, path)
    (run_dir / RECORD / "notices.jsonl").write_bytes(b"\xae\xff")
    with pytest.raises(CallerError, match=r"notices\.jsonl: cannot be read"):
        load_record(run_dir)
    pq.write_table(table.append_column("t_ns", table["t_ns"]), path)
    with pytest.raises(CallerError, match=r"plant_step\.parquet: .*t_ns"):
        load_record(run_dir)


def test_a_flipped_bit_of_a_row_is_noticed(run_dir: Path) -> None:
    path = run_dir / RECORD / f"{PLANT_STEP}.parquet"
    content = path.read_bytes()
    footer_bytes = int.from_bytes(content[-8:-4], "little") + 8
    path.write_bytes(flipped(content, 8 * (len(content) - footer_bytes) - 1))
    with pytest.raises(CallerError, match="cannot be read"):
        _ = load_record(run_dir)[PLANT_STEP]


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
    inputs = [*rows["input"][:2].tolist(), *rows["input"][4:].tolist()]
    assert finished[PLANT_STEP]["input"].tolist() == inputs
    assert [notice["text"] for notice in finished.notices] == ["MANSD violated", "last"]
    assert summarise_loop(finished, 0, "").to_json()["missing_by_table"] == {PLANT_STEP: 2}
    assert steps == len(finished[PLANT_STEP]) + 2


def test_a_table_is_a_regular_file_in_parts_of_bounded_length(run_dir: Path) -> None:
    path = run_dir / RECORD / f"{PLANT_STEP}.parquet"
    table = pq.read_table(path)
    pq.write_table(pa.concat_tables([table] * (40_000 // len(table))), path, row_group_size=10**6)
    with pytest.raises(CallerError, match=r"rows in one part; at most 16,384 are read"):
        load_record(run_dir)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(CallerError, match="not a regular file"):
        load_record(run_dir)


def test_a_flipped_bit_in_a_footer_does_not_end_the_process(tmp_path: Path) -> None:
    path, dtype = tmp_path / f"{PLANT_STEP}.parquet", np.dtype([(LOOP, "<u2"), ("input", "<i8")])
    write_table(path, [np.zeros(3, dtype)], dtype, {})
    reader = multiprocessing.get_context("fork").Process(target=_read_with_flipped_bits, args=(path, dtype))
    reader.start()
    reader.join()
    assert reader.exitcode == 0


def _read_with_flipped_bits(path: Path, dtype: np.dtype[np.void]) -> None:
    content = path.read_bytes()
    footer_bytes = int.from_bytes(content[-8:-4], "little") + 8
    with path.open("r+b", buffering=0) as file:  # in place: a file that is cut and written again is flushed
        for position in range(len(content) - footer_bytes, len(content)):
            for byte in (*(content[position] ^ 1 << bit for bit in range(8)), content[position]):
                file.seek(position)
                file.write(bytes([byte]))
                with suppress(CallerError):
                    _ = [*TableFile(path, dtype).batches()]


# --- latest, and names ----------------------------------------------------------------------------


ANOTHER_UID = 65_534


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """A folder that everybody may write to, where users remove only their own files, as in /tmp."""
    folder = tmp_path / "runs"
    (folder / "first").mkdir(parents=True)
    (folder / "first" / SCENARIO_FILE).write_text("")
    folder.chmod(0o1777)
    return folder


@pytest.mark.parametrize("whose", ["link", "run"])
def test_a_run_of_another_user_is_not_opened(runs: Path, whose: str) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root may give a file to another user")
    point_to_latest(runs / "first")
    os.chown(runs / (LATEST if whose == "link" else "first"), ANOTHER_UID, -1, follow_symlinks=False)
    for opened in (
        lambda: latest_run(runs),
        lambda: chosen_run(runs / LATEST, Path("elsewhere")),
        lambda: open_run(runs / LATEST),
    ):
        with pytest.raises(CallerError, match=rf"^{runs / LATEST}: .* is another user's; name the"):
            opened()
    assert chosen_run(runs / "first", runs) == runs / "first"  # the link's name identifies the run


def test_a_folder_that_is_not_utf8_is_refused_and_a_loops_file_names_it(tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"r\xff")
    for refused in (lambda: new_run_dir(folder, "x"), lambda: chosen_run(folder, tmp_path)):
        with pytest.raises(CallerError, match="is not UTF-8; rename it"):
            refused()
    for name in (None, "a", "b-1"):
        assert loop_of_file(file_of_loop("report.html", name), "report.html") == name


# --- docs/record.md -------------------------------------------------------------------------------


DOCS = Path(__file__).parents[3] / "docs" / "record.md"
TEXT = " ".join(DOCS.read_text(encoding="utf-8").split())


def markdown(columns: tuple[Column, ...]) -> str:
    lines = [f"| `{column.name}` | {column.unit} | {column.meaning} |" for column in columns]
    return " ".join(" ".join(["| column | unit | meaning |", "|---|---|---|", *lines]).split())


def test_the_docs_describe_the_common_columns() -> None:
    assert markdown(COMMON) in TEXT


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.name)
def test_the_docs_describe_every_table(table: Table) -> None:
    described = f"`{table.name}` ({table.owner}): one row per {table.row}. "
    assert described + markdown(table.columns) in TEXT


# --- folders of another kind ----------------------------------------------------------------------


@pytest.fixture(params=["campaign", "run"])
def held(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Path, str]:
    """A folder with results, and what it is in words."""
    folder = tmp_path / "held"
    folder.mkdir()
    files_of = {"campaign": [CAMPAIGN_FILE], "run": [SCENARIO_FILE, ENVIRONMENT_FILE]}
    for name in (*files_of[request.param], "summary.json"):
        (folder / name).write_text("its own")
    holders = {"campaign": "the folder of a campaign", "run": "the directory of a run"}
    return folder, holders[request.param]


def test_no_run_is_made_in_the_folder_of_other_results(held: tuple[Path, str]) -> None:
    folder, holder = held
    with pytest.raises(CallerError, match=f"held: {holder}, not a folder of run directories"):
        new_run_dir(folder, "a")
    assert all(entry.read_text() == "its own" for entry in folder.iterdir())


@pytest.mark.parametrize("name", ["summary.json", "scenario.toml", "report.html", "campaign.html"])
def test_no_output_replaces_a_file_of_a_run_or_a_campaign(held: tuple[Path, str], name: str) -> None:
    folder, holder = held
    with pytest.raises(CallerError, match=f"{name}: is a file of {holder}; give another name"):
        write_output(folder / name, "a page")
    assert not (folder / name).exists() or (folder / name).read_text() == "its own"
    write_output(folder / "overlay.html", "a page")
    write_output(folder.parent / name, "a page")


@pytest.mark.parametrize("name", ["record", "logs", "runs"])
def test_no_output_is_written_among_the_results(held: tuple[Path, str], name: str) -> None:
    folder, holder = held
    if (name == "runs") != ("campaign" in holder):
        return
    (folder / name).mkdir()
    for path in (folder / name, folder / name / "plant.csv", folder / name / "inner" / "plant.csv"):
        with pytest.raises(CallerError, match=f"lies in {holder}, among its results; give another name"):
            require_output(path)


def test_tables_figures_and_exports_replace_no_results(
    held: tuple[Path, str],
) -> None:
    folder, holder = held
    table = ResultTable("summary", "", ("a",), [("1",)])
    tables = folder / ("runs" if "campaign" in holder else "record")
    with pytest.raises(CallerError, match="among its results"):
        save_tables([table], tables)
    with pytest.raises(CallerError, match="among its results"):
        save_mat({"a": 1.0}, tables / "a.mat")
    with pytest.raises(CallerError, match="give another name"):
        export_run(folder, folder, "csv")
    assert not tables.exists()


@pytest.mark.parametrize("number", ["NaN", "-Infinity", "1e999", str(10**30), "9" * 5000])
def test_a_number_that_json_does_not_have_makes_a_file_of_a_run_damaged(run_dir: Path, number: str) -> None:
    """A summary is computed again then; a report counts as missing."""
    summary, reports = run_dir / SUMMARY_FILE, run_dir / REPORTS_FILE
    assert read_summary(read_object(summary)) is not None
    content = json.loads(summary.read_text()) | {"horizon_s": "NUMBER"}
    summary.write_text(json.dumps(content).replace('"NUMBER"', number))
    assert read_summary(read_object(summary)) is None
    reports.write_text(f'{{"plant": {{"rows": {{"plant_step": {number}}}}}}}')
    assert not load_record(run_dir).reports
