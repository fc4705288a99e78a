"""The controller is paused: the plant applies its watchdog policy, and the log states it."""

import signal
import time
from collections.abc import Callable

import numpy as np
from scipy.linalg import expm

from cosim.record.run_record import RunRecord, load_record
from noack.protocol.record_tables import PLANT_ACTUATION, PLANT_STEP
from tests.integration.conftest import Finished, Running, settings, wait_for

Start = Callable[..., Running]
FROZEN_S = 0.4


def outage(start: Start) -> Finished:
    """Return a run in which the controller is paused and later continued."""
    running = start(
        *settings(speed=2.0, horizon_s=400.0),
        *settings(plant__watchdog__policy="model", plant__watchdog__timeout_s=0.1),
    )
    running.wait_started()
    spooled = running.runs / "latest" / "spool" / "plant_actuation.recorder"
    wait_for(lambda: spooled.exists() and spooled.stat().st_size > 5_000)
    controller = running.child("controller")
    controller.send_signal(signal.SIGSTOP)
    time.sleep(FROZEN_S)
    frozen_bytes = spooled.stat().st_size
    controller.send_signal(signal.SIGCONT)
    wait_for(lambda: spooled.stat().st_size > 2 * frozen_bytes)
    running.process.send_signal(signal.SIGINT)
    return running.finish()


def test_the_plant_applies_its_watchdog_policy_and_logs_it(start: Start) -> None:
    finished = outage(start)
    assert finished.status == 130, finished.stderr
    summary, record = finished.summary, load_record(finished.run_dir)
    assert summary["watchdog"]["policy"] == "model"
    assert summary["watchdog"]["trips"] >= 1
    assert summary["replay"]["bit_exact"]
    assert summary["replay"]["complete"]
    acted = inputs_of_the_watchdog(record)
    assert len(acted) > 100
    first_s = float(acted["t_ns"][0]) * 1e-9
    trips = [one for one in record.notices if one["level"] == "watchdog"]
    assert trips[0]["t_ns"] == acted["t_ns"][0]
    said = [one for one in record.notices if one["level"] == "void"]
    (watchdog,) = [one for one in said if "the watchdog replaced" in one["text"]]
    assert watchdog["t_ns"] == acted["t_ns"][0]
    assert watchdog["text"].startswith(
        f"void (assumption violated) from {first_s:.3f} s on: the watchdog replaced the input: "
    )
    # The age limit of a certificate is below the watchdog's timeout.
    void = [one for one in summary["claims"] if one["source"] == "certificate"]
    assert {(one["verdict"], round(one["since_s"] * 1e9)) for one in void} == {
        ("void", min(one["t_ns"] for one in said))
    }
    for one in said:
        assert finished.stderr.count(one["text"]) == 1
    assert "the watchdog's" in summary["fidelity"]["reason"]


def inputs_of_the_watchdog(record: RunRecord) -> np.ndarray:
    """Return the steps with a timed-out actuation; check that the model gives their inputs."""
    steps, taken = record[PLANT_STEP], record[PLANT_ACTUATION]
    newest = taken[np.searchsorted(taken["sequence"], steps["actuation"])]
    has = steps["actuation"] >= 0
    age_s = (steps["t_ns"] - newest["t_ns"]) * 1e-9
    acted = has & (age_s > 0.1 + 1e-12)
    for step, actuation, passed_s in zip(steps[acted], newest[acted], age_s[acted], strict=True):
        expected = record.loop.K @ expm(record.loop.H * passed_s) @ actuation["x_c"]
        np.testing.assert_allclose(step["u"], expected, rtol=1e-10, atol=1e-13)
    np.testing.assert_array_equal(steps["u"][has & ~acted], newest["u"][has & ~acted])
    found: np.ndarray = steps[acted]
    return found
