"""The conditions of a scenario's schedule, and the largest times for which a certificate exists."""

import math
from collections.abc import Callable
from typing import Any

import pytest

from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate
from noack.theory.certificates.assumptions import assumptions
from noack.theory.certificates.conditions import nominal_conditions
from noack.theory.certificates.scenario_certificates import MOST_S, largest


@pytest.mark.parametrize("late_periods", [0, 2])
def test_the_networks_delay_adds_to_the_delay_of_updates(
    content: dict[str, Any], late_periods: int
) -> None:
    at_once = nominal_conditions(resolve(validate(content, "here")), late_periods)
    content["network"]["impairments"] = [{"kind": "delay", "delay_s": 0.02, "jitter_s": 0.01}]
    resolved = resolve(validate(content, "here"))
    delayed = nominal_conditions(resolved, late_periods)
    step_s, tick_s = (
        resolved.timing.plant_period_ns * 1e-9,
        resolved.timing.controller_period_ns * 1e-9,
    )
    assert delayed.delay_s - at_once.delay_s == pytest.approx(0.03, abs=step_s + tick_s)
    assert delayed.delay_s >= 0.03 + late_periods * step_s
    # The input does not pass through this network.
    assert delayed.hold_s == at_once.hold_s
    assert any("up to 30 ms" in assumption.why for assumption in assumptions(resolved))


GAINS: dict[str, Callable[[float], float]] = {
    "proportional": lambda share: share,
    "steep": lambda share: share**9,
    "flat": lambda share: share**0.1,
    "offset": lambda share: 0.9 + 0.1 * share,
    "exponential": lambda share: math.exp(min(share, 500.0) - 1),
    "unknown above": lambda share: share if share < 1 else math.inf,
    "in steps": lambda share: 0.3 + 0.8 * math.floor(share),
    "without a gain": lambda share: 0.0 if share < 1 else 5.0,
}


@pytest.mark.parametrize("name", GAINS)
@pytest.mark.parametrize("limit_s", [3e-6, 2e-3, 0.04, 3.0])
@pytest.mark.parametrize("usual_s", [0.0, 2e-3, 1.0])
def test_the_limit_is_found_to_its_resolution(name: str, limit_s: float, usual_s: float) -> None:
    tried: list[float] = []

    def gain(value_s: float) -> float:
        tried.append(value_s)
        return GAINS[name](value_s / limit_s)

    assert (1 - 1.1e-3) * limit_s <= largest(gain, usual_s) < limit_s
    assert len(tried) < 40


def test_all_times_or_none_may_have_a_certificate() -> None:
    assert largest(lambda value_s: 0.5, 0.01) == MOST_S
    assert largest(lambda value_s: math.inf, 0.01) == 0.0
