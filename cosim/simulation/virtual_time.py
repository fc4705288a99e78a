"""Simulates a run of N ≥ 1 loops in virtual time: native/driver/virtual.c drives the machines.

The machines, their messages and the protocol are those of a live run; only the driver differs. A
datagram arrives at the time of sending, unless the network delays it. So a simulated run equals a
live run in which no deadline is missed. It depends on its scenario alone, bit for bit. The queues
of the network couple the loops. :func:`simulate_run` writes the run directory of such a run.
"""

import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from controller_node.controller import controllers_of
from cosim.record.record_writing import write_run
from cosim.record.rows import NetworkRows, ReadRows, concatenate_rows, pack_rows
from cosim.record.run_directory import (
    EndingFile,
    RunEnding,
    active_run,
    new_run_dir,
    point_to_latest,
    write_environment,
)
from cosim.record.run_record import NETWORK_ROLES, RecordedRun, Rows, RunRecord, loop_roles
from cosim.record.run_scenario import write_scenario
from netem.core.clock import NEVER_NS, NS_PER_S
from netem.core.core_library import CData
from netem.core.errors import ExitStatus, MachineError, why
from netem.core.file_access import remove_folder
from netem.core.settings_section import ReadTable
from netem.core.system_processes import require_limits
from noack.core.core_library import core, ffi, new_handle
from noack.core.progress import Progress, no_progress
from noack.machines.loop_machines import LoopMachines, row_types
from noack.machines.run_channel import RUN_ID, UserNetwork, channel_of
from noack.protocol.record_tables import LOOP, OWNER, is_of_network, network_tables
from noack.protocol.roles import CHANGEABLE, LOOP_ROLES, RECORDER, Notice, Record
from noack.protocol.wire_format import KEY_BYTES, Flow, Rejection
from noack.runtime.end_reasons import HORIZON
from noack.scenario.parameter_changes import change_notice, scheduled, settings_key
from noack.scenario.resolution import ResolvedRun, resolve_run, shape_of, tables_of
from noack.scenario.scenario import Scenario
from plant_server.plant import plants_of
from sensor_node.sensor import sensors_of

_ROLES: Mapping[str, Callable[..., LoopMachines]] = {
    "plant": plants_of,
    "sensor": sensors_of,
    "controller": controllers_of,
}
"""In the order of ``noack_role``."""
_REASONS = tuple(reason.value for reason in Rejection)
_INPUTS_PER_PROGRESS = 2048
"""Inputs between two reports of progress."""
_PIECE_BYTES = 2**24
"""Bytes of rows that are allocated at once."""


class RowMemory:
    """Memory for rows, in pieces for which the kernel has large pages.

    It takes the kernel longer to provide a small page than the core to fill it with rows.
    """

    def __init__(self) -> None:
        self._free = np.empty(0, np.uint8)

    def rows(self, count: int, dtype: np.dtype[np.void]) -> Rows:
        """Return memory for rows of a type."""
        size = count * dtype.itemsize
        if size > len(self._free):
            self._free = np.empty(max(size, _PIECE_BYTES), np.uint8)
        rows, self._free = np.split(self._free, [size])
        return rows.view(dtype)


class RecordCollector:
    """Rows and notices of a run, in the order in which the machines of a role write them.

    Args:
        types: the row type of each table.
        loops: the number of loops.
    """

    def __init__(self, types: Mapping[str, np.dtype[np.void]], loops: int) -> None:
        self._types, self._loops = types, loops
        self._batches: dict[str, list[Rows]] = {}
        self._setting_rows: dict[str, list[tuple[object, ...]]] = {}
        """Rows of the settings tables; the machines write all others in batches."""
        self._by_loop: dict[str, list[Rows]] = {}
        self._notices: list[tuple[Notice, str]] = []

    def take(self, role: str, output: Record | Notice) -> None:
        """Take a row of a settings table, or a notice of a role."""
        if isinstance(output, Record):
            self._setting_rows.setdefault(output.table, []).append(output.row)
        else:
            self._notices.append((output, role))

    def extend(self, table: str, rows: Rows) -> None:
        """Take rows of a table."""
        self._batches.setdefault(table, []).append(rows)

    def counts(self, table: str) -> NDArray[np.int64]:
        """Return the number of rows of each loop in a table of the machines, shape (loops,)."""
        numbers = [rows[LOOP] for rows in self._batches.get(table, [])]
        numbers.append(np.array([row[0] for row in self._setting_rows.get(table, [])], np.uint16))
        return np.bincount(np.concatenate(numbers), minlength=self._loops)

    def take_whole(self, table: str) -> Rows:
        """Return all rows of a table, and keep them no longer."""
        dtype = self._types[table]
        batches = self._batches.pop(table, [])
        if setting_rows := self._setting_rows.pop(table, []):
            batches = [np.array(setting_rows, dtype), *batches]
        return concatenate_rows(batches or [np.zeros(0, dtype)], dtype)

    def of_loop(self, table: str, number: int) -> Rows:
        """Return the rows of a loop in a table of the machines, without the loop's number."""
        if table not in self._by_loop:
            self._by_loop[table] = _split(self.take_whole(table), self._loops)
        return self._by_loop[table][number]

    def notices(self, loop: int | None = None) -> list[dict[str, object]]:
        """Return the notices about the whole run and, of a number, also those of this loop, by time."""
        return [
            notice._replace(loop=None).line() | {"process": role}
            for notice, role in sorted(self._notices, key=lambda entry: entry[0].t_ns)
            if notice.loop in (None, loop)
        ]


class VirtualRun:
    """A run in virtual time.

    Args:
        run: the run.
        network: decides the fate of each update; by default the scenario's own network.
    """

    def __init__(self, run: ResolvedRun, *, network: UserNetwork | None = None) -> None:
        self._scenario, loops = run.scenario, run.loops
        self.phases_ns = run.phases_ns
        """When each loop begins."""
        self.machines = {role: make(loops, self.phases_ns) for role, make in _ROLES.items()}
        """The machines of all loops, by role."""
        memory = RowMemory()
        for machines in self.machines.values():
            machines.connect()
            machines.take_rows_from(memory.rows)
        self.channel = channel_of(run.scenario, loops=len(loops), network=network)
        kinds = {settings_key(loop): loop for loop in loops}
        self.types = {kind: tables_of(loop) for kind, loop in kinds.items()}
        """The row types of the tables of each kind of loops (:func:`settings_key`)."""
        run_types = {**row_types(map(shape_of, kinds.values())), **network_tables()}
        self.record = RecordCollector(run_types, len(loops))
        self.core: CData = self._new_core()

    def run(self, until_ns: int = NEVER_NS, progress: Progress = no_progress) -> None:
        """Run until nothing is due up to a time."""
        simulation = self.core
        while True:
            reason = core.noack_simulate(simulation, until_ns)
            if reason == core.NOACK_DONE:
                break
            if reason == core.NOACK_STEPS_DONE:
                simulation.steps_left = _INPUTS_PER_PROGRESS
                progress(simulation.now_ns / NS_PER_S, self._scenario.horizon_s)
            elif reason == core.NOACK_NO_MEMORY:
                raise MemoryError
            elif simulation.asking == core.NOACK_NETWORK:
                self.channel.answer(reason)
            elif reason == core.NOACK_ROWS_FULL:
                self._take([*_ROLES][simulation.asking])
            else:
                self.machines[[*_ROLES][simulation.asking]].raise_failure()
        self._take_all()

    def announce(self) -> None:
        """Announce the changes that the scenario schedules to every machine whose settings change.

        Raises:
            CallerError: a change is invalid.
        """
        changes = scheduled(self._scenario)
        for role in CHANGEABLE:
            changeable = self.channel if role == "netem" else self.machines[role]
            for change in changes:
                for output in changeable.announce(change, 0):
                    self.record.take(role, output)
        for change in changes:
            self.record.take(RECORDER, change_notice(change))

    def reception(self, role: str, loop: int, *, acknowledges: bool = False) -> dict[str, object]:
        """Return the numbers of datagrams that a loop's machine has accepted and rejected."""
        machine = self.machines[role].machines[loop].machine
        counts = machine.acknowledgements if acknowledges else machine.received
        rejected = zip(_REASONS, ffi.unpack(counts.rejected, len(_REASONS)), strict=True)
        return {
            "accepted": counts.accepted,
            "rejected": {reason: count for reason, count in rejected if count},
        }

    def _new_core(self) -> CData:
        """Return the ``noack_simulation``."""
        key, flows = ffi.from_buffer("uint8_t[]", bytes(KEY_BYTES)), self._scenario.network.flows
        wire = ffi.new("noack_wire *", {"run_id": RUN_ID})
        core.noack_wire_key(wire, key)
        # Numbers of flows begin at 1; place 0 is unused.
        directions = [flows.index(flow) if flow in flows else -1 for flow in (0, *Flow)]
        processes = [machines.core for machines in self.machines.values()]
        simulation = new_handle("simulation", processes, self.channel.core, wire, directions)
        simulation.steps_left = _INPUTS_PER_PROGRESS
        return simulation

    def _take(self, role: str, *, last: bool = False) -> None:
        """Take the rows and notices of the machines of a role."""
        for table, rows in self.machines[role].take_rows(last=last):
            self.record.extend(table, rows)
        for notice in self.machines[role].take_notices():
            self.record.take(role, notice)

    def _take_all(self) -> None:
        for role in self.machines:
            self._take(role, last=True)
        for table, rows in self.channel.take_rows():
            self.record.extend(table, rows)


def simulate(
    resolved: Scenario, network: UserNetwork | None = None, progress: Progress = no_progress
) -> RunRecord:
    """Run a resolved scenario of one loop in virtual time; see :func:`simulate_loops`.

    Args:
        resolved: the scenario.
        network: decides the fate of each update; by default the scenario's own network, as in a
            live run.
        progress: called with the simulated time and the horizon, in seconds.
    """
    if network is not None:
        resolved.coverage.require_unchanging()
    return _simulate(ResolvedRun(resolved, (resolved,)), network, progress).record(0)


def simulate_loops(run: ResolvedRun, progress: Progress = no_progress) -> RecordedRun:
    """Run the loops of a run in virtual time, with the sampling of a live run.

    Args:
        run: the run; speed, ports and real-time settings have no effect.
        progress: called with the simulated time and the horizon, in seconds.

    Returns:
        The record of the run; its reports have no entries about sockets or real-time settings.
    """
    return _simulate(run, None, progress)


def simulate_run(scenario: Scenario, runs: Path, progress: Progress = no_progress) -> RunEnding:
    """Simulate a scenario into a new run directory; :func:`cosim.live.finalize.finalize` ends it.

    An interrupted simulation leaves no run directory.

    Args:
        scenario: as loaded; it is resolved here.
        runs: where run directories are made.
        progress: called with the simulated time and the horizon, in seconds.

    Raises:
        CallerError: the scenario's numbers are too large.
        MachineError: the run directory cannot be written, or a limit of the system is too low.
    """
    require_limits()
    resolved = resolve_run(scenario)
    run_dir = new_run_dir(runs, scenario.name)
    run_id = secrets.randbits(64)  # identifies the recording in the viewer
    try:
        with active_run(run_dir), EndingFile(run_dir) as ending:
            write_environment(run_dir, "simulated")
            run = simulate_loops(write_scenario(resolved, run_dir), progress)
            write_run(run, run_dir)
            ending.store(ExitStatus.OK, HORIZON)
    except BaseException as error:
        remove_folder(run_dir)
        if isinstance(error, OSError):
            raise MachineError(f"{run_dir}: cannot be written: {why(error)}") from None
        raise
    point_to_latest(run_dir)
    return RunEnding(run_dir, run_id, ExitStatus.OK, HORIZON)


def _simulate(resolved: ResolvedRun, network: UserNetwork | None, progress: Progress) -> RecordedRun:
    scenario, run = resolved.scenario, VirtualRun(resolved, network=network)
    run.announce()
    with np.errstate(all="ignore"):  # a diverging loop overflows and is recorded all the same
        run.run(progress=progress)
    of_network = {table: run.record.take_whole(table) for table in network_tables()}
    of_all = {table: len(rows) for table, rows in of_network.items()}
    reports = {"netem": _report(of_all, "netem", {"rejected": {}})}
    common = RunRecord(scenario, of_network, run.record.notices(), reports, "simulated", roles=NETWORK_ROLES)
    packets = NetworkRows(common.batches, run.phases_ns)
    tables = {table for types in run.types.values() for table in types}
    counts = packets.counts() | {
        table: run.record.counts(table) for table in tables if not is_of_network(table)
    }
    numbers = {table: of_loops.tolist() for table, of_loops in counts.items()}
    records = []
    for number, loop in enumerate(resolved.loops):
        types = run.types[settings_key(loop)]
        own_counts = {table: numbers[table][number] for table in types}
        rows = _reader_of_loop(run.record, packets, number, types)
        reports = _reports(run, own_counts, scenario, number)
        notices = run.record.notices(number)
        roles = loop_roles(run.phases_ns)
        records.append(RunRecord(loop, rows, notices, reports, "simulated", number, roles))
    return RecordedRun(resolved, common, lambda chosen: records[chosen.start : chosen.stop])


def _reader_of_loop(
    record: RecordCollector,
    packets: NetworkRows,
    number: int,
    types: Mapping[str, np.dtype[np.void]],
) -> ReadRows:
    """Return what reads the rows of a loop: they are separated from those of other loops at first use."""

    def read(table: str, _: Sequence[str]) -> Iterator[Rows]:
        if is_of_network(table):
            yield from packets.of_loop(table, number)
        else:
            yield pack_rows(record.of_loop(table, number), types[table])

    return read


def _split(rows: Rows, loops: int) -> list[Rows]:
    """Return the rows of each loop, without the column of its number."""
    numbers = rows[LOOP]
    is_sorted = bool((numbers[1:] >= numbers[:-1]).all())
    order = slice(None) if is_sorted else np.argsort(numbers, kind="stable")
    # The loop's number is the first column.
    number_bytes = rows.dtype[LOOP].itemsize
    data = rows.view(np.uint8).reshape(len(rows), rows.dtype.itemsize)[order, number_bytes:]
    of_loops = np.ascontiguousarray(data).view(np.dtype(rows.dtype.descr[1:])).reshape(-1)
    return np.split(of_loops, np.cumsum(np.bincount(numbers, minlength=loops))[:-1])


def _reports(
    run: VirtualRun, counts: Mapping[str, int], scenario: Scenario, loop: int
) -> dict[str, dict[str, object]]:
    """Return the final report of each role, as of a loop with these numbers of rows."""
    channels = {role: run.reception(role, loop) for role in _ROLES}
    if scenario.protocol.acknowledges:
        reception = run.reception("sensor", loop, acknowledges=True)
        channels["sensor"]["acknowledgements"] = reception
    return {role: _report(counts, role, channels.get(role, {"rejected": {}})) for role in LOOP_ROLES}


def _report(counts: Mapping[str, int], role: str, channel: ReadTable) -> dict[str, object]:
    rows = {table: count for table, count in counts.items() if OWNER[table] == role}
    return {"ended": HORIZON, "channel": channel, "rows": rows}
