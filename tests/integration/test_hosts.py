"""Runs across hosts: two network namespaces with a link between them."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from cosim.record.run_record import load_record, load_run
from netem.core.errors import MachineError
from noack.protocol.roles import LOOP_ROLES
from tests.helpers import live_runs as live
from tests.helpers.command_line import invoke
from tests.helpers.live_runs import Start, wait_for_end
from tests.helpers.two_hosts import TwoHosts, two_hosts
from tests.integration.impatient import LEASE_S

pytestmark = [pytest.mark.live, pytest.mark.system]

AHEAD_S = 3
"""The monotonic clock of the second host is ahead by this: it is another clock."""
LISTEN = "10.83.3.1"


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

        def on(host: int, *arguments: str, **more: Any) -> subprocess.Popen[str]:
            runtime = tmp_path / f"host {host}"
            runtime.mkdir(exist_ok=True)
            before = hosts.inside(host, monotonic_s=AHEAD_S * host)
            return begin(*arguments, before=before, runtime=runtime, cwd=tmp_path, **more)

        yield on


def record(
    start: Start, folder: Path, *more: str, scenario: str = "lane_following", **options: Any
) -> subprocess.Popen[str]:
    """Open a run on the first host; return when it can be joined."""
    process = start(0, "record", scenario, "--listen", LISTEN, "--json", *live.BARE, *more, **options)
    live.wait_for(lambda: (folder / "credentials").exists() or process.poll() is not None)
    assert process.poll() is None, process.communicate()
    return process


def start_away(start: Start, role: str, *more: str, **options: Any) -> subprocess.Popen[str]:
    """Start a process on the second host, with its credentials."""
    return start(1, role, "--json", "--credentials", f"credentials/{role}", *more, **options)


def start_processes(start: Start, *away: str, **options: Any) -> list[subprocess.Popen[str]]:
    """Start all processes of the loop, these on the second host."""
    return [
        start_away(start, role, **options) if role in away else start(0, role, "--json")
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


def chronyc(folder: Path, line: str) -> dict[str, str]:
    """Return an environment in which chrony says this."""
    program = folder / "bin" / "chronyc"
    program.parent.mkdir(exist_ok=True)
    program.write_text(f"#!/bin/sh\necho '{line}'\n")
    program.chmod(0o755)
    return {"PATH": f"{program.parent}:{os.environ['PATH']}"}


TRACKING = "7F000001,a,2,0,{offset_s},0,0,0,0,0,0.0002,0.0003,8,Normal"
SEVERAL = f"""
name = "three"
horizon_s = 2.0

{live.PENDULUM}
[[loops]]
name = "one"

[[loops]]
name = "late"
count = 2
phase = 0.5
"""


def test_several_loops_run_on_hosts_with_different_clocks(
    start: Start, hosts: TwoHosts, tmp_path: Path
) -> None:
    """Plant and sensor on one host; controller and network on the other, where there is no chrony."""
    (tmp_path / "three.toml").write_text(SEVERAL)
    with_chrony = chronyc(tmp_path, TRACKING.format(offset_s=0.0001))
    recording = record(start, tmp_path, scenario="three.toml", environment=with_chrony)
    *reports, summary = end_well(*start_processes(start, "netem", "controller"), recording)
    addresses = [report["channel"]["local"].rpartition(":")[0] for report in reports]
    assert addresses == [hosts.addresses[role in ("netem", "controller")][0] for role in LOOP_ROLES]
    assert not (tmp_path / "credentials").exists()
    assert summary["network"]["replay"]["bit_exact"]
    for loop in summary["loops"]:
        live.assert_complete(loop)
        assert loop["conditions"]["clock_error_s"] == 0.001  # as stated
        assert not loop["violations"]
    run = load_run((tmp_path / "runs" / "latest").resolve())
    clocks = next(iter(run.loops)).clocks
    assert {role: (clock.error_ns, clock.source) for role, clock in clocks.items()} == {
        "plant": (500_000, "chronyc tracking"),
        "sensor": (500_000, "chronyc tracking"),
        "netem": (1_000_000, "clocks.largest_error_us"),
        "controller": (1_000_000, "clocks.largest_error_us"),
    }
    assert len({clock.clock for clock in clocks.values()}) == 3  # each `unshare` makes a clock


@pytest.mark.usefixtures("hosts")
def test_a_clock_that_is_off_violates_causality(start: Start, tmp_path: Path) -> None:
    """The controller's host is 0.3 s ahead, though it states at most 1 ms."""
    recording = record(start, tmp_path, *live.settings(horizon_s=2.0))
    processes = start_processes(start, "controller", module="tests.integration.wall_clock_ahead")
    *_, summary = end_well(*processes, recording)
    (loop,) = summary["loops"]
    # The guarantee is held: it counts updates, without a clock.
    verdicts = {claim["verdict"] for claim in loop["claims"] if claim["kind"] != "guarantee"}
    assert verdicts <= {"ended", "unchecked", "not applicable"}
    clock = {claim["detail"] for claim in loop["claims"] if claim["cause"] == "clock"}
    assert clock == {"plant"}
    notices = load_record((tmp_path / "runs" / "latest").resolve()).notices
    during_run = [notice for notice in notices if "before it was sent" in notice["text"]]
    assert {(notice["process"], notice["level"]) for notice in during_run} == {("plant", "clock")}


def wait_recorded(folder: Path) -> Path:
    """Wait until rows of the controller have been recorded; return the run directory."""
    run_dir = folder / "runs" / "latest"
    spooled = run_dir / "spool" / "controller_step.recorder"
    live.wait_for(lambda: spooled.exists() and spooled.stat().st_size > 5000)
    return run_dir.resolve()


def test_a_partition_longer_than_the_lease_costs_no_row(
    start: Start, hosts: TwoHosts, tmp_path: Path
) -> None:
    """The loop works on while the recorder is out of reach; its rows arrive afterwards."""
    recording = record(start, tmp_path, *live.settings(horizon_s=8.0), impatient=True)
    processes = start_processes(start, "netem", "controller", impatient=True)
    wait_recorded(tmp_path)
    with _cut_off(hosts):
        time.sleep(LEASE_S + 1.0)
    *_, summary = end_well(*processes, recording)
    (loop,) = summary["loops"]
    assert loop["replay"]["complete"]
    assert loop["replay"]["bit_exact"]
    assert loop["missing_samples"] == 0
    assert loop["unintended_losses"] > 0
    ticks = load_record((tmp_path / "runs" / "latest").resolve())["controller_step"]
    assert len(ticks) == 8 * 500


def test_rows_of_a_host_that_stays_out_of_reach_are_added(
    start: Start, hosts: TwoHosts, tmp_path: Path
) -> None:
    """The link goes down in the run; its processes work on, and keep their rows and reports."""
    sets = (*live.settings(horizon_s=8.0), *live.AT_RATE)
    recording = record(start, tmp_path, *sets, impatient=True)
    at_home = [start(0, role) for role in ("plant", "sensor")]
    away = {
        role: start_away(start, role, "--runs", str(tmp_path / "kept"), impatient=True)
        for role in ("netem", "controller")
    }
    run_dir = wait_recorded(tmp_path)
    with _cut_off(hosts):
        errors = {role: wait_for_end(process)[1] for role, process in away.items()}
        for process in at_home:
            wait_for_end(process)
        stdout, _ = wait_for_end(recording)
    assert recording.returncode == 1
    (loop,) = json.loads(stdout)["loops"]
    steps = len(load_record(run_dir)["controller_step"])
    assert 0 < steps < 8 * live.RATE_HZ
    assert loop["missing_by_table"]["controller_step"] > 0
    shown = invoke("summary", run_dir)
    assert "samples are missing from the record" in shown.stdout
    assert "noack summary RUN --add FILE" in " ".join(shown.stdout.split())
    for role in away:
        kept = tmp_path / "kept" / run_dir.name / f"{role}.spool"
        assert f"rows are kept in {kept}" in errors[role]
        result = invoke("summary", run_dir, "--add", kept, "--json")
        assert result.exit_code == 0, result.stderr
    (loop,) = json.loads(result.stdout)["loops"]
    assert loop["replay"]["bit_exact"]
    assert loop["replay"]["complete"]
    assert loop["missing_samples"] == 0
    assert len(load_record(run_dir)["controller_step"]) == 8 * live.RATE_HZ


@contextmanager
def _cut_off(hosts: TwoHosts) -> Iterator[None]:
    """Take the link down meanwhile."""
    command = ["ip", "-n", hosts.names[1], "link", "set", "line"]
    subprocess.run([*command, "down"], check=True)
    try:
        yield
    finally:
        subprocess.run([*command, "up"], check=True)
