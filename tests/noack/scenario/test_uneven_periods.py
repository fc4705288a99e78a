"""Periods that do not divide each other are said by check, by each run, and in the library."""

from typing import Any

import pytest

import noack
from noack.scenario.resolution import resolve
from noack.scenario.uneven_periods import uneven_periods

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
