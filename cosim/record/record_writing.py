"""Writes the record of a run: tables as Parquet, the run's log, and the processes' reports."""

import json
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from cosim.record import table_files
from cosim.record.processes import joint_reports
from cosim.record.rows import Rows, with_loop
from cosim.record.run_directory import RECORD, REPORTS_FILE
from cosim.record.run_record import NOTICES_FILE, Notice, RecordedRun
from netem.core.file_access import PARTIAL, create_folder, new_file, remove_file, write_whole
from netem.core.system_processes import cores
from noack.protocol.record_tables import LOOP, is_of_network
from noack.scenario.resolution import ResolvedRun


def write_run(run: RecordedRun, run_dir: Path) -> None:
    """Write the tables, the notices and the reports of a run into its directory.

    Raises:
        OSError, NoackError: they cannot be written.
    """
    types = run.resolved.tables

    def rows(table: str) -> Iterator[Rows]:
        if is_of_network(table):
            yield from run.network.batches(table)
            return
        for number, record in enumerate(run.loops):
            if table in record.tables:
                for batch in record.batches(table):
                    yield with_loop(batch, number, types[table])

    common = list(run.network.notices)
    of_loops = [
        notice | {LOOP: number}
        for number, record in enumerate(run.loops)
        for notice in record.notices
        if notice not in common
    ]
    notices = sorted([*common, *of_loops], key=lambda notice: int(notice["t_ns"]))
    reports = joint_reports(run.network.reports, [record.reports for record in run.loops])
    write_whole(run_dir / REPORTS_FILE, json.dumps(reports, indent=2), make_folder=False)
    folder, names = run_dir / RECORD, vector_names(run.resolved)
    with record_folder(folder, notices), ThreadPoolExecutor(cores()) as threads:
        tasks = [
            threads.submit(table_files.write_table, folder / f"{table}.parquet", rows(table), dtype, names)
            for table, dtype in types.items()
        ]
        for task in tasks:
            task.result()


def vector_names(run: ResolvedRun) -> dict[str, Sequence[str]]:
    """Return the names and known units of states, and names of inputs, if all loops have the same."""
    models = [entry.scenario.model for entry in run.entries]
    names = {(model.state_names or (), model.state_units or (), model.input_names or ()) for model in models}
    if len(names) > 1:
        return {}
    ((states, units, inputs),) = names
    all_names: dict[str, Sequence[str]] = {"state_names": states, "input_names": inputs}
    return all_names | ({"state_units": units} if units else {})


@contextmanager
def record_folder(folder: Path, notices: Iterable[Notice]) -> Iterator[None]:
    """Have a folder for the tables that are written within the context, and for the run's log."""
    create_folder(folder)
    for scratch in folder.glob(f".*{PARTIAL}"):  # of a process that was killed
        remove_file(scratch)
    yield
    with new_file(folder / NOTICES_FILE, make_folder=False) as file:
        file.writelines(f"{json.dumps(notice)}\n".encode() for notice in notices)
