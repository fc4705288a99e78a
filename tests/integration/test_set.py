"""Change runtime parameters of a run from other processes."""

import json
import os
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cosim.record.recorded_changes import changes_of
from cosim.record.run_record import load_record
from noack.runtime import run_registry
from tests.integration.conftest import PATIENCE_S, Running, noack_command, settings, wait_for


def test_a_run_is_changed_twice_from_another_process(
    start: Callable[..., Running], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    running = start(*settings(horizon_s=1000.0))
    running.wait_started()
    run = run_registry.find()

    def set_parameters(*words: str) -> dict[str, Any]:
        done = subprocess.run(
            noack_command("set", "--json", *words), capture_output=True, text=True, check=False,
            timeout=PATIENCE_S,
        )  # fmt: skip
        answer: dict[str, Any] = json.loads(done.stdout)
        assert done.returncode == answer.get("exit", {"status": 0})["status"], done.stderr
        return answer

    wait_for(lambda: run_registry.request_change(run, {})["t_s"] > 0)
    first = set_parameters("loss.p", "0.5", "mansd=2")
    second = set_parameters("setpoint", "[0.0, 0.0, 0.0, 1.0]")
    assert second["runtime_parameters"]["network.mansd"] == 2
    refused = set_parameters("loss.p", "1.5")
    assert refused["exit"]["status"] == 2
    assert "should be less than or equal to 1" in refused["error"]
    wait_for(lambda: run_registry.request_change(run, {})["t_s"] > second["from_s"] + 1)
    running.process.send_signal(signal.SIGINT)
    finished = running.finish()
    assert finished.status == 130, finished.stderr
    summary = finished.summary
    assert summary["replay"]["bit_exact"]
    assert summary["replay"]["complete"]
    assert [one["t_s"] for one in summary["changes"]] == [first["from_s"], second["from_s"]]
    assert summary["changes"][1]["settings"] == {"controller.setpoint": [0.0, 0.0, 0.0, 1.0]}
    assert summary["identity_residual_relative"] < 1e-9
    record = load_record(finished.run_dir)
    assert record.scenario.network.mansd == 4  # as it was at the start
    changes = [one["text"] for one in record.notices if one["level"] == "change"]
    assert len(changes) == 2
    assert all("; requested at " in text for text in changes)
    if not any(one.late for one in changes_of(record)):  # a late change is a recorded violation
        causes = {one["cause"] for one in summary["assumption_violations"]}
        assert not causes & {"dropouts", "change"}
    assert not (tmp_path / f"noack-{os.getuid()}" / "runs" / f"{run.run_id}.json").exists()
    for path in finished.run_dir.rglob("*"):
        assert not path.is_file() or run.password.encode() not in path.read_bytes()
