"""The numeric record of a run, of one or more loops, read batch by batch.

``RUN/record/TABLE.parquet`` is the authoritative record; ``docs/record.md`` documents the columns.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.record.processes import (
    ROW_COLUMNS,
    Entries,
    ProcessRows,
    Report,
    entries_of_loop,
    read_rows,
    report_entries,
    valid_reports,
)
from cosim.record.rows import (
    BATCH_ROWS,
    NetworkRows,
    ReadRows,
    Slice,
    concatenate_rows,
    pack_rows,
    slices,
    with_columns,
)
from cosim.record.rows import Rows as Rows
from cosim.record.run_directory import (
    RECORD,
    SCENARIO_FILE,
    SUMMARY_FILE,
    Kind,
    kind_of,
    require_run_directory,
)
from cosim.record.table_files import TableFile
from netem.core.errors import CallerError, PeerError
from netem.core.packet_rows import NETEM_RELEASE
from noack.core.cached_method import cached_method
from noack.protocol.record_tables import (
    LOOP,
    NO_SEQUENCE,
    OWNER,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
    is_of_network,
    network_tables,
)
from noack.protocol.roles import LOOP_ROLES
from noack.runtime.control_messages import ClockError, LogLine, parse_message
from noack.runtime.host_clocks import STATED
from noack.scenario.resolution import LoopMatrices, ResolvedRun, loop_of, tables_of
from noack.scenario.scenario import Scenario, few_of
from noack.scenario.scenario_file import MOST_RECORDED_BYTES, load

NOTICES_FILE = "notices.jsonl"
Notice = dict[str, Any]
"""A line of the run's log: t_ns, level, text, process, and the number of a loop if it has one."""
_ROWS_PER_STEP, _MORE_ROWS = 4, 100_000
"""A table has at most this number of rows per step of the loops, and some more."""
_CLOCK_EXCHANGE_NS = 20_000_000
"""Shortest wall time between two rows of a clock's offset."""
_COLUMNS = 6_000
"""Columns of a whole run: short runs are not reduced, and figures have far fewer columns."""
NETWORK_ROLES = ("netem",)


def loop_roles(phases_ns: Sequence[int]) -> Sequence[str]:
    """Return the processes whose inputs are in the record of a loop, in a run of loops with these phases.

    The emulator uses the time of the run: its inputs are in the record of a loop that is the only one,
    and begins with the run.
    """
    return LOOP_ROLES if tuple(phases_ns) == (0,) else [r for r in LOOP_ROLES if r not in NETWORK_ROLES]


class _Notice(LogLine):
    process: str


class RunRecord:
    """The record of one loop of a run, or of the run's network.

    Args:
        scenario: the resolved scenario of the loop; that of the run for the network.
        rows: the rows of each table, in the order of the machine's inputs, or what reads them. A
            table that is read as a whole is kept.
        notices: the lines of the run's log, each with t_ns, level, text and process.
        reports: each process's final report; a process that died has none.
        kind: live or simulated.
        number: the number of the loop; 0 for the network.
        roles: the processes whose inputs are all in the record: those of a loop, with the emulator
            if it serves no other loop (:func:`loop_roles`); the emulator alone for the network.
    """

    def __init__(
        self,
        scenario: Scenario,
        rows: Mapping[str, Rows] | ReadRows,
        notices: list[Notice],
        reports: Mapping[str, Report],
        kind: Kind = "live",
        number: int = 0,
        roles: Sequence[str] = LOOP_ROLES,
    ) -> None:
        self.scenario, self.number, self.roles = scenario, number, roles
        self.notices = notices
        self.reports = reports
        self.kind: Kind = kind
        self._read, self._rows = (rows, dict[str, Rows]()) if callable(rows) else (_no_rows, dict(rows))
        self._counts: dict[str, int] = {}
        self.tables = network_tables() if self.is_network else tables_of(scenario)

    @cached_property
    def loop(self) -> LoopMatrices:
        """The matrices of the scenario."""
        return loop_of(self.scenario)

    def __getitem__(self, table: str) -> Rows:
        """All rows of a table of ``noack.protocol.record_tables``; for a long run, see `slices`."""
        if table not in self._rows:
            self._rows[table] = concatenate_rows([*self._read(table, ())], self.tables[table])
        return self._rows[table]

    def count(self, table: str) -> int:
        """Return the number of rows of a table."""
        if table in self._rows:
            return len(self._rows[table])
        if table not in self._counts:
            self._counts[table] = sum(map(len, self._read(table, ("input",))))
        return self._counts[table]

    def batches(self, table: str, columns: Sequence[str] = ()) -> Iterator[Rows]:
        """Yield the rows of a table in order, with all columns or at least some.

        A table of at most ``BATCH_ROWS`` rows is one part; a longer one is not kept in memory.
        """
        if table not in self._rows and self.count(table) > BATCH_ROWS:
            yield from self._read(table, columns)
            return
        rows = self[table]
        for first in range(0, len(rows), BATCH_ROWS):
            yield rows[first : first + BATCH_ROWS]

    def keep(self, table: str, parts: Sequence[Rows]) -> None:
        """Keep the rows of a table, which have been read with those of other loops."""
        self._rows[table] = concatenate_rows(parts, self.tables[table])

    @cached_property
    def is_short(self) -> bool:
        """Whether the whole record is one part, which is kept in memory."""
        return not any(self.count(table) > BATCH_ROWS for table in self.tables)

    def with_departures(self, packets: Rows) -> Rows:
        """Return rows of ``netem_packet`` whose ``release_ns`` is when they left.

        In a queue that chooses what it sends, this is not known at their arrival. A packet that has
        not left gets the time of the last departure, if that is later. Copies keep their times.
        """
        network = self.scenario.network
        if not any(network.link_of(flow).chooses for flow in network.flows):
            return packets
        departures = self.columns(
            NETEM_RELEASE,
            "sequence",
            "flow",
            "copy",
            "t_ns",
            where=lambda rows: rows["copy"] == 0,
        )
        count = max(departures["flow"].max(initial=0), packets["flow"].max(initial=0)) + 1
        numbers = departures["sequence"] * count + departures["flow"]
        order = np.argsort(numbers)
        arrivals, ascending = packets["sequence"] * count + packets["flow"], numbers[order]
        row = np.searchsorted(ascending, arrivals)
        has_left = np.append(ascending, -1)[row] == arrivals
        packets = packets.copy()
        release_ns: NDArray[np.int64] = packets["release_ns"]
        waits = ~has_left & (release_ns > packets["now_ns"])
        left_ns: NDArray[np.int64] = departures["t_ns"]
        release_ns[has_left] = left_ns[order][row[has_left]]
        release_ns[waits] = np.maximum(release_ns[waits], left_ns.max(initial=-1))
        return packets

    def slices(self, *tables: str, columns: Sequence[str] = ()) -> Iterator[Slice]:
        """Yield consecutive parts of some tables, or of all, each up to the same time.

        They have all columns, or at least some besides ``now_ns``.

        A short run is one part. A part of a longer one has half of ``BATCH_ROWS`` steps: what is
        computed from it is several times as large.
        """
        names, columns = tables or [*self.tables], (*columns, "now_ns") if columns else ()
        if any(self.count(table) > BATCH_ROWS for table in names):
            readers = {table: self.batches(table, columns) for table in names}
            empty = {table: np.zeros(0, with_columns(self.tables[table], columns)) for table in names}
            yield from slices(readers, empty, self._slice_ns)
        elif any(map(self.count, names)):
            yield {table: self[table] for table in names}

    def columns(
        self, table: str, *names: str, where: Callable[[Rows], NDArray[np.bool_]] | None = None
    ) -> Rows:
        """Return some columns of a table, of all rows or of those that ``where`` selects.

        For a long run, only tables of few rows and selections of few rows fit into memory.
        """
        batches = self.batches(table, names)
        selection = (rows if where is None else rows.compress(where(rows)) for rows in batches)
        dtype = with_columns(self.tables[table], names)
        return concatenate_rows([pack_rows(rows, dtype) for rows in selection], dtype)

    @cached_method
    def events(self) -> Rows:
        """Return number, nominal and actual time of each event: ``event``, ``t_ns``, ``now_ns``."""
        return self.columns(
            SENSOR_MEASUREMENT,
            "event",
            "t_ns",
            "now_ns",
            where=lambda rows: rows["event"] != NO_SEQUENCE,
        )

    def last_ns(self, table: str) -> int | None:
        """Return the nominal time of the last row of a table; None if it has none."""
        last_ns = None
        for rows in self.batches(table, ("t_ns",)):
            last_ns = int(rows["t_ns"][-1]) if len(rows) else last_ns
        return last_ns

    def derived(self, scenario: Scenario, derive: Callable[[str, Rows], Rows]) -> "RunRecord":
        """Return a record with another scenario, and with rows derived from those of this one.

        ``derive`` gets a table's name and some of its rows, in order.
        """

        def rows(table: str, _: Sequence[str]) -> Iterator[Rows]:
            return (derive(table, part) for part in self.batches(table))

        derived = RunRecord(
            scenario,
            rows,
            self.notices,
            self.reports,
            self.kind,
            self.number,
            self.roles,
        )
        derived.tables = self.tables  # they are those of the run that was recorded
        return derived

    @cached_method
    def rows_of(self, role: str) -> ProcessRows:
        """The recorded rows of a process, with the gaps in them."""
        tables = self.owned_by(role)
        parts = self.slices(*tables, columns=ROW_COLUMNS) if tables else ()
        return read_rows(parts, tables, self.reports.get(role))

    def row_counts(self, role: str) -> dict[str, int]:
        """The numbers of recorded rows of a process, by table."""
        return {table: self.count(table) for table in self.owned_by(role)}

    def is_complete(self, role: str) -> bool:
        """Whether the record has all rows that a process reported."""
        report = self.reports.get(role)
        return report is not None and report["rows"].items() >= self.row_counts(role).items()

    def owned_by(self, role: str) -> list[str]:
        """Return the tables with the inputs of a process's machine."""
        return [table for table in self.tables if OWNER[table] == role]

    @property
    def clocks(self) -> dict[str, ClockError]:
        """How far the clocks of the processes may have been off; empty if they had the same one.

        Of a process without a report it is the largest error that the scenario allows.
        """
        reported = {role: self.reports[role].get("clock") for role in LOOP_ROLES if role in self.reports}
        clocks = {role: ClockError(**clock) for role, clock in reported.items() if clock}
        if clocks and self.scenario.clocks is not None:
            largest_ns = round(self.scenario.clocks.largest_error_us * 1000)
            for role in LOOP_ROLES:
                unknown = ClockError(clock=f"of {role}", error_ns=largest_ns, source=STATED)
                clocks.setdefault(role, unknown)
        return clocks

    @property
    def is_network(self) -> bool:
        """Whether it is the record of the network, for all loops."""
        return self.roles == NETWORK_ROLES

    @property
    def slice_columns(self) -> int:
        """Columns to which a figure may reduce a slice, so that the whole run has many enough."""
        steps = self.count(PLANT_STEP)
        return _COLUMNS if steps <= BATCH_ROWS else max(_COLUMNS * BATCH_ROWS // 2 // steps, 1)

    @property
    def _slice_ns(self) -> int:
        timing = self.scenario.timing
        period_ns: int = min(timing.plant_period_ns, timing.controller_period_ns)
        return BATCH_ROWS // 2 * period_ns


def _no_rows(table: str, _: Sequence[str]) -> Iterator[Rows]:
    """Read a table of a record that is in memory, and does not have it."""
    raise KeyError(table)


_LOOPS_AT_ONCE, _ROWS_AT_ONCE = 64, 2**18
"""Largest number of loops whose rows are read together, and of rows of one of their tables."""


class RecordedRun:
    """The record of a run: of its network, and of each of its loops.

    Args:
        resolved: the run's numbers.
        network: the tables of the network, for all loops, in the time of the run.
        read: ``read(numbers)`` returns the records of some loops. Of several, the rows are read at
            once and kept in memory; those of one loop are read when they are used.
    """

    def __init__(
        self, resolved: ResolvedRun, network: RunRecord, read: Callable[[range], Sequence[RunRecord]]
    ) -> None:
        self.resolved, self.network, self.read = resolved, network, read
        self.scenario, self.kind = network.scenario, network.kind
        self._newest: RunRecord | None = None
        """The loop that was used last."""

    @property
    def loops(self) -> Iterator[RunRecord]:
        """Yield the record of each loop; as many are in memory as :attr:`loops_at_once` says."""
        for first in range(0, len(self.names), self.loops_at_once):
            yield from self.read(range(first, min(first + self.loops_at_once, len(self.names))))

    @cached_property
    def loops_at_once(self) -> int:
        """How many loops are read together."""
        timing = self.scenario.timing
        steps = max(timing.horizon_ns // timing.plant_period_ns, 1)
        return min(_LOOPS_AT_ONCE, max(_ROWS_AT_ONCE // steps, 1))

    def record(self, number: int) -> RunRecord:
        """Return the record of the loop of a number; it stays in memory until another is used."""
        if self._newest is None or self._newest.number != number:
            (self._newest,) = self.read(range(number, number + 1))
        return self._newest

    @property
    def phases_ns(self) -> Sequence[int]:
        """When each loop begins, in the time of the run."""
        return self.resolved.phases_ns

    @property
    def has_own_network(self) -> bool:
        """Whether the network is replayed for itself, and not with the only loop; see `loop_roles`."""
        return loop_roles(self.phases_ns) != LOOP_ROLES

    @property
    def names(self) -> Sequence[str]:
        """The names of the loops."""
        return self.resolved.names

    def number_of(self, name: str | None) -> int:
        """Return the number of the loop of a name; of the only loop without a name.

        Raises:
            CallerError: there is no such loop, or no name and several loops.
        """
        if name is None and len(self.names) == 1:
            return 0
        if name in self.names:
            return self.names.index(name)
        raise no_such_loop(name, self.names)

    def loop(self, name: str | None = None) -> RunRecord:
        """Return the record of a loop; see :meth:`number_of`."""
        return self.record(self.number_of(name))


def no_such_loop(name: str | None, names: Sequence[str]) -> CallerError:
    """Return the error for a name that none of a run's loops has, or for no name of several."""
    few = few_of(names)
    if name is None:
        return CallerError(
            f"the run has {len(names)} loops, and this is for one: use --loop NAME, RUN:NAME in noack "
            f"compare, run.loops[NAME] in Python; they are {few}"
        )
    return CallerError(f"{name}: the run has no such loop; it has {few}")


def resolved_run(run_dir: Path) -> ResolvedRun:
    """Return the numbers of a run, by the scenario of its directory; those of the last one stay.

    Raises:
        CallerError: it cannot be read.
    """
    path = run_dir / SCENARIO_FILE
    return _resolved_run(path, path.stat().st_mtime_ns if path.exists() else 0)


@lru_cache(maxsize=1)
def _resolved_run(path: Path, _changed_ns: int) -> ResolvedRun:
    return ResolvedRun(load(path, most_bytes=MOST_RECORDED_BYTES))


def load_run(run_dir: Path) -> RecordedRun:
    """Read the record of a run directory.

    Raises:
        CallerError: the path is no run directory, or the record is unfinished, damaged, or of an
            earlier version of noack.
    """
    folder = run_dir / RECORD
    require_run_directory(run_dir)
    if not folder.is_dir():
        ended = (run_dir / SUMMARY_FILE).is_file()
        hint = "" if ended else "; `noack summary` finalises an interrupted run"
        raise CallerError(f"{run_dir}: has no numeric record{hint}")
    run = resolved_run(run_dir)
    most_rows, types = _ROWS_PER_STEP * steps_of(run) + _MORE_ROWS, run.tables
    files = {table: TableFile(folder / f"{table}.parquet", types[table], most_rows) for table in types}
    reports = valid_reports(report_entries(run_dir), network_tables())
    notices = read_notices(folder)
    of_all = [notice for notice in notices if LOOP not in notice]

    def read(table: str, columns: Sequence[str]) -> Iterator[Rows]:
        return files[table].batches(with_columns(types[table], columns))

    network = RunRecord(run.scenario, read, of_all, reports, kind_of(run_dir), roles=NETWORK_ROLES)
    return RecordedRun(run, network, _loops_reader(run, network, files, report_entries(run_dir), notices))


def _loops_reader(
    run: ResolvedRun,
    network: RunRecord,
    files: Mapping[str, TableFile],
    entries: Entries,
    notices: Sequence[Notice],
) -> Callable[[range], list[RunRecord]]:
    """Return what reads the records of some loops; see :class:`RecordedRun`."""
    loops, phases = run.loops, run.phases_ns

    @cache
    def network_rows() -> NetworkRows:
        return NetworkRows(network.batches, phases)

    def record_of(number: int) -> RunRecord:
        types = tables_of(loops[number])

        def read(table: str, columns: Sequence[str]) -> Iterator[Rows]:
            if is_of_network(table):
                return network_rows().of_loop(table, number)
            dtype = with_columns(types[table], columns)
            return (rows for _, rows in files[table].of_loops(range(number, number + 1), dtype))

        own = entries_of_loop(entries, number, network_rows().count_of_others)
        return RunRecord(
            loops[number],
            read,
            [
                {key: value for key, value in notice.items() if key != LOOP}
                for notice in notices
                if notice.get(LOOP, number) == number
            ],
            valid_reports(own, types),
            network.kind,
            number,
            loop_roles(phases),
        )

    def read_loops(numbers: range) -> list[RunRecord]:
        records = [record_of(number) for number in numbers]
        if len(records) > 1:
            _keep_rows(records, files, network_rows())
        return records

    return read_loops


def _keep_rows(records: Sequence[RunRecord], files: Mapping[str, TableFile], network: NetworkRows) -> None:
    """Read the rows of consecutive loops at once, and keep them."""
    numbers = range(records[0].number, records[-1].number + 1)
    for table, file in files.items():
        having = {record.number: record for record in records if table in record.tables}
        parts: dict[int, list[Rows]] = {number: [] for number in having}
        if is_of_network(table):
            for of_loops in network.of_loops(table, numbers):
                for number, rows in zip(numbers, of_loops, strict=True):
                    parts[number].append(rows)
        else:
            for dtype in {record.tables[table] for record in having.values()}:
                for number, rows in file.of_loops(numbers, dtype):
                    if number in having and having[number].tables[table] == dtype:
                        parts[number].append(rows)
        for number, record in having.items():
            record.keep(table, parts[number])


def load_record(run_dir: Path, loop: str | None = None) -> RunRecord:
    """Read the record of the only loop of a run directory, or of the loop of a name.

    Raises:
        CallerError: as :func:`load_run`, or there is no such loop.
    """
    return load_run(run_dir).loop(loop)


def steps_of(run: ResolvedRun) -> int:
    """Return the steps of all loops of a run together.

    A step is the shortest period of a loop's processes; a table of a record has at most a few rows
    for each.
    """
    exchange_ns = max(round(run.scenario.speed * _CLOCK_EXCHANGE_NS), 1)
    steps = 0
    for entry in run.entries:
        timing = entry.scenario.timing
        shortest_ns = min(timing.plant_period_ns, timing.controller_period_ns, exchange_ns)
        steps += entry.loops * (timing.horizon_ns // shortest_ns + 1)
    return steps


def read_notices(folder: Path) -> list[Notice]:
    """Read the run's log from the folder of its record."""
    path = folder / NOTICES_FILE
    try:
        lines = path.read_bytes().splitlines() if path.is_file() else []
        return [parse_message(_Notice, line).fields() for line in lines]
    except (OSError, PeerError) as error:
        raise CallerError(f"{path}: cannot be read: {error}") from None
