from typing import Any

import numpy as np
import pytest

from cosim.output.figure_drawing import draw
from cosim.output.run_figures import run_figures
from cosim.output.run_tables import key_numbers, short_numbers
from cosim.output.timing_figures import clock_errors
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from noack.protocol.record_tables import CLOCK_TABLES, LOST_NS, OWNER, clock_table
from tests.cosim.output.conftest import scenario_of
from tests.cosim.output.test_page import shown
from tests.cosim.record.changed_records import changed
from tests.cosim.summaries import summary_of, with_values

ALLOWED_US, SENSOR_NS, MS = 1000.0, 63_200, 1_000_000
FIRST_LOST = 7


@pytest.fixture
def clocked(content: dict[str, Any]) -> RunRecord:
    """A run whose sensor is on a host with another clock, and loses its bound."""
    clocks = {"largest_error_us": ALLOWED_US}
    record = simulate(scenario_of(content | {"clocks": clocks}))
    tables = {}
    for table in CLOCK_TABLES:
        rows = np.zeros(20, record.tables[table])
        rows["input"] = np.arange(20)
        rows["t_ns"] = np.arange(20) * 50 * MS
        rows["now_ns"] = rows["t_ns"] + 50 * MS
        if OWNER[table] == "sensor":
            rows["error_ns"] = SENSOR_NS
            rows["error_ns"][FIRST_LOST:10] = LOST_NS
        tables[table] = rows
    return changed(record, tables)


def test_only_processes_with_another_clock_are_shown(clocked: RunRecord) -> None:
    (one,) = clock_errors(clocked).items()
    assert one[0] == "sensor"
    assert one[1].largest_us == pytest.approx(SENSOR_NS * 1e-3)
    assert np.flatnonzero(one[1].lost).tolist() == [7, 8, 9]


def test_the_figure_has_the_bound_the_limit_and_a_cross_where_the_bound_is_lost(
    clocked: RunRecord,
) -> None:
    found = run_figures(clocked)["clocks"]()
    assert "Largest: sensor 63.2 µs." in found.caption
    assert "the bound was lost (sensor)" in found.caption
    curve, cross, limit = draw(found).axes[0].lines
    assert np.nanmax(curve.get_ydata()) == pytest.approx(SENSOR_NS * 1e-3)
    assert cross.get_xdata().tolist() == pytest.approx([FIRST_LOST * 0.05])
    assert set(limit.get_ydata()) == {ALLOWED_US}


def test_one_clock_has_no_figure(clocked: RunRecord) -> None:
    table = clock_table("sensor")
    rows = clocked[table].copy()
    rows["error_ns"] = 0
    same = {name: clocked[name] for name in CLOCK_TABLES} | {table: rows}
    assert "clocks" not in run_figures(changed(clocked, same))


def test_the_page_and_both_tables_have_the_number(clocked: RunRecord) -> None:
    conditions: dict[str, float | None] = dict.fromkeys(
        ("dropouts", "sampling_s", "delay_s", "hold_s", "start_s")
    )
    conditions["clock_error_s"] = SENSOR_NS * 1e-9
    row = ("largest bound of a clock's error", "63.2 µs")
    summary = summary_of(clocked, conditions=conditions)
    assert row in key_numbers(summary)
    assert row in short_numbers(summary)
    assert row[0] not in dict(
        short_numbers(with_values(summary, conditions=conditions | {"clock_error_s": 0.0}))
    )
    assert row[1] in shown(clocked, conditions=conditions)
