"""Certificates of scenarios: across the floor, where α is too large, in zero-order hold, as JSON.

tests/cosim/analysis/claims compares ``nominal_conditions`` with the machines.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, assume, given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_continuous_lyapunov

from noack.config.resolution import loop_of, resolve
from noack.config.scenario import Scenario
from noack.config.scenario_file import load, validate
from noack.core.linear_systems import spectral_abscissa
from noack.theory.assumptions import AssumptionStatus
from noack.theory.certificate import Constants, NetworkConditions, VoidError
from noack.theory.gains import ErrorGains
from noack.theory.paper_bounds import theorem_2
from noack.theory.run_conditions import ideal_conditions
from noack.theory.scenario_certificates import OWN_PLANT, ScenarioCertificate, certify, certify_box
from tests.noack.theory.loops import STEPS, System, Trace, networks, simulate, systems, times_s

ROUNDING = 1 + 1e-9
ROOT = Path(__file__).parents[3]

SEARCH = settings(deadline=None, suppress_health_check=list(HealthCheck), phases=[Phase.generate])

seeds = st.integers(0, 2**32)


def scenario(system: System, *, mode: str = "model", **changes: Any) -> Scenario:
    """The system's matrices; the rates have no effect where conditions are given."""
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
        },
        "network": {"mansd": system.mansd, "loss": {"model": "worst_case"}},
    }  # fmt: skip
    for section, values in changes.items():
        content[section] |= values
    return resolve(validate(content, "test"))


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
    return simulate(system, *networks(np.random.default_rng(seed), system), floor=floor)


def standing(certificate: ScenarioCertificate) -> ScenarioCertificate:
    assume(certificate.constants is not None)
    return certificate


# --- the floor ------------------------------------------------------------------------------------


@settings(SEARCH, max_examples=12)
@given(systems(), st.floats(0.01, 0.9), seeds)
def test_a_run_across_the_floor_exceeds_no_bound(system: System, share: float, seed: int) -> None:
    """t_ε lies anywhere in the run: missing updates, inputs and growth concern both phases."""
    floor = system.beta * math.exp(-system.alpha * share * STEPS * system.step_s)
    certificate = certify(scenario(system, trigger={"floor": floor}), system.conditions)
    standing(certificate)
    first, late = certificate.constants, certificate.floor_constants
    assert first is not None
    assert late is not None
    # An event of the first phase may still be missing in the second.
    assert (late.inter_event_s or 0.0) <= (first.inter_event_s or 0.0)
    assert certificate.floor_from_s == pytest.approx(share * STEPS * system.step_s)
    assert exceeded(system, certificate, run(system, seed, floor)) == []


def late_start(mansd: int = 0) -> System:
    """ẋ = u, u = −x_c, from a large x(0): x_s diverges from x until the first input is applied."""
    one = np.ones((1, 1))
    return System(
        A=0 * one, B=one, K=-one, H=-one, weight=one, x0=np.array([1000.0]), alpha=0.25, beta=1.0,
        known_start=True, mansd=mansd, step_s=0.01, sample_steps=1, delay_steps=0, hold_steps=1,
        lag_steps=1,
    )  # fmt: skip


@settings(SEARCH, max_examples=12)
@given(systems(hold_steps=4, lag_steps=2, step_share=0.03, beta=0.01), st.floats(1e-3, 0.03), seeds)
def test_a_floor_may_begin_before_the_plant_feels_its_input(
    system: System, share: float, seed: int
) -> None:
    floor = system.beta * math.exp(-system.alpha * share * STEPS * system.step_s)
    certificate = standing(certify(scenario(system, trigger={"floor": floor}), system.conditions))
    assert exceeded(system, certificate, run(system, seed, floor)) == []


def test_an_event_of_the_start_may_be_missing_long_after() -> None:
    """The error at the first event, from the start, is far above the threshold; it is lost."""
    system = late_start(mansd=3)
    for floor in (0.999, 0.99, 0.9, 0.5):
        certificate = certify(scenario(system, trigger={"floor": floor}), system.conditions)
        late = certificate.floor_constants
        first = certificate.constants
        assert first is not None
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
        trigger={"floor": 0.45},
    )  # fmt: skip
    certificate = certify(content, NetworkConditions(0, sampling_s=1e-6, spacing_s=1e-6))
    assert certificate.constants is not None
    assert certificate.floor_constants is not None


def test_bounds_at_the_floor_are_constant_from_its_beginning_on() -> None:
    system = late_start()
    certificate = certify(scenario(system, trigger={"floor": 0.5}), system.conditions)
    late, from_s = certificate.floor_constants, certificate.floor_from_s
    assert late is not None
    assert late.rate_per_s == 0
    assert from_s == pytest.approx(math.log(2) / 0.25)
    t_s = np.array([from_s * (1 - 1e-9), from_s * (1 + 1e-9), from_s + 100])
    before, after, later = certificate.controller_error(t_s)
    assert certificate.constants is not None
    assert before == pytest.approx(certificate.constants.delta * 0.5)
    assert after == later == pytest.approx(late.delta * 0.5)


# --- α above the decay rates, and zero-order hold -----------------------------------------------


def too_fast(system: System, factor: float) -> System:
    """The same loop with a threshold that decays faster than the models and A + BK."""
    closed = system.A + system.B @ system.K
    rate = min(-spectral_abscissa(system.H), -spectral_abscissa(closed))
    return System(**{**system.__dict__, "alpha": factor * rate})


@settings(SEARCH, max_examples=12)
@given(systems(), st.sampled_from([1.0, 1.5, 4.0]), seeds)
def test_where_alpha_is_too_large_bounds_fall_more_slowly(
    system: System, factor: float, seed: int
) -> None:
    system = too_fast(system, factor)
    certificate = standing(certify(scenario(system), system.conditions))
    constants = certificate.constants
    assert constants is not None
    assert 0 < constants.rate_per_s < system.alpha
    assert constants.inter_event_s is None
    assert certificate.inter_event_s is None
    assert exceeded(system, certificate, run(system, seed)) == []
    verdicts = {a.what: a.verdict for a in certificate.assumptions}
    assert AssumptionStatus.VIOLATED in verdicts.values()


@settings(SEARCH, max_examples=8)
@given(systems(), st.floats(0.05, 2.0), seeds)
def test_where_alpha_is_too_large_a_floor_keeps_events_apart(
    system: System, share: float, seed: int
) -> None:
    """A floor above β is a floor, too."""
    system = too_fast(system, 1.5)
    floor = share * system.beta
    certificate = standing(certify(scenario(system, trigger={"floor": floor}), system.conditions))
    assert certificate.constants is not None
    assert certificate.constants.rate_per_s == 0
    assert certificate.inter_event_s is not None
    assert exceeded(system, certificate, run(system, seed, floor)) == []


@settings(SEARCH, max_examples=12)
@given(systems(hold_steps=1), st.sampled_from([0.0, 0.3, 1.5]), seeds)
def test_a_hold_is_bounded(system: System, share: float, seed: int) -> None:
    """H = 0; the plant is the drawn system's closed-loop model."""
    held = System(**{**system.__dict__, "H": np.zeros_like(system.H)})
    floor = share * system.beta
    certificate = standing(
        certify(scenario(held, mode="zoh", trigger={"floor": floor}), held.conditions)
    )
    constants = certificate.constants
    assert constants is not None
    assert constants.rate_per_s == 0
    assert certificate.floor_constants is None
    assert (certificate.inter_event_s is None) == (floor == 0)
    assert exceeded(held, certificate, run(held, seed, floor)) == []


def test_a_hold_under_the_papers_conditions_misses_m_thresholds() -> None:
    """‖e_c‖ ≤ Mβ: each of at most M missing jumps stays and is at most β."""
    resolved = resolve(load(ROOT / "scenarios/lane_following.toml", ['mode="zoh"']))
    constants = certify(resolved, ideal_conditions(resolved)).constants
    assert constants is not None
    assert constants.delta == pytest.approx(5.0, rel=1e-9)
    assert constants.overshoot == 1.0


# --- conditions -----------------------------------------------------------------------------------

HARDER = ("dropouts", "sampling_s", "delay_s", "hold_s", "start_s")


@settings(SEARCH, max_examples=12)
@given(systems(), st.sampled_from(HARDER), st.floats(0.05, 2.0))
def test_harder_conditions_never_have_better_bounds(
    system: System, harder: str, share: float
) -> None:
    """More dropouts, fewer tests, longer delay, older input, later start; the same grid of tests.

    δ is searched with a relative accuracy of 0.1 % and enclosed with 1 %.
    """
    easy = system.conditions
    more = {name: getattr(easy, name) + share * system.step_s for name in HARDER[1:]}
    more["dropouts"] = easy.dropouts + 1
    try:
        hard = system.certify(easy._replace(**{harder: more[harder]}))
    except VoidError:
        assume(False)
        raise
    found = system.certify(easy)
    for name in ("delta", "overshoot", "input_error", "state", "mismatch", "missing_events"):
        assert getattr(found, name) <= getattr(hard, name) * 1.01, name
    longest_s = 5 / system.alpha
    assert (found.inter_event_s or 0.0) >= min(hard.inter_event_s or 0.0, longest_s) * 0.98


# --- certificates of scenarios -------------------------------------------------------------------


@pytest.mark.parametrize("name", ["lane_following", "lane_weighted", "unstable_pendulum"])
def test_a_certificate_is_unchanged_by_json(name: str) -> None:
    resolved = resolve(load(ROOT / f"scenarios/{name}.toml"))
    for conditions in (
        ideal_conditions(resolved),
        NetworkConditions(4, 0.002, 0.002, 0.004, 0.005, 0.004),
    ):
        for found in (certify(resolved, conditions), certify_box(resolved, conditions)):
            assert found is not None
            document = json.loads(json.dumps(found.to_json(), allow_nan=False))
            assert NetworkConditions(**document["conditions"]) == conditions
            for key in ("constants", "floor_constants"):
                constants = getattr(found, key)
                if constants is None:
                    assert document[key] is None
                else:
                    assert Constants(**document[key]) == constants
            for key in (
                "scope",
                "beta",
                "alpha_per_s",
                "floor",
                "weighted",
                "void",
                "inter_event_s",
            ):
                assert document[key] == getattr(found, key)
            assert document["floor_from_s"] == (found.floor_from_s if found.floor else None)
            for written, assumption in zip(document["assumptions"], found.assumptions, strict=True):
                assert written == {**assumption._asdict(), "verdict": str(assumption.verdict)}


def test_a_scenario_with_a_box_has_a_box_certificate() -> None:
    resolved = resolve(load(ROOT / "scenarios/lane_following.toml"))
    conditions = ideal_conditions(resolved)
    own, box = certify(resolved, conditions), certify_box(resolved, conditions)
    assert box is not None
    assert own.scope == OWN_PLANT
    assert (own.source, box.source) == ("certificate", "box certificate")
    assert own.constants is not None
    assert box.constants is not None
    for name in ("delta", "state", "input_error"):
        assert getattr(box.constants, name) >= getattr(own.constants, name) * (1 - 1e-9)
    plain = resolved.plant.model_copy(update={"uncertainty_A": None, "uncertainty_B": None})
    assert certify_box(resolved.model_copy(update={"plant": plain}), conditions) is None


def test_a_void_certificate_gives_the_reason_and_no_bounds() -> None:
    resolved = resolve(
        load(
            ROOT / "scenarios/lane_following.toml",
            ["model.gain=[[0,0,0,0],[0,0,0,0]]", "model.allow_unstable=true"],
        )
    )
    found = certify(resolved, ideal_conditions(resolved))
    assert found.constants is None
    assert found.void is not None
    assert "grows" in found.void
    assert found.inter_event_s is None
    for envelope in (found.sensor_error, found.controller_error, found.state):
        assert np.isnan(envelope(np.linspace(0, 9, 4))).all()
    assert (found.assumptions[-2].what, found.assumptions[-2].verdict) == (
        "there is a certificate", AssumptionStatus.VIOLATED,
    )  # fmt: skip
    slow = certify(
        resolve(load(ROOT / "scenarios/lane_following.toml")), NetworkConditions(4, 0.5, 0.5)
    )
    assert slow.void is not None
    assert "not below 1" in slow.void


def test_the_assumptions_are_checked_for_the_scenario() -> None:
    resolved = resolve(load(ROOT / "scenarios/lane_following.toml"))
    found = certify(resolved, NetworkConditions(4, 0.002, 0.002, 0.004, 0.005, 0.004))
    verdicts = [assumption.verdict for assumption in found.assumptions]
    assert verdicts == [AssumptionStatus.HOLDS] * 3 + [AssumptionStatus.ASSUMED] * 4 + [
        AssumptionStatus.HOLDS, AssumptionStatus.NOT_NEEDED,
    ]  # fmt: skip
    free = resolved.network.model_copy(update={"enforce_mansd": False})
    found = certify(resolved.model_copy(update={"network": free}), ideal_conditions(resolved))
    assert found.assumptions[2].verdict == AssumptionStatus.ASSUMED


def test_the_lane_example_in_a_weight_from_any_lyapunov_function() -> None:
    """Δ = M = 5, exactly; and δ is at least 100 times the 60 µs that Theorem 2 prints."""
    resolved = resolve(load(ROOT / "scenarios/lane_following.toml"))
    loop, plain = loop_of(resolved), certify(resolved, ideal_conditions(resolved)).constants
    assert plain is not None
    printed = theorem_2(loop, 0.5, 0.25, plain.delta)
    assert printed is not None
    assert printed.inter_event_s == pytest.approx(60.3e-6, rel=0.01)
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
        assert found.inter_event_s >= 100 * printed.inter_event_s


@pytest.mark.parametrize("beta", [1e-300, 1e-310, 5e-324])
def test_a_threshold_without_an_inter_event_time_is_rejected_in_few_steps(
    beta: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks, growth = 0, ErrorGains.growth

    def counted(*arguments: Any) -> Any:
        nonlocal looks
        looks += 1
        return growth(*arguments)

    monkeypatch.setattr(ErrorGains, "growth", counted)
    path = ROOT / "scenarios" / "lane_following.toml"
    resolved = resolve(load(path, [f"trigger.beta={beta}"]))
    for found in (certify, certify_box):
        certificate = found(resolved, ideal_conditions(resolved))
        assert certificate is not None
        assert (certificate.constants is None) == (certificate.void is not None)
    assert looks < 500
