"""``noack doctor`` on the machine of the tests: that it measures, not the values."""

import json
import socket
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from cosim.cli import app
from cosim.doctor.machine_measures import requirements_of
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load


def doctor(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["doctor", *arguments])


def test_every_check_gives_a_finding_and_a_taken_port_makes_a_run_impossible(
    tmp_path: Path,
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        ports = ("--set", f"ports={{plant={port}}}")
        done = doctor("--seconds", "0.1", *ports, "--json", "--runs", str(tmp_path))
    document = json.loads(done.stdout)
    assert (done.exit_code, document["verdict"]) == (1, "bad")
    (finding,) = [one for one in document["findings"] if one["what"].startswith("ports of")]
    assert finding["verdict"] == "bad"
    assert str(port) in finding["found"]
    assert "already taken" in finding["found"]
    measured = document["measured"]
    for name in ("plain", "realtime"):
        assert measured[name]["wakes"] > 0, measured[name]
        assert measured[name]["p50_us"] <= measured[name]["max_us"]
    assert measured["round_trips"]["sent"] == 1000
    assert measured["buffer"]["datagrams"] > 100
    assert measured["control"] > 0
    assert measured["disk"]["write_bytes_per_s"] > 0
    assert set(measured["granted"]) >= {"sched_fifo", "memory_lock"}
    assert {one["verdict"] for one in document["findings"]} <= {"good", "limited", "bad"}
    assert not list(tmp_path.iterdir())


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
