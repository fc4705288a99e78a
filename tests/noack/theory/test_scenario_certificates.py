"""Certificates of scenarios: across the floor, where α is too large, in zero-order hold, as JSON.

tests/cosim/analysis/claims compares ``nominal_conditions`` with the machines.
"""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_continuous_lyapunov

from noack.core.linear_systems import spectral_abscissa
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario, loops_of
from noack.scenario.scenario_file import load, validate
from noack.theory.bounds.gains import ErrorGains
from noack.theory.bounds.terms import Constants, NetworkConditions
from noack.theory.certificates.assumptions import AssumptionStatus
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import (
    allowed_conditions,
    ideal_conditions,
)
from noack.theory.certificates.scenario_certificates import box, certify, certify_box, own_plant
from noack.theory.certificates.solution import completed
from noack.theory.paper import theorem_2
from tests.oracles.lossy_loops import (
    ROUNDING,
    SEARCH,
    STEPS,
    System,
    Trace,
    networks,
    seeds,
    simulate,
    systems,
    times_s,
)

ROOT = Path(__file__).parents[3]


def shipped(name: str = "lane_following", *overrides: str) -> Scenario:
    return resolve(load(ROOT / f"scenarios/{name}.toml", list(overrides)))


def scenario(system: System, *, floor: float = 0.0) -> Scenario:
    """The system's matrices; the rates have no effect where conditions are given."""
    mode = "model" if system.H.any() else "zoh"
    model = system.H - system.B @ system.K if mode == "model" else system.A
    content: dict[str, Any] = {
        "name": "random", "horizon_s": 1.0, "mode": mode,
        "model": {"A": model.tolist(), "B": system.B.tolist(), "gain": system.K.tolist()},
        "plant": {
            "draw": "given", "A": system.A.tolist(), "B": system.B.tolist(),
            "initial_state": system.x0.tolist(),
        },
        "trigger": {
            "beta": system.beta, "alpha_per_s": system.alpha, "weight": system.weight.tolist(),
            "floor": floor,
        },
        "network": {"mansd": system.mansd, "loss": {"model": "worst_case"}},
    }  # fmt: skip
    return resolve(validate(content, "test"))


def certified(system: System, floor: float = 0.0) -> tuple[ScenarioCertificate, Constants]:
    certificate = certify(scenario(system, floor=floor), system.conditions)
    if certificate.constants is None:
        assume(False)
    assert certificate.constants is not None
    return certificate, certificate.constants


def exceeded(system: System, certificate: ScenarioCertificate, trace: Trace) -> list[str]:
    """The envelopes that some run exceeds at some step, and the inter-event time."""
    t_s = times_s(system)
    bounds = {
        "e_s": (trace.sensor_error, certificate.sensor_error(t_s)),
        "e_c": (trace.controller_error, certificate.controller_error(t_s)),
        "x": (trace.state, certificate.state(t_s)),
    }
    found = [name for name, (seen, bound) in bounds.items() if not (seen <= bound * ROUNDING).all()]
    least_s = certificate.inter_event_s
    if least_s is not None and trace.inter_event_s < least_s / ROUNDING:
        found.append("inter-event time")
    return found


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
    assert exceeded(system, certificate, run(system, seed, floor)) == []


def late_start(mansd: int) -> System:
    """ẋ = u, u = −x_c, from a large x(0): x_s diverges from x until the first input is applied."""
    one = np.ones((1, 1))
    return System(
        A=0 * one, B=one, K=-one, H=-one, weight=one, x0=np.array([1000.0]), alpha=0.25, beta=1.0,
        known_start=True, mansd=mansd, step_s=0.01, sample_steps=1, delay_steps=0, hold_steps=1,
        lag_steps=1,
    )  # fmt: skip


@pytest.mark.parametrize("floor", [0.999, 0.9, 0.5])
def test_an_event_of_the_start_may_be_missing_long_after(floor: float) -> None:
    """The error at the first event, from the start, is far above the threshold; it is lost."""
    system = late_start(mansd=3)
    certificate, first = certified(system, floor)
    late = certificate.floor_constants
    assert late is not None
    assert late.overshoot >= first.overshoot * (1 - 1e-12)
    assert late.inter_event_s == first.inter_event_s == 0.01
    trace = run(system, 0, floor)
    assert trace.sensor_error.max() > 5
    assert exceeded(system, certificate, trace) == []


def test_a_loop_without_events_has_bounds_at_the_floor() -> None:
    """Exact model, no losses: no events, so the inter-event time is infinite."""
    content = scenario(
        System(
            A=np.array([[0.0, 1.0], [0.0, 0.0]]), B=np.array([[0.0], [1.0]]),
            K=np.array([[-1.0, -1.8]]), H=np.array([[0.0, 1.0], [-1.0, -1.8]]),
            weight=np.eye(2), x0=np.array([1e-3, 0.0]), alpha=0.25, beta=0.5, known_start=True,
            mansd=0, step_s=0.01, sample_steps=1, delay_steps=0, hold_steps=0, lag_steps=0,
        ),
        floor=0.45,
    )  # fmt: skip
    certificate = certify(content, NetworkConditions(0, sampling_s=1e-6, spacing_s=1e-6))
    assert certificate.constants is not None
    assert certificate.floor_constants is not None


@pytest.mark.parametrize("share", [0.0, 0.1, 2.0])
@settings(SEARCH, max_examples=4)
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
    assert exceeded(system, certificate, run(system, seed, floor)) == []


@pytest.mark.parametrize("share", [0.0, 1.5])
@settings(SEARCH, max_examples=4)
@given(system=systems(hold_steps=1), seed=seeds)
def test_a_hold_is_bounded(system: System, share: float, seed: int) -> None:
    """H = 0; the plant is the drawn system's closed-loop model."""
    held = replace(system, H=np.zeros_like(system.H))
    floor = share * system.beta
    certificate, constants = certified(held, floor)
    assert constants.rate_per_s == 0
    assert certificate.floor_constants is None
    assert (certificate.inter_event_s is None) == (floor == 0)
    assert exceeded(held, certificate, run(held, seed, floor)) == []


def test_a_hold_under_the_papers_conditions_misses_m_thresholds() -> None:
    """‖e_c‖ ≤ Mβ: each of at most M missing jumps stays and is at most β."""
    resolved = shipped("lane_following", 'mode="zoh"')
    constants = certify(resolved, ideal_conditions(resolved)).constants
    assert constants is not None
    assert constants.delta == pytest.approx(5.0, rel=1e-9)
    assert constants.overshoot == pytest.approx(1.0, rel=1e-12)


def test_a_void_certificate_gives_the_reason_and_no_bounds() -> None:
    no_gain = ["model.gain=[[0,0,0,0],[0,0,0,0]]", "model.allow_unstable=true"]
    resolved = shipped("lane_following", *no_gain)
    found = certify(resolved, ideal_conditions(resolved))
    assert found.constants is None
    assert "grows" in str(found.void)
    assert found.inter_event_s is None
    for envelope in (found.sensor_error, found.controller_error, found.state):
        assert np.isnan(envelope(np.linspace(0, 9, 4))).all()
    assert (found.assumptions[-2].what, found.assumptions[-2].verdict) == (
        "there is a certificate", AssumptionStatus.VIOLATED,
    )  # fmt: skip
    assert "not below 1" in str(certify(shipped(), NetworkConditions(4, 0.5, 0.5)).void)


def test_the_assumptions_are_checked_for_the_scenario() -> None:
    resolved = shipped()
    found = certify(resolved, NetworkConditions(4, 0.002, 0.002, 0.004, 0.005, 0.004))
    verdicts = [assumption.verdict for assumption in found.assumptions]
    assert verdicts == [AssumptionStatus.HOLDS] * 4 + [AssumptionStatus.ASSUMED] * 4 + [
        AssumptionStatus.HOLDS, AssumptionStatus.NOT_NEEDED,
    ]  # fmt: skip
    free = resolved.network.model_copy(update={"enforce_mansd": False})
    found = certify(resolved.model_copy(update={"network": free}), ideal_conditions(resolved))
    assert found.assumptions[3].verdict == AssumptionStatus.ASSUMED


def test_the_lane_example_in_a_weight_from_any_lyapunov_function() -> None:
    """Δ = M = 5, exactly; and δ is at least 100 times the 60 µs of the paper's formula."""
    resolved = shipped()
    loop, plain = loop_of(resolved), certify(resolved, ideal_conditions(resolved)).constants
    assert plain is not None
    paper = theorem_2(loop, 0.5, 0.25, plain.delta)
    assert paper is not None
    assert paper.inter_event_s == pytest.approx(60.3e-6, rel=0.01)
    P = solve_continuous_lyapunov((loop.H + 0.25 * np.eye(4)).T, -np.eye(4))
    W = np.linalg.cholesky(P).T
    W /= np.linalg.det(W) ** 0.25
    trigger = resolved.trigger.model_copy(update={"weight": tuple(map(tuple, W.tolist()))})
    weighted = resolved.model_copy(update={"trigger": trigger})
    constants = certify(weighted, ideal_conditions(weighted)).constants
    assert constants is not None
    assert constants.delta == pytest.approx(5.0, rel=1e-9)
    for found in (plain, constants):
        assert found.inter_event_s is not None
        assert found.inter_event_s >= 100 * paper.inter_event_s


def test_a_threshold_without_an_inter_event_time_is_rejected_in_few_steps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls, growths = 0, ErrorGains.growths

    def counted(*arguments: Any) -> Any:
        nonlocal calls
        calls += 1
        return growths(*arguments)

    monkeypatch.setattr(ErrorGains, "growths", counted)
    resolved = shipped("lane_following", "trigger.beta=5e-324")
    for found in (certify, certify_box):
        certificate = found(resolved, ideal_conditions(resolved))
        assert certificate is not None
        assert (certificate.constants is None) == (certificate.void is not None)
    assert calls < 500


LOOPS = 'loops=[{name="loop", count=2}]'


@pytest.mark.parametrize(
    "files",
    [
        {"lane_following": ["trigger.floor=0.001", LOOPS]},
        {
            "tabuada_dynamic": ["plant.initial_state_halfwidth=[0.2, 0.1]", LOOPS],
            "different_loops": [],
        },
        {"lane_crosswind": ["horizon_s=10", LOOPS], "different_loops": []},
    ],
    ids=" and ".join,
)
def test_certificates_that_are_computed_together_are_those_of_each_loop(
    files: dict[str, list[str]],
) -> None:
    loops = [
        resolve(loop)
        for name, overrides in files.items()
        for loop in loops_of(load(ROOT / f"scenarios/{name}.toml", overrides))
    ]
    scopes = [
        (scope, allowed_conditions(loop))
        for loop in loops
        for scope in (own_plant(loop), box(loop))
        if scope is not None
    ]
    found = completed([scope.search(conditions) for scope, conditions in scopes])
    assert any(one.constants is not None for one in found)
    for together, (scope, conditions) in zip(found, scopes, strict=True):
        assert_equal_to_rounding(together.to_json(), scope.certificate(conditions).to_json())


def assert_equal_to_rounding(found: Any, expected: Any) -> None:
    """Sums over grids that end at different times are rounded differently."""
    if isinstance(expected, dict):
        assert found.keys() == expected.keys()
        for key, value in expected.items():
            assert_equal_to_rounding(found[key], value)
    elif isinstance(expected, list | tuple):
        for one, other in zip(found, expected, strict=True):
            assert_equal_to_rounding(one, other)
    elif isinstance(expected, float):
        assert found == pytest.approx(expected, rel=1e-12, abs=0.0)
    else:
        assert found == expected
