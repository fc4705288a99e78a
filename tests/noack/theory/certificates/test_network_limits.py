"""The search for the largest time, with loop gains that grow in many ways."""

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import cast

import pytest

from noack.theory.bounds.certificate_terms import NetworkConditions
from noack.theory.certificates.conditions import nominal_conditions
from noack.theory.certificates.network_limits import (
    MOST_S,
    largest_stable_time_s,
    network_limit,
    network_limits,
)
from noack.theory.certificates.scenario_certificates import CertificateScope, own_plant_scope
from tests.helpers.shipped import resolved

GAINS: dict[str, Callable[[float], float]] = {
    "proportional": lambda share: share,
    "steep": lambda share: share**9,
    "exponential": lambda share: math.exp(min(share, 500.0) - 1),
    "unknown above": lambda share: share if share < 1 else math.inf,
    "in steps": lambda share: 0.3 + 0.8 * math.floor(share),
    "without a gain": lambda share: 0.0 if share < 1 else 5.0,
}


@pytest.mark.parametrize("name", GAINS)
@pytest.mark.parametrize("limit_s", [3e-6, 0.04, 3.0])
@pytest.mark.parametrize("usual_s", [0.0, 1.0])
def test_the_limit_is_found_to_its_resolution(name: str, limit_s: float, usual_s: float) -> None:
    tried: list[float] = []

    def gain(value_s: float) -> float:
        tried.append(value_s)
        return GAINS[name](value_s / limit_s)

    assert (1 - 1.1e-3) * limit_s <= largest_stable_time_s(gain, usual_s) < limit_s
    assert len(tried) < 40


class Bumpy:
    """A scope without a certificate at 0.123 s, for its loop gain or ``other_reason``."""

    has_observer, test_times_s = False, ()

    def __init__(self, *, other_reason: bool) -> None:
        self.other_reason = other_reason

    def loop_gain(self, conditions: NetworkConditions) -> float:
        longest_s = max(conditions.sampling_s, conditions.delay_s, conditions.hold_s)
        return 1.1 if longest_s == 0.123 and not self.other_reason else longest_s / 0.1234

    def certificate(self, conditions: NetworkConditions) -> SimpleNamespace:
        return SimpleNamespace(exists=0.123 not in conditions)


@pytest.mark.parametrize("other_reason", [False, True])
def test_a_printed_limit_was_certified_as_it_is_printed(other_reason: bool) -> None:
    scheduled = NetworkConditions(3, sampling_s=0.002, spacing_s=0.002, delay_s=0.006, hold_s=0.007)
    scope = cast(CertificateScope, Bumpy(other_reason=other_reason))
    for limit_s in network_limits(scope, scheduled):
        assert limit_s is not None
        assert limit_s == float(f"{limit_s:.3g}")
        changed = scheduled._replace(sampling_s=limit_s)
        assert scope.loop_gain(changed) < 1
        assert scope.certificate(changed).exists
        assert 0.12 <= limit_s < 0.123


def test_all_times_or_none_may_have_a_certificate() -> None:
    assert largest_stable_time_s(lambda value_s: 0.5, 0.01) == MOST_S
    assert largest_stable_time_s(lambda value_s: math.inf, 0.01) == 0.0


def test_no_shorter_sampling_period_makes_an_update_too_late() -> None:
    """With tests of three quarters of the period, updates are half a period further apart."""
    scenario = resolved("double_integrator", 'trigger={policy="periodic", period_s=0.165}')
    scope, scheduled = own_plant_scope(scenario), nominal_conditions(scenario)

    def gain(t_s: float) -> float:
        return scope.loop_gain(scheduled._replace(sampling_s=t_s, spacing_s=t_s))

    limit_s = network_limit(scope, scheduled, "sampling")
    assert gain(0.48 * 0.165) < 1 < gain(0.75 * 0.165)
    assert gain(1.44 * 0.165) < 1
    assert 0.48 * 0.165 < limit_s < 0.5 * 0.165
