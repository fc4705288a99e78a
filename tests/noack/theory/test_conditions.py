"""The conditions of a scenario's schedule, and the largest times for which a certificate exists."""

import math
from collections.abc import Callable
from typing import Any

import pytest

from noack.impairments.kinds.delay import Delay
from noack.impairments.kinds.rate import Rate
from noack.impairments.link_settings import LinkSettings
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate
from noack.theory.certificates.assumptions import assumptions
from noack.theory.certificates.conditions import nominal_conditions
from noack.theory.certificates.scenario_certificates import MOST_S, largest


@pytest.mark.parametrize(
    ("impairments", "longest_s", "bounded"),
    [
        ((), 0.0, True),
        ((Delay(delay_s=0.01, jitter_s=0.002),), 0.012, True),
        ((Delay(delay_s=0.01), Delay(delay_s=0.02)), 0.03, True),
        ((Delay(delay_s=0.01, jitter_s=0.002, distribution="normal"),), 0.018, False),
        ((Delay(distribution="empirical", samples_s=(0.001, 0.005)),), 0.005, True),
        ((Rate(rate_bps=1_200_000, queue=10),), 0.1, False),
    ],
)
def test_the_longest_delay_of_a_network_follows_from_its_settings(
    impairments: tuple[Any, ...], longest_s: float, bounded: bool
) -> None:
    settings = LinkSettings(impairments=impairments)
    assert settings.longest_delay_s == pytest.approx(longest_s, rel=1e-12)
    assert settings.delay_is_bounded is bounded


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


def test_the_certified_delay_replaces_the_longest_one(content: dict[str, Any]) -> None:
    content["network"]["impairments"] = [{"kind": "delay", "delay_s": 0.02}]
    longest = nominal_conditions(resolve(validate(content, "here")), 2)
    content["network"]["impairments"] = [{"kind": "delay", "delay_s": 3.0}]
    content["certificate"] = {"network_delay_s": 0.02}
    resolved = resolve(validate(content, "here"))
    assert nominal_conditions(resolved, 2) == longest
    why = "; ".join(assumption.why for assumption in assumptions(resolved))
    assert "up to 3000 ms; the certificates allow for 20 ms" in why


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


def test_a_smooth_gain_needs_few_certificates() -> None:
    tried: list[float] = []
    largest(lambda value_s: tried.append(value_s) or 0.2 + 20 * value_s, 0.004)  # type: ignore[func-returns-value]
    assert len(tried) <= 10
