"""Certificates of every trigger policy: under disturbances, in continuous time, with a deadline.

``certificate_kinds/policies.py`` has the loops without them, and the broken copies.
"""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from noack.scenario.resolution import policy_of, resolve
from noack.scenario.scenario_file import load
from noack.theory.bounds.terms import NetworkConditions
from noack.theory.certificates.certified_bounds import known_state_bounds
from noack.theory.certificates.conditions import allowed_conditions
from noack.theory.certificates.scenario_certificates import certify
from tests.noack.theory.certificate_kinds.policies import (
    INSTANT,
    POLICY_KINDS,
    exceeded_by,
    policy_case,
)
from tests.noack.theory.disturbed_loops import DisturbedLoop, signals
from tests.noack.theory.exact_loops import observe
from tests.oracles.lossy_loops import (
    ROUNDING,
    SEARCH,
    STEPS,
    System,
    networks,
    seeds,
    simulate,
    systems,
)

SCENARIO = Path(__file__).parents[3] / "scenarios" / "double_integrator.toml"


@pytest.mark.parametrize("kind", POLICY_KINDS)
@settings(SEARCH, max_examples=3)
@given(systems(step_share=0.002), st.sampled_from([0.02, 0.3]), seeds)
def test_no_bound_of_a_policy_is_exceeded_under_disturbances(
    kind: str, system: System, push: float, seed: int
) -> None:
    resolved, rule, system = policy_case(kind, system, seed, push)
    certificate, n = certify(resolved, system.conditions), len(system.A)
    if certificate.constants is not None:
        loop = DisturbedLoop(system, push * np.eye(n), (STEPS,) * n, np.zeros(n), 0.0)
        pushes, _ = signals(loop, np.random.default_rng(seed))
        trace = simulate(system, *networks(seed, system), rule=rule, pushes=pushes)
        assert exceeded_by(trace, certificate, system) == []


@pytest.mark.parametrize("kind", sorted(POLICY_KINDS.keys() - {"lyapunov"}))
@settings(SEARCH, max_examples=3)
@given(systems(**INSTANT), seeds)
def test_no_bound_of_a_policy_is_exceeded_in_continuous_time(
    kind: str, system: System, seed: int
) -> None:
    resolved, _, system = policy_case(kind, system, seed)
    certificate = certify(resolved, NetworkConditions(system.mansd))
    if certificate.constants is None:
        return
    least_s = certificate.inter_event_s or 0.0
    for run, samples in observe(system, 6.0, seed, policy=policy_of(resolved)):
        slack = ROUNDING - 1
        for seen, bound in (
            (run.system.norms(samples.e_s), certificate.sensor_error(samples.t_s)),
            (run.system.norms(samples.e_c), certificate.controller_error(samples.t_s)),
            (np.linalg.norm(samples.x, axis=1), certificate.state(samples.t_s)),
        ):
            assert (seen <= ROUNDING * bound + slack * certificate.state(samples.t_s)).all()
        assert np.diff(run.event_s).min(initial=np.inf) >= least_s / ROUNDING - 1e-9


@pytest.mark.parametrize(("interval_s", "decays"), [(0.02, True), (1.0, False)])
def test_a_short_deadline_adds_decay_to_a_constant_threshold(
    interval_s: float, *, decays: bool
) -> None:
    rule = '{policy="absolute", delta=0.01}'
    found = []
    for trigger in (rule, f'{{policy="deadline", interval_s={interval_s}, rule={rule}}}'):
        resolved = resolve(load(SCENARIO, [f"trigger={trigger}"]))
        found.append(certify(resolved, allowed_conditions(resolved)))
        assert found[-1].unit == ""  # the errors' constants are absolute
    t_s = np.array([0.0, 1.0, 3.0, 10.0, 1e3])
    alone, short = (one.state(t_s) for one in found)
    assert (short <= alone * ROUNDING).all()
    assert short[-1] < 1e-100 if decays else short[-1] == pytest.approx(alone[-1])
    known = known_state_bounds(resolved, found[-1])
    assert known is not None
    missing = np.zeros(len(t_s), np.int64)
    for bound in (known.state_deviation(t_s, t_s, missing), known.controller_error(t_s, missing)):
        assert bound[-1] < 1e-100 if decays else bound[-1] > 0.0
