"""``noack doctor`` on the machine of the tests: that it measures, not the values."""

import json
import socket
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from cosim.cli import app
from cosim.doctor.machine_facts import requirements_of
from noack.config.resolution import resolve
from noack.config.scenario_file import load

SHORT = ("--seconds", "0.2", "--set", "ports={}")


def doctor(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["doctor", *arguments])


def test_every_check_gives_a_finding(tmp_path: Path) -> None:
    done = doctor(*SHORT, "--json", "--runs", str(tmp_path))
    said = json.loads(done.stdout)
    assert done.exit_code == (1 if said["verdict"] == "bad" else 0)
    measured = said["measured"]
    for name in ("plain", "realtime"):
        assert measured[name]["wakes"] > 0, measured[name]
        assert measured[name]["p50_us"] <= measured[name]["max_us"]
    assert measured["round_trips"]["sent"] == 1000
    assert measured["buffer"]["datagrams"] > 100
    assert measured["control"] > 0
    assert measured["disk"]["write_bytes_per_s"] > 0
    assert set(measured["granted"]) >= {"sched_fifo", "memory_lock"}
    assert {one["verdict"] for one in said["findings"]} <= {"good", "limited", "bad"}
    assert not list(tmp_path.iterdir())


def test_a_taken_port_makes_a_run_impossible() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        done = doctor("--seconds", "0.1", "--set", f"ports={{plant={port}}}")
    assert done.exit_code == 1
    assert str(port) in done.stdout
    assert "already taken" in " ".join(done.stdout.split())


def test_the_requirements_of_a_scenario_are_in_wall_time() -> None:
    wanted = requirements_of(resolve(load(Path("scenarios/lane_following.toml"), ["speed=4"])))
    assert (wanted.duration_s, wanted.period_ns, wanted.allowance_ns) == (5.0, 500_000, 1_000_000)
    assert wanted.rate_hz == 2000
    assert set(wanted.ports) == {"plant", "sensor", "netem", "controller"}


@pytest.mark.parametrize("arguments", [("--seconds", "0"), ("no_such_scenario",)])
def test_invalid_arguments_are_refused(arguments: tuple[str, ...]) -> None:
    done = doctor(*arguments)
    assert done.exit_code == 2
    assert len(done.stderr.splitlines()) == 1
