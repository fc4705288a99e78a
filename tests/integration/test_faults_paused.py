"""Processes that are paused for less or more than zenoh's lease."""

import signal
import time
from collections.abc import Callable

import numpy as np
import psutil

from cosim.record.run_record import load_record
from tests.integration.conftest import (
    AT_RATE,
    RATE_HZ,
    ROLE_MODULES,
    Running,
    private_files,
    settings,
)
from tests.integration.test_faults import LONG, wait_recording

Start = Callable[..., Running]
PAUSE_S = 0.7
"""Well below zenoh's lease, and far above every delay that a certificate allows."""
UNCONFIRMED_S = 1.2
"""Also below the lease, but long enough that unacknowledged rows are sent again."""


def pause(process: psutil.Process, pause_s: float) -> None:
    process.send_signal(signal.SIGSTOP)
    time.sleep(pause_s)
    process.send_signal(signal.SIGCONT)


def test_a_run_catches_up_after_each_process_was_paused(start: Start) -> None:
    running = start(*AT_RATE, *settings(speed=4.0, horizon_s=28.0))
    wait_recording(running)
    for role in ROLE_MODULES:
        pause(running.child(role), PAUSE_S)
        time.sleep(0.1)
    # The launcher's process routes all telemetry; delayed batches are sent again.
    pause(psutil.Process(running.process.pid), UNCONFIRMED_S)
    finished = running.finish()
    summary = finished.summary
    assert finished.status == 0, finished.stderr
    assert summary["exit"]["reason"] == "horizon"
    assert summary["reached_s"] == 28.0
    # No step is skipped: the steps due during the pause are executed late and in order.
    record = load_record(finished.run_dir)
    for table in ("plant_step", "sensor_measurement", "controller_step"):
        rows = record[table]
        assert np.array_equal(rows["sequence"], np.arange(len(rows)))
    assert len(record["plant_step"]) == 28 * RATE_HZ + 1
    assert summary["missing_samples"] == 0
    assert summary["replay"]["bit_exact"]
    assert summary["replay"]["complete"]
    assert summary["identity_residual_relative"] < 1e-11
    assert summary["longest_loss_burst"] <= summary["mansd"]
    for role in ("plant", "sensor", "controller"):  # netem may have had no packet
        assert summary["lateness_us"][role]["max"] > 0.9e6 * PAUSE_S
    # No certificate allows inputs of this age: the claims are void, with time and cause.
    certified = [claim for claim in summary["claims"] if "certificate" in claim["source"]]
    assert certified
    for claim in certified:
        assert claim["verdict"] == "void"
        assert 0 <= claim["since_s"] < 28.0
    void = [notice["text"] for notice in record.notices if notice["level"] == "void"]
    assert any(" s old, " in text or "was felt after " in text for text in void), void
    own = [claim for claim in summary["claims"] if claim["source"] == "(I1)"]
    assert {claim["verdict"] for claim in own} == {"held"}
    assert running.left_behind() == []


def test_a_frozen_recorder_is_named_and_no_row_is_lost(start: Start) -> None:
    """The run ends because it has no recorder; the other processes store their rows themselves."""
    running = start(*LONG)
    wait_recording(running)
    running.child("recorder").send_signal(signal.SIGSTOP)
    finished = running.finish()
    assert finished.status == 1
    assert finished.summary["exit"]["reason"] == "recorder stopped responding"
    assert finished.summary["missing_samples"] == 0
    assert finished.summary["unintended_losses"] == 0
    assert finished.summary["replay"]["bit_exact"]
    steps = load_record(finished.run_dir)["plant_step"]
    # Rows exist up to the end of the lease: two seconds since the last keep-alive.
    assert len(steps) > 1.5 * 4 * RATE_HZ
    assert np.array_equal(steps["sequence"], np.arange(len(steps)))
    assert not (finished.run_dir / "spool").exists()
    assert private_files(running.runs.parent) == []
    assert running.left_behind() == []
