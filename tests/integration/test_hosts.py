"""Runs across hosts: two network namespaces with a link between them."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.record.run_record import load_record, load_run
from noack.core.clock import NS_PER_S
from noack.core.errors import MachineError
from noack.protocol.record_tables import CLOCK_TABLES, LOST_NS, OWNER
from noack.protocol.roles import LOOP_ROLES
from noack.scenario.scenario import phases_ns
from tests.helpers import live_runs as live
from tests.helpers.command_line import invoke
from tests.helpers.live_runs import Start, wait_for_end
from tests.helpers.two_hosts import TwoHosts, two_hosts

pytestmark = pytest.mark.system

INVITED = ("--invitation", "invitation.json")
ROOMY = "clocks.largest_error_us=1000000"
"""A busy machine gives wide bounds."""


@pytest.fixture(scope="module")
def hosts() -> Iterator[TwoHosts]:
    if sys.platform != "linux" or os.geteuid() != 0:
        pytest.skip("only root can make network namespaces")
    try:
        with two_hosts() as made:
            yield made
    except MachineError as error:
        pytest.skip(f"no network namespaces here: {error}")


@pytest.fixture
def start(hosts: TwoHosts, tmp_path: Path) -> Iterator[Start]:
    """Start a command of noack on a host, with a runtime directory of the host's own."""
    with live.start_commands() as begin:

        def on(host: int, *arguments: str, ahead_s: int = 0, **more: Any) -> subprocess.Popen[str]:
            runtime = tmp_path / f"host {host}"
            runtime.mkdir(exist_ok=True)
            before = hosts.inside(host, monotonic_s=ahead_s)
            return begin(*arguments, before=before, runtime=runtime, cwd=tmp_path, **more)

        yield on


def record(
    start: Start, folder: Path, host: str, *more: str, impatient: bool = False
) -> subprocess.Popen[str]:
    """Open a run on the first host; return when it can be joined."""
    scenario = live.settings(horizon_s=4.0)
    process = start(
        0, "record", "lane_following", "--listen", host, "--json", *live.BARE, *live.AT_RATE,
        *scenario, *more, impatient=impatient,
    )  # fmt: skip
    invitation = folder / "invitation.json"
    live.wait_for(lambda: invitation.exists() or process.poll() is not None)
    assert process.poll() is None, process.communicate()
    return process


def start_processes(start: Start, *away: str, **more: int) -> list[subprocess.Popen[str]]:
    """Start all processes of the loop, these on the second host, with the invitation."""
    return [
        start(1, role, "--json", *INVITED, **more) if role in away else start(0, role, "--json")
        for role in LOOP_ROLES
    ]


def end_well(*processes: subprocess.Popen[str]) -> list[Any]:
    """Wait for the processes' ends, with status 0; return what they printed as JSON."""
    outputs = []
    for process in processes:
        stdout, stderr = wait_for_end(process)
        assert process.returncode == 0, stderr
        assert "are kept in" not in stderr
        outputs.append(json.loads(stdout))
    return outputs


SEVERAL = f"""
name = "three"
horizon_s = 4.0

{live.PENDULUM}
[clocks]
largest_error_us = 1e6  # a busy machine gives wide bounds

[[loops]]
name = "one"

[[loops]]
name = "late"
count = 2
phase = 0.5
"""
AHEAD_S = 3


def test_several_loops_run_on_hosts_with_different_clocks(
    start: Start, hosts: TwoHosts, tmp_path: Path
) -> None:
    (_, first_host), (_, second_host) = hosts.addresses  # of IPv6
    (tmp_path / "three.toml").write_text(SEVERAL)
    recording = start(0, "record", "three.toml", "--listen", first_host, "--json", *live.BARE)
    live.wait_for(lambda: (tmp_path / "invitation.json").exists() or recording.poll() is not None)
    assert recording.poll() is None, recording.communicate()
    processes = start_processes(start, "netem", "controller", ahead_s=AHEAD_S)
    *reports, summary = end_well(*processes, recording)
    addresses = {report["channel"]["local"].rpartition(":")[0].strip("[]") for report in reports}
    assert addresses == {first_host, second_host}
    assert not (tmp_path / "invitation.json").exists()
    assert summary["network"]["replay"]["bit_exact"]
    for loop in summary["loops"]:
        live.assert_complete(loop)
        assert 0 < loop["conditions"]["clock_error_s"] < 1
    run = load_run((tmp_path / "runs" / "latest").resolve())
    phase_ns = phases_ns(run.scenario)[1]
    assert phase_ns > 0
    for table in CLOCK_TABLES:
        undelayed, late, _ = (record[table] for record in run.loops)
        assert len(undelayed) > 0
        assert (undelayed["t_ns"] - late["t_ns"] == phase_ns).all()  # each loop has its own time
        known = undelayed[undelayed["error_ns"] != LOST_NS]
        true_ns = -AHEAD_S * NS_PER_S * (OWNER[table] in ("netem", "controller"))
        assert (np.abs(known["offset_ns"] - true_ns) <= known["error_ns"]).all()


@pytest.mark.usefixtures("no_report", "no_recording")
def test_rows_of_a_host_that_was_cut_off_are_collected(start: Start, hosts: TwoHosts, tmp_path: Path) -> None:
    """The link goes down in the run; its processes work on and keep their rows and reports."""
    recording = record(start, tmp_path, "10.83.3.1", *live.settings(horizon_s=8.0), impatient=True)
    at_home = [start(0, role) for role in ("plant", "sensor")]
    kept = ("--runs", str(tmp_path / "kept"))
    away = [start(1, role, *INVITED, *kept, impatient=True) for role in ("netem", "controller")]
    run_dir = wait_recorded(tmp_path)
    with _cut_off(hosts):
        errors = {process: wait_for_end(process)[1] for process in (*away, *at_home)}
        wait_for_end(recording)
    assert recording.returncode == 1
    steps = len(load_record(run_dir)["controller_step"])
    assert 0 < steps < 8 * live.RATE_HZ
    folder = tmp_path / "kept" / run_dir.name
    for process in away:
        assert f"are kept in {folder} " in errors[process]
    result = invoke("collect", run_dir, "nohost.invalid:kept")
    assert result.exit_code in (1, 2)
    assert result.stderr.startswith("noack: nohost.invalid:kept: ")
    result = invoke("collect", run_dir, folder, "--json")
    assert result.exit_code == 0, result.stderr
    replay = json.loads(result.stdout)["loops"][0]["replay"]
    assert replay["bit_exact"]
    assert replay["complete"]
    assert len(load_record(run_dir)["controller_step"]) == 8 * live.RATE_HZ


def wait_recorded(folder: Path) -> Path:
    """Wait until rows of the controller have been recorded; return the run directory."""
    run_dir = folder / "runs" / "latest"
    spooled = run_dir / "spool" / "controller_step.recorder"
    live.wait_for(lambda: spooled.exists() and spooled.stat().st_size > 5000)
    return run_dir.resolve()


def test_a_host_that_comes_back_loses_no_row(start: Start, hosts: TwoHosts, tmp_path: Path) -> None:
    """The link is down until the recorder has given the other host's processes up for lost."""
    sets = (*live.settings(horizon_s=20.0), "--set", ROOMY)
    recording = record(start, tmp_path, "10.83.3.1", *sets, impatient=True)
    processes = start_processes(start, "netem", "controller", ahead_s=AHEAD_S)
    wait_recorded(tmp_path)
    assert recording.stderr is not None
    with _cut_off(hosts):
        lines = (line for line in recording.stderr if "stopped responding" in line)
        lost = dict(line.split(maxsplit=1) for line in islice(lines, 2))
    assert set(lost) == {"netem", "controller"}
    *_, summary = end_well(*processes, recording)
    (loop,) = summary["loops"]
    assert loop["replay"]["complete"]
    assert loop["replay"]["bit_exact"]
    assert loop["unintended_losses"] > 0
    assert {"void"} <= {claim["verdict"] for claim in loop["claims"]} <= {"void", "not applicable"}
    run_record = load_record((tmp_path / "runs" / "latest").resolve())
    assert len(run_record["controller_step"]) == 20 * live.RATE_HZ
    # Without the reference of time, the bound of the clock's error is lost, and all claims with it.
    assert (run_record["controller_clock"]["error_ns"] == LOST_NS).any()
    assert "controller clock lost" in {violation["cause"] for violation in loop["assumption_violations"]}


@contextmanager
def _cut_off(hosts: TwoHosts) -> Iterator[None]:
    """Take the link down meanwhile."""
    command = ["ip", "-n", hosts.names[1], "link", "set", "line"]
    subprocess.run([*command, "down"], check=True)
    try:
        yield
    finally:
        subprocess.run([*command, "up"], check=True)
