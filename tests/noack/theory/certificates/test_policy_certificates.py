"""Certificates of trigger policies in continuous time.

``certificate_kinds`` has the loops with sampled tests, and the broken copies.
"""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings

from cosim.simulation.continuous import ContinuousLoop, TooManyEventsError, simulate_continuous
from noack.scenario.resolution import loop_of, policy_of, resolve
from noack.scenario.scenario_file import load
from noack.theory.bounds.certificate_terms import NetworkConditions
from noack.theory.certificates.certified_bounds import known_state_bounds
from noack.theory.certificates.conditions import allowed_conditions
from noack.theory.certificates.scenario_certificates import certify
from tests.noack.theory.certificates.certificate_kinds.policies import INSTANT, POLICY_KINDS, policy_case
from tests.oracles.lossy_loops import ROUNDING, SEARCH, System, networks, seeds, systems

SCENARIO = Path(__file__).parents[4] / "scenarios" / "double_integrator.toml"


def test_a_short_deadline_adds_decay_to_a_constant_threshold() -> None:
    rule = '{policy="absolute", delta=0.01}'
    t_s, missing = np.array([0.0, 1.0, 3.0, 10.0, 1e3]), np.zeros(5, np.int64)
    resolved = resolve(load(SCENARIO, [f"trigger={rule}"]))
    alone = certify(resolved, allowed_conditions(resolved)).state(t_s)
    for interval_s, decays in ((0.02, True), (1.0, False)):
        trigger = f'trigger={{policy="deadline", interval_s={interval_s}, rule={rule}}}'
        resolved = resolve(load(SCENARIO, [trigger]))
        certificate = certify(resolved, allowed_conditions(resolved))
        assert certificate.unit == ""  # the errors' constants are absolute
        short = certificate.state(t_s)
        assert (short <= alone * ROUNDING).all()
        assert short[-1] < 1e-100 if decays else short[-1] == pytest.approx(alone[-1])
        known = known_state_bounds(resolved, certificate)
        assert known is not None
        for bound in (known.state_deviation(t_s, t_s, missing), known.controller_error(t_s, missing)):
            assert bound[-1] < 1e-100 if decays else bound[-1] > 0.0


@pytest.mark.parametrize("kind", sorted(POLICY_KINDS.keys() - {"lyapunov", "relative"}))
@settings(SEARCH, max_examples=1)
@given(systems(**INSTANT), seeds)
def test_no_bound_of_a_policy_is_exceeded_in_continuous_time(kind: str, system: System, seed: int) -> None:
    """Events of "relative" may accumulate, so that it has no certificate."""
    resolved, _, system = policy_case(kind, system, seed)
    certificate = certify(resolved, NetworkConditions(system.mansd))
    assume(certificate.constants is not None)
    loop = ContinuousLoop(loop_of(resolved), policy_of(resolved))
    horizon_s = 6 / float(np.abs(np.linalg.eigvals(system.A + system.B @ system.K)).max())
    for delivered in networks(seed, system)[0][:3].tolist():  # most lost, none, at random
        try:
            run = simulate_continuous(
                loop, horizon_s=horizon_s, delivered=delivered, known_start=True,
                max_events=len(delivered),
            )  # fmt: skip
        except TooManyEventsError:
            continue
        samples = run.at(np.linspace(0.0, run.reached_s, 200))
        slack = (ROUNDING - 1) * certificate.state(samples.t_s)
        for seen, bound in (
            (run.system.norms(samples.e_s), certificate.sensor_error(samples.t_s)),
            (run.system.norms(samples.e_c), certificate.controller_error(samples.t_s)),
            (np.linalg.norm(samples.x, axis=1), certificate.state(samples.t_s)),
        ):
            assert (seen <= ROUNDING * bound + slack).all()
        least_s = certificate.inter_event_s or 0.0
        assert np.diff(run.event_s).min(initial=np.inf) >= least_s / ROUNDING - 1e-9
