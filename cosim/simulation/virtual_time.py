"""Simulates a run of N ≥ 1 loops in virtual time: native/driver/virtual.c drives the machines.

The machines, their messages and the protocol are those of a live run; only the driver differs. A
datagram arrives at the time of sending, unless the network delays it. So a simulated run equals a
live run in which no deadline is missed. It depends on its scenario alone, bit for bit. The queues
of the network couple the loops.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller_node.controller import controllers_of
from cosim.record.loop_rows import NetworkRows
from cosim.record.record_source import RecordSource, RowsInMemory
from cosim.record.run_record import RecordedRun, Rows, RunRecord
from netem.channel import RUN_ID, Network, channel_of
from noack.config.loops import phases_ns
from noack.config.parameter_changes import change_notice, scheduled
from noack.config.resolution import is_of_network, network_tables, resolved_loops, tables_of
from noack.config.scenario import Scenario
from noack.core.core_library import core, ffi
from noack.machines.loop_machines import LoopMachines
from noack.machines.machine_parts import NEVER_NS
from noack.protocol.datagram_seal import KEY_BYTES
from noack.protocol.machine_interface import Notice, Record
from noack.protocol.record_tables import LOOP, OWNER
from noack.protocol.topology import CHANGEABLE, LOOP_ROLES, RECORDER
from noack.protocol.wire_format import Flow, Rejection
from noack.runtime.life_cycle import HORIZON
from plant_server.plant import plants_of
from sensor_node.sensor import sensors_of

Progress = Callable[[int], None]
"""Called from time to time with the simulated time, in ns."""

_ROLES: Mapping[str, Callable[..., LoopMachines]] = {
    "plant": plants_of,
    "sensor": sensors_of,
    "controller": controllers_of,
}
"""In the order of ``noack_role``."""
_REASONS = tuple(reason.value for reason in Rejection)
_INPUTS_PER_PROGRESS = 2048
_SENT_PLACES = 64


class RecordCollector:
    """Rows and notices of a run, in the order in which the machines of a role write them."""

    def __init__(self) -> None:
        self._batches: dict[str, list[Rows]] = {}
        self._settings: dict[str, list[tuple[Any, ...]]] = {}
        self._notices: list[tuple[Notice, str]] = []

    def take(self, role: str, output: Record | Notice) -> None:
        """Take a row or a notice of a role."""
        if isinstance(output, Record):
            self._settings.setdefault(output.table, []).append(output.row)
        else:
            self._notices.append((output, role))

    def extend(self, table: str, rows: Rows) -> None:
        """Take rows of a table."""
        self._batches.setdefault(table, []).append(rows)

    def rows(self, table: str, dtype: np.dtype[np.void]) -> Rows:
        """Return all rows of a table whose rows have this type."""
        return _joined(
            [np.array(self._settings.get(table, []), dtype), *self._batches.get(table, [])]
        )

    def counts(self, table: str, loops: int) -> NDArray[np.int64]:
        """Return the number of rows of each loop in a table of the machines, shape (loops,)."""
        numbers = [rows[LOOP] for rows in self._batches.get(table, [])]
        numbers.append(np.array([row[0] for row in self._settings.get(table, [])], np.uint16))
        return np.bincount(np.concatenate(numbers), minlength=loops)

    def take_by_loop(self, table: str, dtype: np.dtype[np.void]) -> dict[int, Rows]:
        """Return the rows of each loop in a table of the machines, and keep them no longer.

        The loops' rows may have different types; rows of settings have ``dtype``.
        """
        batches = self._batches.pop(table, [])
        if settings := self._settings.pop(table, []):
            batches = [np.array(settings, np.dtype([(LOOP, "<u2"), *dtype.descr])), *batches]
        by_type: dict[np.dtype[np.void], list[Rows]] = {}
        for rows in batches:
            by_type.setdefault(rows.dtype, []).append(rows)
        return dict(own for same in by_type.values() for own in _split(_joined(same)))

    def notices(self, loop: int | None = None) -> list[dict[str, Any]]:
        """Return the notices of a loop or, of None, those about the whole run, by their times."""
        lines = [
            notice._replace(loop=None).line() | {"process": role}
            for notice, role in self._notices
            if notice.loop in (None, loop)
        ]
        return sorted(lines, key=lambda line: int(line["t_ns"]))


class VirtualRun:
    """A run in virtual time.

    Args:
        scenario: the scenario of the run.
        loops: the resolved scenario of each loop.
        network: decides the fate of each update; by default the scenario's own network.
    """

    def __init__(
        self,
        scenario: Scenario,
        loops: Sequence[Scenario],
        *,
        network: Network | None = None,
    ) -> None:
        self._scenario = scenario
        self.types = [tables_of(loop) for loop in loops]
        """The types of each loop's rows, by table."""
        self.groups: Sequence[Sequence[int]] = [*_groups(self.types)]
        """The numbers of the loops whose rows have the same columns."""
        self.phases_ns = phases = phases_ns(scenario)
        """When each loop begins."""
        self.machines = [
            {
                role: make([loops[k] for k in numbers], [phases[k] for k in numbers], numbered=True)
                for role, make in _ROLES.items()
            }
            for numbers in self.groups
        ]
        """The machines of each group of loops whose rows have the same columns, by role."""
        self.channel = channel_of(scenario, loops=len(loops), network=network)
        self.record = RecordCollector()
        self.core: Any = self._new_core(len(loops))
        wrong = core.noack_simulation_check(self.core)
        if wrong != ffi.NULL:
            raise ValueError(f"simulation: {ffi.string(wrong).decode()}")

    def run(self, until_ns: int = NEVER_NS, progress: Progress | None = None) -> None:
        """Run until nothing is due up to a time."""
        simulation = self.core
        while True:
            reason = core.noack_simulate(simulation, until_ns)
            if reason == core.NOACK_DONE:
                break
            if reason == core.NOACK_STEPS_DONE:
                simulation.steps_left = _INPUTS_PER_PROGRESS
                if progress is not None:
                    progress(int(simulation.now_ns))
            elif reason == core.NOACK_ASK_SENT_PLACES:
                self._add_sent_places()
            elif simulation.asking == core.NOACK_NETWORK:
                self.channel.answer(reason)
            elif reason == core.NOACK_ROWS_FULL:
                role = [*_ROLES][simulation.asking]
                self._take(simulation.asking_group, role)
            else:
                role = [*_ROLES][simulation.asking]
                self.machines[simulation.asking_group][role].answer(reason)
        self._take_all()

    def announce(self) -> None:
        """Announce the changes that the scenario schedules to every machine whose settings change.

        Raises:
            CallerError: a change is invalid.
        """
        changes = scheduled(self._scenario)
        for role in CHANGEABLE:
            for change in changes:
                if role == "netem":
                    for output in self.channel.announce(change, 0):
                        self.record.take(role, output)
                    continue
                for group, machines in enumerate(self.machines):
                    for output in machines[role].announce(change, 0):
                        self.record.take(role, self._of_run(group, output))
        for change in changes:
            self.record.take(RECORDER, change_notice(change))

    def reception(self, role: str, loop: int, *, acknowledges: bool = False) -> dict[str, Any]:
        """Return the numbers of datagrams that a loop's machine has accepted and rejected."""
        place = self.core.of_loop[loop]
        machine = self.machines[place.group][role].machines[place.place].machine
        counts = machine.acknowledgements if acknowledges else machine.received
        rejected = zip(_REASONS, counts.rejected, strict=True)
        return {
            "accepted": counts.accepted,
            "rejected": {reason: count for reason, count in rejected if count},
        }

    def _new_core(self, loops: int) -> Any:
        """Return the ``noack_simulation``."""
        key, flows = ffi.from_buffer("uint8_t[]", bytes(KEY_BYTES)), self._scenario.network.flows
        numbers = [ffi.new("int64_t[]", one) for one in self.groups]
        groups = ffi.new("noack_loop_group[]", len(self.groups))
        of_loop = ffi.new("noack_loop_place[]", loops)
        for number, (group, machines) in enumerate(zip(groups, self.machines, strict=True)):
            group.processes = [one.core for one in machines.values()]
            group.numbers = numbers[number]
            for place, loop in enumerate(self.groups[number]):
                of_loop[loop] = (number, place)
        simulation = ffi.new("noack_simulation *", {
            "groups": len(groups), "loops": loops, "of_group": groups, "of_loop": of_loop,
            "channel": self.channel.core, "wire": {"run_id": RUN_ID},
            "directions": [flows.index(flow) if flow in flows else -1 for flow in (0, *Flow)],
            "steps_left": _INPUTS_PER_PROGRESS,
        })  # fmt: skip
        core.noack_wire_key(ffi.addressof(simulation, "wire"), key)
        self._kept = numbers, groups, of_loop
        self._sent = ffi.new("noack_sent_datagram[]", _SENT_PLACES)
        simulation.sent, simulation.sent_places = self._sent, _SENT_PLACES
        return simulation

    def _add_sent_places(self) -> None:
        """Double the room for datagrams that have been sent."""
        simulation, size = self.core, ffi.sizeof("noack_sent_datagram")
        places, first = simulation.sent_places, simulation.sent_first
        larger = ffi.new("noack_sent_datagram[]", 2 * places)
        ffi.memmove(larger, self._sent + first, (places - first) * size)
        ffi.memmove(larger + (places - first), self._sent, first * size)
        self._sent = simulation.sent = larger
        simulation.sent_places, simulation.sent_first = 2 * places, 0

    def _take(self, group: int, role: str, *, last: bool = False) -> None:
        """Take the rows and notices of machines."""
        machines, numbers = self.machines[group][role], np.array(self.groups[group])
        for table, rows in machines.take_rows(last=last):
            if len(self.groups) > 1:
                rows[LOOP] = numbers[rows[LOOP]]
            self.record.extend(table, rows)
        for notice in machines.take_notices():
            self.record.take(role, self._of_run(group, notice))

    def _take_all(self) -> None:
        for group, machines in enumerate(self.machines):
            for role in machines:
                self._take(group, role, last=True)
        for table, rows in self.channel.take_rows():
            self.record.extend(table, rows)

    def _of_run(self, group: int, output: Record | Notice) -> Record | Notice:
        """Return an output of a group with the number that its loop has in the run."""
        numbers = self.groups[group]
        if isinstance(output, Notice):
            return output if output.loop is None else output._replace(loop=numbers[output.loop])
        if len(self.groups) == 1:
            return output
        place, *row = output.row
        return Record(output.table, (numbers[place], *row))


def simulate(
    resolved: Scenario, network: Network | None = None, progress: Progress | None = None
) -> RunRecord:
    """Run a resolved scenario of one loop in virtual time; see :func:`simulate_loops`.

    Args:
        resolved: the scenario.
        network: decides the fate of each update; by default the scenario's own network, as in a
            live run.
        progress: called with the simulated time.
    """
    if network is not None:
        resolved.coverage.require_unchanging()
    return _simulated(resolved, (resolved,), network, progress).loops[0]


def simulate_loops(scenario: Scenario, progress: Progress | None = None) -> RecordedRun:
    """Run the loops of a scenario in virtual time, with the sampling of a live run.

    Args:
        scenario: the scenario; speed, ports and real-time settings have no effect.
        progress: called with the simulated time.

    Returns:
        The record of the run; its reports have no entries about sockets or real-time settings.
    """
    return _simulated(scenario, resolved_loops(scenario), None, progress)


def _simulated(
    scenario: Scenario,
    loops: Sequence[Scenario],
    network: Network | None,
    progress: Progress | None,
) -> RecordedRun:
    run = VirtualRun(scenario, loops, network=network)
    run.announce()
    with np.errstate(all="ignore"):  # a diverging loop overflows and is recorded all the same
        run.run(progress=progress)
    of_network = {table: run.record.rows(table, dtype) for table, dtype in network_tables().items()}
    packets = NetworkRows(of_network, run.phases_ns)
    by_table: dict[str, dict[int, Rows]] = {}
    counts = packets.counts() | {
        table: run.record.counts(table, len(loops))
        for table in {table for types in run.types for table in types}
        if not is_of_network(table)
    }
    records = []
    for number, loop in enumerate(loops):
        rows = _LoopRows(run.record, by_table, packets, number, run.types[number])
        own_counts = {table: int(counts[table][number]) for table in run.types[number]}
        reports = _reports(run, own_counts, scenario, number)
        notices = run.record.notices(number)
        shared = number if len(loops) > 1 else None
        records.append(RunRecord(loop, rows, notices, reports, "simulated", number=shared))
    of_all = {table: len(rows) for table, rows in of_network.items()}
    reports = {"netem": _report("netem", of_all, {"rejected": {}})}
    common = RunRecord(
        scenario, of_network, run.record.notices(), reports, "simulated", is_network=True
    )
    return RecordedRun(common, records)


class _LoopRows(RecordSource):
    """The rows of a loop. A table of the run is split by loops when one of them is first read.

    Args:
        record: the rows of the run's machines.
        by_table: the tables that have been split, of all loops.
        packets: the rows of the network.
        number: the number of the loop.
        types: the types of its rows.
    """

    def __init__(
        self,
        record: RecordCollector,
        by_table: dict[str, dict[int, Rows]],
        packets: NetworkRows,
        number: int,
        types: Mapping[str, np.dtype[np.void]],
    ) -> None:
        super().__init__(types)
        self._record, self._by_table, self._packets, self._number = (
            record,
            by_table,
            packets,
            number,
        )

    @cached_property
    def _of_network(self) -> Mapping[str, Rows]:
        return self._packets.of_loop(self._number)

    def whole(self, table: str) -> Rows:
        """Return all rows of a table."""
        if is_of_network(table):
            return self._of_network[table]
        if table not in self._by_table:
            self._by_table[table] = self._record.take_by_loop(table, self.types[table])
        # Nothing in virtual time compares clocks: these tables are empty.
        return self._by_table[table].get(self._number, np.zeros(0, self.types[table]))

    def count(self, table: str) -> int:
        """Return the number of rows of a table."""
        return len(self.whole(table))

    def batches(self, table: str, columns: Sequence[str] = ()) -> Iterator[Rows]:
        """Yield the rows of a table in order."""
        yield from RowsInMemory({table: self.whole(table)}).batches(table, columns)


def _groups(types: Sequence[Mapping[str, np.dtype[np.void]]]) -> Iterator[list[int]]:
    """Yield the numbers of the loops whose rows have the same columns."""
    groups: list[tuple[Mapping[str, np.dtype[np.void]], list[int]]] = []
    for number, own in enumerate(types):
        same = next((numbers for known, numbers in groups if known == own), None)
        if same is None:
            groups.append((own, [number]))
        else:
            same.append(number)
    yield from (numbers for _, numbers in groups)


def _joined(batches: Sequence[Rows]) -> Rows:
    """Return rows of one type in one array; numpy's own function takes as long for each column."""
    if len(batches) == 1:
        return batches[0]
    return np.concatenate([rows.view(np.uint8) for rows in batches]).view(batches[0].dtype)


def _split(rows: Rows) -> Iterator[tuple[int, Rows]]:
    """Yield the number and the rows of each loop that has some, without the loop's number."""
    (_, *names), loops = rows.dtype.names or (), rows[LOOP]
    own = np.dtype([(name, rows.dtype[name]) for name in names])
    ends = np.cumsum(np.bincount(loops)).tolist()
    order = np.argsort(loops, kind="stable") if len(ends) > 1 else slice(None)
    data = rows.view(np.uint8).reshape(len(rows), rows.dtype.itemsize)[order, 2:]
    ordered = np.ascontiguousarray(data).view(own).reshape(-1)
    for number, (first, last) in enumerate(pairwise([0, *ends])):
        if last > first:
            yield number, ordered[first:last]


def _reports(
    run: VirtualRun, counts: Mapping[str, int], scenario: Scenario, loop: int
) -> dict[str, dict[str, Any]]:
    """Return the final report of each role, as of a loop with these numbers of rows."""
    reports = {
        role: _report(
            role, counts, run.reception(role, loop) if role in _ROLES else {"rejected": {}}
        )
        for role in LOOP_ROLES
    }
    if scenario.protocol.acknowledges:
        received = run.reception("sensor", loop, acknowledges=True)
        reports["sensor"]["channel"]["acknowledgements"] = received
    return reports


def _report(role: str, counts: Mapping[str, int], channel: dict[str, Any]) -> dict[str, Any]:
    owned = {table: count for table, count in counts.items() if OWNER[table] == role}
    return {"ended": HORIZON, "channel": channel, "rows": owned}
