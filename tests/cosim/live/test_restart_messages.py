"""The summary's messages about restarted processes."""

from typing import Any

import numpy as np
import pytest

from cosim.analysis.run_summary import summarise
from cosim.simulation.virtual_time import simulate
from noack.protocol.machine_interface import GENERATION, RESTART
from noack.protocol.record_tables import SENSOR_MEASUREMENT
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate
from tests.cosim.record.changed_records import changed


def test_a_restart_without_rows_is_listed(content: dict[str, Any]) -> None:
    record = simulate(resolve(validate(content, "")))
    rows = record[SENSOR_MEASUREMENT].copy()
    rows["input"][50:] = 2 * GENERATION + np.arange(len(rows) - 50)
    notices = [
        {"process": "sensor", "level": RESTART, "t_ns": k * 10_000_000, "text": f"after {k}"}
        for k in (1, 2)
    ]
    restarted = changed(record, {SENSOR_MEASUREMENT: rows}, notices=notices, reports={})
    restarts = summarise(restarted, 0, "").to_json()["restarts"]
    last_s = rows["now_ns"][49] * 1e-9
    found = {one["generation"]: (one["last_s"], one["first_s"], one["what"]) for one in restarts}
    assert found == {
        1: (last_s, None, "after 1"),
        2: (last_s, rows["now_ns"][50] * 1e-9, "after 2"),
    }


@pytest.mark.parametrize("newest", [1, 2])
def test_missing_first_rows_of_a_restart_are_counted(content: dict[str, Any], newest: int) -> None:
    """The process died before a recorder was back to which it could have sent them again."""
    record = simulate(resolve(validate(content, "")))
    rows = record[SENSOR_MEASUREMENT].copy()
    rows["input"][50:80] = GENERATION + 7 + np.arange(30)
    rows["input"][80:] = newest * GENERATION + 37 + np.arange(len(rows) - 80)
    if newest == 2:
        rows["input"][80:] -= 37
    notices = [{"process": "sensor", "level": RESTART, "t_ns": 0, "text": "newest"}]
    restarted = changed(record, {SENSOR_MEASUREMENT: rows}, notices=notices, reports={})
    summary = summarise(restarted, 0, "").to_json()
    assert summary["missing_by_table"]["sensor"] == 7
    if newest == 2:
        assert [one["what"] for one in summary["restarts"]] == [None, "newest"]
