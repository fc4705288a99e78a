"""Many segments at once, against the reference simulator with one run at a time."""

import numpy as np
import pytest
from hypothesis import given, settings

from cosim.analysis.adversary.loss_patterns import follow
from cosim.analysis.adversary.objective import Objective
from cosim.analysis.adversary.pattern_evaluation import evaluate
from cosim.simulation.continuous.continuous_loop import LoopState
from noack.config.scenario import Scenario
from noack.core.linear_systems import Matrix
from tests.cosim.analysis.adversary.scenarios import flow_of, scenarios, simulate

STATES = 20


def parts(z: Matrix) -> list[Matrix]:
    return np.split(z, 3, axis=-1)


@given(resolved=scenarios(12))
@settings(max_examples=60)
def test_events_are_those_of_the_reference(resolved: Scenario) -> None:
    """Both are exact up to rounding; an almost tangential crossing amplifies the rounding error."""
    system, _, flow = flow_of(resolved, Objective.INTER_EVENT)
    rng, n = np.random.default_rng(0), system.loop.n
    t_s = rng.uniform(0, resolved.horizon_s, STATES)
    z = rng.uniform(-1, 1, (STATES, 3 * n))
    z[:, n : 2 * n] = 0.0
    found = flow(t_s, z)
    for i in range(STATES):
        state = LoopState(t_s[i], *parts(z[i]))
        crossing = system.next_crossing(state, resolved.horizon_s, system.condition(state))
        expected = None if crossing is None else crossing[0]
        assert found.is_event[i] == (expected is not None)
        if expected is not None:
            assert found.end_s[i] == pytest.approx(expected.t_s, rel=1e-9)
            assert found.value[i] == t_s[i] - found.end_s[i]
        else:
            assert found.end_s[i] == resolved.horizon_s
            expected = system.propagate(state, resolved.horizon_s)
        size = np.abs(np.concatenate(expected[1:])).max()
        np.testing.assert_allclose(found.z[i], np.concatenate(expected[1:]), atol=1e-8 * size)


@pytest.mark.parametrize("objective", list(Objective))
@given(resolved=scenarios(12))
@settings(max_examples=30)
def test_a_pattern_is_worth_what_its_run_is(objective: Objective, resolved: Scenario) -> None:
    """The loop amplifies the rounding of event times; the supremum's own resolution is 1e-6."""
    _, measure, flow = flow_of(resolved, objective)
    rng = np.random.default_rng(0)
    wanted = [tuple(row) for row in (rng.uniform(size=(8, 15)) < 0.5).tolist()]
    outcomes = follow(flow, resolved.network.mansd, wanted)
    first = () if resolved.network.initial_sync == "known_state" else (True,)
    for value, pattern, asked in zip(outcomes.value, outcomes.patterns, wanted, strict=True):
        run = simulate(resolved, first + asked)
        assert tuple(run.delivered.tolist()) == first + pattern
        assert value == pytest.approx(evaluate(run, measure).value, rel=1e-6)
