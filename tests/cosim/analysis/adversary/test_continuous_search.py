"""The search in continuous time against all patterns tried one by one."""

import math
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from cosim.analysis.adversary import WorstRun
from cosim.analysis.adversary.loop_flows import Objective, evaluate
from cosim.analysis.adversary.pattern_search import PatternSearch, search_tree
from cosim.analysis.adversary.scenario_search import find_worst as find_any
from cosim.analysis.scenario_certificates import quick_certificate
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from tests.cosim.analysis.adversary.scenarios import every_run, flow_of, scenarios, simulate
from tests.helpers.shipped import resolved as resolved_shipped

MANY = settings(suppress_health_check=list(HealthCheck), phases=[Phase.generate])

find_worst = partial(find_any, continuous=True)


def signed(worst: WorstRun) -> float:
    if worst.value is None:
        return -math.inf
    return -worst.value if worst.objective is Objective.INTER_EVENT else worst.value


def rate_of(resolved: Scenario) -> float | None:
    proven = quick_certificate(resolved, ideal=True).proven
    return None if proven is None else proven.rate_per_s


@given(resolved=scenarios(5, mansd=2, window=(2, 5), recovery=2))
@settings(MANY, max_examples=4)
def test_the_search_finds_the_worst_of_all_patterns(resolved: Scenario) -> None:
    """Also without initial patterns, so that only the tree's own branches can find it."""
    runs = list(every_run(resolved))
    for objective in Objective:
        flow = flow_of(resolved, objective, rate_of(resolved))
        expected = max(evaluate(run, flow.measure).value for run in runs)
        worst = find_worst(resolved, objective, beam=0)
        assert worst.exact
        assert signed(worst) == pytest.approx(expected, rel=1e-9)
        assert objective is Objective.COST or not worst.breaches, worst
        tree = PatternSearch(flow, resolved.network.guarantee)
        assert search_tree(tree, 10**6)
        assert tree.value == pytest.approx(expected, rel=1e-6)


@given(
    resolved=scenarios(20),
    objective=st.sampled_from(Objective),
    most_nodes=st.sampled_from([0, 2000]),
)
@settings(max_examples=4)
def test_the_pattern_is_admissible_and_has_the_reported_value(
    resolved: Scenario, objective: Objective, most_nodes: int
) -> None:
    worst = find_worst(resolved, objective, most_nodes=most_nodes, beam=16)
    run = simulate(resolved, worst.pattern)
    assert tuple(run.delivered.tolist()) == worst.pattern, "the cap would have forced a delivery"
    assert run.event_s.tolist() == list(worst.event_s)
    measure = flow_of(resolved, objective, rate_of(resolved)).measure
    assert evaluate(run, measure).value == signed(worst)
    for milder in (worst.lossless, worst.with_own_network):
        best = signed(replace(worst, value=milder))
        assert best <= signed(worst) or best == pytest.approx(signed(worst), rel=1e-9)


def test_a_certificate_that_forgets_a_dropout_is_refuted() -> None:
    """M = 2: for no dropout, Δ would be 1, and almost any loss refutes that."""
    refuted = []

    @given(resolved=scenarios(16, mansd=1, window=(1, 1), n=2, alpha_share=0.2))
    @settings(MANY, max_examples=4)
    def attempt(resolved: Scenario) -> None:
        without = resolved.network.model_copy(update={"mansd": 0})
        broken = quick_certificate(resolved.model_copy(update={"network": without}), ideal=True)
        worst = find_worst(resolved, Objective.ERROR, certificate=broken, most_nodes=2000, beam=0)
        refuted.append(worst.breaches)

    attempt()
    assert sum(refuted) >= 0.75 * len(refuted)


def test_a_diverging_loop_has_an_infinite_objective(content: dict[str, Any]) -> None:
    content |= {"model": {"A": [[3.0]], "B": [[1.0]], "gain": [[1.0]]}, "horizon_s": 80.0}
    content["model"]["allow_unstable"] = True
    content["plant"] = {"initial_state": [1.0]}
    worst = find_worst(resolve(validate(content, "small")), Objective.STATE)
    assert worst.diverges
    assert worst.exact
    assert worst.to_json()["value"] is None


@pytest.mark.parametrize("floor", [0.0, 0.03])
def test_unstable_models_and_a_constant_threshold_are_searched(floor: float) -> None:
    """The floor is above β = 0.02; there is neither a certificate nor a bound of the cost to come."""
    unstable = ("model.gain=[[-1.0, -1.0]]", "model.allow_unstable=true", "horizon_s=1.2")
    pendulum = resolved_shipped("unstable_pendulum", *unstable, f"trigger.floor={floor}")
    runs = list(every_run(pendulum))
    for objective in Objective:
        worst = find_worst(pendulum, objective, beam=0)
        measure = flow_of(pendulum, objective, None).measure
        assert worst.exact
        assert worst.certified is None
        assert signed(worst) == pytest.approx(max(evaluate(run, measure).value for run in runs))
