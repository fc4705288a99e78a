"""The rows of a simulated run satisfy all invariants, and every damage to them is detected."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import benchmarks.soak
from benchmarks.soak.invariants import Invariants
from cosim.record.run_record import Rows, RunRecord
from cosim.simulation.virtual_time import simulate
from noack.config.resolution import resolve
from noack.config.scenario_file import load

FOLDER = Path(benchmarks.soak.__file__).parent
Tables = dict[str, Rows]


def simulated(kind: str, horizon_s: float) -> RunRecord:
    return simulate(resolve(load(FOLDER / f"{kind}.toml", [f"horizon_s={horizon_s}"])))


@pytest.fixture(scope="module")
def hour() -> RunRecord:
    return simulated("hour", 6.0)


@pytest.fixture(scope="module")
def day() -> RunRecord:
    return simulated("day", 120.0)


def followed(record: RunRecord, tables: Tables, batches: int = 40) -> Invariants:
    """Pass the tables in batches as a recorder does, and check the invariants after each."""
    invariants = Invariants(record.scenario)
    for i in range(batches):
        for table, rows in tables.items():
            low, high = (len(rows) * (i + more) // batches for more in (0, 1))
            if high > low:
                invariants.take(table, low, rows[low:high].tobytes())
        invariants.advance()
    invariants.advance(final=True)
    return invariants


def tables_of(record: RunRecord) -> Tables:
    return {table: record[table].copy() for table in record.tables}


@pytest.mark.parametrize("kind", ["hour", "day"])
@pytest.mark.parametrize("batches", [1, 7, 40])
def test_a_good_run_violates_no_invariant(
    kind: str, batches: int, request: pytest.FixtureRequest
) -> None:
    record = request.getfixturevalue(kind)
    found = followed(record, tables_of(record), batches)
    account = found.account()
    assert found.broken == []
    assert account["rows"] == {table: len(record[table]) for table in record.tables}
    assert account["events"] == (record["sensor_measurement"]["event"] >= 0).sum()
    assert 1 <= int(str(account["longest_loss_burst"])) <= record.scenario.network.mansd
    assert 0 < float(str(account["identity_residual_relative"])) < 1e-12


def test_the_stored_rows_do_not_grow_with_the_run() -> None:
    held = [
        int(str(followed(record, tables_of(record), batches).account()["most_held"]))
        for record, batches in ((simulated("day", 60.0), 20), (simulated("day", 240.0), 80))
    ]
    assert held[1] < 1.5 * held[0]


def without(table: str, place: float) -> Callable[[Tables], None]:
    def damage(tables: Tables) -> None:
        tables[table] = np.delete(tables[table], int(place * len(tables[table])))

    return damage


def changed(table: str, column: str, by: float, place: float = 0.6) -> Callable[[Tables], None]:
    def damage(tables: Tables) -> None:
        tables[table][column][int(place * len(tables[table]))] += by

    return damage


def unsent(tables: Tables) -> None:
    rows = tables["sensor_measurement"]
    rows["event"][np.flatnonzero(rows["event"] >= 0)[5]] = -1


def lost_in_a_row(tables: Tables) -> None:
    rows = tables["netem_packet"]
    rows["fate"][5:10] = 1
    rows["consecutive_losses"][5:10] = 1 + np.arange(5)


def not_finite(tables: Tables) -> None:
    tables["controller_step"]["x_c"][200] = np.nan


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        (without("plant_step", 0.5), "input of plant"),
        (without("plant_actuation", 0.5), "actuation"),
        (without("sensor_measurement", 0.5), "measurement"),
        (without("netem_packet", 0.5), "update to netem"),
        (without("controller_delivery", 0.5), "update to controller"),
        (without("controller_step", 0.5), "controller_step: ticks"),
        (changed("plant_step", "x", 1e-9), "plant_step: x is not as computed"),
        (changed("plant_step", "t_ns", 1), "plant_step: not one row for each point"),
        (changed("plant_step", "now_ns", -(10**9)), "plant_step: now_ns runs backward"),
        (changed("sensor_measurement", "x_s", 1e-9), "sensor_measurement: x_s is not as computed"),
        (changed("sensor_measurement", "threshold", 1e-9), "sensor_measurement: threshold"),
        (changed("sensor_measurement", "compared", 1.0), "the trigger is not obeyed"),
        (unsent, "the trigger is not obeyed"),
        (changed("controller_step", "x_c", 1e-6), "(I1) does not hold"),
        (changed("controller_step", "u", 1e-9), "controller_step: u is not as computed"),
        (changed("controller_delivery", "x_c", 1.0), "(I1) does not hold"),
        (changed("controller_delivery", "dropouts", 1), "dropouts are miscounted"),
        (changed("netem_packet", "input", 1), "input of netem"),
        (lost_in_a_row, "5 dropouts in a row"),
        (not_finite, "controller_step: u is not as computed"),
    ],
)
def test_every_damage_is_reported(
    hour: RunRecord, damage: Callable[[Tables], None], told: str
) -> None:
    tables = tables_of(hour)
    damage(tables)
    found = followed(hour, tables)
    assert any(what.startswith(told) or told in what for what in found.broken), found.broken


def test_an_update_that_never_left_the_network_is_reported(day: RunRecord) -> None:
    tables = tables_of(day)
    without("netem_release", 0.5)(tables)
    assert any("update to controller" in what for what in followed(day, tables).broken)


def test_a_skipped_batch_is_reported(hour: RunRecord) -> None:
    invariants = Invariants(hour.scenario)
    rows = hour["plant_step"]
    invariants.take("plant_step", 0, rows[:10].tobytes())
    invariants.take("plant_step", 20, rows[20:30].tobytes())
    invariants.advance(final=True)
    assert "plant_step: row 10 is missing" in invariants.broken


def test_repeated_and_reordered_batches_are_put_in_order(hour: RunRecord) -> None:
    invariants = Invariants(hour.scenario)
    rows = hour["plant_step"]
    for first, end in ((0, 10), (20, 30), (10, 20), (10, 20), (25, 40)):
        invariants.take("plant_step", first, rows[first:end].tobytes())
    assert invariants.rows["plant_step"] == 40
    invariants.advance()
    assert invariants.broken == []
