"""A live run and a simulated run of the same scenario have the same events, fates and states.

The steps are 200 ms long, so only a stall of 100 ms changes the order of events. After such a
stall the runs differ. The test compares them up to the stall and repeats a live run with an early
stall.
"""

from pathlib import Path

import numpy as np
import pytest

from cosim.record.run_record import RunRecord, load_record
from cosim.simulation.virtual_time import simulate
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    NETEM_PACKET,
    PLANT_ACTUATION,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)
from tests.integration.conftest import run_scenario, settings

RATE_HZ = 5.0
HORIZON_S = 8.0
ENOUGH_S = 4.0
ATTEMPTS = 20
SAME = {
    PLANT_STEP: ("input", "sequence", "t_ns", "actuation"),
    PLANT_ACTUATION: ("input", "sequence", "t_ns"),
    SENSOR_MEASUREMENT: ("input", "sequence", "t_ns", "event"),
    NETEM_PACKET: ("input", "sequence", "flow", "fate", "consecutive_losses", "size_bytes"),
    CONTROLLER_STEP: ("input", "sequence", "t_ns", "model_t_ns"),
    CONTROLLER_DELIVERY: ("input", "sequence", "t_ns", "model_t_ns", "dropouts"),
}
CLOSE = {
    PLANT_STEP: ("x", "u"),
    PLANT_ACTUATION: ("u",),
    SENSOR_MEASUREMENT: ("x", "x_s", "e_s_norm", "threshold"),
    CONTROLLER_STEP: ("x_c", "u"),
    CONTROLLER_DELIVERY: ("x", "x_c_before", "x_c"),
}


def in_turn_until_ns(live: RunRecord, simulated: RunRecord) -> int:
    """Return the time in ns of the first live event in a different order than in the simulation.

    Only the order of the two kinds of input of the plant and of the controller can differ; the
    ``input`` numbers show it. The plant's applied actuation shows which actuation came in time.
    """
    first_ns = simulated.scenario.timing.horizon_ns + 1
    for table, columns in (
        (PLANT_STEP, ("input", "actuation")),
        (PLANT_ACTUATION, ("input",)),
        (CONTROLLER_STEP, ("input",)),
        (CONTROLLER_DELIVERY, ("input",)),
    ):
        count = min(len(live[table]), len(simulated[table]))
        for column in columns:
            other = live[table][column][:count] != simulated[table][column][:count]
            if other.any():
                first_ns = min(first_ns, int(simulated[table]["now_ns"][np.argmax(other)]))
    return first_ns


def test_a_live_run_agrees_with_the_simulated_run(tmp_path: Path) -> None:
    values = {
        "horizon_s": HORIZON_S,
        "plant__rate_hz": RATE_HZ,
        "controller__rate_hz": RATE_HZ,
        "trigger__beta": 0.02,
        "network__loss__probability": 0.6,
        "network__initial_sync": "known_state",
        "plant__measure_every": 2,
    }
    for _ in range(ATTEMPTS):
        finished = run_scenario(tmp_path / "runs", *settings(**values))
        assert finished.status == 0, finished.stderr
        live = load_record(finished.run_dir)
        simulated = simulate(live.scenario)
        assert (simulated[SENSOR_MEASUREMENT]["event"] >= 0).sum() > 3
        until_ns = in_turn_until_ns(live, simulated)
        compare(live, simulated, until_ns)
        if until_ns >= ENOUGH_S * 1e9:
            break
    else:
        pytest.fail(f"{ATTEMPTS} live runs went another way within their first {ENOUGH_S} s")


def compare(live: RunRecord, simulated: RunRecord, until_ns: int) -> None:
    compared = 0
    for table, columns in SAME.items():
        # A live row may be later than in the simulation, but the order is the same.
        rows = simulated[table][simulated[table]["now_ns"] < until_ns]
        others = live[table][: len(rows)]
        for column in columns:
            np.testing.assert_array_equal(others[column], rows[column], f"{table}.{column}")
        for column in CLOSE.get(table, ()):
            # The same arithmetic in the same order, but BLAS may use another kernel.
            np.testing.assert_allclose(
                others[column], rows[column], rtol=1e-9, atol=1e-12, err_msg=f"{table}.{column}"
            )
        compared += len(rows)
    assert until_ns < ENOUGH_S * 1e9 or compared > 60
    if until_ns > simulated.scenario.timing.horizon_ns:
        for table in SAME:
            assert len(live[table]) == len(simulated[table]), table
