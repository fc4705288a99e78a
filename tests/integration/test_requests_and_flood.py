"""Requests from other processes during a run: changes of parameters, a summary, a flood."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from benchmarks.bare_programs import command_of
from cosim.cli import app
from cosim.record.run_events import changes_of
from cosim.record.run_record import load_record
from noack.protocol.topology import LOOP_ROLES
from noack.runtime import run_registry
from noack.runtime.udp_sockets import SHED
from tests.integration.conftest import PATIENCE_S, Running, noack_command, settings, wait_for

FLOOD_S = 1.5
on_linux = pytest.mark.skipif(sys.platform != "linux", reason="only Linux sheds foreign datagrams")


def set_parameters(*words: str) -> dict[str, Any]:
    done = subprocess.run(
        noack_command("set", "--json", *words), capture_output=True, text=True, check=False,
        timeout=PATIENCE_S,
    )  # fmt: skip
    answer: dict[str, Any] = json.loads(done.stdout)
    assert done.returncode == answer.get("exit", {"status": 0})["status"], done.stderr
    return answer


def flood(running: Running) -> None:
    """Send as many datagrams as possible to every port of the loop."""
    ports = [str(running.udp_port(role)) for role in LOOP_ROLES]
    command = command_of("flood", FLOOD_S, 0, *ports)
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, timeout=60)


@on_linux
def test_a_run_is_changed_twice_and_survives_a_flood(
    start: Callable[..., Running], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    running = start(*settings(horizon_s=1000.0))
    running.wait_recording()
    refused = CliRunner().invoke(app, ["summary", str(running.runs / "latest")])
    assert refused.exit_code == 2
    assert "still under way" in refused.stderr
    flood(running)

    run = run_registry.find()
    first = set_parameters("loss.p", "0.5", "mansd=2")
    second = set_parameters("setpoint", "[0.0, 0.0, 0.0, 1.0]")
    assert second["runtime_parameters"]["network.mansd"] == 2
    invalid = set_parameters("loss.p", "1.5")
    assert invalid["exit"]["status"] == 2
    assert "should be less than or equal to 1" in invalid["error"]
    wait_for(lambda: run_registry.request_change(run, {}).t_s > second["from_s"] + 1)
    running.process.send_signal(signal.SIGTERM)
    finished = running.finish()

    summary, record = finished.summary, load_record(finished.run_dir)
    assert finished.status == 143, finished.stderr
    assert summary["exit"]["reason"] == "stopped on request (SIGTERM)"
    until_s = summary["loops"][0]["judged_until_s"]
    assert 0 < until_s <= summary["reached_s"] + 0.1
    assert all((claim["since_s"] or 0.0) <= until_s for claim in summary["loops"][0]["claims"])
    assert [one for one in summary["loops"][0]["claims"] if one["verdict"] == "violated"] == []
    assert summary["loops"][0]["missing_samples"] == summary["loops"][0]["unintended_losses"] == 0
    assert summary["loops"][0]["replay"]["bit_exact"]
    assert summary["loops"][0]["replay"]["complete"]
    assert summary["loops"][0]["identity_residual_relative"] < 1e-9
    assert set(summary["loops"][0]["realtime"]) == set(LOOP_ROLES)
    assert running.left_behind() == []

    assert [one["t_s"] for one in summary["changes"]] == [first["from_s"], second["from_s"]]
    assert summary["changes"][1]["settings"] == {"controller.setpoint": [0.0, 0.0, 0.0, 1.0]}
    assert record.scenario.network.mansd == 4  # as it was at the start
    changes = [one["text"] for one in record.notices if one["level"] == "change"]
    assert len(changes) == 2
    assert all("; requested at " in text for text in changes)
    if not any(one.late for one in changes_of(record)):  # a late change is a recorded violation
        causes = {one["cause"] for one in summary["loops"][0]["assumption_violations"]}
        assert not causes & {"dropouts", "change"}
    assert [*(tmp_path / f"noack-{os.getuid()}" / "runs").iterdir()] == []

    begun = {line["process"] for line in record.notices if line["text"].startswith("flood:")}
    ended = {line["process"] for line in record.notices if line["text"].startswith("the flood is")}
    assert begun == ended == set(LOOP_ROLES)
    for role in LOOP_ROLES:
        channel = record.reports[role]["channel"]
        assert channel["rejected"][SHED] > 1000
        assert channel["kernel_drops"] == 0
        assert len(channel["received_from"]) <= 17
    assert summary["loops"][0]["rejected_datagrams"].keys() == set(LOOP_ROLES)
