"""Synthetic records: a report also draws data that no run produces."""

import copy
from typing import Any

import numpy as np
import pytest

from cosim.record.run_record import RunRecord
from noack.config.resolution import loop_of, resolve
from noack.config.scenario import Scenario
from noack.config.scenario_file import validate
from noack.protocol.record_tables import NO_SEQUENCE, PACKET_HEAD_BYTES, Fate, tables
from noack.protocol.wire_format import Encoder, Flow, Message

STEP_NS = 2_000_000
EVENT_EVERY = 25
HOSTILE = "</title></svg><script>alert('x')</script> & \"$\\frac{1}{2}$\""
ENCODER = Encoder(1, bytes(32))


def scenario_of(content: dict[str, Any], n: int = 2, **names: Any) -> Scenario:
    """The small scenario with n states."""
    content = copy.deepcopy(content)
    if n != 2 or names:
        model = {
            "A": (-np.eye(n)).tolist(), "B": np.ones((n, 1)).tolist(), "gain": [[0.0] * n],
        }  # fmt: skip
        content["model"] = model | names
        content["plant"]["initial_state"] = [1.0] * n
    return resolve(validate(content, "here"))


def make_record(scenario: Scenario, k: int = 500, largest: float = 1.0) -> RunRecord:
    """A record of k steps in which every 25th measurement is an event and two in three are lost.

    Args:
        scenario: the resolved scenario.
        k: steps of every process.
        largest: final value of the second half of the states.
    """
    loop = loop_of(scenario)
    types = tables(loop.n, loop.m)
    t_ns = np.arange(k, dtype=np.int64) * STEP_NS
    x = np.cos(t_ns[:, None] * 1e-8 + np.arange(loop.n)) + 0.1
    with np.errstate(all="ignore"):
        x[k // 2 :] *= np.geomspace(1.0, largest, k - k // 2)[:, None] if k > 1 else 1.0
    rows = {table: np.zeros(0, dtype) for table, dtype in types.items()}

    def fill(table: str, at_ns: np.ndarray, **columns: Any) -> None:
        filled = np.zeros(len(at_ns), types[table])
        filled["input"] = filled["sequence"] = np.arange(len(at_ns))
        filled["t_ns"], filled["now_ns"] = at_ns, at_ns + 1000 * (1 + np.arange(len(at_ns)) % 97)
        for name, values in columns.items():
            filled[name] = values
        rows[table] = filled

    event = np.full(k, NO_SEQUENCE)
    event[::EVENT_EVERY] = np.arange(len(event[::EVENT_EVERY]))
    event_ns = t_ns[::EVENT_EVERY]
    arrived = np.arange(len(event_ns)) % 3 == 0
    head = [
        ENCODER.encode(Message(Flow.UPDATE, i, int(at_ns), np.ones(1)))[:PACKET_HEAD_BYTES]
        for i, at_ns in enumerate(event_ns)
    ]
    norm = np.abs(np.sin(t_ns * 1e-8)) * np.exp(-1e-9 * t_ns)
    fill("plant_step", t_ns, x=x)
    fill(
        "sensor_measurement",
        t_ns,
        x=x,
        x_s=x + 0.01,
        e_s_norm=norm,
        compared=norm,
        threshold=0.5,
        event=event,
    )
    fill("controller_step", t_ns, model_t_ns=t_ns, x_c=x + 0.02, u=-x[:, :1])
    fill(
        "netem_packet", event_ns,
        head=np.frombuffer(b"".join(head), f"V{PACKET_HEAD_BYTES}") if head else np.zeros(0, "V32"),
        fate=np.where(arrived, np.where(np.arange(len(arrived)) % 2, Fate.FORCED, 0), Fate.DROPPED),
    )  # fmt: skip
    fill("controller_delivery", event_ns[arrived], model_t_ns=event_ns[arrived])
    rows["controller_delivery"]["sequence"] = np.flatnonzero(arrived)
    # The controller processed its deliveries and its ticks in one order.
    for table, later in (("controller_delivery", 0), ("controller_step", 1)):
        rows[table]["input"] = 2 * (rows[table]["t_ns"] // STEP_NS) + later
    return RunRecord(scenario, rows, [], {})


@pytest.fixture
def record(content: dict[str, Any]) -> RunRecord:
    return make_record(scenario_of(content))
