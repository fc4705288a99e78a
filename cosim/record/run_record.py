"""The numeric record of a run: written as Parquet, read back batch by batch.

``RUN/record/TABLE.parquet`` is the authoritative record; ``docs/record.md`` documents the columns.
"""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.record.environment import Kind, kind_of
from cosim.record.process_lives import Life, LifeNumbers, generations, lives_of
from cosim.record.process_reports import read_reports
from cosim.record.record_source import (
    BATCH_ROWS,
    DerivedRows,
    RecordSource,
    RowsInMemory,
    Slice,
    slices,
    with_columns,
)
from cosim.record.record_source import Rows as Rows
from cosim.record.run_directory import LOOP_FILE, LOOPS, RECORD, SCENARIO_FILE, read_object
from noack.config.loops import loop_scenario
from noack.config.resolution import LoopMatrices, loop_of, network_tables, tables_of
from noack.config.scenario import Scenario
from noack.config.scenario_file import MOST_RECORDED_BYTES, load
from noack.core.errors import CallerError, PeerError
from noack.core.file_access import PARTIAL, new_file
from noack.protocol.machine_interface import RESTART
from noack.protocol.record_tables import (
    CLOCK_TABLES,
    NO_SEQUENCE,
    OWNER,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)
from noack.protocol.topology import LOOP_ROLES
from noack.protocol.wire_format import MAX_LOOPS
from noack.runtime.control_messages import LogLine, parse_message

_NOTICES_FILE = "notices.jsonl"
_ROWS_PER_STEP, _MORE_ROWS = 4, 100_000
"""A table has at most this number of rows per step of the loops, and more for restarts."""
_CLOCK_EXCHANGE_NS = 20_000_000
"""Shortest wall time between two rows of a clock's offset."""
_COLUMNS = 6_000
"""Columns of a whole run: short runs are not reduced, and figures have far fewer columns."""


class _Notice(LogLine):
    process: str


class RunRecord:
    """The record of one run, or of the network that several loops share.

    Args:
        scenario: the resolved scenario; that of the network has [[loops]].
        rows: the rows of each table, in the order of the machine's inputs, or where to read them.
        notices: the lines of the run's log, each with t_ns, level, text and process.
        reports: each process's final report; a process that died has none.
        kind: live or simulated.
        earlier: the final reports of processes that were restarted later.
        number: the number of the loop in a run of several loops; None in a run of one.
    """

    def __init__(
        self,
        scenario: Scenario,
        rows: Mapping[str, Rows] | RecordSource,
        notices: list[dict[str, Any]],
        reports: Mapping[str, dict[str, Any]],
        kind: Kind = "live",
        earlier: Sequence[dict[str, Any]] = (),
        number: int | None = None,
    ) -> None:
        self.scenario = scenario
        self.number = number
        self.notices = notices
        self.reports = reports
        self.earlier = earlier
        self.kind: Kind = kind
        self.source = rows if isinstance(rows, RecordSource) else RowsInMemory(rows)
        self.tables = network_tables() if self.is_network else tables_of(scenario)
        self._lives: dict[str, list[Life]] = {}

    @property
    def is_network(self) -> bool:
        """Whether it is the record of the network that several loops share."""
        return self.scenario.loops is not None

    @cached_property
    def loop(self) -> LoopMatrices:
        """The matrices of the scenario."""
        return loop_of(self.scenario)

    def __getitem__(self, table: str) -> Rows:
        """All rows of a table of ``noack.protocol.record_tables``; for a long run, see `slices`."""
        return self.source.whole(table)

    def count(self, table: str) -> int:
        """Return the number of rows of a table."""
        return self.source.count(table)

    def slices(self, *tables: str) -> Iterator[Slice]:
        """Yield consecutive parts of some tables, or of all, each up to the same time.

        A part holds at most ``BATCH_ROWS`` steps of the plant; a short run is one part.
        """
        return slices(self.source, tables or [*self.tables], self._slice_ns)

    def columns(
        self, table: str, *names: str, where: Callable[[Rows], NDArray[np.bool_]] | None = None
    ) -> Rows:
        """Return some columns of a table, of all rows or of those that ``where`` selects.

        For a long run, only tables of few rows and selections of few rows fit into memory.
        """
        batches = self.source.batches(table, names)
        chosen = (rows if where is None else rows[where(rows)] for rows in batches)
        empty = np.zeros(0, with_columns(self.tables[table], names))
        found = [*(empty.dtype.names or ())]
        return np.concatenate([empty, *(rows[found] for rows in chosen)])

    def events(self) -> Rows:
        """Return number, nominal and actual time of each event: ``event``, ``t_ns``, ``now_ns``."""
        return self.columns(
            SENSOR_MEASUREMENT, "event", "t_ns", "now_ns",
            where=lambda rows: rows["event"] != NO_SEQUENCE,
        )  # fmt: skip

    def last_ns(self, table: str) -> int | None:
        """Return the nominal time of the last row of a table; None if it has none."""
        found = None
        for rows in self.source.batches(table, ("t_ns",)):
            found = int(rows["t_ns"][-1]) if len(rows) else found
        return found

    def derived(self, scenario: Scenario, derive: Callable[[str, Rows], Rows]) -> "RunRecord":
        """Return a record with another scenario, and with rows derived from those of this one.

        ``derive`` gets a table's name and some of its rows, in order.
        """
        rows = DerivedRows(self.source, derive)
        derived = RunRecord(
            scenario, rows, self.notices, self.reports, self.kind, self.earlier, self.number
        )
        derived.tables = self.tables  # they are those of the run that was recorded
        return derived

    def lives(self, role: str) -> list[Life]:
        """The generations of a process, in order."""
        if role not in self._lives:
            newest = self.reports.get(role)
            reports = {} if newest is None else {newest.get("generation", 0): newest}
            earlier = [one for one in self.earlier if one["process"] == role]
            reports |= {one.get("generation", 0): one for one in earlier}
            self._lives[role] = lives_of(
                self.source, self.owned_by(role), self.life_numbers(role), reports, self._slice_ns
            )
        return self._lives[role]

    def life_numbers(self, role: str) -> LifeNumbers:
        """The numbers of the generations of a process."""
        again = any((one["process"], one["level"]) == (role, RESTART) for one in self.notices)
        return LifeNumbers(generations(self.source, self.owned_by(role)) if again else [0])

    def owned_by(self, role: str) -> list[str]:
        """Return the tables with the inputs of a process's machine."""
        found = [table for table in self.tables if OWNER[table] == role]
        return [table for table in found if table not in CLOCK_TABLES]

    def restarted(self) -> str | None:
        """A role whose process was restarted; None if there is none."""
        return next((role for role in LOOP_ROLES if len(self.life_numbers(role).begun) > 1), None)

    @property
    def slice_columns(self) -> int:
        """Columns to which a figure may reduce a slice, so that the whole run has many enough."""
        return max(_COLUMNS * BATCH_ROWS // max(self.count(PLANT_STEP), BATCH_ROWS), 1)

    @property
    def _slice_ns(self) -> int:
        timing = self.scenario.timing
        period_ns: int = min(timing.plant_period_ns, timing.controller_period_ns)
        return BATCH_ROWS * period_ns


def load_record(run_dir: Path, *, network: bool = False) -> RunRecord:
    """Read the record of a run directory.

    Args:
        run_dir: the run directory.
        network: return the record of the network, if several loops share it.

    Raises:
        CallerError: the path is no run directory, or the record is unfinished or damaged; or it is
            that of a run of several loops.
    """
    # Imported here because pyarrow takes 0.1 s: a run does not wait for it.
    from cosim.record.table_files import StoredTables

    folder = run_dir / RECORD
    if not (run_dir / SCENARIO_FILE).is_file():
        raise CallerError(f"{run_dir}: not a run directory (no {SCENARIO_FILE})")
    if not folder.is_dir():
        raise CallerError(
            f"{run_dir}: has no numeric record; `noack summary` finalises an interrupted run"
        )
    scenario = load(run_dir / SCENARIO_FILE, most_bytes=MOST_RECORDED_BYTES)
    if scenario.loops is not None and not network:
        one = run_dir / LOOPS / scenario.loops[0].names[0]
        raise CallerError(f"{run_dir}: a run of several loops; name one of them, e.g. {one}")
    tables = tables_of(scenario) if scenario.loops is None else network_tables()
    rows = StoredTables(folder, tables, _ROWS_PER_STEP * steps_of(scenario) + _MORE_ROWS)
    reports, earlier = read_reports(run_dir, rows)
    number = read_object(run_dir / LOOP_FILE).get("number")
    number = number if isinstance(number, int) and 0 <= number < MAX_LOOPS else None
    notices = read_notices(folder)
    return RunRecord(scenario, rows, notices, reports, kind_of(run_dir), earlier, number)


def steps_of(scenario: Scenario) -> int:
    """Return the steps of all loops of a scenario together.

    A step is the shortest period of a loop's processes; a table of a record has at most a few rows
    for each.
    """
    loops = [(1, scenario)]
    if scenario.loops is not None:
        loops = [(one.count, loop_scenario(scenario, one)) for one in scenario.loops]
    exchange_ns = round(scenario.speed * _CLOCK_EXCHANGE_NS)
    return sum(
        count * (timing.horizon_ns // min(
            timing.plant_period_ns, timing.controller_period_ns, max(exchange_ns, 1)
        ) + 1)
        for count, timing in ((count, loop.timing) for count, loop in loops)
    )  # fmt: skip


def write_record(record: RunRecord, run_dir: Path) -> None:
    """Write a record's tables and notices into its run directory.

    Raises:
        OSError: they cannot be written.
    """
    tables = {table: record.source.batches(table) for table in record.tables}
    loop = None if record.is_network else record.loop
    write_tables(run_dir / RECORD, tables, record.tables, loop, record.notices)


def write_tables(
    folder: Path,
    tables: Mapping[str, Iterable[Rows]],
    types: Mapping[str, np.dtype[np.void]],
    loop: LoopMatrices | None,
    notices: Iterable[Mapping[str, Any]],
) -> None:
    """Write tables, with the names of the loop's states and inputs, and the run's log."""
    from cosim.record.table_files import write_table

    folder.mkdir(exist_ok=True)
    for scratch in folder.glob(f".*{PARTIAL}"):  # of a process that was killed
        scratch.unlink(missing_ok=True)
    for table, batches in tables.items():
        write_table(folder / f"{table}.parquet", batches, types[table], loop)
    with new_file(folder / _NOTICES_FILE, make_folder=False) as file:
        file.writelines(f"{json.dumps(notice)}\n".encode() for notice in notices)


def read_notices(folder: Path) -> list[dict[str, Any]]:
    """Read the run's log from the folder of its record."""
    path = folder / _NOTICES_FILE
    try:
        lines = path.read_bytes().splitlines() if path.is_file() else []
        return [parse_message(_Notice, line) for line in lines]
    except (OSError, PeerError) as error:
        raise CallerError(f"{path}: cannot be read: {error}") from None
