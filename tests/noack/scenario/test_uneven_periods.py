"""Periods that do not divide each other are said by check, by each run, and in the library."""

from pathlib import Path
from typing import Any

import pytest
import tomli_w

import noack
from noack.scenario.resolution import resolve
from noack.scenario.uneven_periods import uneven_periods
from tests.helpers.command_line import invoke

PERIODIC = {"trigger": {"policy": "periodic", "period_s": 0.0031}, "horizon_s": 0.2}
SENT = "trigger.period_s: updates are sent at measurements, every 0.004 s, not 0.0031 s"
WAITS = "controller.rate_hz: inputs take effect at steps of the plant, up to 0.002 s later"


@pytest.mark.parametrize(("settings", "expected"), [
    ({}, []),
    ({"trigger": {"policy": "periodic", "period_s": 0.004}}, []),
    ({"controller": {"rate_hz": 50.0}}, []),
    ({"controller": {"rate_hz": 1000.0}}, []),
    (PERIODIC, [SENT]),
    ({"controller": {"rate_hz": 200.0}}, [WAITS]),
    ({"trigger": {"policy": "deadline", "interval_s": 0.0031, "rule": {**PERIODIC["trigger"]}}},
     ["trigger.interval_s: the deadline ends at a measurement, after 0.004 s",
      SENT.replace(".", ".rule.", 1)]),
    ({"plant.measure_every": 3, "trigger": {"policy": "periodic", "period_s": 0.008}},
     ["trigger.period_s: updates are sent at measurements, every 0.012 s, not 0.008 s"]),
])  # fmt: skip
def test_periods_that_divide_no_other_are_found(settings: dict[str, Any], expected: list[str]) -> None:
    found = uneven_periods(resolve(noack.load("lane_following", settings)))
    assert len(found) == len(expected)
    assert all(line.startswith(start) for line, start in zip(found, expected, strict=True))


def test_check_and_each_run_say_them(tmp_path: Path) -> None:
    path = tmp_path / "uneven.toml"
    path.write_text(
        tomli_w.dumps(noack.load("lane_following", PERIODIC).model_dump(mode="json", exclude_none=True))
    )
    assert SENT in " ".join(invoke("check", path).stdout.replace("\n# ", " ").split())
    simulated = invoke("simulate", path, "--runs", tmp_path / "runs", "--no-report")
    assert f"noack: warning: {SENT}\n" in simulated.stderr
    assert f"warning: {SENT}" in simulated.stdout
    assert SENT not in invoke("simulate", path, "--trigger", "continuous").stderr
    run = noack.open_run(tmp_path / "runs" / "latest")
    assert run.summary.loops[0].uneven_periods == [SENT]
    assert SENT in repr(run)


def test_loops_of_a_shared_network_say_them(tmp_path: Path) -> None:
    settings = {**PERIODIC, "loops": [{"name": "even", "trigger": {"period_s": 0.004}}, {"name": "uneven"}]}
    run = noack.simulate(noack.load("lane_following", settings))
    assert [loop.uneven_periods for loop in run.summary.loops] == [[], [SENT]]
    assert SENT in repr(run)
