"""Replay of a restarted controller; only the rows of the second generation are recorded."""

from typing import Any

import pytest

from controller_node.controller import controller_of
from cosim.analysis.replay import replay
from cosim.record.run_record import RunRecord
from noack.config.resolution import resolve
from noack.config.scenario_file import validate
from noack.protocol.machine_interface import GENERATION, RESTART, Start
from noack.protocol.record_tables import CONTROLLER_DELIVERY, CONTROLLER_STEP
from tests.cosim.live.outage import Reborn, simulate_with

NOTICE = {"process": "controller", "level": RESTART, "t_ns": 0, "text": "started anew"}


@pytest.mark.parametrize("ticks", [True, False])
def test_an_update_before_its_first_tick_is_replayed(content: dict[str, Any], ticks: bool) -> None:
    content |= {"trigger": {"policy": "periodic", "period_s": 0.002}}
    resolved = resolve(
        validate(content | {"network": {"mansd": 0, "loss": {"model": "lossless"}}}, "")
    )
    at_ns = 500_000_000 - 300_000  # between ticks, just before an update
    successor = controller_of(resolved, Start(1, at_ns))
    record = simulate_with(resolved, "controller", lambda one: Reborn(one, successor, at_ns))
    rows = {table: record[table] for table in record.tables}
    taken, again = rows[CONTROLLER_DELIVERY], rows[CONTROLLER_STEP]["input"] >= GENERATION
    first = taken[taken["input"] == GENERATION]
    assert len(first) == 1
    assert first["now_ns"][0] < rows[CONTROLLER_STEP]["t_ns"][again][0]
    if not ticks:  # the process died before it had one
        rows[CONTROLLER_STEP] = rows[CONTROLLER_STEP][~again]
        rows[CONTROLLER_DELIVERY] = taken[taken["input"] <= GENERATION]
    found = replay(RunRecord(resolved, rows, [NOTICE], {}, "live"))
    assert found.bit_exact, found.verdict()
    assert found.verdict()["inputs"] == sum(map(len, rows.values()))
