"""Replay finds no difference in a good record, and every flipped bit in a damaged one.

The record is a simulated one; live records are replayed in tests/integration.
"""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.analysis.replay import replay
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from netem.core.packet_rows import NETEM_PACKET
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    OWNER,
    PLANT_ACTUATION,
    PLANT_STEP,
    SENSOR_ACKNOWLEDGEMENT,
    SENSOR_MEASUREMENT,
    SETTINGS,
)
from noack.protocol.roles import LOOP_ROLES
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from tests.cosim.record.changed_records import changed, flipped

ROOT = Path(__file__).parents[4]
SHORT = (
    "horizon_s=1.0", "plant.rate_hz=50", "controller.rate_hz=50",
    "trigger.beta=0.01", "network.loss.probability=0.4",
    'network.impairments=[{kind="delay", delay_s=0.01, jitter_s=0.01},'
    ' {kind="duplicate", probability=0.3}]',
)  # fmt: skip
OBSERVED, ACKNOWLEDGED, ACTUATIONS = "pendulum_observed", "lane_acknowledged", "lane_actuation_loss"
SETTINGS_OF = {
    "lane_following": SHORT,
    OBSERVED: ("horizon_s=0.4",),
    ACKNOWLEDGED: ("horizon_s=0.2", "trigger.beta=0.01"),
    ACTUATIONS: ("horizon_s=0.3", "trigger.beta=0.01"),
}
WORDS = (0, 1, -1, 7, 10**6, 2**40, 2**60, 2**61, 2**62 - 1, 2**62, 2**63 - 1, -(2**63))
FROM_OUTSIDE = ("input", "now_ns")
"""Columns with separate tests: they record the process's clock and input order."""


@cache
def recorded(name: str = "lane_following") -> RunRecord:
    return simulate(resolve(load(ROOT / "scenarios" / f"{name}.toml", [*SETTINGS_OF[name]])))


@pytest.fixture
def record() -> RunRecord:
    return recorded()


def filled_tables(record: RunRecord) -> list[str]:
    """Its tables, but those of parameter changes."""
    return [table for table in record.tables if len(record[table]) or table not in SETTINGS]


@pytest.mark.sanitized
def test_a_run_is_replayed_bit_for_bit(record: RunRecord) -> None:
    result = replay(record)
    assert result.bit_exact
    assert result.gaps == []
    assert result.first_difference is None
    assert result.inputs == sum(len(record[table]) for table in record.tables)
    assert {hop.hop: hop.compared for hop in result.messages} == {
        "plant → sensor": len(record[SENSOR_MEASUREMENT]),
        "sensor → netem": len(record[NETEM_PACKET]),
        "netem → controller": len(record[CONTROLLER_DELIVERY]),
        "controller → plant": len(record[PLANT_ACTUATION]),
    }
    assert min(hop.compared for hop in result.messages) > 0


def test_a_flipped_bit_is_reported_and_named(record: RunRecord) -> None:
    rng = np.random.default_rng(1)
    for table in filled_tables(record):
        for column in record[table].dtype.names or ():
            if column not in FROM_OUTSIDE and (table, column) != (NETEM_PACKET, "t_ns"):
                for _ in range(4):
                    require_difference(record, table, column, rng)


def require_difference(record: RunRecord, table: str, column: str, rng: np.random.Generator) -> None:
    """Flip a bit of any row; the replay has to name its place."""
    rows = record[table]
    row, byte = int(rng.integers(len(rows))), int(rng.integers(rows.dtype[column].itemsize))
    result = replay(flipped(record, table, row, column, 8 * byte + int(rng.integers(8))))
    first = result.first_difference
    assert result.bit_exact is False, (table, row, column)
    assert first is not None
    assert first.table == table
    name = f"{column}_{byte // 8 + 1}" if rows.dtype[column].shape else column
    if column == "sequence":
        # With another message's number, the rest of the row differs; with the next one's, the next
        # row may be the repeated one.
        assert first.row - row in (0, 1)
        assert first.column in ("sequence", "t_ns")
    else:
        assert (first.row, first.column) == (row, name)
    assert first.recorded != first.replayed or first.recorded_hex != first.replayed_hex


@pytest.mark.parametrize(
    ("name", "table", "columns"),
    [
        (OBSERVED, SENSOR_MEASUREMENT, ("y", "u_applied")),
        (ACKNOWLEDGED, SENSOR_ACKNOWLEDGEMENT, ("sequence", "t_ns", "model_t_ns", "x_s")),
        (ACKNOWLEDGED, NETEM_PACKET, ("flow", "fate", "head", "size_bytes", "sequence")),
        (ACTUATIONS, NETEM_PACKET, ("flow", "fate", "head", "size_bytes", "sequence")),
        (ACTUATIONS, PLANT_ACTUATION, ("predicted", "t_ns")),
        (ACTUATIONS, PLANT_STEP, ("entry", "actuation")),
    ],
)
def test_a_flipped_bit_of_a_loop_of_another_kind_is_reported(
    name: str, table: str, columns: tuple[str, ...]
) -> None:
    record = recorded(name)
    assert replay(record).bit_exact
    flows = record[table]["flow"] if "flow" in columns else np.zeros(len(record[table]), int)
    for flow in set(flows.tolist()):
        rows = np.flatnonzero(flows == flow)
        for column in columns:
            result = replay(flipped(record, table, int(rows[len(rows) // 2]), column, 0))
            assert result.first_difference is not None, column


def test_a_wrong_input_number_is_reported(record: RunRecord) -> None:
    rng = np.random.default_rng(2)
    for table in 6 * filled_tables(record):
        row, bit = int(rng.integers(len(record[table]))), int(rng.integers(64))
        result = replay(flipped(record, table, row, "input", bit))
        first = result.first_difference
        assert first is not None, (table, row, bit)
        # Either of two rows with the same number may be the wrong one.
        assert OWNER[first.table] == OWNER[table]
        assert first.column == "input"
        assert [gap.partition(":")[0] for gap in result.gaps] == [OWNER[table]]


def test_a_time_that_decreases_is_reported(record: RunRecord) -> None:
    for table in filled_tables(record):
        first = replay(flipped(record, table, len(record[table]) - 1, "now_ns", 63)).first_difference
        assert first is not None, table
        assert first.column in ("now_ns", "t_ns")  # netem's t_ns is its now_ns


def test_missing_rows_are_reported(record: RunRecord) -> None:
    for table in filled_tables(record):
        rows, process = record[table], OWNER[table]
        number = int(rows["input"][len(rows) // 2])
        result = replay(changed(record, {table: np.delete(rows, [len(rows) // 2])}))
        assert result.bit_exact  # up to the gap
        assert result.gaps == [f"{process}: rows are missing from input {number} on"]
        assert result.verdict().complete is False
        accounts = {account.process: account for account in result.processes}
        assert accounts[process].missing_from == accounts[process].compared == number
        assert all(account.is_complete for name, account in accounts.items() if name != process)


@pytest.mark.parametrize("role", LOOP_ROLES)
def test_rows_missing_at_the_end_are_reported(role: str, record: RunRecord) -> None:
    owned = {table: record[table] for table in record.tables if OWNER[table] == role}
    last = max(int(rows["input"][-1]) for rows in owned.values() if len(rows))
    shorter_rows = {table: rows[rows["input"] < last] for table, rows in owned.items()}
    others = {other_role: report for other_role, report in record.reports.items() if other_role != role}
    for cut, gap in (
        (changed(record, shorter_rows), f"{role}: rows are missing from input {last} on"),
        (
            changed(record, reports=others),
            f"{role}: left no report; whether its last rows are missing is not known",
        ),
    ):
        result = replay(cut)
        assert result.bit_exact
        assert result.gaps == [gap]


def test_a_message_that_no_process_sent_is_reported(record: RunRecord) -> None:
    """The plant applies a forged actuation, so only the sender's rows reveal it."""
    rows = record[PLANT_ACTUATION].copy()
    last = len(rows) - 1
    rows["sequence"][last] += 1
    steps = record[PLANT_STEP].copy()
    steps["actuation"][steps["actuation"] == last] += 1
    first = replay(changed(record, {PLANT_ACTUATION: rows, PLANT_STEP: steps})).first_difference
    assert first is not None
    assert (first.table, first.row, first.column) == (PLANT_ACTUATION, last, "sequence")
    assert first.what == "was never sent"


def test_a_delivery_of_a_dropped_update_is_reported(record: RunRecord) -> None:
    """The record shows the arrival of an update that was sent and then dropped."""
    events = record[SENSOR_MEASUREMENT][record[SENSOR_MEASUREMENT]["event"] >= 0]
    deliveries = record[CONTROLLER_DELIVERY].copy()
    delivered = set(deliveries["sequence"].tolist())
    lost = next(i for i in range(len(events)) if i not in delivered and i + 1 in delivered)
    row = int(np.flatnonzero(deliveries["sequence"] == lost + 1)[0])
    for column in ("t_ns", "x"):
        deliveries[column][row] = events[column][lost]
    deliveries["sequence"][row] = lost
    result = replay(changed(record, {CONTROLLER_DELIVERY: deliveries}))
    differences = {hop.hop: hop.difference for hop in result.messages}
    delivery = differences["netem → controller"]
    assert delivery is not None
    assert delivery.what == "netem did not forward it"
    assert (delivery.table, delivery.row) == (CONTROLLER_DELIVERY, row)
    assert differences["sensor → netem"] is None


@pytest.mark.sanitized
@pytest.mark.parametrize("table", [PLANT_STEP, CONTROLLER_STEP])
def test_ticks_after_the_runs_end_are_not_made(table: str, record: RunRecord) -> None:
    """Of a period of 10¹⁸ ns, the times of ten more steps would not fit 64 bits."""
    rows = record[table]
    copies = np.repeat(rows[-1:], 10)
    owned = (record[name]["input"] for name in record.tables if OWNER[name] == OWNER[table])
    last = max(inputs.max(initial=0) for inputs in owned)
    copies["input"], copies["now_ns"] = np.arange(1, 11) + last, 2**62
    result = replay(changed(record, {table: np.concatenate([rows, copies])}))
    account = next(process for process in result.processes if process.process == OWNER[table])
    assert account.difference is not None
    assert account.difference.row == len(rows)
    assert f"{OWNER[table]}: replayed up to input {last + 1}" in result.gaps


@pytest.mark.sanitized
def test_a_recorded_measurement_after_the_runs_end_is_not_taken() -> None:
    """The observer would make 10⁹ steps up to it."""
    record = recorded(OBSERVED)
    rows = record[SENSOR_MEASUREMENT].copy()
    rows["t_ns"][20] = 10**18
    result = replay(changed(record, {SENSOR_MEASUREMENT: rows}))
    sensor = next(account for account in result.processes if account.process == "sensor")
    assert sensor.difference is not None
    assert "cannot take this input" in sensor.difference.what
    assert sensor.compared == 20


@pytest.mark.sanitized
@settings(max_examples=60)
@given(st.integers(0, len(SETTINGS_OF) - 1), st.data())
def test_a_record_with_any_numbers_is_replayed(number: int, data: st.DataObject) -> None:
    """The machines get inputs that no run has; the first of them is found."""
    record = recorded([*SETTINGS_OF][number])
    rows = {table: record[table].copy() for table in record.tables if len(record[table])}
    equal = True
    for _ in range(data.draw(st.integers(1, 4))):
        table = data.draw(st.sampled_from(sorted(rows)))
        words = rows[table].view(np.int64).reshape(len(rows[table]), -1)
        # Rows are found by their numbers of inputs: these have tests of their own.
        place = data.draw(st.integers(0, len(words) - 1)), data.draw(st.integers(1, 3))
        if data.draw(st.booleans()):
            place = place[0], data.draw(st.integers(4, words.shape[1] - 1))
        old_word, words[place] = words[place], data.draw(st.sampled_from(WORDS))
        equal &= bool(old_word == words[place])
    result = replay(changed(record, rows))
    assert json.dumps(result.to_json(), allow_nan=False)
    if equal:
        assert result.bit_exact
