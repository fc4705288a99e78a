from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from noack.protocol.machine_interface import Record
from noack.protocol.record_tables import PLANT_STEP, tables
from noack.protocol.wire_format import Flow, Message
from noack.scenario.resolution import resolved_loops
from noack.scenario.scenario_file import validate
from plant_server.plant import plants_of
from tests.machine_parts import OneLoop, linear_plant, state_of

H_NS = 2_000_000
A = np.array([[0.0, 1.0], [-3.0, 0.4]])
B = np.array([[0.0, 1.0], [2.0, -1.0]])


def new_plant(horizon_ns: int = 10**9, measure_every: int = 1) -> OneLoop:
    x0 = np.array([1.0, -0.5])
    return linear_plant(A, B, x0, H_NS, horizon_ns=horizon_ns, measure_every=measure_every)


def actuation(sequence: int, u: Sequence[float]) -> Message:
    return Message(Flow.ACTUATION, sequence, sequence, np.array(u, dtype=float))


def measured(outputs: Sequence[object]) -> list[Message]:
    return [output for output in outputs if isinstance(output, Message)]


def rows(outputs: Sequence[object], table: str) -> Any:
    """The table's rows in the form that is recorded."""
    found = [out.row for out in outputs if isinstance(out, Record) and out.table == table]
    return np.array(found, tables(2, 2)[table])


def test_late_steps_keep_their_length_and_are_caught_up() -> None:
    on_time, late = new_plant(), new_plant()
    expected, found = [], []
    for plant in (on_time, late):
        plant.handle(actuation(0, [1.0, -1.0]), 0)
    for step in range(20):
        expected += on_time.on_timer(step * H_NS)
    now_ns = 0
    for step in range(20):
        assert late.next_deadline_ns() == step * H_NS  # the grid does not shift
        # Stopped for a quarter of the run, then every step at once.
        now_ns = max(now_ns, step * H_NS) if step != 5 else 10 * H_NS + 123
        found += late.on_timer(now_ns)
    for one, other in zip(measured(expected), measured(found), strict=True):
        assert (one.sequence, one.t_ns) == (other.sequence, other.t_ns)
        assert one.vector.tobytes() == other.vector.tobytes()
    steps = rows(found, PLANT_STEP)
    assert steps["t_ns"].tolist() == [step * H_NS for step in range(20)]
    assert steps["now_ns"][[4, 5, 6, 10, 11]].tolist() == [
        4 * H_NS,
        10 * H_NS + 123,
        10 * H_NS + 123,
        10 * H_NS + 123,
        11 * H_NS,
    ]


@pytest.mark.parametrize("noise", [False, True])
def test_loops_with_the_same_plant_share_its_description(
    content: dict[str, Any], *, noise: bool
) -> None:
    content["loops"] = [{"name": "loop", "count": 3}]
    if noise:
        content["plant"]["measurement"] = {"noise_std": [0.1, 0.1]}
    plants = plants_of(resolved_loops(validate(content, "loops")))
    assert len({id(part) for part in plants.parts}) == (3 if noise else 1)
    for name in ("x", "u"):
        assert np.array_equal(state_of(plants, name, 2), state_of(plants, name))
