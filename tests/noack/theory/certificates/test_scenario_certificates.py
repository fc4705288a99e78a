"""Certificates of scenarios: across the floor, where α is too large, in zero-order hold, as JSON.

tests/cosim/analysis/claims compares ``nominal_conditions`` with the machines.
"""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from noack.core.linear_systems import spectral_abscissa
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load, validate
from noack.theory.certificates.conditions import Constants
from noack.theory.certificates.assumptions import AssumptionStatus, assumptions
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import ideal_conditions, nominal_conditions
from noack.theory.certificates.scenario_certificates import box_scope, certify, own_plant_scope
from tests.noack.theory.certificates.certificate_kinds.policies import exceeded_by, scenario_with
from tests.noack.theory.certificates.certified_loops import conditions_of
from tests.oracles.lossy_loops import SEARCH, STEPS, System, Trace, networks, seeds, simulate, systems

ROOT = Path(__file__).parents[4]


def shipped(name: str = "lane_following", *overrides: str) -> Scenario:
    return resolve(load(ROOT / f"scenarios/{name}.toml", list(overrides)))


def scenario(system: System, *, floor: float = 0.0) -> Scenario:
    threshold = {"beta": system.beta, "alpha_per_s": system.alpha, "floor": floor}
    return scenario_with(system, threshold)


def certified(system: System, floor: float = 0.0) -> tuple[ScenarioCertificate, Constants]:
    certificate = certify(scenario(system, floor=floor), conditions_of(system))
    if certificate.constants is None:
        assume(False)
    assert certificate.constants is not None
    return certificate, certificate.constants


def run(system: System, seed: int, floor: float = 0.0) -> Trace:
    return simulate(system, *networks(seed, system), floor=floor)


LATE_INPUT = systems(hold_steps=4, lag_steps=2, step_share=0.03, beta=0.01)


@settings(SEARCH, max_examples=8)
@given(systems() | LATE_INPUT, st.sampled_from([0.002, 0.02, 0.1, 0.5, 0.9]), seeds)
def test_a_run_across_the_floor_exceeds_no_bound(system: System, share: float, seed: int) -> None:
    """t_ε lies anywhere in the run, also before the plant applies its first input."""
    floor = system.beta * math.exp(-system.alpha * share * STEPS * system.step_s)
    certificate, first = certified(system, floor)
    late = certificate.floor_constants
    assert late is not None
    # An event of the first phase may still be missing in the second.
    assert (late.inter_event_s or 0.0) <= (first.inter_event_s or 0.0)
    assert certificate.floor_from_s == pytest.approx(share * STEPS * system.step_s)
    assert exceeded_by(run(system, seed, floor), certificate, system) == []


@pytest.mark.parametrize("share", [0.0, 0.1, 2.0])
@settings(SEARCH, max_examples=3)
@given(system=systems(), factor=st.sampled_from([1.0, 1.5, 4.0]), seed=seeds)
def test_where_alpha_is_too_large_bounds_fall_more_slowly(
    system: System, factor: float, share: float, seed: int
) -> None:
    """With a floor, even if it is above β, they are constant and keep the events apart."""
    closed = system.A + system.B @ system.K
    rate = min(-spectral_abscissa(system.H), -spectral_abscissa(closed))
    system = replace(system, alpha=factor * rate)
    floor = share * system.beta
    certificate, constants = certified(system, floor)
    assert constants.rate_per_s < system.alpha
    assert (constants.rate_per_s == 0) == (floor > 0)
    assert (certificate.inter_event_s is None) == (floor == 0)
    assert AssumptionStatus.VIOLATED in [a.verdict for a in certificate.assumptions]
    assert exceeded_by(run(system, seed, floor), certificate, system) == []


def test_a_hold_under_the_papers_conditions_misses_m_thresholds() -> None:
    """‖e_c‖ ≤ Mβ: each of at most M missing jumps stays and is at most β."""
    resolved = shipped("lane_following", 'mode="zoh"')
    constants = certify(resolved, ideal_conditions(resolved)).constants
    assert constants is not None
    assert constants.delta == pytest.approx(5.0, rel=1e-9)
    assert constants.overshoot == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize("late_periods", [0, 2])
def test_the_networks_delay_adds_to_the_delay_of_updates(content: dict[str, Any], late_periods: int) -> None:
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


DELAYED = 'network.impairments=[{kind="delay",delay_s=0.2}]'


@pytest.mark.parametrize(
    ("overrides", "exists"),
    [
        ((DELAYED,), True),
        (("controller.safe_input=[5.0]",), True),
        (("controller.safe_input=[0.0]", DELAYED), True),
        (("controller.safe_input=[5.0]", DELAYED), False),  # ‖e_c‖ was 2.0 times its bound
        (("controller.safe_input=[5.0]", DELAYED, 'network.initial_sync="known_state"'), True),
    ],
)
def test_no_safe_input_may_come_before_the_first_update(overrides: tuple[str, ...], exists: bool) -> None:
    loop = shipped("double_integrator", *overrides)
    conditions = nominal_conditions(loop)
    scopes = own_plant_scope(loop), box_scope(loop)
    for scope in scopes:
        assert scope is not None
        assert scope.certificate(conditions).exists is exists
        assert (scope.loop_gain(conditions) < 1) is exists
        assert scope.certificate(ideal_conditions(loop)).exists
    certificate = certify(loop, conditions)
    assert exists or "controller.safe_input" in str(certificate.void)


@pytest.mark.parametrize(
    ("watchdog", "exists"),
    [
        ('{policy="hold", timeout_s=0.002}', True),
        ('{policy="zero"}', True),
        ('{policy="zero", timeout_s=0.002}', False),  # an input may be 5 ms old at a step
        ('{policy="model", timeout_s=0.0049}', False),
        ('{policy="zero", timeout_s=0.005}', True),
    ],
)
def test_no_watchdog_may_replace_an_input_that_is_not_too_old(watchdog: str, exists: bool) -> None:
    loop = shipped("double_integrator", f"plant.watchdog={watchdog}", "certificate.late_periods=2")
    conditions = nominal_conditions(loop, 2)
    assert conditions.hold_s == pytest.approx(0.007)
    certificate = certify(loop, conditions)
    assert certificate.exists is exists
    assert exists or "plant.watchdog.timeout_s" in str(certificate.void)


def test_events_that_are_due_may_come_as_soon_as_they_are_due() -> None:
    """Where measurements may be missing, the longest time between two events is longer."""
    trigger = 'trigger={policy="deadline", interval_s=0.04, rule={policy="absolute", delta=5.0}}'
    resolved = resolve(load(ROOT / "scenarios" / "double_integrator.toml", [trigger, "network.mansd=0"]))
    conditions = nominal_conditions(resolved)
    missing = conditions._replace(sampling_s=5 * conditions.spacing_s)
    for tested in (conditions, missing):
        assert own_plant_scope(resolved).certificate(tested).inter_event_s == pytest.approx(0.04)
