"""Loops of different plants, sizes and rates in one run, against each of them alone."""

from collections.abc import Sequence

import numpy as np
import pytest

from cosim.analysis.replay import replay
from cosim.record.run_record import RecordedRun, RunRecord
from cosim.shipped_files import find_shipped
from cosim.simulation.virtual_time import simulate, simulate_loops
from noack.protocol.record_tables import OWNER
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario, loop_names, loops_of, phases_ns
from noack.scenario.scenario_file import load

NETWORKS: dict[str, Sequence[str]] = {
    "no losses": ('network.loss={ model = "lossless" }',),
    "numbered losses": ('network.loss={ model = "periodic", period = 3, burst = 2 }',),
    "most losses and a delay": (
        'network.loss={ model = "worst_case" }',
        'network.impairments=[{ kind = "delay", delay_s = 0.011 }]',
    ),
    "lost actuations": (
        'network.loss={ model = "lossless" }',
        'network.actuation={ mansd = 2, loss = { model = "periodic", period = 4, burst = 1 } }',
    ),
}  # fmt: skip
"""Networks that decide for each flow alone, without a draw."""


def shipped(*settings: str) -> Scenario:
    """The shipped scenario; its double integrator is in a file whose network is the first one."""
    return load(find_shipped("different_loops", "scenarios"), ["horizon_s=4.0", *settings])


def with_network(settings: Sequence[str]) -> Scenario:
    """The same loops on another network."""
    path = find_shipped("different_loops", "scenarios")
    given = shipped()
    other = load(path.with_name("lane_following.toml"), settings).network
    return given.model_copy(update={"network": other})


@pytest.fixture(scope="module")
def mixed() -> RecordedRun:
    return simulate_loops(shipped())


def test_the_first_loop_is_the_loop_alone_with_its_losses(mixed: RecordedRun) -> None:
    """The first flow of the network has the draws of the only flow of a run of one loop."""
    own = loops_of(mixed.scenario)[0]
    same(simulate(resolve(own)), mixed.loops[0])


@pytest.mark.parametrize("network", NETWORKS)
def test_each_loop_has_the_bits_of_the_loop_alone(network: str) -> None:
    scenario = with_network(NETWORKS[network])
    run = simulate_loops(scenario)
    for own, record in zip(loops_of(scenario), run.loops, strict=True):
        same(simulate(resolve(own)), record)


def same(alone: RunRecord, record: RunRecord) -> None:
    """Compare all rows of plant, sensor and controller, and when what was sent was received."""
    for table in alone.tables:
        if OWNER[table] != "netem":
            assert alone[table].tobytes() == record[table].tobytes(), table
    for table in ("netem_packet", "netem_release"):
        if len(alone[table]):
            names = [name for name in alone[table].dtype.names or () if name != "head"]
            for name in names:
                assert np.array_equal(alone[table][name], record[table][name]), (table, name)


def test_a_change_applies_to_loops_of_all_sizes_at_its_time() -> None:
    at_s = 2.0
    change = f'changes=[{{ at_s = {at_s}, set = {{ mansd = 1, "trigger.beta" = 0.001 }} }}]'
    path = find_shipped("different_loops", "scenarios")
    entries = 'loops=[{ name = "lane" }, { name = "slow", plant = { rate_hz = 50.0 } }]'
    run = simulate_loops(load(path, ["horizon_s=4.0", entries, change]))
    phases = dict(zip(loop_names(run.scenario), phases_ns(run.scenario), strict=True))
    for record in run.loops:
        (row,) = record["sensor_setting"]
        assert row["since_ns"] == max(2_000_000_000 - phases[record.scenario.name], 0)
        assert replay(record).bit_exact
