"""Records of simulated runs, and data that no run produces."""

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from noack.protocol.record_tables import PLANT_STEP
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from tests.conftest import CONTENT
from tests.cosim.record.changed_records import changed, copied

HOSTILE = "</title></svg><script>alert('x')</script> & \"$\\frac{1}{2}$\""


def scenario_of(content: dict[str, Any], n: int = 2, **names: Any) -> Scenario:
    """The small scenario with n states."""
    content = copy.deepcopy(content)
    content["trigger"]["beta"] = 0.01
    if n != 2 or names:
        model = {
            "A": (-np.eye(n)).tolist(), "B": np.ones((n, 1)).tolist(), "gain": [[0.0] * n],
        }  # fmt: skip
        content["model"] = model | names
        content["plant"]["initial_state"] = [1.0] * n
    return resolve(validate(content, "here"))


def make_record(scenario: Scenario, largest: float = 1.0) -> RunRecord:
    """A record of a simulated run, late as a live one.

    Args:
        scenario: the resolved scenario.
        largest: factor of the plant's last state.
    """
    record = simulate(scenario)
    rows = copied(record)
    for filled in rows.values():
        filled["now_ns"] += 1000 * (1 + np.arange(len(filled)) % 97)
    x = rows[PLANT_STEP]["x"]
    with np.errstate(all="ignore"):
        x *= np.geomspace(1.0, largest, len(x))[:, None]
    return changed(record, rows, notices=[], reports={}, kind="live")


@pytest.fixture
def record(content: dict[str, Any]) -> RunRecord:
    return make_record(scenario_of(content))


def lone(*present: str) -> RunRecord:
    """A record with only these tables."""
    record = make_record(scenario_of(CONTENT))
    rows = {t: record[t][: None if t in present else 0] for t in record.tables}
    return changed(record, rows)


CASES: dict[str, Callable[[], RunRecord]] = {
    "empty": lone,
    "two steps": lambda: make_record(scenario_of(CONTENT | {"horizon_s": 0.002})),
    "diverged": lambda: make_record(scenario_of(CONTENT), largest=np.inf),
    "plant only": lambda: lone("plant_step"),
    "deliveries only": lambda: lone("controller_delivery"),
    "forty states": lambda: make_record(scenario_of(CONTENT, 40)),
}
"""Records that a run may leave."""
