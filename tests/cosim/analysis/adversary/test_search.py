"""The adversary's search against all patterns tried one by one, and against certificates."""

import math
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from cosim.analysis.adversary import Objective, Worst, find_worst
from cosim.analysis.adversary.objective import measure_of
from cosim.analysis.adversary.pattern_evaluation import evaluate
from cosim.analysis.adversary.pattern_tree import search_tree
from noack.config.resolution import resolve
from noack.config.scenario import Scenario
from noack.config.scenario_file import validate
from noack.theory.run_conditions import ideal_conditions
from noack.theory.scenario_certificates import certify
from tests.cosim.analysis.adversary.scenarios import every_run, flow_of, scenarios, simulate

MANY = settings(suppress_health_check=list(HealthCheck), phases=[Phase.generate])


def signed(worst: Worst) -> float:
    if worst.value is None:
        return -math.inf
    return -worst.value if worst.objective is Objective.INTER_EVENT else worst.value


@given(resolved=scenarios(7), objective=st.sampled_from(Objective))
@settings(max_examples=15)
def test_the_exact_search_finds_what_trying_all_finds(
    resolved: Scenario, objective: Objective
) -> None:
    constants = certify(resolved, ideal_conditions(resolved)).constants
    worst = find_worst(resolved, objective, beam=0)
    runs = list(every_run(resolved))
    rate = None if constants is None else constants.rate_per_s
    measure = measure_of(runs[0].system, objective, rate)
    expected = max(evaluate(run, measure).value for run in runs)
    assert worst.exact
    assert signed(worst) == pytest.approx(expected, rel=1e-9)


@given(resolved=scenarios(7, mansd=3), objective=st.sampled_from(Objective))
@settings(max_examples=6)
def test_the_tree_alone_finds_it_too(resolved: Scenario, objective: Objective) -> None:
    """Without initial guesses, so that only the tree's own branches can find the pattern."""
    _, measure, flow = flow_of(resolved, objective)
    found = search_tree(flow, resolved.network.mansd, 10**6)
    expected = max(evaluate(run, measure).value for run in every_run(resolved))
    assert found.complete
    assert found.value == pytest.approx(expected, rel=1e-6)


@given(resolved=scenarios(12), objective=st.sampled_from(Objective))
@settings(MANY, max_examples=8)
def test_the_beam_comes_within_a_hundredth(resolved: Scenario, objective: Objective) -> None:
    exact = signed(find_worst(resolved, objective, most_nodes=20_000, beam=0))
    beam = signed(find_worst(resolved, objective, most_nodes=0, beam=64))
    assert exact - 0.01 * abs(exact) <= beam <= exact + 1e-9 * abs(exact)


@given(
    resolved=scenarios(20),
    objective=st.sampled_from(Objective),
    most_nodes=st.sampled_from([0, 2000]),
)
@settings(max_examples=6)
def test_every_pattern_is_admissible_and_leads_to_what_is_told(
    resolved: Scenario, objective: Objective, most_nodes: int
) -> None:
    worst = find_worst(resolved, objective, most_nodes=most_nodes, beam=16)
    run = simulate(resolved, worst.pattern)
    assert tuple(run.delivered.tolist()) == worst.pattern, "the cap would have stepped in"
    assert run.event_s.tolist() == list(worst.event_s)
    constants = certify(resolved, ideal_conditions(resolved)).constants
    rate = None if constants is None else constants.rate_per_s
    measure = measure_of(run.system, objective, rate)
    assert evaluate(run, measure).value == signed(worst)
    for other in (worst.lossless, worst.own):
        best = signed(replace(worst, value=other))
        assert best <= signed(worst) or best == pytest.approx(signed(worst), rel=1e-9)


@given(resolved=scenarios(12, mansd=2))
@settings(max_examples=10)
def test_the_search_gives_up_at_its_budget_and_says_so(resolved: Scenario) -> None:
    _, _, flow = flow_of(resolved, Objective.ERROR)
    found = search_tree(flow, 2, 10)
    assert not found.complete
    assert found.nodes <= 10
    for nodes in (0, 10):
        assert not find_worst(resolved, Objective.ERROR, most_nodes=nodes, beam=4).exact


@given(resolved=scenarios(12), objective=st.sampled_from(Objective))
@settings(max_examples=5)
def test_the_same_arguments_give_the_same_result(resolved: Scenario, objective: Objective) -> None:
    first, second = (find_worst(resolved, objective, most_nodes=500) for _ in range(2))
    assert first == second


@given(
    resolved=scenarios(12),
    objective=st.sampled_from([Objective.ERROR, Objective.STATE, Objective.INTER_EVENT]),
)
@settings(MANY, max_examples=8)
def test_no_certificate_is_exceeded(resolved: Scenario, objective: Objective) -> None:
    worst = find_worst(resolved, objective, most_nodes=5_000, beam=0)
    assert not worst.breaches, worst


def test_a_certificate_that_forgets_a_dropout_is_caught() -> None:
    """M = 2: for no dropout, Δ would be 1, and almost any loss refutes that."""
    caught = []

    @given(resolved=scenarios(16, mansd=1, n=2, alpha_share=0.2))
    @settings(MANY, max_examples=8)
    def attempt(resolved: Scenario) -> None:
        broken = certify(resolved, ideal_conditions(resolved)._replace(dropouts=0))
        caught.append(find_worst(resolved, Objective.ERROR, certificate=broken).breaches)

    attempt()
    assert sum(caught) >= 0.8 * len(caught)


def test_a_diverging_loop_has_an_infinite_objective(content: dict[str, Any]) -> None:
    content |= {"model": {"A": [[3.0]], "B": [[1.0]], "gain": [[1.0]]}, "horizon_s": 80.0}
    content["model"]["allow_unstable"] = True
    content["plant"] = {"initial_state": [1.0]}
    worst = find_worst(resolve(validate(content, "small")), Objective.STATE)
    assert worst.diverges
    assert worst.exact
    assert worst.to_json()["value"] is None


def test_without_dropouts_there_is_one_pattern(content: dict[str, Any]) -> None:
    content["network"]["mansd"] = 0
    content["horizon_s"] = 20.0
    worst = find_worst(resolve(validate(content, "small")), Objective.ERROR)
    assert worst.exact
    assert all(worst.pattern)
    assert worst.value == worst.lossless
