"""The loops of a run on one network in virtual time: the fleets of a live run, without clocks.

The queues of the network couple the loops. A run with one loop computes what the run without
[[loops]] does, bit for bit.
"""

from typing import Any

from controller_node.controller import controller_of
from cosim.record.loop_rows import NetworkRows
from cosim.record.run_record import RecordedRun, RunRecord
from cosim.simulation.virtual_time import Gathered, Progress, Shuttle, drive, reports_of
from netem.duplex_link import network_of
from noack.config.loops import loops_of, phases_ns
from noack.config.resolution import is_of_network, network_tables, resolve, tables_of
from noack.config.scenario import Scenario
from noack.protocol.fleet import Fleet
from noack.protocol.machine_interface import Machine, Notice, Record
from plant_server.plant import plant_of
from sensor_node.sensor import sensor_of

_BATCH_ROWS = 256
"""Rows of a table of a loop until they become an array."""


class _GatheredByLoop:
    """Rows and notices of the network, and of each loop."""

    def __init__(self, loops: list[Scenario]) -> None:
        self.network = Gathered(network_tables())
        self.loops = [
            Gathered(
                {table: one for table, one in tables_of(loop).items() if not is_of_network(table)},
                _BATCH_ROWS,
            )
            for loop in loops
        ]

    def take(self, role: str, output: Record | Notice) -> None:
        """Take a row or a notice; a notice of the network or the recorder concerns all loops."""
        if isinstance(output, Notice):
            chosen = (
                [self.network, *self.loops] if output.loop is None else [self.loops[output.loop]]
            )
            for gathered in chosen:
                gathered.take(role, output)
        elif is_of_network(output.table):
            self.network.take(role, output)
        else:
            number, *row = output.row
            self.loops[number].take(role, Record(output.table, tuple(row)))


def simulate_loops(scenario: Scenario, progress: Progress | None = None) -> RecordedRun:
    """Run the loops of a scenario in virtual time; see :func:`simulate`.

    Args:
        scenario: the scenario, not resolved; speed, ports and real-time settings have no effect.
        progress: called with the simulated time.
    """
    loops = [resolve(loop) for loop in loops_of(scenario)]
    phases = phases_ns(scenario)
    gathered = _GatheredByLoop(loops)
    machines: dict[str, Machine[Any]] = {
        "plant": Fleet([plant_of(loop) for loop in loops], phases),
        "sensor": Fleet([sensor_of(loop) for loop in loops], phases),
        "netem": network_of(scenario, loops=len(loops)),
        "controller": Fleet([controller_of(loop) for loop in loops], phases),
    }
    entries = [loop.message_sizes.entries for loop in loops]
    shuttle = Shuttle(machines, entries, gathered.take, network=scenario.network.flows)
    drive(shuttle, scenario, gathered.take, progress)
    network_rows = gathered.network.rows()
    records = []
    of_network = NetworkRows(network_rows, phases)
    for number in range(len(loops)):
        rows = gathered.loops[number].rows() | of_network.of_loop(number)
        reports = reports_of(rows, shuttle, scenario, number)
        notices = gathered.loops[number].sorted_notices()
        rows = {table: rows[table] for table in tables_of(loops[number])}
        shared = number if len(loops) > 1 else None
        records.append(RunRecord(loops[number], rows, notices, reports, "simulated", number=shared))
    reports = reports_of(network_rows, shuttle, scenario)
    network = RunRecord(
        scenario, network_rows, gathered.network.sorted_notices(),
        {"netem": reports["netem"]}, "simulated", is_network=True,
    )  # fmt: skip
    return RecordedRun(network, records)
